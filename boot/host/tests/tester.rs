//! Who may program: without the proof of a tester nothing on the bus changes the flash. Frame by
//! frame, as a foreign tester sends them.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::loader_bench::LoaderBench;
use fixture::proof::{self, TESTER, known};
use fixture::{Images, factory, image};
use tandem_board::{Instant, ResetCause};
use tandem_boot::{Answer, HostRequest, LogEvent, Next, Refusal, Slot, read_log};
use tandem_boot_host::life::{End, Life, TEST_KEY, TEST_KEY_1, TEST_PUBLIC};
use tandem_boot_host::{SigningKey, SimulatedFlash, records};

/// Returns whether a host with this key programs a controller that knows one tester, and the
/// refusal.
fn programs(
    flash: &mut SimulatedFlash,
    tester: Option<SigningKey>,
    window: u8,
) -> (bool, Option<Refusal>) {
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    flash.power_on(1, None);
    let life = Life {
        testers: vec![TEST_KEY_1.public()],
        tester,
        ..Life::with_file(&lines, window)
    };
    let outcome = life.live(flash);
    assert!(matches!(outcome.end, End::Running(_)), "{outcome:?}");
    (outcome.downloaded, outcome.refused)
}

const fn numbered(number: u8, key: SigningKey) -> SigningKey {
    SigningKey { number, ..key }
}

fn events(flash: &mut SimulatedFlash) -> Vec<LogEvent> {
    let mut events = Vec::new();
    read_log(flash, &mut |entry| events.push(entry.event));
    events
}

/// T-BOOT-1, E-4: only a tester with the right key, under its right number, changes the flash.
#[test]
fn a_tester_proves_that_it_has_a_key() {
    for (tester, allowed) in [
        (Some(numbered(0, TEST_KEY_1)), true),
        (Some(numbered(1, TEST_KEY_1)), false),
        (Some(numbered(0, TEST_KEY)), false),
        (None, false),
    ] {
        for window in [0, 8] {
            let mut flash = factory();
            let before = flash.work();
            let refused = (!allowed).then_some(Refusal::Tester);
            let expected = (allowed, refused);
            assert_eq!(programs(&mut flash, tester, window), expected, "{tester:?}");
            let erased = flash.work().0 - before.0;
            assert_eq!(erased > 0, allowed, "{tester:?}: {erased} bytes erased");
        }
    }
}

/// E-4: after wrong signatures a tester waits, also if the controller is reset in between; the
/// right one ends that.
#[test]
fn wrong_keys_lock_the_loader_over_resets() {
    let mut flash = factory();
    let [right, wrong] = [TEST_KEY_1, TEST_KEY].map(|key| Some(numbered(0, key)));
    assert_eq!(
        programs(&mut flash, wrong, 0),
        (false, Some(Refusal::Tester))
    );
    assert!(events(&mut flash).contains(&LogEvent::TesterRefused));
    // The next life begins at once: its loader is still locked.
    assert_eq!(
        programs(&mut flash, right, 0),
        (false, Some(Refusal::Tester))
    );
    assert!(!events(&mut flash).contains(&LogEvent::TesterProved));
}

/// A loader that was sent into a download. `noise` decides its challenges.
fn started_with(flash: SimulatedFlash, testers: &'static [[u8; 32]], noise: u8) -> LoaderBench {
    const KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
    let mut setup = fixture::setup(&KEYS);
    setup.trust.testers = testers;
    setup.cause = ResetCause::Download;
    setup.noise = std::array::from_fn(|at| noise ^ at as u8);
    LoaderBench::start(flash, setup)
}

fn started(testers: &'static [[u8; 32]], noise: u8) -> LoaderBench {
    started_with(factory(), testers, noise)
}

fn connect(bench: &mut LoaderBench) {
    assert_eq!(bench.connect(None), Some(Answer::Connected));
}

fn asked(bench: &mut LoaderBench) -> Vec<u8> {
    proof::challenge(None, 0, |request| bench.send(request)).unwrap()
}

fn signed(bench: &mut LoaderBench, signature: &[u8; 64]) -> Option<Answer> {
    proof::send_signature(None, signature, |request| bench.send(request))
}

/// E-4: no challenge comes twice, and an old signature proves nothing. The signed bytes are those
/// of the page, so that a foreign tester can make them.
#[test]
fn a_signature_is_good_once() {
    let mut bench = started(known(), 3);
    connect(&mut bench);
    let first = asked(&mut bench);
    let challenge = asked(&mut bench);
    assert_eq!(first, challenge, "until it is answered");
    let message = [&b"tandem tester"[..], &[0, 0], &challenge].concat();
    let signature = TESTER.sign(&message);
    assert_eq!(signed(&mut bench, &signature), Some(Answer::Proved));
    assert_eq!(
        signed(&mut bench, &signature),
        None,
        "the challenge is used up"
    );
    connect(&mut bench);
    let second = asked(&mut bench);
    assert_ne!(second, first);
    assert_eq!(signed(&mut bench, &signature), Some(Answer::Unproved));
    let locked = bench.send(HostRequest::Challenge {
        system: None,
        key: 0,
        part: 0,
    });
    assert_eq!(locked, Some(Answer::Locked { seconds: 3 }));
    bench.now += tandem_board::Duration::from_ms(2_000);
    let third = asked(&mut bench);
    assert!(third != second && third != first);
    let mut other = started(known(), 77);
    connect(&mut other);
    assert_ne!(asked(&mut other), first);
}

/// T-BOOT-1: a host that does not prove itself changes no page of the flash, however often it is
/// refused: a full log would also forget the wrong keys.
#[test]
fn an_unproved_host_writes_nothing() {
    let mut bench = started(known(), 8);
    let before = bench.loader.flash().work();
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    for _ in 0..20 {
        connect(&mut bench);
        let refused = Some(Answer::Refused(Refusal::Tester));
        assert_eq!(bench.line(&lines[0]), refused);
    }
    assert_eq!(bench.loader.flash().work(), before);
}

/// T-BOOT-1: a host that does not prove itself keeps the loader for at most two seconds with
/// any record; without testers for ten seconds after the last record that the loader has accepted.
#[test]
fn an_unproved_host_does_not_hold_the_loader() {
    for (testers, holds_ms) in [(known(), 2_000), (&[][..], 10_000)] {
        let mut bench = started(testers, 5);
        connect(&mut bench);
        let mut held_ms = 0;
        while held_ms < 60_000 {
            bench.now = Instant::from_ns(bench.now.as_ns() + 9_000_000);
            held_ms += 9;
            let frame = HostRequest::Data(b"").frame().unwrap();
            bench.loader.on_frame(bench.now, &frame);
            match bench.loader.next(bench.now) {
                Next::Wait(_) | Next::Send(_) => {}
                _ => break,
            }
        }
        assert!((holds_ms..holds_ms + 20).contains(&held_ms), "{held_ms} ms");
    }
}

/// T-BOOT-3: with a window a record that is missing is asked for again eight times, then the file
/// is refused.
#[test]
fn a_gap_in_a_window_is_asked_for_eight_times() {
    let mut bench = started(&[], 6);
    connect(&mut bench);
    let granted = bench.send(HostRequest::Offer { records: 1 });
    assert!(
        matches!(granted, Some(Answer::Window { records: 1, .. })),
        "{granted:?}"
    );
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    for (number, text) in (1..).zip(&lines[..3]) {
        assert_eq!(bench.line(text), Some(Answer::Accepted { records: number }));
    }
    // The end of a record is lost: the next one shows it at once.
    let [begin, next] = [3, 4].map(|record: usize| &lines[record].as_bytes()[..8]);
    assert_eq!(bench.send(HostRequest::Data(begin)), None);
    let asked = bench.send(HostRequest::Data(next));
    assert_eq!(asked, Some(Answer::Resend { record: 3 }));
    assert_eq!(bench.send(HostRequest::GoBack { record: 3 }), None);
    for _ in 0..8 {
        assert_eq!(bench.line(&lines[4]), Some(Answer::Resend { record: 3 }));
        assert_eq!(bench.send(HostRequest::GoBack { record: 3 }), None);
    }
    assert_eq!(bench.line(&lines[4]), Some(Answer::Refused(Refusal::Gap)));
}

/// T-BOOT-3: after it has asked for a record with a window, the loader ignores records until the
/// host says that it goes on with that one.
#[test]
fn a_loader_waits_for_the_record_that_it_asked_for() {
    let mut bench = started(&[], 6);
    connect(&mut bench);
    let _granted = bench.send(HostRequest::Offer { records: 1 });
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    assert_eq!(bench.line(&lines[0]), Some(Answer::Accepted { records: 1 }));
    assert_eq!(bench.line(&lines[1]), Some(Answer::Accepted { records: 2 }));
    let resend = Some(Answer::Resend { record: 2 });
    assert_eq!(bench.line(&lines[3]), resend);
    assert_eq!(bench.line(&lines[2]), None, "it waits");
    assert_eq!(bench.send(HostRequest::GoBack { record: 3 }), resend);
    assert_eq!(bench.line(&lines[2]), None, "it still waits");
    assert_eq!(bench.send(HostRequest::GoBack { record: 2 }), None);
    assert_eq!(bench.line(&lines[2]), Some(Answer::Accepted { records: 3 }));
}

/// T-BOOT-3: a host without a window sends a record again from its beginning if the end was lost.
#[test]
fn a_record_that_was_cut_short_is_sent_again() {
    let mut bench = started(&[], 6);
    connect(&mut bench);
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    let accepted = Some(Answer::Accepted { records: 0 });
    assert_eq!(bench.line(&lines[0]), accepted);
    let begin = HostRequest::Data(&lines[1].as_bytes()[..8]);
    assert_eq!(bench.send(begin), None);
    for line in &lines[1..10] {
        assert_eq!(bench.line(line), accepted);
    }
    // Without a window no record is on the way that could have been lost.
    let refused = Some(Answer::Refused(Refusal::Gap));
    assert_eq!(bench.line(&lines[11]), refused);
}

/// T-BOOT-3: after a silence the loader itself asks for the next record, if one was begun, or if
/// some have no answer yet.
#[test]
fn a_loader_asks_after_a_silence() {
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    for (whole, begun, asks) in [
        (2, false, Some(Answer::Resend { record: 2 })),
        (0, true, Some(Answer::Resend { record: 0 })),
        (2, true, Some(Answer::Resend { record: 2 })),
        (4, false, None),
    ] {
        let mut bench = started(&[], 6);
        connect(&mut bench);
        let _granted = bench.send(HostRequest::Offer { records: 4 });
        for line in &lines[..whole] {
            let answer = bench.line(line);
            let is_due = line == &lines[3];
            assert_eq!(answer.is_some(), is_due, "{answer:?}");
        }
        if begun {
            let begin = HostRequest::Data(&lines[whole].as_bytes()[..8]);
            assert_eq!(bench.send(begin), None);
        }
        let mut asked = None;
        for _ in 0..1_000 {
            bench.now += tandem_board::Duration::from_ms(1);
            if let Next::Send(frame) = bench.loader.next(bench.now) {
                asked = Answer::decode(frame.data());
                break;
            }
        }
        assert_eq!(asked, asks, "{whole} {begun}");
    }
    // Of a record only the middle has arrived.
    let mut bench = started(&[], 6);
    connect(&mut bench);
    assert_eq!(bench.send(HostRequest::Data(b"12345678")), None);
    let Next::Wait(until) = bench.loader.next(bench.now) else {
        panic!("it waits");
    };
    assert_eq!(until.since(bench.now).as_us(), 100_000);
    assert!(matches!(bench.loader.next(until), Next::Send(_)));
}

/// T-BOOT-3: the loader tells which slots are free: those that do not boot.
#[test]
fn the_free_slots_are_told() {
    for (flash, application) in [(factory(), 1), (Images::updated().flash, 0)] {
        let mut bench = started_with(flash, &[], 6);
        connect(&mut bench);
        let granted = Answer::Window {
            records: 4,
            application,
            configuration: 1,
            accepted: 0,
        };
        let answer = bench.send(HostRequest::Offer { records: 4 });
        assert_eq!(answer, Some(granted));
    }
}

/// T-BOOT-3: a tester whose frames were lost for seconds goes on: to resume the connection keeps
/// the proof and the records. To connect anew ends both, and the loader does not wait for another.
#[test]
fn a_connection_that_is_resumed_keeps_its_proof() {
    let mut bench = started(known(), 3);
    connect(&mut bench);
    let challenge = asked(&mut bench);
    let message = [&b"tandem tester"[..], &[0, 0], &challenge].concat();
    assert_eq!(
        signed(&mut bench, &TESTER.sign(&message)),
        Some(Answer::Proved)
    );
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    assert_eq!(bench.line(&lines[0]), Some(Answer::Accepted { records: 0 }));
    bench.now += tandem_board::Duration::from_ms(4_000);
    let connect = |resume| HostRequest::Connect {
        system: None,
        resume,
    };
    assert_eq!(bench.send(connect(true)), Some(Answer::Connected));
    assert_eq!(bench.line(&lines[1]), Some(Answer::Accepted { records: 0 }));
    assert_eq!(bench.send(connect(false)), Some(Answer::Connected));
    let next = bench.loader.next(bench.now);
    assert!(
        !matches!(next, Next::Wait(_) | Next::Send(_)),
        "it boots: {next:?}"
    );
}

/// T-BOOT-1: who has proved itself and left does not leave the loader to others: no record that
/// brings nothing keeps it from booting.
#[test]
fn records_that_bring_nothing_do_not_hold_the_loader() {
    for nothing in ["S5030000FC\n", "S40B00000000000000000000F4\n"] {
        let mut bench = started(known(), 3);
        connect(&mut bench);
        let challenge = asked(&mut bench);
        let message = [&b"tandem tester"[..], &[0, 0], &challenge].concat();
        assert_eq!(
            signed(&mut bench, &TESTER.sign(&message)),
            Some(Answer::Proved)
        );
        let mut boots = false;
        for record in [nothing, "S0030000FC\n"].into_iter().cycle().take(8) {
            bench.now += tandem_board::Duration::from_ms(2_000);
            bench.line(record);
            boots |= !matches!(bench.loader.next(bench.now), Next::Wait(_) | Next::Send(_));
        }
        assert!(boots, "{nothing}: held for 16 s");
    }
}

/// T-BOOT-3: a refusal that comes long after the last record can be asked for again.
#[test]
fn a_late_refusal_is_told_again() {
    let mut bench = started(&[], 3);
    connect(&mut bench);
    bench.now += tandem_board::Duration::from_ms(5_000);
    let refused = Some(Answer::Refused(Refusal::Protected));
    let protected = "S30D000100000102030405060708CD\n";
    assert_eq!(bench.line(protected), refused);
    bench.now += tandem_board::Duration::from_ms(40);
    assert_eq!(bench.line(protected), refused, "within 50 ms");
}

/// T-BOOT-1: after a refusal no frame holds the loader.
#[test]
fn no_frame_holds_the_loader_after_a_refusal() {
    for request in [
        HostRequest::Data(b"S9"),
        HostRequest::Offer { records: 4 },
        HostRequest::RollBack {
            system: Some(tandem_board::SystemId::B),
        },
    ] {
        let mut bench = started(known(), 3);
        connect(&mut bench);
        let refused = bench.line("S1130000000000000000000000000000000000000000EC\n");
        assert_eq!(refused, Some(Answer::Refused(Refusal::Tester)));
        let mut boots = false;
        for _ in 0..20 {
            bench.now += tandem_board::Duration::from_ms(5);
            bench.send(request);
            boots |= !matches!(bench.loader.next(bench.now), Next::Wait(_) | Next::Send(_));
        }
        assert!(boots, "{request:?}: held after 100 ms");
    }
}
