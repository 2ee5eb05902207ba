//! The map of the program flash: 27 logical sectors and the regions that own them. T-BOOT-6, U-2

use core::ops::Range;
use strum::FromRepr;

/// Bytes of the program flash.
pub const FLASH_BYTES: u32 = 0x20_0000;
/// Bytes of a page, the unit of programming.
pub const PAGE_BYTES: usize = 32;
/// Bytes of the smallest sector.
pub const SMALLEST_SECTOR: u32 = 0x4000;
/// Number of logical sectors, S0 to S26.
pub const SECTORS: u8 = 27;

/// Groups of sectors of one size: number and offset of the first sector, size.
const GROUPS: [(u8, u32, u32); 5] = [
    (0, 0x00_0000, 0x4000),
    (8, 0x02_0000, 0x8000),
    (16, 0x06_0000, 0x1_0000),
    (20, 0x0A_0000, 0x2_0000),
    (23, 0x10_0000, 0x4_0000),
];

/// Returns the range of logical sector `number`; `None` above S26.
#[must_use]
pub fn sector(number: u8) -> Option<Range<u32>> {
    let in_flash = number < SECTORS;
    let group = GROUPS.iter().rfind(|(first, ..)| *first <= number);
    let (first, offset, size) = group.filter(|_| in_flash)?;
    let start = offset + u32::from(number - first) * size;
    Some(start..start + size)
}

/// Returns the range of the logical sector that contains `offset`.
#[must_use]
pub fn sector_at(offset: u32) -> Option<Range<u32>> {
    let group = GROUPS.iter().rfind(|(_, start, _)| *start <= offset);
    let (_, start, size) = group.filter(|_| offset < FLASH_BYTES)?;
    let start = start + (offset - start) / size * size;
    Some(start..start + size)
}

/// Converts an address of an S-record to an offset in the flash. The flash begins at 0 in files for
/// this loader, and at 0x8000_0000 (cached) and 0xA000_0000 (uncached) in the address space of the
/// TC297.
#[must_use]
pub const fn offset_of(address: u32) -> Option<u32> {
    let offset = address & 0x0FFF_FFFF;
    match address >> 28 {
        0x0 | 0x8 | 0xA if offset < FLASH_BYTES => Some(offset),
        _ => None,
    }
}

/// One of two equivalent places for an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Slot {
    /// The first.
    A,
    /// The second.
    B,
}

impl Slot {
    /// Both slots.
    pub const ALL: [Self; 2] = [Self::A, Self::B];

    /// Returns the other slot.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }
}

/// A place from which a bootloader runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Bank {
    /// S0 and S1. The boot ROM starts it if it is sealed and intact.
    Primary,
    /// S2 and S3. The boot ROM starts it otherwise.
    Backup,
}

/// The kind of an image. Each kind has its own places and its own update procedure. U-5
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ImageKind {
    /// The program of the three cores.
    Application,
    /// Parameters of the application.
    Configuration,
    /// The bootloader itself.
    Bootloader,
}

/// The place to which a downloaded image is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageTarget {
    /// A slot of the application.
    Application(Slot),
    /// A slot of the configuration.
    Configuration(Slot),
    /// Where a new bootloader waits until it is installed.
    Staging,
}

impl ImageTarget {
    /// All targets, in the order of their addresses.
    pub const ALL: [Self; 5] = [
        Self::Configuration(Slot::A),
        Self::Configuration(Slot::B),
        Self::Staging,
        Self::Application(Slot::A),
        Self::Application(Slot::B),
    ];

    /// Returns the target that contains `offset`.
    #[must_use]
    pub fn at(offset: u32) -> Option<Self> {
        let holds = |target: &Self| FlashRegion::Target(*target).range().contains(&offset);
        Self::ALL.into_iter().find(holds)
    }

    /// Returns the kind of image that belongs there.
    #[must_use]
    pub const fn kind(self) -> ImageKind {
        match self {
            Self::Application(_) => ImageKind::Application,
            Self::Configuration(_) => ImageKind::Configuration,
            Self::Staging => ImageKind::Bootloader,
        }
    }
}

/// A region of the flash and its use. U-2
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlashRegion {
    /// A runnable bootloader: S0–S1, S2–S3.
    Bank(Bank),
    /// One of two copies of the boot environment: S4, S5.
    Environment(u8),
    /// A place that a download may write: S6, S7 (configuration), S8 (staging), S12–S22 and S23–S25
    /// (application, 768 KiB each).
    Target(ImageTarget),
    /// One of two sectors of the log: S10, S11.
    Log(u8),
}

/// Where a board without other one-time programmable pages has its
/// [`OneTimeWords`](crate::OneTimeWords): nothing erases this sector.
pub const COUNTER_PAGES: Range<u32> = 0x02_8000..0x02_9000;

impl FlashRegion {
    /// Returns its range, which consists of whole sectors.
    #[must_use]
    pub const fn range(self) -> Range<u32> {
        match self {
            Self::Bank(Bank::Primary) => 0x00_0000..0x00_8000,
            Self::Bank(Bank::Backup) => 0x00_8000..0x01_0000,
            Self::Environment(0) => 0x01_0000..0x01_4000,
            Self::Environment(_) => 0x01_4000..0x01_8000,
            Self::Target(ImageTarget::Configuration(Slot::A)) => 0x01_8000..0x01_C000,
            Self::Target(ImageTarget::Configuration(Slot::B)) => 0x01_C000..0x02_0000,
            Self::Target(ImageTarget::Staging) => 0x02_0000..0x02_8000,
            Self::Log(0) => 0x03_0000..0x03_8000,
            Self::Log(_) => 0x03_8000..0x04_0000,
            Self::Target(ImageTarget::Application(Slot::A)) => 0x04_0000..0x10_0000,
            Self::Target(ImageTarget::Application(Slot::B)) => 0x10_0000..0x1C_0000,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REGIONS: [FlashRegion; 11] = [
        FlashRegion::Bank(Bank::Primary),
        FlashRegion::Bank(Bank::Backup),
        FlashRegion::Environment(0),
        FlashRegion::Environment(1),
        FlashRegion::Target(ImageTarget::Configuration(Slot::A)),
        FlashRegion::Target(ImageTarget::Configuration(Slot::B)),
        FlashRegion::Target(ImageTarget::Staging),
        FlashRegion::Log(0),
        FlashRegion::Log(1),
        FlashRegion::Target(ImageTarget::Application(Slot::A)),
        FlashRegion::Target(ImageTarget::Application(Slot::B)),
    ];

    /// T-BOOT-6: the sectors have the offsets of the thesis's figure 3.9, without a gap.
    #[test]
    fn the_sectors_are_those_of_the_tc297() {
        let table: [(u8, u32, u32); 9] = [
            (0, 0x00_0000, 16),
            (1, 0x00_4000, 16),
            (7, 0x01_C000, 16),
            (8, 0x02_0000, 32),
            (15, 0x05_8000, 32),
            (17, 0x07_0000, 64),
            (22, 0x0E_0000, 128),
            (23, 0x10_0000, 256),
            (26, 0x1C_0000, 256),
        ];
        for (number, offset, kib) in table {
            assert_eq!(sector(number), Some(offset..offset + kib * 1024));
        }
        let mut end = 0;
        for number in 0..SECTORS {
            let range = sector(number).unwrap();
            assert_eq!(range.start, end);
            assert_eq!(sector_at(range.start), Some(range.clone()));
            assert_eq!(sector_at(range.end - 1), Some(range.clone()));
            end = range.end;
        }
        assert_eq!(end, FLASH_BYTES);
        assert_eq!(sector(SECTORS), None);
        assert_eq!(sector_at(FLASH_BYTES), None);
    }

    /// T-BOOT-6, U-2: targets of a download lie in S2–S26 and share no sector with another region.
    #[test]
    fn regions_are_whole_sectors_and_do_not_overlap() {
        for (index, region) in REGIONS.iter().enumerate() {
            let range = region.range();
            assert_eq!(sector_at(range.start).unwrap().start, range.start);
            assert_eq!(sector_at(range.end - 1).unwrap().end, range.end);
            for other in &REGIONS[..index] {
                let other = other.range();
                assert!(range.end <= other.start || other.end <= range.start);
            }
        }
        for target in ImageTarget::ALL {
            let range = FlashRegion::Target(target).range();
            assert!(range.start >= sector(2).unwrap().start);
            assert_eq!(ImageTarget::at(range.start), Some(target));
            assert_eq!(ImageTarget::at(range.end - 1), Some(target));
        }
        assert_eq!(ImageTarget::at(0x00_8000), None);
        let [a, b] =
            Slot::ALL.map(|slot| FlashRegion::Target(ImageTarget::Application(slot)).range());
        assert_eq!(a.len(), b.len());
    }

    #[test]
    fn an_address_names_an_offset_in_three_segments_only() {
        assert_eq!(offset_of(0xA00E_0020), Some(0x0E_0020));
        assert_eq!(offset_of(0x8004_0000), Some(0x04_0000));
        assert_eq!(offset_of(0x0004_0000), Some(0x04_0000));
        assert_eq!(offset_of(0xA020_0000), None);
        assert_eq!(offset_of(0x7000_0000), None);
    }
}
