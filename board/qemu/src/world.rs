//! All machines of a run as the vehicle sees them: one bus, the wires, and virtual time.

use std::fmt;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use tandem_board::{
    CanFrame, Carried, CoreAddress, CoreId, Edge, HardwareFault, Instant, Line, Received, RoleLamp,
    SystemId, Traced, VehicleBus, VehiclePort,
};
use tandem_board_udp::UdpPlace;
use tandem_cosim::{Item, PERIOD_NS};
use tandem_peripherals::codec::{BusFrame, Reach, Sender, decode_trace};
use tandem_peripherals::network::{self, BusFault, Network, Wire};

use crate::bridge::Bridge;
use crate::machine::{BootFrom, Machine, MachineError, MachineOptions};

/// The number of emulators that run the two systems.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WorldLayout {
    /// Both systems in one emulator.
    One,
    /// One emulator for each system: each can be killed separately.
    Two,
}

/// The machines of a run. The run's one vehicle acts as the bus between the machines, and calls
/// [`EmulatedWorld::step`] for each millisecond of virtual time.
#[derive(Debug)]
pub struct EmulatedWorld {
    machines: Vec<Node>,
    /// Steps so far.
    steps: u64,
    /// Frames of cores that were on the bus since the last step.
    sent: Vec<network::Delivery>,
    /// The connections between the machines.
    network: Network,
    /// The connection of the systems to the Ethernet of this machine.
    bridge: Option<Bridge>,
    /// What runs beside the machines.
    beside: Option<Beside>,
    /// Decides which frames a disturbed connection loses; the same in each run.
    noise: ChaCha8Rng,
    /// The level line of each system, as last sent to the other system.
    shown: [bool; 2],
    /// When the last frame was on the bus.
    carried: Instant,
    traced: Vec<Traced>,
    lamps: [RoleLamp; 2],
    powered: [bool; 2],
    lost: u32,
    reported: Instant,
    stop: Arc<AtomicBool>,
}

/// A program that runs in the time of the machines.
struct Beside(Box<dyn FnMut(Instant)>);

impl fmt::Debug for Beside {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Beside").finish_non_exhaustive()
    }
}

#[derive(Debug)]
struct Node {
    /// `None` after the machine has ended.
    machine: Option<Machine>,
    systems: Vec<SystemId>,
    /// The items of the next answer.
    outgoing: Vec<Item>,
    lost: u32,
}

impl EmulatedWorld {
    /// Starts the emulators. Both systems have no power yet.
    ///
    /// # Errors
    /// [`MachineError`]
    pub fn start(
        image: &Path,
        layout: WorldLayout,
        options: MachineOptions,
    ) -> Result<Self, MachineError> {
        let groups: &[&[SystemId]] = match layout {
            WorldLayout::One => &[&SystemId::ALL],
            WorldLayout::Two => &[&[SystemId::A], &[SystemId::B]],
        };
        let machines = groups.iter().map(|systems| {
            let machine = Machine::start(image, systems, options, None)?;
            Ok((machine, systems.to_vec()))
        });
        Self::of(machines)
    }

    /// Starts an emulator for each of these systems with the image `bootloader`, which boots from
    /// the system's flash. Both systems have no power yet; a system that is not in `from` never
    /// gets power.
    ///
    /// # Errors
    /// [`MachineError`]
    pub fn start_booting(
        bootloader: &Path,
        reintegrate: bool,
        from: &[(SystemId, BootFrom)],
    ) -> Result<Self, MachineError> {
        let options = MachineOptions {
            reintegrate,
            ..MachineOptions::default()
        };
        let machines = from.iter().map(|(system, from)| {
            let machine = Machine::start(bootloader, &[*system], options, Some(from))?;
            Ok((machine, vec![*system]))
        });
        Self::of(machines)
    }

    fn of(
        started: impl Iterator<Item = Result<(Machine, Vec<SystemId>), MachineError>>,
    ) -> Result<Self, MachineError> {
        let mut machines = Vec::new();
        for started in started {
            let (machine, systems) = started?;
            machines.push(Node {
                machine: Some(machine),
                systems,
                outgoing: vec![],
                lost: 0,
            });
        }
        Ok(Self {
            machines,
            steps: 0,
            sent: vec![],
            network: Network::default(),
            bridge: None,
            beside: None,
            noise: ChaCha8Rng::seed_from_u64(1),
            shown: [false; 2],
            carried: Instant::ORIGIN,
            traced: vec![],
            lamps: [RoleLamp::Starting; 2],
            powered: [false; 2],
            lost: 0,
            reported: Instant::ORIGIN,
            stop: Arc::default(),
        })
    }

    fn running(&self) -> impl Iterator<Item = &Machine> {
        self.machines.iter().flat_map(|node| &node.machine)
    }

    /// Returns the running emulator processes, with their systems.
    pub fn processes(&self) -> impl Iterator<Item = (u32, &[SystemId])> {
        self.running()
            .map(|machine| (machine.pid(), machine.systems()))
    }

    /// Returns the flag that requests an early end of the run.
    #[must_use]
    pub fn stop_flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.stop)
    }

    /// Returns the firmware logs of all running machines.
    #[must_use]
    pub fn log(&self) -> String {
        self.running()
            .map(Machine::log)
            .collect::<Vec<_>>()
            .join("\n")
    }

    /// Ends all machines and returns their firmware's logs.
    ///
    /// # Errors
    /// [`MachineError`] if a machine had already ended.
    pub fn end(self) -> Result<String, MachineError> {
        let machines = self.machines.into_iter().filter_map(|node| node.machine);
        let logs: Result<Vec<_>, _> = machines.map(Machine::end).collect();
        Ok(logs?.join("\n"))
    }

    /// Runs all machines to the next step, with all frames and commands since the last one. If a
    /// machine was killed, its systems stop and their level lines fall.
    ///
    /// # Errors
    /// [`MachineError`] if a machine hangs or has ended without being killed.
    pub fn step(&mut self) -> Result<Instant, MachineError> {
        if self.steps > 0 {
            self.bridge();
            self.answer()?;
        }
        self.steps += 1;
        self.network.settle_bus(self.now(), &mut self.noise);
        self.carry();
        for index in 0..self.machines.len() {
            self.hear(index)?;
        }
        // A stable sort: the frames of one core keep their order even at equal times.
        self.sent.sort_by_key(|sent| sent.at);
        let now = self.now();
        if let Some(Beside(program)) = &mut self.beside {
            program(now);
        }
        Ok(now)
    }

    /// Connects both systems to the network of a place at the next step: each is a station with
    /// sockets of this machine. Their time is the emulator's, so no latency is real.
    ///
    /// # Errors
    /// If the sockets cannot be opened.
    pub fn connect_network(&mut self, place: UdpPlace) -> io::Result<()> {
        let bridge = Bridge::open(place)?;
        for of in SystemId::ALL {
            bridge.connects(of).for_each(|item| self.command(of, item));
        }
        self.bridge = Some(bridge);
        Ok(())
    }

    /// Runs a program after each step, while the machines wait: it has their time, whether that is
    /// faster or slower than this machine's.
    pub fn run_beside(&mut self, program: impl FnMut(Instant) + 'static) {
        self.beside = Some(Beside(Box::new(program)));
    }

    /// Adds what has arrived on the Ethernet to the next answers.
    fn bridge(&mut self) {
        let Some(bridge) = &self.bridge else {
            return;
        };
        for node in &mut self.machines {
            for system in &node.systems {
                bridge.receive(*system, |item| node.outgoing.push(item));
            }
        }
    }

    fn answer(&mut self) -> Result<(), MachineError> {
        for node in &mut self.machines {
            let items = std::mem::take(&mut node.outgoing);
            if let Some(machine) = &mut node.machine {
                let left_out = machine.answer(&items);
                match left_out {
                    // If a machine has just been killed, its next report fails, and that ends its
                    // systems.
                    Ok(_) | Err(MachineError::Ended { .. }) => {}
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(())
    }

    /// Reads the report of a machine.
    fn hear(&mut self, index: usize) -> Result<(), MachineError> {
        let Some(machine) = &mut self.machines[index].machine else {
            return Ok(());
        };
        let mut items = vec![];
        let report = match machine.report(|item| items.push(item)) {
            Ok(report) => report,
            // Killed by a signal: treat it as a loss of power.
            Err(MachineError::Ended { status, .. }) if status.code().is_none() => {
                self.bury(index);
                return Ok(());
            }
            Err(error) => return Err(error),
        };
        self.reported = report.now;
        let node = &mut self.machines[index];
        self.lost = self.lost.wrapping_add(
            report
                .lost
                .wrapping_sub(std::mem::replace(&mut node.lost, report.lost)),
        );
        for system in node.systems.clone() {
            self.lamps[system.index()] = report.lamps[system.index()];
            self.set_level(system, report.powered[system.index()]);
        }
        for item in items {
            self.take(item);
        }
        Ok(())
    }

    fn bury(&mut self, index: usize) {
        self.machines[index].machine = None;
        for system in self.machines[index].systems.clone() {
            self.set_level(system, false);
        }
    }

    /// Sets the level line of a system.
    fn set_level(&mut self, of: SystemId, high: bool) {
        self.powered[of.index()] = high;
        self.show_level(of);
    }

    /// Sends the level of the line to the other system if it has changed since the last time.
    fn show_level(&mut self, of: SystemId) {
        let high = self.network.conditions.level(of, self.powered[of.index()]);
        if std::mem::replace(&mut self.shown[of.index()], high) != high {
            self.forward(of.peer(), of, Item::Level { of, high });
        }
    }

    /// Passes the frames on the bus to all machines except that of their sender. A machine passes a
    /// frame to all of its cores, so it gets only frames that reach core 0 of one of its systems.
    fn carry(&mut self) {
        while let Some(carried) = self.network.carried() {
            let network::Delivery {
                sender,
                frame,
                at,
                reach,
                ..
            } = carried;
            let frame = BusFrame {
                received: Received { frame, at },
                sender,
                reach: Reach::ALL,
            };
            let item = Item::Frame(frame.encode());
            for node in &mut self.machines {
                let is_own =
                    matches!(sender, Sender::Core(from) if node.systems.contains(&from.system));
                let hears = |of: &SystemId| reach.has(CoreAddress::new(*of, CoreId::CONTROL));
                if !is_own && node.systems.iter().any(hears) {
                    node.outgoing.push(item);
                }
            }
            if sender != Sender::Vehicle {
                self.sent.push(carried);
            }
        }
    }

    /// Sends the item to the machine of `to`, unless `from` is in the same machine.
    fn forward(&mut self, to: SystemId, from: SystemId, item: Item) {
        let elsewhere =
            |node: &&mut Node| node.systems.contains(&to) && !node.systems.contains(&from);
        for node in self.machines.iter_mut().filter(elsewhere) {
            node.outgoing.push(item);
        }
    }

    fn take(&mut self, item: Item) {
        match item {
            Item::Frame(words) => {
                let Some(frame) = BusFrame::decode(&words) else {
                    return;
                };
                let Sender::Core(from) = frame.sender else {
                    return;
                };
                let Received { frame, at } = frame.received;
                self.network
                    .send_from_controller(from, &frame, at, &mut self.noise);
                self.carry();
            }
            Item::Trace { from, words } => {
                let (at, record) = decode_trace(words);
                self.traced.push(Traced {
                    at,
                    system: from.system,
                    core: from.core,
                    record,
                });
            }
            Item::Edges { to, line, .. } => {
                let is_cut = |line| {
                    self.network
                        .conditions
                        .cuts
                        .is_cut(Wire::Line(line), to.peer())
                };
                if !Line::ALL.get(line).is_some_and(|line| is_cut(*line)) {
                    self.forward(to, to.peer(), item);
                }
            }
            Item::Datagram { to, .. } => {
                if !self.network.conditions.cuts.is_cut(Wire::Link, to.peer()) {
                    self.forward(to, to.peer(), item);
                }
            }
            Item::Packet {
                of,
                is_first,
                words,
            } => {
                if let Some(bridge) = &mut self.bridge {
                    bridge.send(of, is_first, &words);
                }
            }
            Item::Level { .. }
            | Item::Connect { .. }
            | Item::Feed { .. }
            | Item::Fault { .. }
            | Item::Crash { .. }
            | Item::Scribble { .. }
            | Item::Hang { .. }
            | Item::CutLevel { .. }
            | Item::Later { .. }
            | Item::End => {}
        }
    }

    /// Connects or disconnects the battery of a system at the next step.
    pub fn set_feed(&mut self, of: SystemId, on: bool) {
        self.command(of, Item::Feed { of, on });
    }

    /// Injects or repairs a hardware fault of a system at the next step.
    pub fn set_fault(&mut self, of: SystemId, fault: HardwareFault, present: bool) {
        self.command(of, Item::Fault { of, fault, present });
    }

    /// Makes core 0 of a system take an exception at the next step: its supply resets the system.
    pub fn crash(&mut self, of: SystemId) {
        self.command(of, Item::Crash { of });
    }

    /// Stops core 0 of a system from the next step on, until its watchdog resets the system.
    pub fn hang(&mut self, of: SystemId) {
        self.command(of, Item::Hang { of });
    }

    /// Cuts the level line of a system at the next step.
    pub fn cut_level(&mut self, of: SystemId) {
        self.command(of, Item::CutLevel { of, cut: true });
    }

    /// Cuts or restores a wire that starts at a system. Affects only wires between two machines.
    pub fn set_cut(&mut self, wire: Wire, from: SystemId, is_cut: bool) {
        self.network.conditions.cuts.set(wire, from, is_cut);
        self.show_level(from);
    }

    /// Holds a system's level line low, or releases it. Affects only lines between two machines.
    pub fn hold_level_low(&mut self, of: SystemId, is_held: bool) {
        self.network.conditions.held_low[of.index()] = is_held;
        self.show_level(of);
    }

    /// Sets the faults of a system's connection to the bus. Affects only frames between machines.
    pub fn disturb_bus(&mut self, of: SystemId, fault: BusFault) {
        self.network.conditions.bus[of.index()] = fault;
    }

    /// Delivers to a system an edge that no system has sent.
    pub fn stray_edge(&mut self, to: SystemId, line: Line, edge: Edge) {
        let edges = Item::Edges {
            to,
            line: line.index(),
            edge: usize::from(edge == Edge::Falling),
            count: 1,
            at: self.now(),
        };
        self.command(to, edges);
    }

    /// Delays the next command to a system by `us` microseconds (fewer than 1,000) after the step.
    pub fn later(&mut self, of: SystemId, us: u32) {
        self.command(of, Item::Later { us });
    }

    /// Makes a core of a system overwrite the whole LMU at the next step. `seed` selects the words.
    pub fn scribble(&mut self, of: SystemId, seed: u32) {
        self.command(of, Item::Scribble { of, seed });
    }

    fn command(&mut self, system: SystemId, item: Item) {
        for node in &mut self.machines {
            if node.systems.contains(&system) {
                node.outgoing.push(item);
            }
        }
    }

    /// Returns the clock of the machines at their last report. The machines have been waiting since
    /// then for the next step, which carries out all commands.
    #[must_use]
    pub const fn reported(&self) -> Instant {
        self.reported
    }
}

impl VehicleBus for EmulatedWorld {
    /// Returns the virtual time of the last step, at which the machines wait. The first is at zero.
    fn now(&self) -> Instant {
        Instant::from_ns(self.steps.saturating_sub(1) * PERIOD_NS)
    }

    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried)) {
        for it in self.sent.drain(..) {
            let Sender::Core(from) = it.sender else {
                continue;
            };
            // Times on the bus never decrease: a frame gets at least the time of the previous one.
            self.carried = self.carried.max(it.at);
            let carried = Carried {
                frame: it.frame,
                sent: it.sent.at,
                at: self.carried,
            };
            seen(from.system, from.core, carried);
        }
    }

    /// The cores receive the frame with the next step.
    fn broadcast(&mut self, frame: &CanFrame) -> Instant {
        let now = self.now();
        self.carried = self.carried.max(now);
        self.network.send_from_vehicle(frame, now, &mut self.noise);
        self.carry();
        self.carried
    }
}

impl VehiclePort for EmulatedWorld {
    type Error = MachineError;

    fn tick(&mut self) -> Result<Instant, MachineError> {
        self.step()
    }

    fn set_ignition(&mut self, on: bool) {
        SystemId::ALL
            .into_iter()
            .for_each(|of| self.set_feed(of, on));
    }

    fn stop_requested(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32 {
        self.traced.drain(..).for_each(into);
        std::mem::take(&mut self.lost)
    }

    fn role(&self, system: SystemId) -> RoleLamp {
        self.lamps[system.index()]
    }

    fn is_powered(&self, system: SystemId) -> bool {
        self.powered[system.index()]
    }
}
