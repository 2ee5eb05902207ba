//! One machine with hand-made inputs: cases that the model of two systems cannot provoke.
#![allow(clippy::unwrap_used)]

mod faults;
mod leave;
mod level;
mod limits;

use tandem_board::{Duration, Edge, Instant, Line, ResetCause, ResetRequest, SystemId};
use tandem_redundancy::{
    Ability, Action, Actions, Config, ControlHeader, FailureMode, Input, LineSnapshot, LinkReport,
    Loaded, Mode, ObeyedTerm, PeerReport, Phase, Redundancy, RedundancyEvent, Role, SystemState,
    Term,
};

const CONFIG: Config = Config::rt();
const QUIET: LineSnapshot = LineSnapshot {
    handshakes: 0,
    syncs: 0,
    beats: [0; 2],
    peer_powered: true,
    can_frames: 0,
};

const SYNC: Action = Action::SendEdge(Line::Start, Edge::Falling);

fn is_beat(action: Action) -> bool {
    matches!(
        action,
        Action::SendEdge(Line::Heartbeat1 | Line::Heartbeat2, _)
    )
}

fn persisted(actions: &Actions) -> Option<SystemState> {
    actions.iter().find_map(|action| match action {
        Action::Persist(state) => Some(state),
        _ => None,
    })
}

struct Bench {
    machine: Redundancy,
    snapshot: LineSnapshot,
    now: Instant,
}

/// Returns the report of a system without a fault.
fn sound(role: Role, term: Term) -> PeerReport {
    PeerReport {
        role,
        mode: Mode::L3,
        term,
        can_alive: true,
        ability: Ability::All,
    }
}

impl Bench {
    fn new(system: SystemId, state: SystemState) -> Self {
        Self::with(CONFIG, system, state)
    }

    fn with(config: Config, system: SystemId, state: SystemState) -> Self {
        let now = Instant::from_ns(5_000_000_000);
        let loaded = Loaded::State(state);
        let machine = Redundancy::new(config, system, ResetCause::PowerOn, loaded, now);
        Self {
            machine,
            snapshot: QUIET,
            now,
        }
    }

    /// Sends as many handshakes as a start needs; returns the actions of the last one.
    fn handshakes(&mut self) -> Actions {
        self.snapshot.handshakes += 1;
        let _ = self.poll();
        self.snapshot.handshakes += 1;
        self.poll()
    }

    /// Returns system A, started by handshakes of B, some milliseconds into dual operation.
    fn master() -> Self {
        Self::master_with(CONFIG)
    }

    fn master_with(config: Config) -> Self {
        Self::master_from(config, SystemState::factory(SystemId::A))
    }

    fn master_from(config: Config, state: SystemState) -> Self {
        let mut bench = Self::with(config, SystemId::A, state);
        let _ = bench.poll();
        let actions = bench.handshakes();
        assert!(actions.contains(SYNC) && actions.contains(Action::Transmit));
        bench.run_with_beats(20);
        assert_eq!(bench.machine.phase(), Phase::Master);
        bench
    }

    /// Returns system B, started by the sync edge of A, with control frames every 10 ms.
    fn standby() -> Self {
        Self::standby_with(CONFIG)
    }

    fn standby_with(config: Config) -> Self {
        let mut bench = Self::with(config, SystemId::B, SystemState::factory(SystemId::B));
        let _ = bench.poll();
        bench.snapshot.syncs += 1;
        assert!(bench.poll().contains(Action::AlignControl));
        for _ in 0..5 {
            let _ = bench.control(16);
            bench.run_with_beats(10);
        }
        assert_eq!(bench.machine.phase(), Phase::Standby);
        bench
    }

    fn on(&mut self, input: Input) -> Actions {
        self.machine.on(self.now, input)
    }

    fn obeyed(&mut self, term: Term, age_ms: u64) -> Actions {
        let age = Duration::from_ms(age_ms);
        self.on(Input::VehicleTerm(ObeyedTerm {
            term,
            age,
            sent: None,
        }))
    }

    /// Passes on a report over the link that was sent just now.
    fn linked(&mut self, report: PeerReport) -> Actions {
        self.linked_late(report, 0)
    }

    /// Passes on a report over the link that was sent `ms` milliseconds ago.
    fn linked_late(&mut self, report: PeerReport, ms: u64) -> Actions {
        let (start, sent_us) = (1, (self.now.as_ns() / 1_000 - ms * 1_000) as u32);
        self.on(Input::LinkReport(LinkReport {
            report,
            start,
            sent_us,
        }))
    }

    fn poll(&mut self) -> Actions {
        self.now += Duration::from_ms(1);
        self.snapshot.can_frames = self.snapshot.can_frames.wrapping_add(1);
        self.on(Input::Poll(self.snapshot))
    }

    fn run_with_beats(&mut self, ms: u64) {
        for _ in 0..ms {
            self.snapshot.beats = self.snapshot.beats.map(|count| count.wrapping_add(1));
            let _ = self.poll();
        }
    }

    /// Passes on a control frame of the system to which the term belongs.
    fn control(&mut self, term: u32) -> Actions {
        let term = Term::from_bits(term);
        self.on(Input::ControlFrame(ControlHeader {
            system: term.system(),
            term,
            role: Role::Master,
            mode: Mode::L3,
        }))
    }
}

/// T-RED-9: a standby that was frozen together with its receivers finds nothing new at its first
/// polls. Its own stall is not evidence: it takes over only after the silence limits have passed
/// again.
#[test]
fn own_absence_is_no_evidence() {
    let mut bench = Bench::standby();
    bench.now += Duration::from_ms(200);
    let listened_from = bench.now;
    while bench.machine.phase() == Phase::Standby {
        let _ = bench.poll();
        assert!(bench.now.since(listened_from) < Duration::from_ms(100));
    }
    assert!(bench.now.since(listened_from) > CONFIG.witness_limit());
}

/// T-RED-9: a system that was held up restarts the limits of the heartbeat lines: a first poll
/// without an edge is not evidence. If no edge arrives within the limit, the line is silent.
#[test]
fn the_limits_of_the_lines_begin_anew_after_a_stall() {
    for mut bench in [Bench::master(), Bench::standby()] {
        bench.now += Duration::from_ms(15);
        let resumed = bench.now;
        let reported = loop {
            let actions = bench.poll();
            let silent = actions
                .events()
                .find(|it| matches!(it, RedundancyEvent::LineSilent(_)));
            if silent.is_some() {
                break bench.now.since(resumed);
            }
        };
        assert!(
            reported > CONFIG.silent_limit(),
            "reported after {reported:?}"
        );
        assert!(
            reported <= CONFIG.detection_bound() + CONFIG.poll_interval,
            "{reported:?}"
        );
    }
}

/// T-RED-9: a stray handshake, with heartbeats that arrive, does not depose a master that the
/// vehicle obeys, even if this system misses a frame.
#[test]
fn a_stray_handshake_deposes_no_master_that_the_vehicle_obeys() {
    for (age_ms, expected) in [
        (0, Phase::Standby),
        (
            CONFIG.witness_limit().as_us() / 1_000 + 1,
            Phase::DegradedMaster,
        ),
    ] {
        let mut bench = Bench::standby();
        let _ = bench.control(16);
        bench.snapshot.handshakes += 1;
        bench.run_with_beats(2);
        let _ = bench.obeyed(Term::from_bits(16), age_ms);
        bench.run_with_beats(CONFIG.mute_limit().as_us() / 1_000 - 2);
        assert_eq!(bench.machine.phase(), expected, "obeyed {age_ms} ms ago");
    }
}

/// T-RED-8: a system that was switched on and is standby for the first time has seen no change of
/// the driver: the lines depose its master within their bound. A reset may follow a change of the
/// driver.
#[test]
fn only_a_standby_that_was_switched_on_has_no_hold_down() {
    for (cause, expected) in [
        (ResetCause::PowerOn, Phase::DegradedMaster),
        (ResetCause::Software, Phase::Standby),
        (ResetCause::Watchdog, Phase::Standby),
    ] {
        let mut bench = Bench::new(SystemId::B, SystemState::factory(SystemId::B));
        let loaded = Loaded::State(SystemState::factory(SystemId::B));
        bench.machine = Redundancy::new(CONFIG, SystemId::B, cause, loaded, bench.now);
        let _ = bench.poll();
        bench.snapshot.syncs += 1;
        let _ = bench.poll();
        let _ = bench.control(16);
        bench.run_with_beats(5);
        bench.snapshot.peer_powered = false;
        // The vehicle still obeys the master's last frame.
        for age_ms in 5..5 + (CONFIG.level_limit() + CONFIG.poll_interval).as_us() / 1_000 {
            let _ = bench.obeyed(Term::from_bits(16), age_ms);
            let _ = bench.poll();
        }
        assert_eq!(bench.machine.phase(), expected, "{cause:?}");
    }
}

/// T-RED-2: a system that waits for the other repeats its handshake edge every period.
#[test]
fn a_starting_system_repeats_its_handshake() {
    let mut bench = Bench::new(SystemId::A, SystemState::factory(SystemId::A));
    let handshake = Action::SendEdge(Line::Start, Edge::Rising);
    let sent_at = (0..40).filter(|_| bench.poll().contains(handshake));
    assert!(sent_at.eq((0..40).step_by(5)));
}

/// T-RED-9: just after a change of the driver the lines alone depose no master; only the vehicle's
/// echo does. This time doubles with each change.
#[test]
fn after_a_change_of_the_driver_only_the_vehicle_deposes() {
    let mut held = Vec::new();
    let mut bench = Bench::master();
    for _ in 0..4 {
        // The other system has taken over.
        let term = bench.machine.highest_term().above(1, SystemId::B).unwrap();
        let _ = bench.control(term.bits());
        assert_eq!(bench.machine.phase(), Phase::Standby);
        let deposed = bench.now;
        bench.run_with_beats(5);
        // The other system's level falls and its heartbeats end, but the vehicle obeys it.
        bench.snapshot.peer_powered = false;
        while bench.machine.phase() == Phase::Standby {
            let _ = bench.obeyed(Term::from_bits(1), 0);
            let _ = bench.poll();
        }
        held.push(bench.now.since(deposed).as_us() / 1_000);
        bench.snapshot.peer_powered = true;
        bench.run_with_beats(5);
    }
    let first = CONFIG.hold_down.as_us() / 1_000;
    for (change, held) in (0..).zip(held) {
        // This system's own takeover counts as a change as well.
        let expected = first << (2 * change).min(5);
        assert!(held.abs_diff(expected) <= 2, "change {change}: {held} ms");
    }

    // The vehicle reports no driver: the takeover is immediate, with or without heartbeats. Without
    // an echo, the last frame of the mute master is the one that deposed this system.
    for (beats, echo, bound) in [
        (false, true, CONFIG.gap_bound_mute()),
        (true, true, CONFIG.gap_bound_mute()),
        (true, false, CONFIG.mute_limit() + CONFIG.poll_interval),
    ] {
        let mut bench = Bench::master();
        let term = bench.machine.highest_term().above(1, SystemId::B).unwrap();
        let _ = bench.control(term.bits());
        let deposed = bench.now;
        while bench.machine.phase() == Phase::Standby {
            let age = bench.now.since(deposed).as_us() / 1_000;
            if echo {
                let _ = bench.obeyed(term, age);
            }
            bench.snapshot.can_frames += 1;
            bench.snapshot.beats[0] += u32::from(beats);
            let _ = bench.poll();
        }
        let took = bench.now.since(deposed);
        assert!(
            took <= bound,
            "heartbeats {beats}, echo {echo}: {took:?} of {bound:?}"
        );
    }
}

/// T-RED-2: a start line on which no edge ever arrived is reported once; a heartbeat line that is
/// cut from the start is reported too.
#[test]
fn lines_that_are_cut_from_the_start_are_told() {
    for (handshakes, syncs) in [(0, 0), (1, 0), (0, 1)] {
        let mut bench = Bench::new(SystemId::B, SystemState::factory(SystemId::B));
        let _ = bench.poll();
        bench.snapshot.handshakes += handshakes;
        bench.snapshot.syncs += syncs;
        let mut reported = Vec::new();
        for _ in 0..3_000 {
            bench.snapshot.beats[1] += 1;
            let lines = |it: &RedundancyEvent| {
                matches!(
                    it,
                    RedundancyEvent::StartLineSilent | RedundancyEvent::LineSilent(_)
                )
            };
            reported.extend(bench.poll().events().filter(lines));
        }
        let start_line = (handshakes + syncs == 0).then_some(RedundancyEvent::StartLineSilent);
        let expected: Vec<_> = [RedundancyEvent::LineSilent(1)]
            .into_iter()
            .chain(start_line)
            .collect();
        assert_eq!(reported, expected);
    }
}

/// T-RED-9: a master that was held up beyond the witness's limit is silent until it has new
/// evidence, even if no control frame of the other system has reached it yet.
#[test]
fn a_master_held_up_listens_first() {
    for hears_other in [true, false] {
        let mut bench = Bench::master();
        let term = bench.machine.term();
        assert!(bench.machine.may_transmit(bench.now));
        bench.now += Duration::from_ms(30);
        assert!(!bench.machine.may_transmit(bench.now));
        bench.snapshot.beats = bench.snapshot.beats.map(|count| count + 30);
        let actions = bench.poll();
        assert_eq!(bench.machine.phase(), Phase::Thawed);
        assert!(actions.contains(Action::DiscardUnsent) && !actions.iter().any(is_beat));
        assert!(!bench.machine.may_transmit(bench.now));
        bench.run_with_beats(5);
        if hears_other {
            let higher = term.above(1, SystemId::B).unwrap();
            let _ = bench.control(higher.bits());
            assert_eq!(bench.machine.phase(), Phase::Standby);
        } else {
            let listened = CONFIG.mute_limit().as_us() / 1_000 - 5;
            bench.run_with_beats(listened);
            assert_eq!(bench.machine.phase(), Phase::Thawed);
            bench.run_with_beats(1);
            assert_eq!(bench.machine.phase(), Phase::DegradedMaster);
            assert_eq!(
                bench.machine.term(),
                term,
                "a new term might depose the other"
            );
        }
    }
}

/// T-RED-2: a master answers a handshake with the sync edge only: another driving system would
/// answer a handshake with one of its own, without end.
#[test]
fn a_master_answers_a_handshake_without_one() {
    let mut bench = Bench::master();
    bench.snapshot.handshakes += 1;
    let actions = bench.poll();
    assert!(actions.contains(SYNC));
    assert!(!actions.contains(Action::SendEdge(Line::Start, Edge::Rising)));
}

/// T-RED-9: a standby that polls late every time still takes over: a late poll restarts its limits
/// only once between two signs of life of the master.
#[test]
fn a_standby_that_is_always_late_takes_over() {
    let mut bench = Bench::standby();
    let silent_since = bench.now;
    while bench.machine.phase() == Phase::Standby {
        bench.now += Duration::from_ms(3);
        let _ = bench.poll();
        assert!(bench.now.since(silent_since) <= Duration::from_ms(26));
    }
    assert!(bench.now.since(silent_since) > CONFIG.witness_limit());
}

/// T-RED-9: if the other system is off, a master that was held up continues to drive: no other
/// system can have taken over.
#[test]
fn the_last_system_goes_on_after_a_stall() {
    let mut bench = Bench::master();
    bench.snapshot.peer_powered = false;
    let _ = bench.poll();
    bench.now += Duration::from_ms(100);
    assert!(!bench.machine.may_transmit(bench.now));
    let actions = bench.poll();
    assert_eq!(bench.machine.phase(), Phase::DegradedMaster);
    assert!(
        actions.contains(Action::Transmit),
        "the frame that was refused is sent now"
    );
    assert!(bench.machine.may_transmit(bench.now));
}

/// T-RED-9: frames that no correct peer sends change nothing.
#[test]
fn implausible_frames_are_ignored() {
    let mut bench = Bench::master();
    let term = Term::from_bits(4_001);
    let good = ControlHeader {
        system: SystemId::B,
        term,
        role: Role::Master,
        mode: Mode::L3,
    };
    for frame in [
        ControlHeader {
            system: SystemId::A,
            ..good
        },
        ControlHeader {
            term: Term::from_bits(4_000),
            ..good
        },
        ControlHeader {
            role: Role::Standby,
            ..good
        },
    ] {
        let actions = bench.on(Input::ControlFrame(frame));
        assert!(actions.events().eq([RedundancyEvent::Implausible]));
        assert_eq!(bench.machine.phase(), Phase::Master);
        assert!(bench.machine.highest_term() < term);
    }
    let actions = bench.on(Input::ControlFrame(good));
    assert!(actions.contains(Action::DiscardUnsent));
    assert_eq!(bench.machine.phase(), Phase::Standby);
    assert!(!bench.machine.may_transmit(bench.now));
    assert!(persisted(&actions).is_some_and(|state| !state.is_master && state.term == term));
}

/// T-RED-9: the vehicle fences frames of a lower term, so these have no effect: such a frame is
/// reported once, and does not keep a standby from taking over.
#[test]
fn frames_of_a_lower_term_do_not_count() {
    let mut bench = Bench::standby();
    let _ = bench.control(100);
    let reported = (0..4).map(|_| {
        bench.run_with_beats(10);
        let stale = RedundancyEvent::StaleTerm(Term::from_bits(16));
        bench
            .control(16)
            .events()
            .filter(|&event| event == stale)
            .count()
    });
    assert_eq!(reported.sum::<usize>(), 1);
    assert_eq!(bench.machine.phase(), Phase::DegradedMaster);
    assert!(bench.machine.term() > Term::from_bits(100));
}

/// T-RED-9: a master that the vehicle refuses takes a term above the obeyed one. If the other
/// system drives in that term now, the master follows it.
#[test]
fn a_refused_master_takes_a_higher_term_or_follows() {
    for (above, age_ms, follows) in [(41, 200, false), (42, 0, false), (41, 5, true)] {
        let mut bench = Bench::master();
        let term = Term::from_bits(bench.machine.term().bits() + above);
        let mut actions = bench.obeyed(term, age_ms);
        let of_peer = term.system() == SystemId::B;
        if of_peer && !follows {
            assert!(
                bench.machine.term() < term,
                "the other's frames may be on their way"
            );
            actions = bench.obeyed(term, age_ms);
        }
        let raised = RedundancyEvent::TermRaised(bench.machine.term());
        if follows {
            assert_eq!(bench.machine.phase(), Phase::Standby);
            assert!(actions.contains(Action::DiscardUnsent));
        } else {
            assert_eq!(bench.machine.phase(), Phase::Master);
            assert!(bench.machine.term() > term);
            assert_eq!(bench.machine.term().system(), SystemId::A);
            assert!(actions.contains(Action::Record(raised)));
        }
        assert!(persisted(&actions).is_some_and(|state| state.term >= term));
    }
}

/// T-RED-9: a standby whose lines are silent and that hears no frame of its master stays standby if
/// the vehicle still obeys the master. When the vehicle no longer hears the master either, the
/// standby takes over within the bound.
#[test]
fn the_vehicle_is_a_witness_for_the_master() {
    let mut bench = Bench::standby();
    let term = bench.machine.highest_term();
    for _ in 0..50 {
        let _ = bench.obeyed(term, 0);
        for _ in 0..10 {
            let _ = bench.poll();
        }
        assert_eq!(bench.machine.phase(), Phase::Standby);
    }
    let _ = bench.obeyed(term, 0);
    let accepted = bench.now;
    for age_ms in 1.. {
        if age_ms % 10 == 4 {
            let _ = bench.obeyed(term, age_ms);
        }
        let _ = bench.poll();
        if bench.machine.phase() == Phase::DegradedMaster {
            break;
        }
    }
    let bound = CONFIG.takeover_bound();
    assert!(bench.now.since(accepted) <= bound, "{:?}", bench.now);
}

/// Returns the first term of system A with this record and these reports before it drives.
fn first_term(cause: ResetCause, loaded: Loaded, reported: &[Input]) -> Term {
    let mut bench = Bench::new(SystemId::A, SystemState::factory(SystemId::A));
    bench.machine = Redundancy::new(CONFIG, SystemId::A, cause, loaded, bench.now);
    let _ = bench.poll();
    for input in reported {
        let _ = bench.on(*input);
    }
    while !bench.machine.phase().is_driving() {
        let _ = bench.poll();
        assert!(bench.now < Instant::from_ns(10_000_000_000));
    }
    bench.machine.term()
}

/// T-RED-9: the first term is 8 masterships above the known one (a term is `count << 1 | system`),
/// and far above it unless the vehicle or a running system has reported the newest since the start.
/// A report of a system that has just started is not enough, and neither is one echo with a term
/// that no rule explains. If the flash is lost, the same holds after a reset.
#[test]
fn the_first_term_is_far_above_what_may_be_old() {
    const FAR: u32 = 2 * 1024;
    let state = SystemState {
        term: Term::from_bits(32),
        ..SystemState::factory(SystemId::A)
    };
    let record = Loaded::State(state);
    let report = |role| {
        let report = PeerReport {
            role,
            mode: Mode::None,
            term: Term::from_bits(33),
            can_alive: true,
            ability: Ability::All,
        };
        Input::LinkReport(LinkReport {
            report,
            start: 1,
            sent_us: 7,
        })
    };
    let (term, age, sent) = (Term::from_bits(5_001), Duration::from_ms(900), None);
    let vehicle = Input::VehicleTerm(ObeyedTerm { term, age, sent });
    let power_on = |reported: &[Input]| first_term(ResetCause::PowerOn, record, reported).bits();
    assert!(power_on(&[]) >= FAR);
    assert!(power_on(&[report(Role::Starting)]) >= FAR);
    assert_eq!(power_on(&[report(Role::Standby)]), 2 * (33 / 2 + 8));
    assert_eq!(power_on(&[vehicle]), 2 * (32 / 2) + FAR);
    assert_eq!(power_on(&[vehicle; 2]), 2 * (5_001 / 2 + 8));
    let reset = |loaded| first_term(ResetCause::Watchdog, loaded, &[]).bits();
    assert_eq!(reset(record), 2 * (32 / 2 + 8));
    assert!(reset(Loaded::Lost) >= FAR && reset(Loaded::Blank) >= FAR);
}

/// T-RED-9: only the term of a control frame with a wrong counter counts: a master follows it, and
/// a standby does not treat it as a sign that its master drives.
#[test]
fn only_the_term_counts_of_a_frame_with_a_wrong_counter() {
    let stale = |term: u32| {
        Input::StaleFrame(ControlHeader {
            system: Term::from_bits(term).system(),
            term: Term::from_bits(term),
            role: Role::Master,
            mode: Mode::L3,
        })
    };
    let mut bench = Bench::master();
    let own = bench.machine.term().bits();
    let _ = bench.on(stale(own - 1));
    let _ = bench.on(stale(own + 2));
    assert_eq!(bench.machine.phase(), Phase::Master, "older, or its own");
    // The vehicle may refuse that frame, too, and obeys this master until the next one.
    let mut obeyed = Bench::master();
    let _ = obeyed.obeyed(obeyed.machine.term(), 0);
    let _ = obeyed.on(stale(own + 3));
    assert_eq!(obeyed.machine.phase(), Phase::Master);
    assert_eq!(obeyed.machine.highest_term().bits(), own + 3);
    let _ = obeyed.control(own + 3);
    assert_eq!(obeyed.machine.phase(), Phase::Standby);
    let actions = bench.on(stale(own + 3));
    assert_eq!(bench.machine.phase(), Phase::Standby);
    assert!(actions.contains(Action::DiscardUnsent));
    assert_eq!(bench.machine.highest_term().bits(), own + 3);

    for (powered, bound) in [
        (true, CONFIG.takeover_bound()),
        (false, CONFIG.level_limit() + CONFIG.poll_interval),
    ] {
        let mut bench = Bench::standby();
        bench.snapshot.peer_powered = powered;
        let silent_since = bench.now;
        while bench.machine.phase() == Phase::Standby {
            let _ = bench.poll();
            let _ = bench.on(stale(16));
            assert!(bench.now.since(silent_since) <= bound, "{powered}");
        }
    }
}

/// T-RED-9: a standby with no term left suspends instead of driving in a term that is not its own.
#[test]
fn terms_used_up() {
    // The last but one, and the last one of A.
    let state = SystemState {
        term: Term::from_bits(Term::LAST.bits() - 2),
        ..SystemState::factory(SystemId::B)
    };
    let mut bench = Bench::with(CONFIG, SystemId::B, state);
    let _ = bench.poll();
    bench.snapshot.syncs += 1;
    let _ = bench.poll();
    let _ = bench.control(Term::LAST.bits() - 1);
    bench.run_with_beats(5);
    bench.snapshot.peer_powered = false;
    let mut actions = bench.poll();
    while bench.machine.phase() == Phase::Standby {
        actions = bench.poll();
    }
    assert_eq!(bench.machine.phase(), Phase::Suspended);
    assert!(actions.contains(Action::Reset(ResetRequest::Suspend)));
    assert_eq!(
        bench.machine.state().failure_mode,
        FailureMode::TermsExhausted
    );
    assert!(!bench.machine.may_transmit(bench.now));
}

/// T-RED-9: a master that hears of the last term has none above it, and drives on in its own.
#[test]
fn a_master_without_a_higher_term_drives_on() {
    let term = Term::from_bits(Term::LAST.bits() - 3);
    let state = SystemState {
        term,
        ..SystemState::factory(SystemId::A)
    };
    let mut bench = Bench::master_from(CONFIG, state);
    assert_eq!(bench.machine.term().bits(), Term::LAST.bits() - 1);
    let actions = bench.on(Input::StatusFrame(sound(Role::Standby, Term::LAST)));
    assert_eq!(bench.machine.phase(), Phase::Master);
    assert!(actions.contains(Action::Record(RedundancyEvent::FarTerm(Term::LAST))));
    bench.run_with_beats(5);
    assert!(bench.machine.may_transmit(bench.now));
}

/// T-RED-9: a standby that knows a higher term does not drive in it: the master takes a higher one.
#[test]
fn a_standby_that_knows_a_higher_term_deposes_no_master() {
    let mut bench = Bench::master();
    let term = bench.machine.term().above(1, SystemId::B).unwrap();
    let _ = bench.on(Input::StatusFrame(sound(Role::Standby, term)));
    assert_eq!(bench.machine.phase(), Phase::Master);
    assert!(bench.machine.term() > term);
}

/// T-RED-9: the other's claim over the link alone deposes a master only if it lasts long enough.
#[test]
fn a_claim_over_the_link_must_hold() {
    let mut bench = Bench::master();
    let term = bench.machine.term().above(1, SystemId::B).unwrap();
    let claim = PeerReport {
        role: Role::Master,
        mode: Mode::DegradedL2,
        term,
        can_alive: true,
        ability: Ability::All,
    };
    let _ = bench.linked(claim);
    for no_claim in [
        PeerReport {
            can_alive: false,
            ..claim
        },
        // The other system has seen this master's term and no higher one.
        PeerReport {
            term: bench.machine.term(),
            ..claim
        },
    ] {
        bench.run_with_beats(10);
        let _ = bench.linked(no_claim);
        bench.run_with_beats(30);
        let _ = bench.linked(claim);
        assert_eq!(bench.machine.phase(), Phase::Master);
    }
    bench.run_with_beats(30);
    let _ = bench.linked(claim);
    assert_eq!(bench.machine.phase(), Phase::Standby);
}

/// T-RED-3: one silent line is reported, but is not a failure.
#[test]
fn one_line_silent() {
    let mut bench = Bench::master();
    let mut events = Vec::new();
    for _ in 0..50 {
        bench.snapshot.beats[1] += 1;
        events.extend(bench.poll().events());
    }
    assert_eq!(events, [RedundancyEvent::LineSilent(1)]);
    assert_eq!(bench.machine.lines_silent(), [true, false]);
    assert_eq!(bench.machine.phase(), Phase::Master);
    let (sent, [line_1, line_2]) = bench.machine.heartbeat_counts();
    assert!(sent >= 70 && line_2 >= line_1 + 50);
}

/// T-RED-2, T-RED-3: a snapshot has the right counts, and the answer has the right edges: a
/// handshake before the sync edge, and heartbeats on both lines.
#[test]
fn lines_in_and_out() {
    let received = |line, edge| match (line, edge) {
        (Line::Start, Edge::Rising) => 1,
        (Line::Start, Edge::Falling) => 2,
        (Line::Heartbeat1, Edge::Rising) => u32::MAX,
        (Line::Heartbeat1, Edge::Falling) => 11,
        (Line::Heartbeat2, _) => 20,
        (Line::Time, _) => 300,
    };
    let expected = LineSnapshot {
        handshakes: 1,
        syncs: 2,
        beats: [10, 40],
        ..QUIET
    };
    assert_eq!(LineSnapshot::new(received, true, 0), expected);

    let mut bench = Bench::new(SystemId::A, SystemState::factory(SystemId::A));
    let _ = bench.poll();
    let actions = bench.handshakes();
    let edges = actions.iter().filter_map(|action| match action {
        Action::SendEdge(line, edge) => Some((line, edge)),
        _ => None,
    });
    let expected = [
        (Line::Start, Edge::Rising),
        (Line::Start, Edge::Falling),
        (Line::Heartbeat1, Edge::Rising),
        (Line::Heartbeat2, Edge::Rising),
    ];
    assert!(edges.eq(expected), "{actions:?}");
}
