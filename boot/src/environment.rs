//! The boot environment: what boots, what is on trial, what is refused. Kept twice. U-2, U-3
//!
//! Each copy has a sector of its own. A change is written to one copy and then to the other, and
//! each time the sector is erased first: a page that a loss of power left half programmed may read
//! as erased, as right, or differently each time, so no page is ever programmed in a later life
//! than the one that erased it. A copy is a record and a confirmation page behind it, which is
//! programmed when the record has been read back. A confirmation that reads as right, even by
//! luck, proves that its record is firm. `docs/boot.md` says why two copies survive any two losses
//! of power in a row.

use crate::flash_access::{FlashFault, erase, program, read};
use crate::map::{FlashRegion, PAGE_BYTES, Slot};
use crate::page::{CRC_32, word};
use embedded_storage::nor_flash::NorFlash;
use strum::{FromRepr, VariantArray};

const RECORD_BYTES: usize = 2 * PAGE_BYTES;
const MAGIC: [u8; 4] = *b"TENV";
const CONFIRMED: [u8; 4] = *b"FIRM";
/// A record that differs between this many reads is not a record.
const READS: usize = 3;

/// Which slots; `None` for "none yet", or "as before" in a trial.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Selection {
    /// The slot of the application.
    pub application: Option<Slot>,
    /// The slot of the configuration.
    pub configuration: Option<Slot>,
}

/// Images that were downloaded and have not approved themselves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Trial {
    /// What is new.
    pub selection: Selection,
    /// Whether it was started.
    pub executed: bool,
}

/// How far an update of the bootloader itself is. Each state is left by a write of the
/// environment, and what is done in it may be done again from its beginning. U-4
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
pub enum LoaderUpdate {
    /// There is none.
    #[default]
    Idle,
    /// The new one lies in staging, verified. Next: copy the running one to the backup.
    Staged,
    /// The backup is whole. Next: write the new one to the primary bank, not sealed.
    Installing,
    /// The primary bank holds the new one, not sealed, so the backup boots and starts it.
    Trial,
    /// The new one was started. If the backup boots again, it has failed.
    TrialExecuted,
    /// The new one has approved itself. Next: seal it.
    Sealing,
    /// The new one has failed. Next: copy the backup to the primary bank, sealed.
    Restoring,
}

/// The content of the boot environment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// What has approved itself and boots.
    pub active: Selection,
    /// What is to approve itself, if anything.
    pub trial: Option<Trial>,
    /// The update of the bootloader itself.
    pub loader: LoaderUpdate,
    /// The highest version that has approved itself, by kind. Lower ones are not taken.
    pub versions: [u32; 3],
    /// The lowest key that is accepted.
    pub lowest_key: u8,
}

impl Environment {
    fn encode(&self, sequence: u32) -> [u8; RECORD_BYTES] {
        let slot = |slot: Option<Slot>| slot.map_or(0xFF, |slot| slot as u8);
        let trial = self.trial.unwrap_or(Trial {
            selection: Selection::default(),
            executed: false,
        });
        let mut bytes = [0; RECORD_BYTES];
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4..8].copy_from_slice(&sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&[
            slot(self.active.application),
            slot(self.active.configuration),
            slot(trial.selection.application),
            slot(trial.selection.configuration),
            u8::from(self.trial.is_some()) + u8::from(trial.executed),
            self.loader as u8,
            self.lowest_key,
            0,
        ]);
        let (places, _) = bytes[16..28].as_chunks_mut::<4>();
        for (place, version) in places.iter_mut().zip(self.versions) {
            *place = version.to_le_bytes();
        }
        let crc = CRC_32.checksum(&bytes[..60]);
        bytes[60..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    fn decode(bytes: &[u8; RECORD_BYTES]) -> Option<(Self, u32)> {
        let word = |at: usize| word(bytes, at);
        let trial = Trial {
            selection: Selection {
                application: Slot::from_repr(bytes[10]),
                configuration: Slot::from_repr(bytes[11]),
            },
            executed: bytes[12] == 2,
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
        // One encoding for each environment, with its magic number and its checksum.
        (environment.encode(sequence) == *bytes).then_some((environment, sequence))
    }
}

/// What one copy reads as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Copy {
    environment: Environment,
    sequence: u32,
    confirmed: bool,
}

/// The environment as it is in the flash.
#[derive(Clone, Debug)]
pub struct EnvironmentStore {
    current: Environment,
    sequence: u32,
    /// The copy that stays while the other one is written.
    base: u8,
    /// Both copies hold the current environment, confirmed.
    settled: bool,
}

impl EnvironmentStore {
    /// Reads both copies. `None` if neither holds a record: a new controller, or both were lost.
    ///
    /// # Errors
    /// [`FlashFault`] if the flash cannot be read.
    pub fn load(flash: &mut impl NorFlash) -> Result<Option<Self>, FlashFault> {
        let copies = [read_copy(flash, 0)?, read_copy(flash, 1)?];
        let rank = |copy: &Copy| (copy.confirmed, copy.sequence);
        // Of equal copies the second stays: a change begins with the first.
        let base = match copies.map(|copy| copy.as_ref().map(rank)) {
            [first, second] if first > second => 0,
            _ => 1,
        };
        Ok(copies[usize::from(base)].map(|copy| Self {
            current: copy.environment,
            sequence: copy.sequence,
            base,
            settled: copies[0] == copies[1] && copy.confirmed,
        }))
    }

    /// An environment where there is none; [`EnvironmentStore::settle`] writes it.
    #[must_use]
    pub const fn new(environment: Environment) -> Self {
        Self {
            current: environment,
            sequence: 1,
            base: 1,
            settled: false,
        }
    }

    /// The environment that counts.
    #[must_use]
    pub const fn get(&self) -> &Environment {
        &self.current
    }

    /// Makes both copies equal again after a loss of power. Nothing may act on the environment
    /// before.
    ///
    /// # Errors
    /// [`FlashFault`] if the flash does not take it.
    pub fn settle(&mut self, flash: &mut impl NorFlash) -> Result<(), FlashFault> {
        if !self.settled {
            self.write_copy(flash, 1 - self.base)?;
            self.write_copy(flash, self.base)?;
            (self.base, self.settled) = (1, true);
        }
        Ok(())
    }

    /// Replaces the environment, in both copies. Atomic: after a loss of power at any moment the
    /// old or the new one is read.
    ///
    /// # Errors
    /// [`FlashFault`] if the flash does not take it; the environment is then the old or the new
    /// one.
    pub fn write(
        &mut self,
        flash: &mut impl NorFlash,
        environment: Environment,
    ) -> Result<(), FlashFault> {
        (self.current, self.settled) = (environment, false);
        self.sequence = self.sequence.wrapping_add(1);
        self.settle(flash)
    }

    fn write_copy(&self, flash: &mut impl NorFlash, copy: u8) -> Result<(), FlashFault> {
        let range = FlashRegion::Environment(copy).range();
        let record = self.current.encode(self.sequence);
        let (pages, _) = record.as_chunks::<PAGE_BYTES>();
        erase(flash, range.clone())?;
        for (page, at) in pages.iter().zip((range.start..).step_by(PAGE_BYTES)) {
            program(flash, at, page)?;
        }
        program(
            flash,
            range.start + RECORD_BYTES as u32,
            &confirmation(&record),
        )
    }
}

/// The page behind a record, made from the record.
fn confirmation(record: &[u8; RECORD_BYTES]) -> [u8; PAGE_BYTES] {
    let mut page = [0; PAGE_BYTES];
    page[..4].copy_from_slice(&CONFIRMED);
    page[4..8].copy_from_slice(&record[4..8]);
    page[8..12].copy_from_slice(&record[60..]);
    page
}

fn read_copy(flash: &mut impl NorFlash, copy: u8) -> Result<Option<Copy>, FlashFault> {
    let start = FlashRegion::Environment(copy).range().start;
    let record: [u8; RECORD_BYTES] = read(flash, start)?;
    let mut confirmed = true;
    for _ in 0..READS {
        if read(flash, start)? != record {
            return Ok(None);
        }
        let page: [u8; PAGE_BYTES] = read(flash, start + RECORD_BYTES as u32)?;
        confirmed &= page == confirmation(&record);
    }
    let decoded = Environment::decode(&record);
    Ok(decoded.map(|(environment, sequence)| Copy {
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
            trial in prop::option::of((slots(), any::<bool>())),
            loader in prop::sample::select(LoaderUpdate::VARIANTS),
            versions: [u32; 3],
            lowest_key: u8,
            sequence: u32,
        ) {
            let trial = trial.map(|(selection, executed)| Trial { selection, executed });
            let environment = Environment { active, trial, loader, versions, lowest_key };
            let bytes = environment.encode(sequence);
            prop_assert_eq!(Environment::decode(&bytes), Some((environment, sequence)));
        }

        /// U-5: no change of a record is taken for a record.
        #[test]
        fn a_changed_record_is_none(place in 0..RECORD_BYTES, value: u8) {
            let mut bytes = Environment::default().encode(7);
            let changed = bytes[place] != value;
            bytes[place] = value;
            prop_assert_eq!(Environment::decode(&bytes).is_none(), changed);
        }
    }
}
