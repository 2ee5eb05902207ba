//! A model of the TC297's program flash in memory. A loss of power has the same effects as in real
//! flash.
//!
//! A loss of power interrupts a program or erase operation. Bits that were changing are then
//! *weak*: their value is undefined until their sector is erased. A flash may also wear out, refuse
//! operations, check its pages by an ECC, and erase to 0 (see [`FlashTraits`]).

use chacha20::ChaCha8Rng;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use rand::{Rng, RngExt, SeedableRng};
use std::collections::BTreeMap;
use std::ops::Range;
use strum::{FromRepr, VariantArray};
use tandem_board::Duration;
use tandem_boot::{FLASH_BYTES, PAGE_BYTES, SMALLEST_SECTOR, sector_at};

type Page = [u8; PAGE_BYTES];

/// Moments in one program operation: one before it, and one after each byte.
pub const PROGRAM_TICKS: u64 = PAGE_BYTES as u64 + 1;
/// Moments in one erase operation: one before it, and one after each of 32 parts of the sector.
pub const ERASE_TICKS: u64 = 33;

/// The state in which an interrupted operation leaves the changing bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
pub enum Tear {
    /// They keep their old value: bytes change one after another.
    Clean,
    /// They take random values, which do not change again.
    Noise,
    /// They read differently each time.
    Flicker,
    /// They read differently in each life.
    PerLife,
    /// In one life the whole sector reads as if the operation had finished, in another as if it had
    /// not begun. This is the most misleading case.
    Mimic,
}

/// How one type of flash differs from another.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FlashTraits {
    /// An erased byte is 0 and programming sets bits, as in AURIX; otherwise 0xFF and clears them.
    pub erases_to_0: bool,
    /// Each page has an ECC: a page that was torn, or programmed twice, cannot be read.
    pub ecc: bool,
    /// An erased page cannot be read.
    pub blank_is_unreadable: bool,
    /// So many times a sector can be erased; then each erase fails, and its pages are noise.
    pub endurance: Option<u32>,
    /// How long its operations take.
    pub times: FlashTimes,
}

/// How long operations of a flash take; by default no time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FlashTimes {
    /// Programming a page of 32 bytes.
    pub page: Duration,
    /// Erasing 16 KiB of a sector.
    pub erase: Duration,
}

impl FlashTimes {
    /// Those of AURIX, rounded up: a sector of 256 KiB is erased in one second.
    pub const AURIX: Self = Self {
        page: Duration::from_us(60),
        erase: Duration::from_us(62_500),
    };
}

impl FlashTraits {
    /// The program flash of AURIX: it erases to 0, with an ECC, and an erased page cannot be read.
    pub const AURIX: Self = Self {
        erases_to_0: true,
        ecc: true,
        blank_is_unreadable: true,
        endurance: None,
        times: FlashTimes::AURIX,
    };
}

/// An operation that can fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, VariantArray)]
pub enum FlashOperation {
    /// Reads within a page.
    Read,
    /// Programs a page.
    Program,
    /// Erases a sector.
    Erase,
}

/// Operations in a range that fail.
#[derive(Clone, Debug)]
pub struct Failing {
    /// Where.
    pub range: Range<u32>,
    /// Which operation.
    pub operation: FlashOperation,
    /// So many succeed before.
    pub after: u32,
    /// So many fail then; `u32::MAX` for good.
    pub times: u32,
}

/// A page that is not erased. A weak bit is 1 in `weak` and 0 in `bits`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Cell {
    bits: Page,
    weak: Page,
    tear: Tear,
    /// Programmed once, completely, while it was erased.
    is_whole: bool,
}

impl Cell {
    const ERASED: Self = Self {
        bits: [0xFF; PAGE_BYTES],
        weak: [0; PAGE_BYTES],
        tear: Tear::Clean,
        is_whole: true,
    };
}

/// Why an operation failed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModelError {
    /// Power is lost: every operation fails until [`SimulatedFlash::power_on`].
    PowerLost,
    /// The range is outside the flash, or does not consist of whole pages or sectors.
    Range,
    /// The ECC found a page that was torn, programmed twice, or is erased.
    Ecc,
    /// The sector is worn out.
    Worn,
    /// A [`Failing`] operation.
    Failed,
}

impl NorFlashError for ModelError {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::PowerLost | Self::Ecc | Self::Worn | Self::Failed => NorFlashErrorKind::Other,
            Self::Range => NorFlashErrorKind::NotAligned,
        }
    }
}

/// A random generator whose clone produces the same numbers.
#[derive(Debug)]
struct Noise(ChaCha8Rng);

impl Clone for Noise {
    fn clone(&self) -> Self {
        Self(ChaCha8Rng::deserialize_state(&self.0.serialize_state()))
    }
}

/// A simulated program flash.
#[derive(Clone, Debug)]
pub struct SimulatedFlash {
    cells: BTreeMap<u32, Cell>,
    noise: Noise,
    /// Decides the values of weak bits in this life.
    life: u64,
    /// Ticks until power is lost, and the state of the changing bits then.
    cut: Option<(u64, Tear)>,
    is_on: bool,
    /// Ticks of all operations in this life so far.
    ticks: u64,
    /// Offsets of pages that were programmed although they were not erased or had weak bits.
    overwrites: Vec<u32>,
    erased_bytes: u64,
    programmed_pages: u64,
    traits: FlashTraits,
    /// How many times each sector was erased, by its start.
    erases: BTreeMap<u32, u32>,
    failing: Vec<Failing>,
    /// A defect for tests that must fail: the range maps to the memory that begins at the offset.
    alias: Option<(Range<u32>, u32)>,
}

impl Default for SimulatedFlash {
    fn default() -> Self {
        Self::new()
    }
}

impl SimulatedFlash {
    /// Creates an erased flash with power on and no loss of power planned.
    #[must_use]
    pub fn new() -> Self {
        Self {
            cells: BTreeMap::new(),
            noise: Noise(ChaCha8Rng::seed_from_u64(0)),
            life: 0,
            cut: None,
            is_on: true,
            ticks: 0,
            overwrites: Vec::new(),
            erased_bytes: 0,
            programmed_pages: 0,
            traits: FlashTraits::default(),
            erases: BTreeMap::new(),
            failing: Vec::new(),
            alias: None,
        }
    }

    /// Adds a wiring defect: `range` maps to the memory that begins at `place`, so two slots, or
    /// two banks of the bootloader, share one memory.
    #[must_use]
    pub fn with_alias(mut self, range: Range<u32>, place: u32) -> Self {
        self.alias = Some((range, place));
        self
    }

    /// Sets the type of the flash. Call it before anything is loaded.
    #[must_use]
    pub const fn with_traits(mut self, traits: FlashTraits) -> Self {
        self.traits = traits;
        self
    }

    /// Lets operations fail from now on.
    pub fn fail(&mut self, failing: Failing) {
        self.failing.push(failing);
    }

    /// Returns how many times each sector was erased, by its start.
    #[must_use]
    pub const fn erases(&self) -> &BTreeMap<u32, u32> {
        &self.erases
    }

    /// Sets how many times a sector was erased.
    pub fn wear(&mut self, sector: u32, erases: u32) {
        self.erases.insert(sector, erases);
    }

    /// Takes one operation at an offset; an error if it is to fail.
    fn attempt(&mut self, operation: FlashOperation, at: u32) -> Result<(), ModelError> {
        let mut failing = self.failing.iter_mut();
        let found = failing.find(|it| it.operation == operation && it.range.contains(&at));
        let Some(found) = found else { return Ok(()) };
        if found.after > 0 {
            found.after -= 1;
            return Ok(());
        }
        match found.times {
            0 => Ok(()),
            u32::MAX => Err(ModelError::Failed),
            _ => {
                found.times -= 1;
                Err(ModelError::Failed)
            }
        }
    }

    fn wired(&self, offset: u32) -> u32 {
        match &self.alias {
            Some((range, place)) if range.contains(&offset) => place + (offset - range.start),
            _ => offset,
        }
    }

    /// Begins the next life. Power is lost after `cut.0` ticks, if `cut` is given; `seed` decides
    /// the values of weak bits.
    pub fn power_on(&mut self, seed: u64, cut: Option<(u64, Tear)>) {
        self.noise = Noise(ChaCha8Rng::seed_from_u64(seed));
        self.life = self.noise.0.next_u64();
        (self.cut, self.is_on, self.ticks) = (cut, true, 0);
    }

    /// Returns whether power is on.
    #[must_use]
    pub const fn is_on(&self) -> bool {
        self.is_on
    }

    /// Returns the ticks of all operations in this life: the points at which power can be lost.
    #[must_use]
    pub const fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Returns the number of bytes erased and of pages programmed since the flash was created.
    #[must_use]
    pub const fn work(&self) -> (u64, u64) {
        (self.erased_bytes, self.programmed_pages)
    }

    /// Returns how long all operations since the flash was created took.
    #[must_use]
    pub fn busy(&self) -> Duration {
        let FlashTimes { page, erase } = self.traits.times;
        let pages = page.as_ns() * self.programmed_pages;
        Duration::from_ns(pages + erase.as_ns() * (self.erased_bytes / 0x4000))
    }

    /// Returns the offsets of pages that were programmed while not erased or with weak bits.
    #[must_use]
    pub fn overwrites(&self) -> &[u32] {
        &self.overwrites
    }

    /// Returns the bytes of a range if none of its bits is weak.
    #[must_use]
    pub fn firm(&self, offset: u32, len: u32) -> Option<Vec<u8>> {
        let byte = |at: u32| {
            let place = at as usize % PAGE_BYTES;
            let cell = self.cells.get(&(at / PAGE_BYTES as u32));
            cell.map_or(Some(0xFF), |cell| {
                (cell.weak[place] == 0).then(|| cell.bits[place])
            })
        };
        let outside = |byte: u8| if self.traits.erases_to_0 { !byte } else { byte };
        let bytes = (offset..offset + len).map(|at| byte(at).map(outside));
        bytes.collect()
    }

    /// Writes bytes, as a programming station does before assembly.
    pub fn load(&mut self, offset: u32, bytes: &[u8]) {
        for (byte, at) in bytes.iter().zip(offset..) {
            let cell = self.cells.entry(at / PAGE_BYTES as u32);
            let cell = cell.or_insert(Cell::ERASED);
            let byte = if self.traits.erases_to_0 {
                !byte
            } else {
                *byte
            };
            cell.bits[at as usize % PAGE_BYTES] = byte;
        }
    }

    /// Counts the ticks of an operation. If power is lost within it, returns the completed ticks
    /// and the state of the changing bits; otherwise `None`.
    fn spend(&mut self, ticks: u64) -> Result<Option<(u64, Tear)>, ModelError> {
        if !self.is_on {
            return Err(ModelError::PowerLost);
        }
        self.ticks += ticks;
        let Some((left, tear)) = &mut self.cut else {
            return Ok(None);
        };
        if *left >= ticks {
            *left -= ticks;
            return Ok(None);
        }
        self.is_on = false;
        Ok(Some((*left, *tear)))
    }

    fn program_page(&mut self, index: u32, data: &Page) -> Result<(), ModelError> {
        self.attempt(FlashOperation::Program, index * PAGE_BYTES as u32)?;
        let torn = self.spend(PROGRAM_TICKS)?;
        self.programmed_pages += 1;
        let old = self.cells.get(&index).copied().unwrap_or(Cell::ERASED);
        if old != Cell::ERASED {
            self.overwrites.push(index * PAGE_BYTES as u32);
        }
        let mut cell = old;
        cell.is_whole = old == Cell::ERASED && torn.is_none();
        for (place, byte) in data.iter().enumerate() {
            let is_done = torn.is_none_or(|(ticks, _)| (place as u64) < ticks);
            // Programming clears bits. A weak bit that is programmed to 1 stays weak.
            if is_done {
                cell.weak[place] &= byte;
                cell.bits[place] &= byte;
            } else {
                let changing = old.bits[place] & !byte;
                self.leave(&mut cell, place, changing, torn);
            }
        }
        // A loss of power before the first byte changes nothing.
        if torn.is_none_or(|(ticks, _)| ticks > 0) || old != Cell::ERASED || cell != old {
            self.cells.insert(index, cell);
        }
        torn.map_or(Ok(()), |_| Err(ModelError::PowerLost))
    }

    /// Puts these bits of a byte into the state in which the loss of power leaves them.
    fn leave(&mut self, cell: &mut Cell, place: usize, bits: u8, torn: Option<(u64, Tear)>) {
        let Some((_, tear)) = torn else { return };
        match tear {
            Tear::Clean => {}
            Tear::Noise => cell.bits[place] ^= bits & self.noise.0.next_u32() as u8,
            Tear::Flicker | Tear::PerLife | Tear::Mimic => {
                cell.bits[place] &= !bits;
                cell.weak[place] |= bits;
                cell.tear = tear;
            }
        }
    }

    fn erase_sector(&mut self, range: Range<u32>) -> Result<(), ModelError> {
        self.attempt(FlashOperation::Erase, range.start)?;
        let torn = self.spend(ERASE_TICKS)?;
        self.erased_bytes += u64::from(range.end - range.start);
        let erases = self.erases.entry(range.start).or_default();
        *erases += 1;
        if self.traits.endurance.is_some_and(|most| *erases > most) {
            return Err(self.wear_out(range));
        }
        let [from, to] = [range.start, range.end].map(|at| at / PAGE_BYTES as u32);
        let pages = self.cells.range(from..to);
        let pages: Vec<u32> = pages.map(|(index, _)| *index).collect();
        for index in pages {
            let done =
                torn.is_none_or(|(ticks, _)| self.noise.0.random_range(0..ERASE_TICKS - 1) < ticks);
            if done {
                self.cells.remove(&index);
            } else if let Some(mut cell) = self.cells.get(&index).copied() {
                cell.is_whole = false;
                for place in 0..PAGE_BYTES {
                    let changing = !cell.bits[place];
                    self.leave(&mut cell, place, changing, torn);
                }
                self.cells.insert(index, cell);
            }
        }
        torn.map_or(Ok(()), |_| Err(ModelError::PowerLost))
    }

    /// Leaves noise in the pages of a worn-out sector.
    fn wear_out(&mut self, range: Range<u32>) -> ModelError {
        let noise = Cell {
            bits: [0; PAGE_BYTES],
            weak: [0xFF; PAGE_BYTES],
            tear: Tear::Flicker,
            is_whole: false,
        };
        for at in range.step_by(PAGE_BYTES) {
            self.cells.insert(at / PAGE_BYTES as u32, noise);
        }
        ModelError::Worn
    }

    /// Reads bytes of one page, beginning with its byte `place`.
    fn read_page(&mut self, index: u32, place: usize, into: &mut [u8]) -> Result<(), ModelError> {
        self.attempt(FlashOperation::Read, index * PAGE_BYTES as u32)?;
        let is_readable = match self.cells.get(&index) {
            Some(cell) => !self.traits.ecc || cell.is_whole || self.passes_by_chance(index, cell),
            None => !self.traits.blank_is_unreadable,
        };
        if !is_readable {
            return Err(ModelError::Ecc);
        }
        self.read_cell(index, place, into);
        if self.traits.erases_to_0 {
            into.iter_mut().for_each(|byte| *byte = !*byte);
        }
        Ok(())
    }

    /// Returns whether the ECC of a torn page is right by chance in this life.
    const fn passes_by_chance(&self, index: u32, cell: &Cell) -> bool {
        matches!(cell.tear, Tear::PerLife | Tear::Mimic) && mix(self.life ^ index as u64) & 2 == 0
    }

    fn read_cell(&mut self, index: u32, place: usize, into: &mut [u8]) {
        let Some(cell) = self.cells.get(&index) else {
            return into.fill(0xFF);
        };
        for (byte, place) in into.iter_mut().zip(place..) {
            *byte = cell.bits[place];
            if cell.weak[place] == 0 {
                continue;
            }
            let at = index * PAGE_BYTES as u32 + place as u32;
            let fall = match cell.tear {
                Tear::Flicker => self.noise.0.next_u32() as u8,
                Tear::PerLife => (mix(self.life ^ u64::from(at)) >> 8) as u8,
                _ => {
                    let sector = sector_at(at).map_or(0, |range| range.start);
                    0u8.wrapping_sub((mix(self.life ^ u64::from(sector)) & 1) as u8)
                }
            };
            *byte |= cell.weak[place] & fall;
        }
    }

    /// Encodes the state that survives a loss of power.
    #[must_use]
    pub fn save(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        for (index, cell) in &self.cells {
            bytes.extend(index.to_le_bytes());
            bytes.extend(cell.bits);
            bytes.extend(cell.weak);
            bytes.push(cell.tear as u8 | u8::from(cell.is_whole) << 7);
        }
        bytes
    }

    /// Decodes the output of [`SimulatedFlash::save`]; `None` for other bytes.
    #[must_use]
    pub fn restore(bytes: &[u8]) -> Option<Self> {
        let (records, rest) = bytes.as_chunks::<{ 4 + 2 * PAGE_BYTES + 1 }>();
        let mut flash = Self::new();
        for record in records {
            let (index, cell) = record.split_first_chunk::<4>()?;
            let (bits, cell) = cell.split_first_chunk()?;
            let (weak, tear) = cell.split_first_chunk()?;
            let cell = Cell {
                bits: *bits,
                weak: *weak,
                tear: Tear::from_repr(*tear.first()? & 0x7F)?,
                is_whole: tear.first()? >> 7 == 1,
            };
            flash.cells.insert(u32::from_le_bytes(*index), cell);
        }
        rest.is_empty().then_some(flash)
    }
}

/// Returns pseudo-random bits (the finalizer of SplitMix64).
const fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    value ^ (value >> 31)
}

impl ErrorType for SimulatedFlash {
    type Error = ModelError;
}

impl ReadNorFlash for SimulatedFlash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), ModelError> {
        if !self.is_on {
            return Err(ModelError::PowerLost);
        }
        if offset as usize + bytes.len() > FLASH_BYTES as usize {
            return Err(ModelError::Range);
        }
        let (mut at, mut rest) = (self.wired(offset), bytes);
        while !rest.is_empty() {
            let place = at as usize % PAGE_BYTES;
            let (now, later) = rest.split_at_mut((PAGE_BYTES - place).min(rest.len()));
            self.read_page(at / PAGE_BYTES as u32, place, now)?;
            at += now.len() as u32;
            rest = later;
        }
        Ok(())
    }

    fn capacity(&self) -> usize {
        FLASH_BYTES as usize
    }
}

impl NorFlash for SimulatedFlash {
    const WRITE_SIZE: usize = PAGE_BYTES;
    const ERASE_SIZE: usize = SMALLEST_SECTOR as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), ModelError> {
        let (mut at, to) = (self.wired(from), self.wired(to - 1) + 1);
        while at < to {
            let sector = sector_at(at).filter(|sector| sector.start == at && sector.end <= to);
            let sector = sector.ok_or(ModelError::Range)?;
            at = sector.end;
            self.erase_sector(sector)?;
        }
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), ModelError> {
        let (pages, rest) = bytes.as_chunks::<PAGE_BYTES>();
        let end = offset as usize + bytes.len();
        let aligned = (offset as usize).is_multiple_of(PAGE_BYTES) && rest.is_empty();
        if !aligned || end > FLASH_BYTES as usize {
            return Err(ModelError::Range);
        }
        for (page, index) in pages.iter().zip(self.wired(offset) / PAGE_BYTES as u32..) {
            match self.traits.erases_to_0 {
                true => self.program_page(index, &page.map(|byte| !byte))?,
                false => self.program_page(index, page)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read<const N: usize>(flash: &mut SimulatedFlash, at: u32) -> [u8; N] {
        let mut bytes = [0; N];
        flash.read(at, &mut bytes).unwrap();
        bytes
    }

    /// T-BOOT-6: only whole pages are programmed, and only whole sectors erased.
    #[test]
    fn it_is_nor_flash_with_sectors_of_five_sizes() {
        let mut flash = SimulatedFlash::new();
        flash.write(0x04_0000, &[0xF0; 64]).unwrap();
        flash.write(0x04_0020, &[0x3C; 32]).unwrap();
        assert_eq!(read(&mut flash, 0x04_001F), [0xF0, 0x30]);
        assert_eq!(flash.overwrites(), [0x04_0020]);
        assert_eq!(flash.write(0x04_0010, &[0; 32]), Err(ModelError::Range));
        assert_eq!(flash.write(FLASH_BYTES, &[0; 32]), Err(ModelError::Range));
        assert_eq!(flash.erase(0x10_0000, 0x10_4000), Err(ModelError::Range));
        assert_eq!(flash.erase(0x04_4000, 0x04_8000), Err(ModelError::Range));
        flash.erase(0x04_0000, 0x04_8000).unwrap();
        assert_eq!(read(&mut flash, 0x04_0000), [0xFF; 96]);
    }

    /// U-5: for a loss of power at each byte, the bytes before and after the page are unchanged.
    #[test]
    fn a_torn_page_is_torn_where_power_was_lost() {
        for &tear in Tear::VARIANTS {
            for cut in 0..PROGRAM_TICKS {
                let mut flash = SimulatedFlash::new();
                flash.write(0, &[0x11; 32]).unwrap();
                flash.power_on(cut, Some((cut, tear)));
                assert_eq!(flash.write(32, &[0; 32]), Err(ModelError::PowerLost));
                assert_eq!(flash.read(0, &mut [0]), Err(ModelError::PowerLost));
                flash.power_on(1, None);
                let done = cut as usize;
                let page: Page = read(&mut flash, 32);
                assert_eq!(page[..done], vec![0; done]);
                if tear == Tear::Clean {
                    assert_eq!(page[done..], vec![0xFF; PAGE_BYTES - done]);
                }
                assert_eq!(read(&mut flash, 0), [0x11; 32]);
                assert_eq!(read(&mut flash, 64), [0xFF; 32]);
            }
        }
    }

    /// U-5: weak bits read as their [`Tear`] says, even if saved and restored, until erased.
    #[test]
    fn weak_bits_stay_weak_until_they_are_erased() {
        for (tear, within_life, between_lives) in [
            (Tear::Clean, false, false),
            (Tear::Noise, false, false),
            (Tear::Flicker, true, true),
            (Tear::PerLife, false, true),
            (Tear::Mimic, false, true),
        ] {
            let mut flash = SimulatedFlash::new();
            flash.power_on(3, Some((0, tear)));
            assert_eq!(flash.write(32, &[0; 32]), Err(ModelError::PowerLost));
            let mut flash = SimulatedFlash::restore(&flash.save()).unwrap();
            let (mut lives, mut reads) = (Vec::new(), Vec::new());
            for life in 0..20 {
                flash.power_on(life, None);
                reads.push([read::<32>(&mut flash, 32), read(&mut flash, 32)]);
                lives.push(reads[reads.len() - 1][0]);
                assert_eq!(flash.firm(32, 32).is_none(), between_lives);
            }
            assert_eq!(reads.iter().any(|[a, b]| a != b), within_life, "{tear:?}");
            assert_eq!(
                lives.iter().any(|page| *page != lives[0]),
                between_lives,
                "{tear:?}"
            );
            if tear == Tear::Mimic {
                assert!(lives.contains(&[0; 32]) && lives.contains(&[0xFF; 32]));
            }
            flash.erase(0, 0x4000).unwrap();
            assert_eq!(flash.firm(32, 32), Some(vec![0xFF; 32]));
        }
    }

    /// U-5: an interrupted erase operation leaves only old and erased pages.
    #[test]
    fn a_torn_erase_leaves_some_pages() {
        let mut left = Vec::new();
        for cut in 0..ERASE_TICKS {
            let mut flash = SimulatedFlash::new();
            flash.write(0, &[0; 0x4000]).unwrap();
            flash.power_on(cut, Some((cut, Tear::Clean)));
            assert_eq!(flash.erase(0, 0x4000), Err(ModelError::PowerLost));
            flash.power_on(0, None);
            let bytes: [u8; 0x4000] = read(&mut flash, 0);
            let (pages, _) = bytes.as_chunks::<PAGE_BYTES>();
            assert!(
                pages
                    .iter()
                    .all(|page| *page == [0; 32] || *page == [0xFF; 32])
            );
            left.push(pages.iter().filter(|page| **page == [0; 32]).count());
        }
        assert_eq!((left[0], left[ERASE_TICKS as usize - 1]), (512, 0));
        assert!(left.iter().any(|pages| (1..512).contains(pages)));
    }
}
