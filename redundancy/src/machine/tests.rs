//! The transition table as the machine follows it: every cell is run, checked, and compared with
//! the docs.
#![allow(clippy::unwrap_used)]

#[path = "../../tests/pair/page.rs"]
mod page;

use super::*;
use crate::{Ability, ControlHeader, ObeyedTerm};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::format;
use std::string::{String, ToString};
use std::vec::Vec;
use strum::VariantArray as _;
use tandem_board::Duration;

const CONFIG: Config = Config::rt();

/// A machine of system A and the state of its lines.
struct Bench {
    machine: Redundancy,
    snapshot: LineSnapshot,
    now: Instant,
}

impl Bench {
    fn starting() -> Self {
        let now = Instant::from_ns(3_000_000_000);
        let loaded = Loaded::State(SystemState::factory(SystemId::A));
        let mut bench = Self {
            machine: Redundancy::new(CONFIG, SystemId::A, ResetCause::PowerOn, loaded, now),
            snapshot: LineSnapshot {
                handshakes: 0,
                syncs: 0,
                beats: [0; 2],
                peer_powered: true,
                can_frames: 0,
            },
            now,
        };
        let _ = bench.poll();
        bench
    }

    fn poll(&mut self) -> Actions {
        self.snapshot.beats = self.snapshot.beats.map(|count| count + 1);
        self.poll_without_beats()
    }

    fn poll_without_beats(&mut self) -> Actions {
        self.now += Duration::from_ms(1);
        self.snapshot.can_frames += 1;
        self.machine.on(self.now, Input::Poll(self.snapshot))
    }

    /// Brings a new machine into this phase by inputs, and returns it.
    fn of(phase: Phase) -> Self {
        let mut bench = Self::starting();
        match phase {
            Phase::Starting => {}
            Phase::Standby => {
                bench.snapshot.syncs += 1;
                let _ = bench.poll();
            }
            Phase::Master => {
                for _ in 0..2 {
                    bench.snapshot.handshakes += 1;
                    let _ = bench.poll_without_beats();
                }
            }
            Phase::DegradedMaster => {
                bench = Self::of(Phase::Master);
                bench.snapshot.peer_powered = false;
                for _ in 0..3 {
                    let _ = bench.poll_without_beats();
                }
                bench.snapshot.peer_powered = true;
                let _ = bench.poll();
            }
            Phase::Thawed => {
                bench = Self::of(Phase::Master);
                bench.now += CONFIG.witness_limit();
                let _ = bench.poll();
            }
            Phase::Resetting => bench.fails(FailureMode::Deadline),
            Phase::Suspended => {
                bench = Self::of(Phase::Standby);
                bench.fails(FailureMode::TermsExhausted);
            }
        }
        assert_eq!(bench.machine.phase(), phase);
        bench
    }

    fn fails(&mut self, mode: FailureMode) {
        let _ = self.machine.on(self.now, Input::OwnFault(mode));
    }
}

/// The result of following one cell of the table.
struct Cell {
    from: Phase,
    to: Phase,
    actions: Actions,
    before: Redundancy,
    after: Redundancy,
}

/// Follows the table in this phase on this evidence. `peer_failed`: the flag before this step.
fn follow(phase: Phase, evidence: Evidence, peer_failed: bool) -> Cell {
    let mut bench = Bench::of(phase);
    bench.machine.state.cpsys_failure = peer_failed;
    let before = bench.machine.clone();
    let mut actions = Actions::none();
    bench.machine.apply(bench.now, evidence, &mut actions);
    Cell {
        from: phase,
        to: bench.machine.phase(),
        actions,
        before,
        after: bench.machine,
    }
}

/// Returns every cell of the table, with the flag clear and set.
fn cells() -> impl Iterator<Item = (Phase, Evidence, [Cell; 2])> {
    Phase::VARIANTS.iter().copied().flat_map(|phase| {
        Evidence::VARIANTS.iter().copied().map(move |evidence| {
            let cells = [false, true].map(|failed| follow(phase, evidence, failed));
            (phase, evidence, cells)
        })
    })
}

impl Cell {
    /// Returns the effects of the cell other than the change of phase.
    fn effects(&self) -> BTreeSet<&'static str> {
        let mut effects = BTreeSet::new();
        for action in self.actions.iter() {
            effects.insert(match action {
                Action::SendEdge(Line::Start, Edge::Rising) => "handshake",
                Action::SendEdge(Line::Start, Edge::Falling) => "sync",
                Action::SendEdge(..) => "heartbeat",
                Action::Transmit => "transmit",
                Action::DiscardUnsent => "discard",
                Action::AlignControl => "align",
                Action::Record(RedundancyEvent::PeerFailed(true)) => "set flag",
                Action::Record(RedundancyEvent::PeerFailed(false)) => "clear flag",
                Action::Record(RedundancyEvent::LinesSplit) => "report",
                Action::Record(_) => continue,
                Action::Persist(_) => "persist",
                Action::Reset(_) => "reset",
            });
        }
        if self.after.term() > self.before.term() && self.before.term() == Term::NONE {
            effects.insert("new term");
        }
        effects
    }
}

fn text(cells: &[Cell; 2]) -> String {
    let mut effects = cells[0].effects();
    effects.extend(cells[1].effects());
    let effects: Vec<&str> = effects.into_iter().collect();
    let effects = effects.join(", ");
    let [Cell { from, to, .. }, _] = cells;
    match (from == to, effects.is_empty()) {
        (true, true) => "\u{b7}".to_string(),
        (true, false) => format!("({effects})"),
        (false, true) => format!("{to:?}"),
        (false, false) => format!("{to:?} ({effects})"),
    }
}

fn transitions() -> String {
    let mut page = String::from("| evidence |");
    for &phase in Phase::VARIANTS {
        write!(page, " {phase:?} |").unwrap();
    }
    page.push_str("\n|---|");
    page.push_str(&"---|".repeat(Phase::VARIANTS.len()));
    for &evidence in Evidence::VARIANTS {
        write!(page, "\n| {evidence:?} |").unwrap();
        for &phase in Phase::VARIANTS {
            let cells = [false, true].map(|failed| follow(phase, evidence, failed));
            write!(page, " {} |", text(&cells)).unwrap();
        }
    }
    page.push('\n');
    page
}

fn yes(is: bool) -> &'static str {
    if is { "yes" } else { "no" }
}

/// Returns a table of the behaviour of a machine in each phase.
fn phases() -> String {
    let mut page = String::from(
        "| phase | output open | heartbeats | role in frames | mode | master in record \
         | flag in record | asks for |\n|---|---|---|---|---|---|---|---|\n",
    );
    for &phase in Phase::VARIANTS {
        let mut bench = Bench::of(phase);
        let open = bench.machine.may_transmit(bench.now);
        let (machine, state) = (&bench.machine, bench.machine.state());
        let (role, mode) = (machine.role(), machine.mode());
        let (master, flag) = (yes(state.is_master), yes(state.cpsys_failure));
        let actions = bench.poll();
        let beats = actions
            .iter()
            .any(|action| matches!(action, Action::SendEdge(Line::Heartbeat1, _)));
        let reset = actions.iter().find_map(|action| match action {
            Action::Reset(request) => Some(format!("{request:?}")),
            _ => None,
        });
        let reset = reset.unwrap_or_else(|| "\u{b7}".to_string());
        let (open, beats) = (yes(open), yes(beats));
        writeln!(
            page,
            "| {phase:?} | {open} | {beats} | {role:?} | {mode:?} | {master} | {flag} | {reset} |"
        )
        .unwrap();
    }
    page
}

/// T-RED-9: the tables of the docs agree with the machine; `UPDATE_DOCS=1` writes them.
#[test]
fn tables_in_the_docs_are_what_the_machine_does() {
    page::check(&[("transitions", transitions()), ("phases", phases())]);
}

/// T-RED-9: an output opens only on evidence that the other system does not drive, or resigns.
#[test]
fn only_the_absence_of_a_master_opens_an_output() {
    use Evidence as E;
    use Phase as P;
    for (from, on, cells) in cells() {
        for cell in cells {
            if cell.to.is_driving() && !from.is_driving() {
                assert!(matches!(
                    (from, on),
                    (P::Starting, E::HandshakeDone | E::NoAnswer)
                        | (
                            P::Standby,
                            E::HandshakeDone
                                | E::PeerOff
                                | E::PeerSilent
                                | E::MasterMute
                                | E::MasterResigns
                        )
                        | (P::Thawed, E::PeerStable | E::ListenOver | E::PeerOff)
                ));
                assert!(cell.actions.contains(Action::Transmit));
                let (term, known) = (cell.after.term(), cell.before.highest_term());
                assert_eq!(term.system(), SystemId::A);
                assert!(term > known || from == P::Thawed, "{from:?} {on:?}");
                assert!(cell.after.highest_term() >= term, "it goes to the flash");
            } else {
                assert!(!cell.actions.contains(Action::Transmit));
            }
        }
    }
}

/// T-RED-9: an output that closes discards the waiting frames in the same call; no other cell
/// discards frames.
#[test]
fn an_output_that_closes_discards_what_waits() {
    let mut closed = 0;
    for (from, on, cells) in cells() {
        for mut cell in cells {
            let closes = from.is_driving() && !cell.to.is_driving();
            let discards = cell.actions.contains(Action::DiscardUnsent);
            assert_eq!(closes, discards, "{from:?} {on:?}");
            closed += u32::from(closes);
            let now = Bench::of(from).now;
            assert_eq!(cell.after.may_transmit(now), cell.to.is_driving());
        }
    }
    assert_eq!(
        closed,
        2 * 2 * 3,
        "two phases; higher term, stall, no term left"
    );
}

/// T-RED-5, T-RED-9: a failed system stays silent; faults and higher terms have their effect in
/// every phase where they apply; every change of phase is reported, and nothing else is.
#[test]
fn faults_and_higher_terms_work_in_every_phase() {
    use Evidence as E;
    for (from, on, cells) in cells() {
        for cell in cells {
            let reported = cell.actions.events().any(|event| {
                event
                    == RedundancyEvent::Phase {
                        from,
                        to: cell.to,
                        on,
                    }
            });
            assert_eq!(reported, from != cell.to, "{from:?} {on:?}");
            let starts = from == Phase::Starting || (from, on) == (Phase::Standby, E::SyncStray);
            assert!(starts || cell.to != Phase::Starting, "{from:?} {on:?}");
            let expected = match (from, on) {
                (Phase::Suspended, _) | (_, E::FaultSuspend) => Some(Phase::Suspended),
                (Phase::Resetting, _) | (Phase::Starting | Phase::Standby, E::FaultReset) => {
                    Some(Phase::Resetting)
                }
                (_, E::HigherTerm) if from.is_driving() => Some(Phase::Standby),
                _ => None,
            };
            if let Some(expected) = expected {
                assert_eq!(cell.to, expected, "{from:?} {on:?}");
            }
        }
    }
}

/// T-RED-9: a failed standby suspends only when it has received a control frame of the other
/// system, which may have failed too. A disturbed start line looks like a running system.
#[test]
fn a_failed_standby_leaves_when_it_has_heard_the_other_drive() {
    let mut bench = Bench::of(Phase::Standby);
    bench.fails(FailureMode::IoModule);
    let _ = bench.poll();
    assert_eq!(bench.machine.phase(), Phase::Standby);
    let frame = ControlHeader {
        system: SystemId::B,
        term: Term::from_bits(33),
        role: Role::Master,
        mode: Mode::L3,
    };
    let _ = bench.machine.on(bench.now, Input::ControlFrame(frame));
    let _ = bench.poll();
    assert_eq!(bench.machine.phase(), Phase::Suspended);
}

/// T-RED-5, T-RED-9: if no term is left, every cell that would open an output suspends instead.
#[test]
fn no_cell_drives_without_a_term() {
    let mut suspended = 0;
    for (from, on, [cell, _]) in cells() {
        let mut bench = Bench::of(from);
        bench.machine.state.term = Term::from_bits(u32::MAX);
        let mut actions = Actions::none();
        bench.machine.apply(bench.now, on, &mut actions);
        let needs_one = cell.to.is_driving() && cell.before.term() == Term::NONE;
        if needs_one {
            assert_eq!(bench.machine.phase(), Phase::Suspended, "{from:?} {on:?}");
            assert!(!actions.contains(Action::Transmit));
            suspended += 1;
        } else {
            assert_eq!(bench.machine.phase(), cell.to);
        }
    }
    assert_eq!(suspended, 7);
}

fn every_input() -> Vec<Input> {
    let quiet = Bench::starting().snapshot;
    let mut inputs = Vec::from([Input::HandOver]);
    for peer_powered in [false, true] {
        for new in [0, 1, u32::MAX] {
            inputs.push(Input::Poll(LineSnapshot {
                handshakes: new,
                syncs: new / 2,
                beats: [new, new.wrapping_mul(3)],
                peer_powered,
                can_frames: new,
            }));
            inputs.push(Input::Poll(LineSnapshot {
                peer_powered,
                syncs: new,
                ..quiet
            }));
        }
    }
    for term in [0, 1, 16, 17, 2048, u32::MAX - 1, u32::MAX].map(Term::from_bits) {
        let age = Duration::from_us(u64::from(term.bits()));
        inputs.push(Input::VehicleTerm(ObeyedTerm {
            term,
            age,
            sent: Some((term.bits() as u8, Duration::from_ms(1))),
        }));
        for &role in Role::VARIANTS {
            for &mode in Mode::VARIANTS {
                for system in SystemId::ALL {
                    let frame = ControlHeader {
                        system,
                        term,
                        role,
                        mode,
                    };
                    inputs.extend([Input::ControlFrame(frame), Input::StaleFrame(frame)]);
                    inputs.push(Input::StaleEcho(frame.term));
                }
                for (can_alive, ability) in [(false, Ability::All), (true, Ability::StopOnly)] {
                    let report = PeerReport {
                        role,
                        mode,
                        term,
                        can_alive,
                        ability,
                    };
                    inputs.extend([
                        Input::StatusFrame(report),
                        Input::LinkReport(LinkReport {
                            report,
                            start: 1,
                            sent_us: term.bits(),
                        }),
                    ]);
                }
            }
        }
    }
    inputs.extend(FailureMode::ALL.iter().copied().map(Input::OwnFault));
    inputs.extend(Ability::VARIANTS.iter().copied().map(Input::Ability));
    inputs
}

/// T-RED-9: each phase gets every input twice, without a stall and after one. The machine does not
/// panic, reports each change of phase in order, opens and closes its output as reported, and never
/// has more actions than the list holds.
#[test]
fn every_input_in_every_phase() {
    for &phase in Phase::VARIANTS {
        for input in every_input() {
            for stall in [
                Duration::ZERO,
                Duration::from_ms(1),
                Duration::from_ms(10_000),
            ] {
                let mut bench = Bench::of(phase);
                for _ in 0..2 {
                    bench.now += stall;
                    check_step(&mut bench.machine, bench.now, input);
                }
            }
        }
    }
}

/// Gives the machine one input and checks its answer.
fn check_step(machine: &mut Redundancy, now: Instant, input: Input) {
    let what = format!("{:?} {input:?}", machine.phase());
    let (from, before) = (machine.phase(), *machine.state());
    let actions = machine.on(now, input);
    let to = machine.phase();
    let mut phase = from;
    for event in actions.events() {
        if let RedundancyEvent::Phase { from, to, .. } = event {
            assert_eq!(from, phase, "{what}");
            phase = to;
        }
    }
    assert_eq!(phase, to, "{what}");
    assert!(actions.events().count() < Actions::EVENTS, "{what}");
    assert!(actions.iter().count() < Actions::CAPACITY, "{what}");
    if from.is_driving() && !to.is_driving() {
        assert!(actions.contains(Action::DiscardUnsent), "{what}");
    }
    if !from.is_driving() && to.is_driving() {
        assert!(actions.contains(Action::Transmit), "{what}");
    }
    let persists = actions.contains(Action::Persist(*machine.state()));
    assert_eq!(persists, before != *machine.state(), "{what}");
    assert!(
        machine.state().term >= before.term,
        "{what}: known terms rise"
    );
    let resets = actions
        .iter()
        .any(|action| matches!(action, Action::Reset(_)));
    assert_eq!(
        resets,
        matches!(to, Phase::Resetting | Phase::Suspended),
        "{what}"
    );
    if from == Phase::Suspended {
        assert_eq!(to, Phase::Suspended, "{what}");
    }
}
