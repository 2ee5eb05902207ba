//! The whole controller and a vehicle on the simulated board.

use std::cell::RefCell;
use std::rc::Rc;
use tandem_board::{Board, CanFrame, CanId, CoreId, Duration, Instant, SystemId};
use tandem_board_sim::{Config, Poller, SimBoard, SimPair, WorldTick};
use tandem_cores::Core;
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::trace::Event;
use tandem_vehicle::{Scenario, World};

/// What the vehicle saw during a drive.
pub struct Seen {
    /// The vehicle, its traffic and its gate for control frames.
    pub world: World,
    /// Times in ns at which control frames were accepted, and from which system.
    pub accepted: Vec<(u64, SystemId)>,
    /// Frames that somebody else sends with the next tick.
    pub forged: Vec<CanFrame>,
}

/// Both systems and one vehicle in virtual time.
pub struct Drive {
    /// The machine.
    pub pair: SimPair,
    /// What the vehicle saw until now.
    pub seen: Rc<RefCell<Seen>>,
    /// What the cores traced until now, in order.
    pub events: Vec<(Instant, SystemId, CoreId, Event)>,
}

/// A new life of the core that this board belongs to.
#[must_use]
pub fn poller(board: &SimBoard, config: tandem_cores::Config) -> Poller {
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
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    #[must_use]
    pub fn new(scenario: &str, seed: u64) -> Self {
        let config = tandem_cores::Config::rt();
        Self::with(scenario, seed, move |board| poller(board, config))
    }

    /// As [`Drive::new`], with cores that `core` makes: one for each life.
    ///
    /// # Panics
    /// If there is no embedded scenario of this name.
    pub fn with(
        scenario: &str,
        seed: u64,
        core: impl FnMut(&SimBoard) -> Poller + 'static,
    ) -> Self {
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
        let mut pair = SimPair::new(board_config, core);
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
    ///
    /// # Panics
    /// If the cores trace more than the machine keeps for a second.
    pub fn run_for(&mut self, span: Duration) {
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
    #[must_use]
    pub fn takeovers(&self) -> Vec<(Instant, SystemId, Event)> {
        let takeover = |event: &Event| matches!(event, Event::TookOver { .. });
        let events = self.events.iter().filter(|(.., event)| takeover(event));
        events
            .map(|(at, system, _, event)| (*at, *system, *event))
            .collect()
    }

    /// The largest time between two accepted control frames.
    #[must_use]
    pub fn gap_max(&self) -> Duration {
        let seen = self.seen.borrow();
        let gaps = seen.accepted.windows(2).map(|pair| pair[1].0 - pair[0].0);
        Duration::from_ns(gaps.max().unwrap_or(u64::MAX))
    }

    /// Systems in the order in which they drove, without repetition.
    #[must_use]
    pub fn masters(&self) -> Vec<SystemId> {
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

    /// How often the vehicle has hit another.
    #[must_use]
    pub fn collisions(&self) -> u32 {
        self.seen.borrow().world.metrics().collisions
    }
}
