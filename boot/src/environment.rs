//! The boot environment, in two copies: what boots, what is on trial, what is refused. U-2, U-3
//!
//! Each copy has its own sector, whose slots are filled one after the other, so that few changes
//! need an erase. A change is written to one copy and then to the other. A slot holds a record and
//! a page that confirms it, programmed after the record was read back. A confirmation that reads
//! as right, even by chance, proves that its record is firm. A page that a loss of power left half
//! programmed may read as erased, as right, or differently each time. A slot that was begun with
//! such a page may be lost later, but only in one copy: before the next slot of the second copy is
//! begun, the first copy has a whole record, and a slot with a whole record never looks erased
//! again. `docs/boot.md` explains why the copies survive any two losses of power in a row.

use crate::flash_access::{FlashFault, erase, program, read};
use crate::map::{FlashRegion, PAGE_BYTES, SMALLEST_SECTOR, Slot};
use crate::page::{checksum, word};
use embedded_storage::nor_flash::NorFlash;
use strum::{FromRepr, VariantArray};

/// Bytes of a record.
pub const RECORD_BYTES: usize = 2 * PAGE_BYTES;
/// A record and its confirmation.
const SLOT_BYTES: u32 = 3 * PAGE_BYTES as u32;
/// Slots of a copy. Its sector is erased once for this number of changes.
const SLOTS: u32 = SMALLEST_SECTOR / SLOT_BYTES;
/// Slots that a start leaves for the application.
const RESERVE: u32 = 12;
/// So many slots are tried before the sector is erased.
const ATTEMPTS: u32 = 3;
const MAGIC: [u8; 4] = *b"TENV";
const CONFIRMED: [u8; 4] = *b"FIRM";
/// A record counts only if this many reads agree.
const READS: usize = 3;

/// A choice of slots. `None` means no slot yet; in a trial it means unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Selection {
    /// The slot of the application.
    pub application: Option<Slot>,
    /// The slot of the configuration.
    pub configuration: Option<Slot>,
}

impl Selection {
    /// Returns these slots, and those of `other` where this leaves them unchanged.
    #[must_use]
    pub fn over(self, other: Self) -> Self {
        Self {
            application: self.application.or(other.application),
            configuration: self.configuration.or(other.configuration),
        }
    }
}

/// Downloaded images that have not approved themselves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trial {
    /// The slots with new images.
    pub selection: Selection,
    /// Whether they were started.
    pub executed: bool,
    /// Whether both systems have found that they work. A start does not roll them back then,
    /// because the other system may have approved them.
    pub ready: bool,
    /// Whether all of them are signed by an accepted key. Only then does their approval raise what
    /// is refused.
    pub authentic: bool,
}

/// The progress of an update of the bootloader itself. A write of the environment ends each state,
/// and the work of a state may be repeated from its beginning. U-4
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
pub enum LoaderUpdate {
    /// No update.
    #[default]
    Idle,
    /// The new bootloader is in staging, verified. Next: copy the running one to the backup bank.
    Staged,
    /// The backup is complete. Next: write the new bootloader to the primary bank, not sealed.
    Installing,
    /// The primary bank holds the new bootloader, not sealed. The backup boots and starts it.
    Trial,
    /// The new bootloader was started. If the backup boots again, the new one has failed.
    TrialExecuted,
    /// The new bootloader has approved itself. Next: seal it.
    Sealing,
    /// The new bootloader has failed. Next: copy the backup to the primary bank, sealed.
    Restoring,
    /// The primary bank cannot be written. The backup runs, and a new bootloader may be tried.
    BackupOnly,
}

/// The content of the boot environment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// The approved images, which boot.
    pub active: Selection,
    /// The images on trial, if any.
    pub trial: Option<Trial>,
    /// The update of the bootloader itself.
    pub loader: LoaderUpdate,
    /// The highest approved version of each kind. Lower versions are refused.
    pub versions: [u32; 3],
    /// The number of the lowest accepted key.
    pub lowest_key: u8,
}

impl Environment {
    /// Returns whether a start only boots what is approved.
    const fn is_quiet(&self) -> bool {
        self.trial.is_none() && matches!(self.loader, LoaderUpdate::Idle | LoaderUpdate::BackupOnly)
    }

    /// Encodes a record: see `docs/boot.md`.
    #[must_use]
    pub fn encode(&self, sequence: u32) -> [u8; RECORD_BYTES] {
        let slot = |slot: Option<Slot>| slot.map_or(0xFF, |slot| slot as u8);
        let trial = self.trial.unwrap_or(Trial {
            selection: Selection::default(),
            executed: false,
            ready: false,
            authentic: false,
        });
        let mut bytes = [0; RECORD_BYTES];
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4..8].copy_from_slice(&sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&[
            slot(self.active.application),
            slot(self.active.configuration),
            slot(trial.selection.application),
            slot(trial.selection.configuration),
            u8::from(self.trial.is_some())
                | u8::from(trial.executed) << 1
                | u8::from(trial.ready) << 2,
            self.loader as u8,
            self.lowest_key,
            u8::from(trial.authentic),
        ]);
        let (places, _) = bytes[16..28].as_chunks_mut::<4>();
        for (place, version) in places.iter_mut().zip(self.versions) {
            *place = version.to_le_bytes();
        }
        let crc = checksum(&bytes[..60]);
        bytes[60..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Decodes the output of [`Environment::encode`], with the sequence number. Refuses all other
    /// bytes.
    #[must_use]
    pub fn decode(bytes: &[u8; RECORD_BYTES]) -> Option<(Self, u32)> {
        let word = |at: usize| word(bytes, at);
        let trial = Trial {
            selection: Selection {
                application: Slot::from_repr(bytes[10]),
                configuration: Slot::from_repr(bytes[11]),
            },
            executed: bytes[12] & 2 > 0,
            ready: bytes[12] & 4 > 0,
            authentic: bytes[15] == 1,
        };
        let environment = Self {
            active: Selection {
                application: Slot::from_repr(bytes[8]),
                configuration: Slot::from_repr(bytes[9]),
            },
            trial: (bytes[12] > 0).then_some(trial),
            loader: LoaderUpdate::from_repr(bytes[13])?,
            versions: [word(16), word(20), word(24)],
            lowest_key: bytes[14],
        };
        let sequence = word(4);
        // Each environment has one encoding: this checks magic number, checksum and unused bytes.
        (environment.encode(sequence) == *bytes).then_some((environment, sequence))
    }
}

/// The content of one copy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Copy {
    environment: Environment,
    sequence: u32,
    confirmed: bool,
}

/// The environment in the flash.
#[derive(Clone, Debug)]
pub struct EnvironmentStore {
    current: Environment,
    sequence: u32,
    /// The copy that is kept while the other one is written.
    base: u8,
    /// Whether that copy holds the current environment, confirmed.
    is_current: bool,
    /// Whether both copies do.
    settled: bool,
    /// The next slot of each copy; [`SLOTS`] if its sector must be erased first.
    next: [u32; 2],
}

impl EnvironmentStore {
    /// Reads both copies. Returns `None` if neither holds a record that can be read: the controller
    /// is new, or lost both.
    pub fn load(flash: &mut impl NorFlash) -> Option<Self> {
        let [(first, next_first), (second, next_second)] = [0, 1].map(|copy| newest(flash, copy));
        let copies = [first, second];
        let rank = |copy: &Copy| (copy.confirmed, copy.sequence);
        // If both copies are equal, keep the second, so that a change writes the first copy first.
        let base = match copies.map(|copy| copy.as_ref().map(rank)) {
            [first, second] if first > second => 0,
            _ => 1,
        };
        copies[usize::from(base)].map(|copy| {
            // A torn slot that cannot be read now may be read in another life. It must then be
            // older than what this life has acted on.
            let acts = !copy.environment.is_quiet();
            let settled = copies[0] == copies[1] && copy.confirmed && !acts;
            Self {
                current: copy.environment,
                // What is written again is newer than what may be read differently the next time.
                sequence: copy.sequence.wrapping_add(u32::from(!settled)),
                base,
                is_current: copy.confirmed && !acts,
                settled,
                next: [next_first, next_second],
            }
        })
    }

    /// Creates a store with a first environment; [`EnvironmentStore::settle`] writes it.
    #[must_use]
    #[inline(never)]
    pub const fn new(environment: Environment) -> Self {
        Self {
            current: environment,
            sequence: 1,
            base: 1,
            is_current: false,
            settled: false,
            next: [SLOTS; 2],
        }
    }

    /// Returns the current environment.
    #[must_use]
    pub const fn get(&self) -> &Environment {
        &self.current
    }

    /// Makes both copies equal after a loss of power. Call it before anything acts on the
    /// environment. If one copy cannot be written, because its sector is worn out, the other copy
    /// is left alone. But if that is older, it is written too, although a loss of power during its
    /// erase would then lose both.
    ///
    /// # Errors
    /// [`FlashFault`] if no copy can be written.
    pub fn settle(&mut self, flash: &mut impl NorFlash) -> Result<(), FlashFault> {
        if self.settled {
            return Ok(());
        }
        let first = self.write_copy(flash, 1 - self.base);
        if first.is_err() && self.is_current {
            return Ok(());
        }
        let second = self.write_copy(flash, self.base);
        match (first, second) {
            (Ok(()), Ok(())) => (self.base, self.settled) = (1, true),
            (Ok(()), Err(FlashFault)) => self.base = 1 - self.base,
            (Err(FlashFault), second) => second?,
        }
        self.is_current = true;
        Ok(())
    }

    /// Erases early, so that an application that writes the environment need not: its core would
    /// stand still for the erase. Writes both copies again if one of them is nearly full.
    pub(crate) fn make_room(&mut self, flash: &mut impl NorFlash) -> Result<(), FlashFault> {
        let mut nearly_full = false;
        for next in &mut self.next {
            if *next > SLOTS - RESERVE {
                (*next, nearly_full) = (SLOTS, true);
            }
        }
        match nearly_full {
            true => self.write(flash, self.current),
            false => Ok(()),
        }
    }

    /// Replaces the environment in both copies. Atomic: after a loss of power at any moment, the
    /// old or the new environment is read.
    ///
    /// # Errors
    /// [`FlashFault`] if no copy can be written; the flash then holds the old or the new
    /// environment, or none.
    pub fn write(
        &mut self,
        flash: &mut impl NorFlash,
        environment: Environment,
    ) -> Result<(), FlashFault> {
        (self.current, self.is_current, self.settled) = (environment, false, false);
        self.sequence = self.sequence.wrapping_add(1);
        self.settle(flash)
    }

    /// Writes a record to the next slot of a copy. A slot with a torn page does not read back.
    fn write_copy(&mut self, flash: &mut impl NorFlash, copy: u8) -> Result<(), FlashFault> {
        let record = self.current.encode(self.sequence);
        let next = &mut self.next[usize::from(copy)];
        for _ in 0..ATTEMPTS {
            if *next >= SLOTS {
                break;
            }
            *next += 1;
            if write_slot(flash, slot_at(copy, *next - 1), &record).is_ok() {
                return Ok(());
            }
        }
        *next = SLOTS;
        erase(flash, FlashRegion::Environment(copy).range())?;
        *next = 1;
        write_slot(flash, slot_at(copy, 0), &record)
    }
}

/// Returns the offset of a slot of a copy.
#[inline(never)]
const fn slot_at(copy: u8, slot: u32) -> u32 {
    FlashRegion::Environment(copy).range().start + slot * SLOT_BYTES
}

fn write_slot(
    flash: &mut impl NorFlash,
    at: u32,
    record: &[u8; RECORD_BYTES],
) -> Result<(), FlashFault> {
    let (pages, _) = record.as_chunks::<PAGE_BYTES>();
    for (page, at) in pages.iter().zip((at..).step_by(PAGE_BYTES)) {
        program(flash, at, page)?;
    }
    program(flash, at + RECORD_BYTES as u32, &confirmation(record))
}

/// Returns the newest record of a copy, and the slot after the last one that can be read.
#[inline(never)]
fn newest(flash: &mut impl NorFlash, copy: u8) -> (Option<Copy>, u32) {
    let rank = |copy: &Copy| (copy.confirmed, copy.sequence);
    let (mut newest, mut next): (Option<Copy>, u32) = (None, 0);
    for slot in 0..SLOTS {
        let Ok(Some(found)) = read_slot(flash, slot_at(copy, slot)) else {
            continue;
        };
        next = slot + 1;
        if newest.as_ref().map(rank) < Some(rank(&found)) {
            newest = Some(found);
        }
    }
    (newest, next)
}

/// Returns the confirmation page of a record.
#[inline(never)]
fn confirmation(record: &[u8; RECORD_BYTES]) -> [u8; PAGE_BYTES] {
    let mut page = [0; PAGE_BYTES];
    page[..4].copy_from_slice(&CONFIRMED);
    page[4..8].copy_from_slice(&record[4..8]);
    page[8..12].copy_from_slice(&record[60..]);
    page
}

fn read_slot(flash: &mut impl NorFlash, start: u32) -> Result<Option<Copy>, FlashFault> {
    let record: [u8; RECORD_BYTES] = read(flash, start)?;
    let Some((environment, sequence)) = Environment::decode(&record) else {
        return Ok(None);
    };
    let mut confirmed = true;
    for _ in 0..READS {
        if read(flash, start)? != record {
            return Ok(None);
        }
        // A page that cannot be read confirms nothing.
        let page = read(flash, start + RECORD_BYTES as u32);
        confirmed &= page == Ok(confirmation(&record));
    }
    Ok(Some(Copy {
        environment,
        sequence,
        confirmed,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn slots() -> impl Strategy<Value = Selection> {
        let slot = || prop::option::of(prop::sample::select(&Slot::ALL[..]));
        (slot(), slot()).prop_map(|(application, configuration)| Selection {
            application,
            configuration,
        })
    }

    proptest! {
        /// U-2, U-3
        #[test]
        fn what_is_encoded_is_decoded(
            active in slots(),
            trial in prop::option::of((slots(), any::<[bool; 3]>())),
            loader in prop::sample::select(LoaderUpdate::VARIANTS),
            versions: [u32; 3],
            lowest_key: u8,
            sequence: u32,
        ) {
            let trial = trial.map(|(selection, [executed, ready, authentic])| Trial {
                selection,
                executed,
                ready,
                authentic,
            });
            let environment = Environment { active, trial, loader, versions, lowest_key };
            let bytes = environment.encode(sequence);
            prop_assert_eq!(Environment::decode(&bytes), Some((environment, sequence)));
        }

        /// U-5: a changed record is refused.
        #[test]
        fn a_changed_record_is_none(place in 0..RECORD_BYTES, value: u8) {
            let mut bytes = Environment::default().encode(7);
            let changed = bytes[place] != value;
            bytes[place] = value;
            prop_assert_eq!(Environment::decode(&bytes).is_none(), changed);
        }
    }
}
