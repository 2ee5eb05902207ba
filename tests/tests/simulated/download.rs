//! Tests of a host that requests the bootloader from a driving controller. T-BOOT-1

use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{
    Board, CanFrame, CanId, CoreId, DeskAction, Duration, Instant, NoCounter, ResetCause, RoleLamp,
    SystemId, TesterDesk,
};
use tandem_board_sim::SystemEventKind;
use tandem_boot::{
    Answer, BootDesk, CHALLENGE_BYTES, DeskSetup, Environment, EnvironmentStore, HostRequest,
    Question, Refusal, Selection, Slot, Trust, TrustMode, ed25519, tester_message,
};
use tandem_boot_host::{SigningKey, SimulatedFlash};
use tandem_cores::Core as _;
use tandem_cores::core2::Core2;
use tandem_redundancy::Evidence;
use tandem_sim::drive::{Drive, poller};

const MS: fn(u64) -> Duration = Duration::from_ms;

/// Returns the connect request of `docs/boot.md` for system 1 (A), 2 (B), or 0 (any).
fn connect(to: u8) -> CanFrame {
    let data = [0x2D, 0x57, 0x3E, 0x08, to, 0, 0, 0];
    CanFrame::new(CanId::Extended(0x0CFF_0126), false, &data).expect("a frame")
}

/// Returns the causes of a system's resets so far.
fn resets(drive: &Drive, of: SystemId) -> Vec<ResetCause> {
    let events = drive.pair.events().into_iter();
    let reset = events.filter_map(|event| match event.kind {
        SystemEventKind::Reset(cause) if event.system == of => Some(cause),
        _ => None,
    });
    reset.collect()
}

/// Starts a drive whose systems resume dual operation after a reset.
fn drive() -> Drive {
    let mut config = tandem_cores::Config::rt();
    config.redundancy.reintegrate = true;
    let mut drive = Drive::with("free-lane", 1, move |board| poller(board, config));
    drive.run_for(MS(4_000));
    assert_eq!(lamps(&drive), DUAL);
    drive
}

fn lamps(drive: &Drive) -> [Option<RoleLamp>; 2] {
    SystemId::ALL.map(|system| drive.pair.lamp(system))
}

/// A drives, and B is its standby.
const DUAL: [Option<RoleLamp>; 2] = [Some(RoleLamp::Master), Some(RoleLamp::Standby)];

/// Repeats a host's request until the system resets, for at most 300 ms as in `docs/boot.md`.
fn ask(drive: &mut Drive, system: SystemId) {
    let to = system.index() as u8 + 1;
    for _ in 0..60 {
        drive.seen.borrow_mut().forged.push(connect(to));
        drive.run_for(MS(5));
        if !resets(drive, system).is_empty() {
            return;
        }
    }
}

/// T-BOOT-1, U-3: each system enters its bootloader while the other system drives: the standby at
/// once, the master after it has handed over. No control frame is lost in either case.
#[test]
fn both_systems_go_for_a_download_while_the_vehicle_drives() {
    let mut drive = drive();
    drive.seen.borrow_mut().forged.push(connect(0));
    drive.run_for(MS(1_000));
    for system in SystemId::ALL {
        assert_eq!(resets(&drive, system), [], "{system} was not named");
    }
    ask(&mut drive, SystemId::B);
    drive.run_for(MS(4_000));
    assert_eq!(resets(&drive, SystemId::B), [ResetCause::Download]);
    assert_eq!(lamps(&drive), DUAL, "B is back");

    ask(&mut drive, SystemId::A);
    drive.run_for(MS(4_000));
    assert_eq!(resets(&drive, SystemId::A), [ResetCause::Download]);
    assert_eq!(resets(&drive, SystemId::B), [ResetCause::Download]);
    let [a, b] = lamps(&drive);
    assert_eq!([b, a], DUAL, "A is the standby of B");
    let takeovers = drive.takeovers();
    let causes: Vec<_> = takeovers.iter().map(|takeover| takeover.cause).collect();
    assert_eq!(causes, [Some(Evidence::MasterResigns)]);
    assert!(takeovers[0].gap_ms <= 11.0, "{takeovers:?}");
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
    assert_eq!(drive.two_masters_ns(), 0);
}

/// T-BOOT-1: one request makes the master hand over. It then remains the standby, and enters the
/// bootloader only after another request.
#[test]
fn a_system_that_drives_does_not_go() {
    let mut drive = drive();
    drive.seen.borrow_mut().forged.push(connect(1));
    drive.run_for(MS(4_000));
    let [a, b] = lamps(&drive);
    assert_eq!([b, a], DUAL);
    assert_eq!(resets(&drive, SystemId::A), []);
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
}

/// T-BOOT-1: a standby does not reset while its master fails, however often a host requests it.
#[test]
fn a_standby_does_not_leave_a_master_that_fails() {
    for after_ms in [5, 8, 12] {
        let mut drive = drive();
        drive.pair.power_off(SystemId::A);
        drive.run_for(MS(after_ms));
        ask(&mut drive, SystemId::B);
        assert_eq!(resets(&drive, SystemId::B), [], "after {after_ms} ms");
        assert_eq!(drive.masters(), SystemId::ALL);
        assert!(drive.gap_max() <= MS(20), "{:?}", drive.gap_max());
    }
}

const TESTER: SigningKey = SigningKey {
    number: 0,
    seed: [3; 32],
};

/// A desk, and what both desks have answered.
struct Watched<D>(D, Rc<RefCell<Vec<Answer>>>);

impl<D: TesterDesk> TesterDesk for Watched<D> {
    fn hear(&mut self, now: Instant, frame: &CanFrame) -> Option<DeskAction> {
        let action = self.0.hear(now, frame);
        if let Some(DeskAction::Send(frame)) = &action {
            self.1.borrow_mut().extend(Answer::decode(frame.data()));
        }
        action
    }

    fn poll(&mut self, now: Instant, has_role: bool) -> Option<DeskAction> {
        self.0.poll(now, has_role)
    }
}

/// Starts a drive whose core 2 has a bootloader's desk that knows one tester. Also returns what the
/// desks answer.
fn drive_with_desks() -> (Drive, Rc<RefCell<Vec<Answer>>>) {
    let answers: Rc<RefCell<Vec<Answer>>> = Rc::default();
    let seen = answers.clone();
    let mut config = tandem_cores::Config::rt();
    config.redundancy.reintegrate = true;
    let testers: &'static [[u8; 32]] = Box::leak(Box::new([TESTER.public()]));
    let mut drive = Drive::with("free-lane", 1, move |board| {
        if board.identity().core != CoreId::PLANNING {
            return poller(board, config);
        }
        let board = Box::leak(Box::new(board.clone()));
        let setup = DeskSetup {
            trust: Trust {
                keys: &[],
                testers,
                mode: TrustMode::Strict,
                verify: ed25519,
            },
            system: board.identity().system,
            running: Slot::A,
            starts: 1,
            noise: [board.identity().system.index() as u8; 32],
        };
        let mut flash = SimulatedFlash::new();
        let environment = Environment {
            active: Selection {
                application: Some(Slot::A),
                configuration: None,
            },
            ..Environment::default()
        };
        EnvironmentStore::new(environment)
            .settle(&mut flash)
            .expect("a flash");
        let desk = BootDesk::new(flash, NoCounter, setup, board.now());
        let mut core = Core2::with_desk(board, Watched(desk, seen.clone()));
        Box::new(move |_| core.poll())
    });
    drive.run_for(MS(4_000));
    assert_eq!(lamps(&drive), DUAL);
    (drive, answers)
}

fn send(drive: &mut Drive, request: HostRequest<'_>) {
    let frame = request.frame().expect("a frame");
    drive.seen.borrow_mut().forged.push(frame);
    drive.run_for(MS(1));
}

/// Asks for the challenge of a system.
fn challenge(
    drive: &mut Drive,
    answers: &RefCell<Vec<Answer>>,
    system: SystemId,
) -> [u8; CHALLENGE_BYTES] {
    let mut challenge = [0; CHALLENGE_BYTES];
    for part in 0..3 {
        let system = Some(system);
        send(
            drive,
            HostRequest::Challenge {
                system,
                key: 0,
                part,
            },
        );
    }
    drive.run_for(MS(60));
    let mut found = 0;
    for answer in answers.borrow().iter() {
        if let Answer::Challenge { part, bytes } = answer {
            challenge[usize::from(*part) * 5..][..5].copy_from_slice(bytes);
            found |= 1 << part;
        }
    }
    assert_eq!(found, 0b111, "all parts");
    challenge
}

/// T-BOOT-1, E-4: the frame that took a standby out of a driving vehicle does nothing without a
/// proof, however often it comes, and neither does a flood of questions. A tester with the key
/// takes the standby out.
#[test]
fn only_a_tester_takes_the_standby_out_of_a_driving_vehicle() {
    let (mut drive, answers) = drive_with_desks();
    for _ in 0..200 {
        drive.seen.borrow_mut().forged.push(connect(2));
        drive.seen.borrow_mut().forged.push(connect(1));
        for age in 0..3 {
            let request = HostRequest::Info {
                system: Some(SystemId::B),
                question: Question::Log(age).code().expect("a question"),
            };
            let frame = request.frame().expect("a frame");
            drive.seen.borrow_mut().forged.push(frame);
        }
        drive.run_for(MS(5));
    }
    for system in SystemId::ALL {
        assert_eq!(resets(&drive, system), [], "{system}");
    }
    assert_eq!(lamps(&drive), DUAL, "no system handed over");
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());

    let refused = Answer::Refused(Refusal::Tester);
    assert!(answers.borrow().contains(&refused));
    let challenge = challenge(&mut drive, &answers, SystemId::B);
    let message = tester_message(SystemId::B, 0, &challenge);
    let signature = [&TESTER.sign(&message)[..], &[0]].concat();
    for (part, piece) in (0..).zip(signature.chunks(5)) {
        let request = HostRequest::Proof {
            system: Some(SystemId::B),
            part,
            bytes: piece.try_into().expect("five bytes"),
        };
        send(&mut drive, request);
    }
    ask(&mut drive, SystemId::B);
    drive.run_for(MS(4_000));
    assert_eq!(resets(&drive, SystemId::B), [ResetCause::Download]);
    assert_eq!(resets(&drive, SystemId::A), []);
    assert!(drive.gap_max() <= MS(11), "{:?}", drive.gap_max());
}
