//! The redundancy in C: system B takes over, and its twin in Rust answers the same, word for word.

use crate::lmu::{ANSWER_WORDS, Bench, Order};
use tandem_board::{Duration, Edge, Instant, ResetCause, ResetRequest, SystemId};
use tandem_redundancy::{Actions, Config, ControlFrame, Input, Loaded, Redundancy, Role, Snapshot};

const INIT: u32 = 0;
const POLL: u32 = 1;
const CONTROL_FRAME: u32 = 2;

/// The actions of the twin as the peer in C writes them into its answer.
fn words(twin: &mut Redundancy, actions: Option<Actions>, now: Instant) -> [u32; ANSWER_WORDS] {
    let mut words = [0; ANSWER_WORDS];
    words[0] = Order::Redundancy as u32;
    if let Some(actions) = actions {
        let edge = actions.beat.map_or(0, |beat| match beat.edge {
            Edge::Rising => 1,
            Edge::Falling => 2,
        });
        let reset = actions.reset.map_or(0, |reset| match reset {
            ResetRequest::Software => 1,
            ResetRequest::CoreDead => 2,
            ResetRequest::Suspend => 3,
        });
        let [low, high] = actions.deadline.to_words();
        let term = actions.persist.map_or(0, |state| state.term.bits());
        words[1..12].copy_from_slice(&[
            actions.handshake.into(),
            actions.sync.into(),
            edge,
            actions.transmit_now.into(),
            actions.output_closed.into(),
            actions.synchronised.into(),
            actions.persist.is_some().into(),
            term,
            reset,
            low,
            high,
        ]);
        let events = actions.events.iter().flat_map(|event| event.to_words());
        for (place, word) in words[17..].iter_mut().zip(events) {
            *place = word;
        }
        words[16] = actions.events.iter().count() as u32;
    }
    words[12] = twin.role().code().into();
    words[13] = twin.mode().code().into();
    words[14] = twin.term().bits();
    words[15] = twin.may_transmit(now).into();
    words
}

const QUIET: Snapshot = Snapshot {
    handshakes: 0,
    syncs: 0,
    beats: [0; 2],
    peer_powered: true,
    can_frames: 0,
};

/// What the edges of one system do to the counts that the other sees.
fn act(actions: &Actions, seen: &mut Snapshot) {
    seen.handshakes += u32::from(actions.handshake);
    seen.syncs += u32::from(actions.sync);
    let beats = u32::from(actions.beat.is_some());
    seen.beats = seen.beats.map(|count| count + beats);
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

    /// Tells both the same, and compares what they say.
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

    fn poll(&mut self, now: Instant, seen: Snapshot) -> Actions {
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

    fn hear(&mut self, now: Instant, frame: ControlFrame) -> Actions {
        let details = [
            frame.system.index() as u32,
            frame.term.bits(),
            frame.role.code().into(),
            frame.mode.code().into(),
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

/// A drives for a while and dies in silence; B, in C, takes over within the bound.
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
                let frame = ControlFrame {
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
        takeover = takeover.or(actions.events.takeover());
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
            assert!(actions.transmit_now);
            break;
        }
        assert!(cycle < 2 * CYCLES, "no takeover");
    }
    assert_eq!(b.twin.role(), Role::Master);
    assert!(takeover.is_some_and(|takeover| takeover.term > a.term()));
    b.bench.stop(child);
}
