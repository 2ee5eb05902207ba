//! The whole controller and a vehicle on the simulated board.

use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{Board, CanFrame, CanId, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Config, SimBoard, SimPair, WorldTick};
use tandem_cores::Core;
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::trace::Event;
use tandem_vehicle::{Scenario, World};

/// What the vehicle saw during a drive.
pub(crate) struct Seen {
    pub(crate) world: World,
    /// Times in ns at which control frames were accepted, and from which system.
    pub(crate) accepted: Vec<(u64, SystemId)>,
    /// Frames that somebody else sends with the next tick.
    pub(crate) forged: Vec<CanFrame>,
}

/// Both systems and one vehicle in virtual time.
pub(crate) struct Drive {
    pub(crate) pair: SimPair,
    pub(crate) seen: Rc<RefCell<Seen>>,
    pub(crate) events: Vec<(Instant, SystemId, CoreId, Event)>,
}

pub(crate) fn poller(
    board: &SimBoard,
    config: tandem_cores::Config,
) -> Box<dyn FnMut(&SimBoard) -> Instant> {
    // A core's life ends with its reset, which this process outlives: a few boards are leaked.
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    match board.identity().core {
        CoreId::CONTROL => {
            let mut core = Core0::new(board, config);
            Box::new(move |_| core.poll())
        }
        CoreId::PERCEPTION => {
            let mut core = Core1::new(board);
            Box::new(move |_| core.poll())
        }
        _ => {
            let mut core = Core2::new(board);
            Box::new(move |_| core.poll())
        }
    }
}

fn tick(seen: &mut Seen, tick: &mut WorldTick) {
    let now = tick.at.as_ns();
    for on_bus in &tick.heard {
        if let CanId::Standard(id) = on_bus.frame.id() {
            seen.world
                .on_frame(on_bus.at.as_ns(), id.into(), on_bus.frame.data());
        }
    }
    let mut frames = Vec::new();
    seen.world.step(now, &mut |id, data| {
        frames.push(CanFrame::new(CanId::Standard(id), true, data).expect("a frame of the DBC"));
    });
    frames.append(&mut seen.forged);
    frames.into_iter().for_each(|frame| tick.send(frame));
    for acceptance in seen.world.gate_mut().drain_log() {
        if acceptance.verdict == tandem_vehicle::gate::Verdict::Accepted {
            let system = SystemId::from_index(acceptance.system.into()).expect("a system");
            seen.accepted.push((acceptance.at_ns, system));
        }
    }
}

impl Drive {
    /// Both systems are switched on and a vehicle waits in the named scenario.
    pub(crate) fn new(scenario: &str, seed: u64) -> Self {
        Self::with(scenario, seed, tandem_cores::Config::rt())
    }

    pub(crate) fn with(scenario: &str, seed: u64, config: tandem_cores::Config) -> Self {
        let scenario = Scenario::load(scenario).expect("an embedded scenario");
        let world = World::new(&scenario, tandem_vehicle::Config { seed });
        let seen = Rc::new(RefCell::new(Seen {
            world,
            accepted: vec![],
            forged: vec![],
        }));
        let board_config = Config {
            seed,
            ..Config::default()
        };
        let mut pair = SimPair::new(board_config, move |board| poller(board, config));
        let shared = Rc::clone(&seen);
        pair.set_world(move |now| tick(&mut shared.borrow_mut(), now));
        for system in SystemId::ALL {
            pair.power_on(system);
        }
        Self {
            pair,
            seen,
            events: vec![],
        }
    }

    /// Drives on for so long, and keeps what the cores traced.
    pub(crate) fn run_for(&mut self, span: Duration) {
        let until = self.pair.now() + span;
        while self.pair.now() < until {
            // In steps, so that the trace does not run over.
            let step = until.since(self.pair.now());
            self.pair.run_for(step.min(Duration::from_ms(1000)));
            let (entries, lost) = self.pair.take_trace();
            assert_eq!(lost, 0, "the trace ran over");
            self.events.extend(entries.into_iter().filter_map(|entry| {
                Some((
                    entry.at,
                    entry.system,
                    entry.core,
                    Event::decode(entry.record)?,
                ))
            }));
            self.pair.take_bus_log();
        }
    }

    /// Takeovers in the trace: when, by whom, the event.
    pub(crate) fn takeovers(&self) -> Vec<(Instant, SystemId, Event)> {
        let takeover = |event: &Event| matches!(event, Event::TookOver { .. });
        let events = self.events.iter().filter(|(.., event)| takeover(event));
        events
            .map(|(at, system, _, event)| (*at, *system, *event))
            .collect()
    }

    /// The largest time between two accepted control frames.
    pub(crate) fn gap_max(&self) -> Duration {
        let seen = self.seen.borrow();
        let gaps = seen.accepted.windows(2).map(|pair| pair[1].0 - pair[0].0);
        Duration::from_ns(gaps.max().unwrap_or(u64::MAX))
    }

    /// Systems in the order in which they drove, without repetition.
    pub(crate) fn masters(&self) -> Vec<SystemId> {
        let mut masters: Vec<_> = self
            .seen
            .borrow()
            .accepted
            .iter()
            .map(|(_, s)| *s)
            .collect();
        masters.dedup();
        masters
    }

    pub(crate) fn collisions(&self) -> u32 {
        self.seen.borrow().world.metrics().collisions
    }
}
