//! The log of the bootloader's actions and refusals, in two sectors used alternately. U-2
//!
//! A failed write is ignored: nothing that boots depends on the log. It counts wrong testers, and a
//! controller with an empty one is new.

use crate::flash_access::{FlashFault, erase, program, read};
use crate::map::{FlashRegion, PAGE_BYTES};
use crate::page::{Page, checksum, word};
use embedded_storage::nor_flash::NorFlash;
use strum::FromRepr;

const MAGIC: [u8; 2] = *b"LG";

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr)]
#[repr(u8)]
pub enum LogEvent {
    /// A download was verified and is on trial. Value: the new version.
    Downloaded = 1,
    /// A download was refused. Value: the refusal's code.
    DownloadRefused,
    /// An image approved itself. Value: the highest approved version of the application.
    Approved,
    /// An image did not approve itself; the previous one boots.
    RolledBack,
    /// An image (active, on trial or in staging) is damaged and is not used.
    SlotDamaged,
    /// `IntegrityOrAuthenticityCheckFailed`; the image was started in monitor mode. E-4
    StartedUntrusted,
    /// `IntegrityOrAuthenticityCheckFailed`; the image was not started, in strict mode. E-4
    RefusedUntrusted,
    /// The boot environment was lost and rebuilt from the slots.
    EnvironmentRebuilt,
    /// A new bootloader was installed and is on trial.
    LoaderInstalled,
    /// The new bootloader approved itself.
    LoaderApproved,
    /// The bootloader was restored from its backup.
    LoaderRestored,
    /// A bank of the bootloader cannot be written. Value: the state of the update.
    LoaderNotWritten,
    /// The boot environment cannot be written: an image on trial is not started.
    NotRecorded,
    /// No start worked for long: the other slot is tried. Value: the number of starts.
    ResetLoop,
    /// A tester's signature was wrong. Value: how many in a row.
    TesterRefused,
    /// A tester has proved that it has a key.
    TesterProved,
}

/// One entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LogEntry {
    /// Sequence number, ascending.
    pub sequence: u32,
    /// What happened.
    pub event: LogEvent,
    /// The value that the event describes.
    pub value: u32,
}

impl LogEntry {
    fn encode(&self) -> Page {
        let mut page = [0; PAGE_BYTES];
        page[..2].copy_from_slice(&MAGIC);
        page[2] = self.event as u8;
        page[4..8].copy_from_slice(&self.sequence.to_le_bytes());
        page[8..12].copy_from_slice(&self.value.to_le_bytes());
        let crc = checksum(&page[..28]);
        page[28..].copy_from_slice(&crc.to_le_bytes());
        page
    }

    fn decode(page: &Page) -> Option<Self> {
        let word = |at: usize| word(page, at);
        let entry = Self {
            sequence: word(4),
            event: LogEvent::from_repr(page[2])?,
            value: word(8),
        };
        let sound = page[..2] == MAGIC && checksum(&page[..28]) == word(28);
        sound.then_some(entry)
    }
}

/// Calls `found` for every readable entry. Returns the offset of the page after the last one. An
/// erased page may be unreadable, or have any value.
fn scan(flash: &mut impl NorFlash, sector: u8, found: &mut dyn FnMut(LogEntry)) -> u32 {
    let range = FlashRegion::Log(sector).range();
    let mut free = range.start;
    for at in range.clone().step_by(PAGE_BYTES) {
        let page = read(flash, at).ok();
        if let Some(entry) = page.as_ref().and_then(LogEntry::decode) {
            found(entry);
            free = at + PAGE_BYTES as u32;
        }
    }
    free
}

/// The end of the log in one of its sectors.
struct End {
    /// The last sequence number, if the sector has an entry.
    newest: Option<u32>,
    /// The page after the last entry.
    free: u32,
}

/// Returns where the log ends in each sector.
#[inline(never)]
fn ends(flash: &mut impl NorFlash) -> [End; 2] {
    [0, 1].map(|sector| {
        let mut newest = None;
        let free = scan(flash, sector, &mut |entry| newest = Some(entry.sequence));
        End { newest, free }
    })
}

/// Returns how many wrong signatures of testers there were since the last right one; `None` if
/// nothing was ever logged.
pub(crate) fn wrong_testers(flash: &mut impl NorFlash) -> Option<u8> {
    let mut wrong = None;
    read_log(flash, &mut |entry| {
        wrong = match entry.event {
            LogEvent::TesterRefused => Some(entry.value as u8),
            LogEvent::TesterProved => Some(0),
            _ => wrong.or(Some(0)),
        };
    });
    wrong
}

/// Calls `found` for every entry, the oldest first.
#[inline(never)]
pub fn read_log(flash: &mut impl NorFlash, found: &mut dyn FnMut(LogEntry)) {
    let [end_0, end_1] = ends(flash);
    let first = u8::from(end_0.newest > end_1.newest);
    scan(flash, first, found);
    scan(flash, 1 - first, found);
}

/// Appends an entry. A loss of power may have left the next page half programmed, so a page that
/// does not read back is skipped.
///
/// # Errors
/// [`FlashFault`] if the entry cannot be written to any page.
pub(crate) fn append(
    flash: &mut impl NorFlash,
    event: LogEvent,
    value: u32,
) -> Result<(), FlashFault> {
    let ends = ends(flash);
    let newest = ends[0].newest.max(ends[1].newest);
    let sequence = newest.map_or(0, |last| last.wrapping_add(1));
    let page = LogEntry {
        sequence,
        event,
        value,
    }
    .encode();
    let sector = u8::from(ends[1].newest > ends[0].newest);
    let end = FlashRegion::Log(sector).range().end;
    for at in (ends[usize::from(sector)].free..end).step_by(PAGE_BYTES) {
        if program(flash, at, &page).is_ok() {
            return Ok(());
        }
    }
    let range = FlashRegion::Log(1 - sector).range();
    erase(flash, range.clone())?;
    program(flash, range.start, &page)
}
