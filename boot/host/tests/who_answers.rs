//! Which loader answers which request, for how long it waits then, and what it logs of a refusal.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::loader_bench::LoaderBench;
use fixture::proof::{TESTER, WRONG, known};
use fixture::{factory, image};
use tandem_board::tester_desk::{TO_HOST, TO_LOADER};
use tandem_board::{CanFrame, Instant, ResetCause, SystemId};
use tandem_boot::{Answer, HostRequest, LogEvent, Next, Question, Refusal, Slot, read_log};
use tandem_boot_host::life::TEST_PUBLIC;
use tandem_boot_host::{SimulatedFlash, records};

const A: Option<SystemId> = Some(SystemId::A);
const B: Option<SystemId> = Some(SystemId::B);

/// A loader of a system after a reset. `testers`: it knows a tester.
fn started(
    flash: SimulatedFlash,
    system: SystemId,
    cause: ResetCause,
    testers: bool,
) -> LoaderBench {
    const KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
    let mut setup = fixture::setup(&KEYS);
    (setup.system, setup.cause) = (system, cause);
    if testers {
        setup.trust.testers = known();
    }
    LoaderBench::start(flash, setup)
}

/// Returns for how long a loader still waits, ms.
fn waits_ms(bench: &mut LoaderBench) -> u64 {
    let begun = bench.now;
    while matches!(bench.loader.next(bench.now), Next::Wait(_) | Next::Send(_)) {
        bench.now = Instant::from_ns(bench.now.as_ns() + 1_000_000);
    }
    bench.now.since(begun).as_us() / 1_000
}

/// T-BOOT-1: of two loaders that start together one answers a host that names no system: A at
/// power-on, else the one that was sent into the download, or that has nothing to boot.
#[test]
fn one_of_two_loaders_connects() {
    use ResetCause::{Download, PowerOn};
    for (boots_nothing, system, cause, connects) in [
        (false, SystemId::A, PowerOn, [true, true, false]),
        (false, SystemId::B, PowerOn, [false, false, true]),
        (false, SystemId::A, Download, [true, true, false]),
        (false, SystemId::B, Download, [true, false, true]),
        (true, SystemId::B, PowerOn, [true, false, true]),
    ] {
        for (named, connects) in [None, A, B].into_iter().zip(connects) {
            let flash = match boots_nothing {
                true => SimulatedFlash::new(),
                false => factory(),
            };
            let mut bench = started(flash, system, cause, false);
            if boots_nothing {
                // It finds that when its window for hosts has ended.
                bench.now = Instant::from_ns(1_000_000_000);
                assert!(matches!(bench.loader.next(bench.now), Next::Wait(_)));
            }
            let expected = connects.then_some(Answer::Connected);
            assert_eq!(
                bench.connect(named),
                expected,
                "{system} {cause:?} {named:?}"
            );
        }
    }
}

/// T-BOOT-1: a loader hears nothing under another identifier, and nothing after it has decided.
#[test]
fn a_loader_hears_its_own_identifier() {
    let (system, resume) = (A, false);
    let request = HostRequest::Connect { system, resume }.frame().unwrap();
    for (id, connects) in [(TO_LOADER, true), (TO_HOST, false)] {
        let frame = CanFrame::new(id, false, request.data()).unwrap();
        let mut bench = started(factory(), SystemId::A, ResetCause::PowerOn, false);
        bench.loader.on_frame(bench.now, &frame);
        let answers = matches!(bench.loader.next(bench.now), Next::Send(_));
        assert_eq!(answers, connects, "{id:?}");
    }
    let mut bench = started(factory(), SystemId::A, ResetCause::Watchdog, false);
    let decided = bench.loader.next(bench.now);
    assert!(matches!(decided, Next::Jump(_)), "{decided:?}");
    bench.loader.on_frame(bench.now, &request);
    assert_eq!(bench.loader.next(bench.now), decided);
}

/// T-BOOT-1, U-2: a loader answers questions and proofs that name its system, and those that name
/// none if a host is connected.
#[test]
fn a_loader_answers_who_means_it() {
    let place = Question::Environment(0).code().unwrap();
    let ask = |system| HostRequest::Info {
        system,
        question: place,
    };
    let challenge = |system| HostRequest::Challenge {
        system,
        key: 0,
        part: 0,
    };
    for connects in [false, true] {
        for (system, answers) in [(A, true), (B, false), (None, connects)] {
            let mut bench = started(factory(), SystemId::A, ResetCause::Download, true);
            if connects {
                assert_eq!(bench.connect(A), Some(Answer::Connected));
            }
            let told = bench.send(ask(system));
            assert_eq!(told.is_some(), answers, "{connects} {system:?}");
            let told = bench.send(challenge(system));
            assert_eq!(told.is_some(), answers, "{connects} {system:?}");
        }
    }
}

/// T-BOOT-1: a tester has ten seconds after its proof; a wrong proof earns none.
#[test]
fn a_proof_is_progress() {
    for (key, answer, expected_ms) in [
        (TESTER, Answer::Proved, 10_000),
        (WRONG, Answer::Unproved, 500),
    ] {
        let mut bench = started(factory(), SystemId::A, ResetCause::Download, true);
        assert_eq!(bench.connect(A), Some(Answer::Connected));
        bench.now = Instant::from_ns(1_500_000_000);
        assert_eq!(bench.prove(&key), Some(answer));
        assert_eq!(waits_ms(&mut bench), expected_ms);
    }
}

/// E-4: a host that connects anew has to prove itself again.
#[test]
fn a_new_connection_has_no_proof() {
    let mut bench = started(factory(), SystemId::A, ResetCause::Download, true);
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    assert_eq!(bench.connect(A), Some(Answer::Connected));
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    assert_eq!(bench.connect(A), Some(Answer::Connected));
    let refused = Some(Answer::Refused(Refusal::Tester));
    assert_eq!(bench.line(&lines[0]), refused);
}

/// U-2: the log has one entry for a refused download, with the reason, also if the host goes on.
#[test]
fn a_refusal_is_logged_once() {
    let mut bench = started(factory(), SystemId::A, ResetCause::Download, false);
    let lines = records("new", &[&image(Slot::A, 2, 300)]);
    for _ in 0..2 {
        assert_eq!(bench.connect(A), Some(Answer::Connected));
        assert_eq!(bench.line(&lines[0]), Some(Answer::Accepted { records: 0 }));
        let refused = Some(Answer::Refused(Refusal::SlotInUse));
        assert_eq!(bench.line(&lines[1]), refused);
        let _ignored = bench.line(&lines[2]);
    }
    let mut logged = Vec::new();
    read_log(&mut bench.loader.flash().clone(), &mut |entry| {
        logged.push((entry.event, entry.value));
    });
    let refusal = (LogEvent::DownloadRefused, Refusal::SlotInUse as u32);
    logged.retain(|(event, _)| *event == LogEvent::DownloadRefused);
    assert_eq!(logged, [refusal; 2], "one for each connection");
}
