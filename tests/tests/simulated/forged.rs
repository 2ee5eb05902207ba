//! Frames with a right CRC, the next counter, and a wrong word: one of them decides nothing.

use crate::terms::obeyed;
use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{Board, CanFrame, CoreId, Duration, SystemId};
use tandem_board_sim::{Poller, SimBoard};
use tandem_bus::{Control, Message, ModeCode, RoleCode};
use tandem_cores::Config;
use tandem_redundancy::{SystemState, Term};
use tandem_sim::drive::{Drive, poller};
use tandem_tests::bent::{altered, bent_core};
use tandem_vehicle::gate::{EXPLAINED, LAST_TERM, LAST_UNEXPLAINED_TERM};

use SystemId::{A, B};

const MS: fn(u64) -> Duration = Duration::from_ms;
const FAR: [u32; 4] = [0xFFFF_FFFE, 0xFFFF_FFFF, 0x7FFF_FFFE, 1_000_001];

/// Alters a message that one core 0 hears; returns whether it did.
type Alter = Rc<dyn Fn(&mut Message) -> bool>;

/// A drive in which the next message that fits is altered, once in each system that hears it.
struct Forger {
    drive: Drive,
    /// What each system still has to hear.
    waits: Rc<RefCell<[Option<Alter>; 2]>>,
}

impl Forger {
    /// Starts both systems, and drives until the standby would be a backup.
    fn start(seed: u64) -> Self {
        let waits: Rc<RefCell<[Option<Alter>; 2]>> = Rc::default();
        let shared = Rc::clone(&waits);
        let drive = Drive::with("free-lane", seed, move |board: &SimBoard| -> Poller {
            let of = board.identity();
            if of.core != CoreId::CONTROL {
                return poller(board, Config::rt());
            }
            let (waits, system) = (Rc::clone(&shared), of.system.index());
            let hears = move |_, frame| altered_once(frame, &mut waits.borrow_mut()[system]);
            bent_core(
                board,
                Config::rt(),
                Box::new(|_, frame| vec![frame]),
                Box::new(hears),
            )
        });
        let mut forger = Self { drive, waits };
        forger.drive.run_for(MS(6_000));
        forger
    }

    /// Lets these systems hear one altered message each, and drives for `ms`.
    fn hear(&mut self, hearers: &[SystemId], alter: &Alter, ms: u64, what: &str) {
        for hearer in hearers {
            self.waits.borrow_mut()[hearer.index()] = Some(Rc::clone(alter));
        }
        self.drive.run_for(MS(ms));
        let missed = self.waits.borrow().iter().any(Option::is_some);
        assert!(!missed, "{what}: no such message was heard");
    }

    /// Returns the time without an accepted frame since `from_ns`, at most, ms.
    fn gap_ms(&self, from_ns: u64) -> f64 {
        let seen = self.drive.seen.borrow();
        let times = seen.log.accepted().map(|frame| frame.at_ns);
        let times = Vec::from_iter(times.chain([self.drive.pair.now().as_ns()]));
        let gaps = times.windows(2).filter(|pair| pair[1] > from_ns);
        gaps.map(|pair| (pair[1] - pair[0]) as f64 * 1e-6)
            .fold(0.0, f64::max)
    }

    fn now_ns(&self) -> u64 {
        self.drive.pair.now().as_ns()
    }

    fn suspended(&self) -> [bool; 2] {
        SystemId::ALL.map(|system| self.drive.state_in_flash(system).sys_failure)
    }
}

fn altered_once(frame: CanFrame, waits: &mut Option<Alter>) -> CanFrame {
    let Some(alter) = waits.clone() else {
        return frame;
    };
    let mut fits = false;
    let forged = altered(frame, |message| fits = alter(message));
    if fits {
        *waits = None;
        return forged;
    }
    frame
}

/// Sets the term of the next frame of a kind, from either system.
fn with_term(kind: &'static str, term: u32) -> Alter {
    Rc::new(move |message| {
        let place = match (message, kind) {
            (Message::GateEcho(echo), "echo") => &mut echo.term,
            (Message::Status { status, .. }, "status") => &mut status.term,
            (Message::Control { system, control }, "control") if u32::from(*system) == term & 1 => {
                &mut control.term
            }
            _ => return false,
        };
        *place = term;
        true
    })
}

/// T-RED-9: the vehicle shares no code with the systems, and has the same ends of the terms. It
/// explains twice their distance, so that it accepts a system that has believed a wrong word and
/// takes a term above it.
#[test]
fn the_vehicle_and_the_systems_explain_the_same_terms() {
    assert_eq!(EXPLAINED, 2 * Term::EXPLAINED);
    assert_eq!(LAST_TERM, Term::LAST.bits());
    assert_eq!(LAST_UNEXPLAINED_TERM, Term::LAST_UNEXPLAINED.bits());
}

/// T-RED-9: one status frame, echo or control frame with a far term changes nothing, whichever
/// system hears it, in dual operation and in a system that is alone.
#[test]
fn one_frame_with_a_far_term_changes_nothing() {
    let mut forger = Forger::start(4);
    for alone in [false, true] {
        if alone {
            forger.drive.pair.power_off(B);
            forger.drive.run_for(MS(500));
        }
        let hearers: &[&[SystemId]] = if alone {
            &[&[A]]
        } else {
            &[&[A], &[B], &[A, B]]
        };
        for kind in ["status", "echo", "control"] {
            for term in FAR {
                for &hearers in hearers {
                    // Only the standby hears control frames, and a lone system hears echoes only.
                    let control = kind == "control" && (hearers != [B] || term & 1 == 1);
                    if control || alone && kind != "echo" {
                        continue;
                    }
                    let what = format!("{kind} {term:x} to {hearers:?}, alone {alone}");
                    let from = forger.now_ns();
                    forger.hear(hearers, &with_term(kind, term), 250, &what);
                    let gap = forger.gap_ms(from);
                    assert!(gap < 12.0, "{what}: {gap} ms");
                    assert_eq!(forger.suspended(), [false; 2], "{what}");
                    assert_eq!(forger.drive.masters(), [A], "{what}");
                }
            }
        }
    }
}

/// T-RED-9: one control frame of the standby with a far term, heard by all, changes nothing; and
/// frames of both systems with far terms again and again make no system leave.
#[test]
fn a_control_frame_with_a_far_term_does_not_act() {
    for (term, times) in [
        (0xFFFF_FFFF, 1),
        (0x7FFF_FFFF, 1),
        (1_000_001, 1),
        (1_000_001, 60),
    ] {
        let mut drive = Drive::new("free-lane", 4);
        drive.run_for(MS(6_000));
        let mut transmitter = tandem_bus::FrameTransmitter::new();
        for _ in 0..times {
            let control = Control {
                role: RoleCode::Master,
                mode: ModeCode::L3,
                term,
                ..Control::default()
            };
            crate::stale::forge(&drive, &mut transmitter, control);
            drive.run_for(MS(10));
        }
        drive.run_for(MS(500));
        let counts = drive.seen.borrow().world.gate().counts();
        println!("{term:x}, {times} times: {counts:?}");
        assert_eq!(counts.unexplained + counts.invalid, times, "{counts:?}");
        assert_eq!(drive.masters(), [A], "{term:x}");
        assert!(drive.gap_max() < MS(12), "{term:x}: {:?}", drive.gap_max());
        for system in SystemId::ALL {
            assert!(!drive.state_in_flash(system).sys_failure);
        }
    }
}

/// T-RED-9: flashes with a term near the end of all terms in both systems: both start, one drives,
/// and the records are healed.
#[test]
fn poisoned_records_are_healed() {
    let mut drive = Drive::new("free-lane", 8);
    for system in SystemId::ALL {
        drive.pair.power_off(system);
        let state = SystemState {
            term: Term::from_bits(u32::MAX - 1),
            ..SystemState::factory(system)
        };
        drive.pair.edit_flash(system, |bytes| {
            bytes.fill(0xFF);
            bytes[..SystemState::BYTES].copy_from_slice(&state.encode(1));
        });
    }
    drive.run_for(MS(100));
    for system in SystemId::ALL {
        drive.pair.power_on(system);
    }
    drive.run_for(MS(6_000));
    let last = obeyed(&drive).expect("a system drives");
    assert!(last.term < 9_000, "{last:?}");
    for system in SystemId::ALL {
        let state = drive.state_in_flash(system);
        assert!(
            !state.sys_failure && state.term.bits() == last.term,
            "{state:?}"
        );
    }
}

/// Alters the next message for which `alter` returns `true`.
fn once(alter: impl Fn(&mut Message) -> bool + 'static) -> Alter {
    Rc::new(alter)
}

fn in_echo(alter: impl Fn(&mut tandem_bus::GateEcho) + 'static) -> Alter {
    once(move |message| {
        if let Message::GateEcho(echo) = message {
            alter(echo);
            return true;
        }
        false
    })
}

fn in_status(of: SystemId, alter: impl Fn(&mut tandem_bus::Status) + 'static) -> Alter {
    once(move |message| match message {
        Message::Status { system, status } if usize::from(*system) == of.index() => {
            alter(status);
            true
        }
        _ => false,
    })
}

fn in_control(alter: impl Fn(&mut Control) + 'static) -> Alter {
    once(move |message| {
        if let Message::Control { system: 0, control } = message {
            alter(control);
            return true;
        }
        false
    })
}

/// T-RED-9: the worst wrong value of each word, heard once by one system in dual operation or by a
/// system that is alone, costs at most the gap of a mute master. Prints what each does.
#[test]
fn no_forged_word_costs_more_than_a_mute_master() {
    use tandem_bus::AgreementCode;
    let near = |echo: &mut tandem_bus::GateEcho, above: u32| echo.term += above;
    let resigns = |status: &mut tandem_bus::Status| {
        (status.role, status.mode) = (RoleCode::Master, ModeCode::SafeStop);
    };
    let claims = |status: &mut tandem_bus::Status| {
        status.role = RoleCode::Master;
        status.term += 1;
    };
    let words: Vec<(&str, SystemId, Alter)> = vec![
        (
            "echo: other system, next term",
            A,
            in_echo(move |it| (near(it, 1), it.term_age = 0.0).1),
        ),
        ("echo: own next term", A, in_echo(move |it| near(it, 2))),
        ("echo: no term", A, in_echo(|it| it.term = 0)),
        ("echo: old", A, in_echo(|it| it.term_age = 500.0)),
        (
            "echo: one refusal more",
            A,
            in_echo(|it| it.refused = it.refused.wrapping_add(1)),
        ),
        (
            "echo: refusals",
            A,
            in_echo(|it| it.refused = it.refused.wrapping_add(77)),
        ),
        (
            "echo: counter",
            A,
            in_echo(|it| it.obeyed_counter = it.obeyed_counter.wrapping_sub(9)),
        ),
        ("echo: steering", A, in_echo(|it| it.steering_angle = 0.3)),
        (
            "echo: acceleration",
            A,
            in_echo(|it| it.acceleration = -9.0),
        ),
        (
            "echo: clock",
            A,
            in_echo(|it| it.sent_at = it.sent_at.wrapping_add(100)),
        ),
        ("echo: no term", B, in_echo(|it| it.term = 0)),
        ("echo: own next term", B, in_echo(move |it| near(it, 1))),
        ("echo: old", B, in_echo(|it| it.term_age = 500.0)),
        ("echo: steering", B, in_echo(|it| it.steering_angle = 0.3)),
        (
            "echo: clock",
            B,
            in_echo(|it| it.sent_at = it.sent_at.wrapping_add(100)),
        ),
        ("status: claims to drive", A, in_status(B, claims)),
        (
            "status: starting",
            A,
            in_status(B, |it| it.role = RoleCode::Starting),
        ),
        (
            "status: standby, next term",
            A,
            in_status(B, |it| it.term += 1),
        ),
        (
            "status: stops",
            A,
            in_status(B, |it| it.agreement = AgreementCode::Unresolved),
        ),
        ("status: resigns", B, in_status(A, resigns)),
        (
            "status: standby",
            B,
            in_status(A, |it| it.role = RoleCode::Standby),
        ),
        ("status: next term", B, in_status(A, |it| it.term += 2)),
        (
            "status: stops",
            B,
            in_status(A, |it| it.agreement = AgreementCode::Unresolved),
        ),
        (
            "control: standby",
            B,
            in_control(|it| it.role = RoleCode::Standby),
        ),
        ("control: next term", B, in_control(|it| it.term += 2)),
        ("control: old term", B, in_control(|it| it.term = 0)),
        (
            "control: stops",
            B,
            in_control(|it| it.mode = ModeCode::SafeStop),
        ),
        (
            "control: steering",
            B,
            in_control(|it| it.steering_angle = 0.3),
        ),
    ];
    let mut bad = vec![];
    for (what, hearer, alter) in words {
        let alone_too = hearer == A && what.starts_with("echo");
        for alone in [false, true] {
            if alone && !alone_too {
                continue;
            }
            let mut forger = Forger::start(4);
            if alone {
                forger.drive.pair.power_off(B);
                forger.drive.run_for(MS(1_000));
            }
            let from = forger.now_ns();
            forger.hear(&[hearer], &alter, 3_000, what);
            let (gap, masters) = (forger.gap_ms(from), forger.drive.masters());
            let resets = forger.drive.state_in_flash(A).abn_resets
                + forger.drive.state_in_flash(B).abn_resets;
            println!(
                "{what} to {hearer}, alone {alone}: {gap:.1} ms, {masters:?}, {resets} resets"
            );
            let driven = obeyed(&forger.drive).is_some() && forger.suspended() == [false; 2];
            if gap > 21.0 || !driven {
                bad.push(what);
            }
        }
    }
    assert!(bad.is_empty(), "{bad:?}");
}
