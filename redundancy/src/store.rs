//! The state in data flash: two sectors, a log of records in each, the newest valid one wins.
//! T-RED-1
//!
//! Records are appended to the active sector until it is full; then the other sector is erased and
//! becomes the active one. No operation touches the newest record, so a loss of power at any moment
//! leaves it readable: afterwards the old state or the new one is read.

use crate::{StateDecodeError, SystemState};
use tandem_board::{FlashError, FlashStatus};

const SLOT: u32 = SystemState::BYTES as u32;
/// After this many failed operations in a row the flash counts as broken.
const MAX_FAILURES: u8 = 4;

/// The position of the store in the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// Bytes of a sector; a multiple of [`SystemState::BYTES`].
    pub sector_bytes: u32,
    /// The first of its two sectors.
    pub first_sector: u32,
}

impl Geometry {
    /// The first two sectors of a flash.
    #[must_use]
    pub const fn first_sectors(sector_bytes: u32) -> Self {
        Self {
            sector_bytes,
            first_sector: 0,
        }
    }

    const fn slots(&self) -> u32 {
        self.sector_bytes / SLOT
    }

    const fn offset(&self, sector: u32, slot: u32) -> u32 {
        (self.first_sector + sector) * self.sector_bytes + slot * SLOT
    }
}

/// The result of reading the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Loaded {
    /// The newest state.
    State(SystemState),
    /// The flash was never written.
    Blank,
    /// The flash is not blank, but has no valid record.
    Lost,
}

/// The next operation on the flash.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FlashOp {
    /// Erase this sector.
    Erase {
        /// Number of the sector in the flash.
        sector: u32,
    },
    /// Program these bytes.
    Program {
        /// Offset in the flash.
        offset: u32,
        /// One record.
        data: [u8; SystemState::BYTES],
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Running {
    Nothing,
    Erase,
    Program(SystemState),
}

/// Writes states to the flash, one operation at a time, and never waits.
///
/// Sans-IO: [`StateStore::poll`] gets the state of the flash and returns the operation to start.
#[derive(Clone, Debug)]
pub struct StateStore {
    geometry: Geometry,
    /// The active sector, 0 or 1.
    sector: u32,
    /// The next slot that may be blank; equal to the number of slots if the sector is full.
    slot: u32,
    sequence: u32,
    durable: Option<SystemState>,
    wanted: Option<SystemState>,
    running: Running,
    failures: u8,
}

/// The result of scanning one sector.
#[derive(Clone, Copy, Default)]
struct Sector {
    /// The slot after the last one that is not blank.
    free: u32,
    newest: Option<(SystemState, u32)>,
}

impl StateStore {
    /// Reads both sectors, at the start of a system. `read` copies bytes from an offset of the
    /// flash; a slot that cannot be read counts as invalid.
    pub fn load(
        geometry: Geometry,
        mut read: impl FnMut(u32, &mut [u8]) -> Result<(), FlashError>,
    ) -> (Self, Loaded) {
        let sectors = [0, 1].map(|sector| scan(geometry, sector, &mut read));
        let newest = sectors
            .iter()
            .zip(0..)
            .filter_map(|(found, sector)| found.newest.map(|newest| (newest, sector)))
            .reduce(|a, b| if is_newer(b.0.1, a.0.1) { b } else { a });
        let (loaded, sector, sequence) = match newest {
            Some(((state, sequence), sector)) => (Loaded::State(state), sector, sequence),
            None if sectors.iter().all(|found| found.free == 0) => (Loaded::Blank, 0, 0),
            // Sector 1 counts as active and full, so that the first write erases sector 0.
            None => (Loaded::Lost, 1, 0),
        };
        let lost = loaded == Loaded::Lost;
        let slot = if lost {
            geometry.slots()
        } else {
            sectors[sector as usize].free
        };
        let durable = match loaded {
            Loaded::State(state) => Some(state),
            Loaded::Blank | Loaded::Lost => None,
        };
        let store = Self {
            geometry,
            sector,
            slot,
            sequence,
            durable,
            wanted: None,
            running: Running::Nothing,
            failures: 0,
        };
        (store, loaded)
    }

    /// Requests that `state` be written. A newer request replaces one that has not started.
    pub fn request(&mut self, state: SystemState) {
        self.wanted = Some(state);
    }

    /// Returns the operation to start now, for this state of the flash. Start it before the next
    /// call, or call [`StateStore::refused`].
    #[must_use = "an operation that is returned counts as started"]
    pub fn poll(&mut self, status: FlashStatus) -> Option<FlashOp> {
        if status == FlashStatus::Busy {
            return None;
        }
        self.finish(status == FlashStatus::Failed);
        if self.is_broken() {
            return None;
        }
        let state = self.wanted?;
        if self.durable == Some(state) {
            self.wanted = None;
            return None;
        }
        if self.slot >= self.geometry.slots() {
            self.sector ^= 1;
            self.slot = 0;
            self.running = Running::Erase;
            return Some(FlashOp::Erase {
                sector: self.geometry.first_sector + self.sector,
            });
        }
        self.wanted = None;
        self.running = Running::Program(state);
        let sequence = self.sequence.wrapping_add(1);
        let offset = self.geometry.offset(self.sector, self.slot);
        Some(FlashOp::Program {
            offset,
            data: state.encode(sequence),
        })
    }

    /// Reports that the operation of the last [`StateStore::poll`] was not started; a later poll
    /// returns it again.
    pub fn refused(&mut self) {
        match core::mem::replace(&mut self.running, Running::Nothing) {
            Running::Nothing => {}
            Running::Erase => self.step_back(),
            Running::Program(state) => self.wanted = self.wanted.or(Some(state)),
        }
    }

    /// Returns whether every requested state is in flash, or the flash is broken.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.is_broken() || (self.wanted.is_none() && self.running == Running::Nothing)
    }

    /// Returns whether the flash failed so often in a row that the store has given up. The system
    /// can continue, but its next start will read an old state.
    #[must_use]
    pub fn is_broken(&self) -> bool {
        self.failures >= MAX_FAILURES
    }

    /// Returns the newest state that is known to be in flash.
    #[must_use]
    pub fn durable(&self) -> Option<&SystemState> {
        self.durable.as_ref()
    }

    /// Handles the end of the running operation.
    fn finish(&mut self, failed: bool) {
        match core::mem::replace(&mut self.running, Running::Nothing) {
            Running::Nothing => return,
            Running::Erase if failed => self.step_back(),
            Running::Erase => {}
            Running::Program(state) => {
                // The slot is used up either way, and so is the sequence number: a failed program
                // may have written a whole record.
                self.slot += 1;
                self.sequence = self.sequence.wrapping_add(1);
                if failed {
                    self.wanted = self.wanted.or(Some(state));
                } else {
                    self.durable = Some(state);
                }
            }
        }
        self.failures = if failed { self.failures + 1 } else { 0 };
    }

    /// Makes the full sector active again, because the other one is not erased.
    fn step_back(&mut self) {
        self.sector ^= 1;
        self.slot = self.geometry.slots();
    }
}

/// Returns whether the record with the first sequence number was written after that with the
/// second. The numbers wrap around; the numbers in the two sectors are close to each other.
const fn is_newer(sequence: u32, than: u32) -> bool {
    (sequence.wrapping_sub(than) as i32) > 0
}

fn scan(
    geometry: Geometry,
    sector: u32,
    read: &mut impl FnMut(u32, &mut [u8]) -> Result<(), FlashError>,
) -> Sector {
    let mut found = Sector::default();
    for slot in 0..geometry.slots() {
        let mut bytes = [0; SystemState::BYTES];
        let decoded = match read(geometry.offset(sector, slot), &mut bytes) {
            Ok(()) => SystemState::decode(&bytes),
            Err(_) => Err(StateDecodeError::Invalid),
        };
        if decoded == Err(StateDecodeError::Blank) {
            continue;
        }
        found.free = slot + 1;
        if let Ok((state, sequence)) = decoded
            && found
                .newest
                .is_none_or(|(_, newest)| is_newer(sequence, newest))
        {
            found.newest = Some((state, sequence));
        }
    }
    found
}
