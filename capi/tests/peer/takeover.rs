//! The redundancy in C: system B takes over, and returns the same words as its twin in Rust.

use crate::lmu::{ANSWER_WORDS, Bench, Order};
use tandem_board::{Duration, Edge, Instant, Line, ResetCause, ResetRequest, SystemId};
use tandem_redundancy::{
    Action, Actions, Config, ControlHeader, Input, LineSnapshot, Loaded, Redundancy, Role,
};

const INIT: u32 = 0;
const POLL: u32 = 1;
const CONTROL_FRAME: u32 = 2;

/// Returns the actions of the twin, in the format of the answers of the peer in C.
fn words(twin: &mut Redundancy, actions: Option<Actions>, now: Instant) -> [u32; ANSWER_WORDS] {
    let mut words = [0; ANSWER_WORDS];
    words[0] = Order::Redundancy as u32;
    if let Some(actions) = actions {
        for action in actions.iter() {
            match action {
                Action::SendEdge(Line::Start, Edge::Rising) => words[1] = 1,
                Action::SendEdge(Line::Start, Edge::Falling) => words[2] = 1,
                Action::SendEdge(_, Edge::Rising) => words[3] = 1,
                Action::SendEdge(_, Edge::Falling) => words[3] = 2,
                Action::Transmit => words[4] = 1,
                Action::DiscardUnsent => words[5] = 1,
                Action::AlignControl => words[6] = 1,
                Action::Persist(state) => words[7..9].copy_from_slice(&[1, state.term.bits()]),
                Action::Reset(ResetRequest::Software | ResetRequest::Download) => words[9] = 1,
                Action::Reset(ResetRequest::CoreDead) => words[9] = 2,
                Action::Reset(ResetRequest::Suspend) => words[9] = 3,
                Action::Record(_) => {}
            }
        }
        words[10..12].copy_from_slice(&actions.deadline().to_words());
        let events = actions.events().flat_map(|event| event.to_words());
        for (place, word) in words[17..].iter_mut().zip(events) {
            *place = word;
        }
        words[16] = actions.events().count() as u32;
    }
    words[12] = twin.role() as u32;
    words[13] = twin.mode() as u32;
    words[14] = twin.term().bits();
    words[15] = twin.may_transmit(now).into();
    words
}

const QUIET: LineSnapshot = LineSnapshot {
    handshakes: 0,
    syncs: 0,
    beats: [0; 2],
    peer_powered: true,
    can_frames: 0,
};

/// Adds the edges that one system sends to the counts that the other system sees.
fn act(actions: &Actions, seen: &mut LineSnapshot) {
    for action in actions.iter() {
        match action {
            Action::SendEdge(Line::Start, Edge::Rising) => seen.handshakes += 1,
            Action::SendEdge(Line::Start, Edge::Falling) => seen.syncs += 1,
            Action::SendEdge(Line::Heartbeat1, _) => seen.beats[0] += 1,
            Action::SendEdge(Line::Heartbeat2, _) => seen.beats[1] += 1,
            _ => {}
        }
    }
}

/// System B in C, and its twin in Rust.
struct InC {
    bench: Bench,
    twin: Redundancy,
}

impl InC {
    fn new(mut bench: Bench, now: Instant) -> Self {
        let mut twin = new(SystemId::B, now);
        let [low, high] = now.to_words();
        let answer = bench.ask(&[Order::Redundancy as u32, INIT, low, high]);
        assert_eq!(answer, words(&mut twin, None, now));
        Self { bench, twin }
    }

    /// Passes the same input to both, and compares their answers.
    fn on(&mut self, now: Instant, kind: u32, details: &[u32], input: Input) -> Actions {
        let [low, high] = now.to_words();
        let mut order = vec![Order::Redundancy as u32, kind, low, high];
        order.extend(details);
        let answer = self.bench.ask(&order);
        let actions = self.twin.on(now, input);
        assert_eq!(
            answer,
            words(&mut self.twin, Some(actions), now),
            "{input:?} at {now:?}"
        );
        actions
    }

    fn poll(&mut self, now: Instant, seen: LineSnapshot) -> Actions {
        let [one, two] = seen.beats;
        let powered = seen.peer_powered.into();
        let details = [
            seen.handshakes,
            seen.syncs,
            one,
            two,
            powered,
            seen.can_frames,
        ];
        self.on(now, POLL, &details, Input::Poll(seen))
    }

    fn hear(&mut self, now: Instant, frame: ControlHeader) -> Actions {
        let details = [
            frame.system.index() as u32,
            frame.term.bits(),
            frame.role as u32,
            frame.mode as u32,
        ];
        self.on(now, CONTROL_FRAME, &details, Input::ControlFrame(frame))
    }
}

fn new(system: SystemId, now: Instant) -> Redundancy {
    Redundancy::new(
        Config::rt(),
        system,
        ResetCause::PowerOn,
        Loaded::Blank,
        now,
    )
}

/// A drives for a while and then stops silently; B, in C, takes over within the bound.
#[test]
fn system_b_in_c_takes_over() {
    const CYCLES: u32 = 200;
    let mut bench = Bench::new();
    let child = bench.start(1);
    let mut now = Instant::from_ns(5_000_000_000);
    let mut a = new(SystemId::A, now);
    let mut b = InC::new(bench, now);
    let (mut to_a, mut to_b) = (QUIET, QUIET);
    let mut takeover = None;
    for cycle in 0.. {
        now += Duration::from_ms(1);
        if cycle < CYCLES {
            act(&a.on(now, Input::Poll(to_a)), &mut to_b);
            if cycle % 10 == 0 && a.may_transmit(now) {
                to_b.can_frames += 1;
                let frame = ControlHeader {
                    system: SystemId::A,
                    term: a.term(),
                    role: a.role(),
                    mode: a.mode(),
                };
                let heard = b.hear(now, frame);
                act(&heard, &mut to_a);
            }
        }
        let actions = b.poll(now, to_b);
        act(&actions, &mut to_a);
        takeover = takeover.or(actions.takeover());
        if cycle == CYCLES - 1 {
            assert_eq!((a.role(), b.twin.role()), (Role::Master, Role::Standby));
            assert_eq!(takeover, None);
        }
        if takeover.is_some() {
            let bound = Config::rt().takeover_bound().as_us() / 1000;
            assert!(
                cycle >= CYCLES && u64::from(cycle - CYCLES) <= bound,
                "in cycle {cycle}"
            );
            assert!(actions.contains(Action::Transmit));
            break;
        }
        assert!(cycle < 2 * CYCLES, "no takeover");
    }
    assert_eq!(b.twin.role(), Role::Master);
    assert!(takeover.is_some_and(|takeover| takeover.term > a.term()));
    b.bench.stop(child);
}
