//! Which loader answers which request, for how long it waits then, and what it logs of a refusal.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{factory, image};
use tandem_board::tester_desk::{TO_HOST, TO_LOADER};
use tandem_board::{CanFrame, Instant, ResetCause, SystemId};
use tandem_boot::{
    Answer, HostRequest, Loader, LogEvent, Next, Question, Refusal, Slot, read_log, tester_message,
};
use tandem_boot_host::life::{TEST_KEY_1, TEST_PUBLIC};
use tandem_boot_host::{SigningKey, SimulatedFlash, records};

const TESTER: SigningKey = SigningKey {
    number: 0,
    ..TEST_KEY_1
};
const A: Option<SystemId> = Some(SystemId::A);
const B: Option<SystemId> = Some(SystemId::B);

struct Bench {
    loader: Loader<'static, SimulatedFlash>,
    now: Instant,
}

impl Bench {
    fn new(flash: SimulatedFlash, system: SystemId, cause: ResetCause, testers: bool) -> Self {
        const KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
        let mut setup = fixture::setup(&KEYS);
        (setup.system, setup.cause) = (system, cause);
        if testers {
            setup.trust.testers = Box::leak(Box::new([TESTER.public()]));
        }
        let now = Instant::ORIGIN;
        Self {
            loader: Loader::start(flash, setup, now),
            now,
        }
    }

    fn send(&mut self, request: HostRequest<'_>) -> Option<Answer> {
        self.loader.on_frame(self.now, &request.frame().unwrap());
        match self.loader.next(self.now) {
            Next::Send(frame) => Answer::decode(frame.data()),
            _ => None,
        }
    }

    fn connect(&mut self, system: Option<SystemId>) -> Option<Answer> {
        let resume = false;
        self.send(HostRequest::Connect { system, resume })
    }

    fn line(&mut self, line: &str) -> Option<Answer> {
        let pieces = line.as_bytes().chunks(8);
        let answers = pieces.map(|piece| self.send(HostRequest::Data(piece)));
        answers.last().flatten()
    }

    /// Proves that the host has a tester's key; with `right` false by a wrong signature.
    fn prove(&mut self, right: bool) -> Option<Answer> {
        let mut challenge = Vec::new();
        for part in 0..3 {
            let (system, key) = (A, 0);
            match self.send(HostRequest::Challenge { system, key, part })? {
                Answer::Challenge { bytes, .. } => challenge.extend(bytes),
                other => return Some(other),
            }
        }
        let message = tester_message(SystemId::A, 0, &challenge.try_into().unwrap());
        let mut signature = [&TESTER.sign(&message)[..], &[0]].concat();
        signature[7] ^= u8::from(!right);
        let mut answer = None;
        for (part, bytes) in (0..).zip(signature.as_chunks::<5>().0) {
            let (system, bytes) = (A, *bytes);
            answer = self.send(HostRequest::Proof {
                system,
                part,
                bytes,
            });
        }
        answer
    }

    /// Returns for how long the loader still waits, ms.
    fn waits_ms(&mut self) -> u64 {
        let begun = self.now;
        while matches!(self.loader.next(self.now), Next::Wait(_) | Next::Send(_)) {
            self.now = Instant::from_ns(self.now.as_ns() + 1_000_000);
        }
        self.now.since(begun).as_us() / 1_000
    }
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
            let mut bench = Bench::new(flash, system, cause, false);
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
        let mut bench = Bench::new(factory(), SystemId::A, ResetCause::PowerOn, false);
        bench.loader.on_frame(bench.now, &frame);
        let answers = matches!(bench.loader.next(bench.now), Next::Send(_));
        assert_eq!(answers, connects, "{id:?}");
    }
    let mut bench = Bench::new(factory(), SystemId::A, ResetCause::Watchdog, false);
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
            let mut bench = Bench::new(factory(), SystemId::A, ResetCause::Download, true);
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
    for (right, answer, waits_ms) in [
        (true, Answer::Proved, 10_000),
        (false, Answer::Unproved, 500),
    ] {
        let mut bench = Bench::new(factory(), SystemId::A, ResetCause::Download, true);
        assert_eq!(bench.connect(A), Some(Answer::Connected));
        bench.now = Instant::from_ns(1_500_000_000);
        assert_eq!(bench.prove(right), Some(answer));
        assert_eq!(bench.waits_ms(), waits_ms);
    }
}

/// E-4: a host that connects anew has to prove itself again.
#[test]
fn a_new_connection_has_no_proof() {
    let mut bench = Bench::new(factory(), SystemId::A, ResetCause::Download, true);
    let lines = records("new", &[&image(Slot::B, 2, 300)]);
    assert_eq!(bench.connect(A), Some(Answer::Connected));
    assert_eq!(bench.prove(true), Some(Answer::Proved));
    assert_eq!(bench.connect(A), Some(Answer::Connected));
    let refused = Some(Answer::Refused(Refusal::Tester));
    assert_eq!(bench.line(&lines[0]), refused);
}

/// U-2: the log has one entry for a refused download, with the reason, also if the host goes on.
#[test]
fn a_refusal_is_logged_once() {
    let mut bench = Bench::new(factory(), SystemId::A, ResetCause::Download, false);
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
