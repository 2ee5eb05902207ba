//! The log in its two sectors: entries stay in order when it goes round, and what is no entry is
//! none.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::factory;
use tandem_board::{DeskAction, Instant, NoCounter, SystemId, TesterDesk};
use tandem_boot::{
    Answer, BootDesk, FlashRegion, HostRequest, LogEvent, Slot, read_log, tester_message,
};
use tandem_boot_host::life::TEST_KEY_1;
use tandem_boot_host::{SigningKey, SimulatedFlash};

/// Entries of a sector.
const ENTRIES: u32 = 1_024;
/// Entries of both.
const ALL: u32 = 2 * ENTRIES;
const TESTER: SigningKey = SigningKey {
    number: 0,
    ..TEST_KEY_1
};

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

/// A desk that knows a tester.
struct Bench {
    desk: BootDesk<'static, SimulatedFlash, NoCounter>,
    now: Instant,
}

impl Bench {
    fn new(flash: SimulatedFlash) -> Self {
        let mut setup = fixture::desk(Slot::A);
        setup.trust.testers = Box::leak(Box::new([TESTER.public()]));
        let now = Instant::from_ns(1_000_000_000_000);
        Self {
            desk: BootDesk::new(flash, NoCounter, setup, now),
            now,
        }
    }

    fn ask(&mut self, request: HostRequest<'_>) -> Option<Answer> {
        match self.desk.hear(self.now, &request.frame().unwrap())? {
            DeskAction::Send(frame) => Answer::decode(frame.data()),
            _ => None,
        }
    }

    /// Makes the desk write an entry: a signature that is right or wrong.
    fn prove(&mut self, right: bool) -> Option<Answer> {
        let system = Some(SystemId::A);
        let mut challenge = Vec::new();
        for part in 0..3 {
            match self.ask(HostRequest::Challenge {
                system,
                key: 0,
                part,
            })? {
                Answer::Challenge { bytes, .. } => challenge.extend(bytes),
                other => return Some(other),
            }
        }
        let message = tester_message(SystemId::A, 0, &challenge.try_into().unwrap());
        let mut signature = [&TESTER.sign(&message)[..], &[0]].concat();
        signature[9] ^= u8::from(!right);
        let pieces = (0..).zip(signature.as_chunks::<5>().0);
        let answers = pieces.map(|(part, bytes)| {
            let bytes = *bytes;
            self.ask(HostRequest::Proof {
                system,
                part,
                bytes,
            })
        });
        answers.last().flatten()
    }
}

/// Returns the flash after one more entry was appended.
fn appended(flash: SimulatedFlash) -> SimulatedFlash {
    let mut bench = Bench::new(flash);
    assert!(bench.prove(true) == Some(Answer::Proved));
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
    let mut bench = Bench::new(factory());
    assert_eq!(bench.prove(false), Some(Answer::Unproved));
    let locked = bench.prove(true);
    assert!(matches!(locked, Some(Answer::Locked { .. })), "{locked:?}");
    bench.now = Instant::from_ns(2_000_000_000_000);
    assert_eq!(bench.prove(true), Some(Answer::Proved));
    let mut bench = Bench::new(bench.desk.into_parts().0);
    assert_eq!(bench.prove(true), Some(Answer::Proved));
}

/// E-4: the log has the number of wrong signatures in a row, so that the lock of the next start is
/// as long as the last one.
#[test]
fn the_lock_grows_over_starts() {
    let mut flash = factory();
    for wrong in 1..=5u32 {
        let mut bench = Bench::new(flash);
        let locked = bench.prove(true);
        let seconds = 1u16 << (wrong - 1);
        let expected = Some(Answer::Locked {
            seconds: seconds + 1,
        });
        assert_eq!(locked == expected, wrong > 1, "{wrong}: {locked:?}");
        bench.now = Instant::from_ns(5_000_000_000_000);
        if wrong == 1 {
            // The proof above was right, and ended nothing.
            assert_eq!(locked, Some(Answer::Proved));
        }
        assert_eq!(bench.prove(false), Some(Answer::Unproved));
        flash = bench.desk.into_parts().0;
        let mut logged = None;
        read_log(&mut flash, &mut |entry| {
            logged = Some((entry.event, entry.value))
        });
        assert_eq!(logged, Some((LogEvent::TesterRefused, wrong)));
    }
}
