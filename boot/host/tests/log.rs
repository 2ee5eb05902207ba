//! The log in its two sectors: entries stay in order when it goes round, and what is no entry is
//! none.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::desk_bench::DeskBench;
use fixture::factory;
use fixture::proof::{TESTER, WRONG};
use tandem_boot::{Answer, FlashRegion, LogEvent, Slot, read_log};
use tandem_boot_host::SimulatedFlash;

/// Entries of a sector.
const ENTRIES: u32 = 1_024;
/// Entries of both.
const ALL: u32 = 2 * ENTRIES;

/// Returns the page of an entry, as `docs/boot.md` describes it.
fn page(sequence: u32, value: u32) -> [u8; 32] {
    let mut page = [0; 32];
    page[..3].copy_from_slice(&[b'L', b'G', LogEvent::ResetLoop as u8]);
    page[4..8].copy_from_slice(&sequence.to_le_bytes());
    page[8..12].copy_from_slice(&value.to_le_bytes());
    with_checksum(page)
}

fn with_checksum(mut page: [u8; 32]) -> [u8; 32] {
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&page[..28]);
    page[28..].copy_from_slice(&crc.to_le_bytes());
    page
}

/// Writes entries with these numbers to the beginning of a sector. Their value is their number.
fn fill(flash: &mut SimulatedFlash, sector: u8, numbers: std::ops::Range<u32>) {
    let start = FlashRegion::Log(sector).range().start;
    for (number, at) in numbers.zip((start..).step_by(32)) {
        flash.load(at, &page(number, number));
    }
}

fn numbers(flash: &SimulatedFlash) -> Vec<u32> {
    let mut found = Vec::new();
    read_log(&mut flash.clone(), &mut |entry| found.push(entry.sequence));
    found
}

/// Returns the flash after one more entry was appended.
fn appended(flash: SimulatedFlash) -> SimulatedFlash {
    let mut bench = DeskBench::in_slot(flash, Slot::A);
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    bench.desk.into_parts().0
}

/// U-2: the log continues behind its newest entry, goes on in the other sector, and then erases the
/// sector with the oldest entries. It is read from the oldest to the newest.
#[test]
fn the_log_goes_round() {
    let start = factory();
    let begun = numbers(&start);
    assert!(!begun.is_empty(), "the first start was logged");
    for (first, second, expected) in [
        (0..0, 0..0, 0..=0),
        (0..5, 0..0, 0..=5),
        (0..ENTRIES, 0..0, 0..=ENTRIES),
        (0..ENTRIES, ENTRIES..ENTRIES + 9, 0..=ENTRIES + 9),
        (0..ENTRIES, ENTRIES..ALL, ENTRIES..=ALL),
        (ALL..ALL + 6, ENTRIES..ALL, ENTRIES..=ALL + 6),
        (0..0, 7..9, 7..=9),
    ] {
        let mut flash = SimulatedFlash::new();
        flash.power_on(1, None);
        fill(&mut flash, 0, first.clone());
        fill(&mut flash, 1, second.clone());
        let numbers = numbers(&appended(flash));
        let ends = (numbers.first(), numbers.last());
        let right = numbers.iter().copied().eq(expected);
        assert!(right, "{first:?} {second:?}: {ends:?}");
    }
}

/// U-2: a page is an entry if its mark, its event and its checksum are right.
#[test]
fn what_is_no_entry_is_none() {
    let good = page(3, 9);
    let with = |at: usize, byte: u8| {
        let mut page = good;
        page[at] = byte;
        with_checksum(page)
    };
    let mut torn = good;
    torn[9] ^= 1;
    for (what, page, is_entry) in [
        ("an entry", good, true),
        ("another mark", with(0, b'K'), false),
        ("an unknown event", with(2, 200), false),
        ("a wrong checksum", torn, false),
    ] {
        let mut flash = SimulatedFlash::new();
        flash.load(FlashRegion::Log(0).range().start, &page);
        flash.power_on(1, None);
        assert_eq!(numbers(&flash).len(), usize::from(is_entry), "{what}");
    }
}

/// E-4: a right signature ends the lock, also for the next start.
#[test]
fn a_right_signature_ends_the_lock_for_good() {
    let mut bench = DeskBench::new(factory());
    assert_eq!(bench.prove(&WRONG), Some(Answer::Unproved));
    let locked = bench.prove(&TESTER);
    assert!(matches!(locked, Some(Answer::Locked { .. })), "{locked:?}");
    bench.wait(3_000);
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    let mut bench = DeskBench::new(bench.desk.into_parts().0);
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
}

/// E-4: the log has the number of wrong signatures in a row, so that the lock of the next start is
/// as long as the last one.
#[test]
fn the_lock_grows_over_starts() {
    let mut flash = factory();
    for wrong in 0..6u32 {
        let mut bench = DeskBench::new(flash);
        if wrong > 0 {
            let seconds = 1 << wrong;
            assert_eq!(bench.prove(&TESTER), Some(Answer::Locked { seconds }));
            bench.wait(u64::from(seconds) * 1_000);
        }
        assert_eq!(bench.prove(&WRONG), Some(Answer::Unproved));
        flash = bench.desk.into_parts().0;
        let mut logged = None;
        read_log(&mut flash, &mut |entry| {
            logged = Some((entry.event, entry.value));
        });
        assert_eq!(logged, Some((LogEvent::TesterRefused, wrong + 1)));
    }
}
