//! The vehicle's end of the backplane: the bus, the ignition, and data for an observer.

use core::convert::Infallible;

use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use tandem_board::{
    CanFrame, Carried, CoreAddress, CoreId, Duration, Forgery, Handled, Instant, Pass, Received,
    RoleLamp, SupplyEvent, SystemId, TraceRecord, Traced, VehicleBus, VehiclePort,
};
use tandem_peripherals::codec::{BusFrame, FRAME_WORDS, Sender};
use tandem_peripherals::network::{self, Network, Sent, Wire};
use tandem_shm::{FitError, bare, broadcast, fifo};

use crate::args::VehicleArgs;
use crate::backplane::{
    Backplane, BackplaneError, RINGS, TRANSMIT_WORDS, Transmit, supply_trace_ring,
};
use crate::clock::{self, Ticker};
use crate::doorbell::{Doorbell, DoorbellError, Owner, Ringers};
use crate::outside::Outside;
use crate::spawn::{self, Watched};
use crate::trace_ring::Reader;

/// The period of the vehicle.
const PERIOD: Duration = Duration::from_ms(1);
/// How long the vehicle drives on after the death of the launcher, and how often it looks.
///
/// A death must not disturb the drive, but nobody watches it any longer, and its processes have
/// real-time priority. All but the vehicle's process end within 2 s of the death.
const WITHOUT_LAUNCHER: Duration = Duration::from_ms(1_000);
const LOOK_AT_LAUNCHER: Duration = Duration::from_ms(100);

/// Why the vehicle cannot start.
#[derive(Debug, thiserror::Error)]
pub enum VehiclePortError {
    /// The backplane cannot be mapped.
    #[error(transparent)]
    Backplane(#[from] BackplaneError),
    /// The doorbell of the bus cannot be set up.
    #[error(transparent)]
    Doorbell(#[from] DoorbellError),
    /// The backplane has a different layout from that of this build.
    #[error("the rings of the backplane do not fit: {0:?}")]
    Fit(FitError),
    /// The launcher died before all processes of the run had started.
    #[error("the launcher of the run died while it started")]
    Abandoned,
}

impl From<FitError> for VehiclePortError {
    fn from(error: FitError) -> Self {
        Self::Fit(error)
    }
}

/// The vehicle's connection to the controller. A run has one. It acts as the bus and orders the
/// frames of all nodes.
///
/// When a core has sent a frame, and when the vehicle itself sends one, the vehicle calls
/// [`VehicleBus::transmitted`], which moves the frames of the cores, and [`VehicleBus::broadcast`]
/// for each frame of its own nodes.
#[derive(Debug)]
pub struct HostVehiclePort {
    backplane: Backplane,
    ringers: Ringers,
    from_cores: Vec<Node>,
    from_supplies: [Reader; 2],
    bus: broadcast::Writer<'static, [u32; FRAME_WORDS]>,
    network: Network,
    /// Decides which frames a disturbed connection loses.
    noise: ChaCha8Rng,
    /// Empty between calls; kept to avoid allocations.
    carried: Vec<network::Delivery>,
    /// When the transmit buffers were last emptied.
    emptied: Instant,
    /// Whether the cores have not yet been notified of the newest frames on the bus.
    news: bool,
    /// `None` before the first period.
    ticker: Option<Ticker>,
    /// The cores ring it when they send a frame.
    doorbell: Doorbell,
    /// Whether the doorbell was rung.
    rung: bool,
    /// The vehicle sends no frame before this time, so earlier periods may be returned late.
    quiet_until: Instant,
    launcher: LauncherWatch,
    outside: Outside,
}

/// Notices the death of the process that started the run.
#[derive(Debug)]
struct LauncherWatch {
    /// `None` once it has ended.
    process: Option<Watched>,
    look: Instant,
    died: Option<Instant>,
}

impl LauncherWatch {
    fn on(backplane: Backplane) -> Self {
        Self {
            process: Watched::new(backplane.launcher_pid()),
            look: Instant::ORIGIN,
            died: None,
        }
    }

    /// Returns whether the launcher has been dead for so long that the run must end.
    fn is_over(&mut self, now: Instant) -> bool {
        if self.died.is_none() && now >= self.look {
            self.look = now + LOOK_AT_LAUNCHER;
            if self.process.as_ref().is_none_or(Watched::has_ended) {
                (self.process, self.died) = (None, Some(now));
            }
        }
        self.died
            .is_some_and(|died| now.since(died) >= WITHOUT_LAUNCHER)
    }
}

#[derive(Debug)]
struct Node {
    of: CoreAddress,
    frames: fifo::Consumer<'static, [u32; TRANSMIT_WORDS]>,
    trace: Reader,
    lost: u32,
    /// The core's count of discards at the last call.
    discards: u32,
    /// Whether frames wait in the ring because the core's controller does not accept them yet.
    waits: bool,
}

impl Node {
    /// Applies a discard or a loss of power to the core's controller. Returns whether the system
    /// has power.
    fn follow(&mut self, backplane: Backplane, network: &mut Network) -> bool {
        let discards = backplane.discards(self.of.system, self.of.core);
        if core::mem::replace(&mut self.discards, discards) != discards {
            network.discard(self.of);
        }
        let is_powered = backplane.level(self.of.system);
        if !is_powered {
            network.restart(self.of);
        }
        is_powered
    }

    /// Returns the next record of the core's trace; `read` takes it from the ring.
    fn traced(
        &mut self,
        read: impl FnOnce(&mut Reader) -> Option<(Instant, TraceRecord)>,
    ) -> Option<Traced> {
        let CoreAddress { system, core } = self.of;
        read(&mut self.trace).map(|(at, record)| Traced {
            at,
            system,
            core,
            record,
        })
    }
}

impl HostVehiclePort {
    /// Attaches as the vehicle of the run after all of its processes have started.
    ///
    /// # Errors
    /// [`VehiclePortError`] if the run has ended or never became complete.
    pub fn attach(args: &VehicleArgs) -> Result<Self, VehiclePortError> {
        let backplane = Backplane::open(&args.common.run)?;
        if !spawn::wait_until_assembled(backplane) {
            return Err(VehiclePortError::Abandoned);
        }
        let mut from_cores = vec![];
        for of in CoreAddress::ALL {
            let frames = RINGS.transmit[of.index()];
            from_cores.push(Node {
                of,
                frames: bare::fifo_consumer(backplane.ring(frames), frames.shape)?,
                trace: Reader::new(backplane.trace_ring(of.index())),
                lost: backplane.lost_trace(of.system, of.core),
                discards: backplane.discards(of.system, of.core),
                waits: false,
            });
        }
        let bus = RINGS.receive;
        Ok(Self {
            backplane,
            ringers: Ringers::new(&args.common.run),
            from_cores,
            from_supplies: SystemId::ALL
                .map(|system| Reader::new(backplane.trace_ring(supply_trace_ring(system)))),
            bus: bare::broadcast_writer(backplane.ring(bus), bus.shape)?,
            network: Network::default(),
            noise: ChaCha8Rng::seed_from_u64(1),
            carried: vec![],
            emptied: clock::now(),
            news: false,
            ticker: None,
            doorbell: Doorbell::attach(&args.common.run, Owner::Bus)?,
            rung: false,
            quiet_until: Instant::ORIGIN,
            launcher: LauncherWatch::on(backplane),
            outside: Outside::default(),
        })
    }

    /// Returns whether the bus has work in each period, because frames wait or a fault disturbs it.
    fn is_disturbed(&mut self) -> bool {
        self.network.conditions = self.backplane.conditions();
        self.network.is_disturbed() || self.from_cores.iter().any(|node| node.waits)
    }

    /// Cuts or restores a connection.
    pub fn set_cut(&self, wire: Wire, from: SystemId, is_cut: bool) {
        self.backplane.set_cut(wire, from, is_cut);
    }

    /// Returns the backplane, for an observer.
    #[must_use]
    pub const fn backplane(&self) -> Backplane {
        self.backplane
    }

    /// Moves the frames of the cores from their rings to their controllers.
    fn collect(&mut self, now: Instant) {
        // These frames were sent after the last call, so raise earlier times to that call's time. A
        // core that was frozen between reading the clock and sending must not hide a gap.
        let emptied = core::mem::replace(&mut self.emptied, now);
        let (backplane, network) = (self.backplane, &mut self.network);
        for node in &mut self.from_cores {
            node.waits = false;
            for _ in 0..RINGS.transmit[0].shape.slots() {
                if backplane.level(node.of.system) && !network.is_ready(node.of, now) {
                    node.waits = true;
                    break;
                }
                let Ok(Some(words)) = node.frames.receive() else {
                    break;
                };
                // Do this after the receive, because the core may have just discarded this frame.
                let is_powered = node.follow(backplane, network);
                let wanted = |it: &Transmit| is_powered && it.discards == node.discards;
                let Some(Transmit { frame, mark, .. }) = Transmit::decode(&words).filter(wanted)
                else {
                    continue;
                };
                // Read the clock again: this process may have been delayed since `now`.
                let Received { frame, at } = frame.received;
                let at = at.clamp(emptied, clock::now());
                let sent = Sent { at, mark };
                // The ring determines the sender. A controller that is ready is not full.
                let _full = network.send_frame(node.of, &frame, sent, now, &mut self.noise);
            }
        }
    }

    /// Publishes to the cores a frame that the network has carried.
    fn publish(&mut self, carried: &network::Delivery, at: Instant) {
        let frame = BusFrame {
            received: Received {
                frame: carried.frame,
                at,
            },
            sender: carried.sender,
            reach: carried.reach,
        };
        self.bus.publish(&frame.encode());
        self.news = true;
    }
}

impl VehicleBus for HostVehiclePort {
    fn now(&self) -> Instant {
        clock::now()
    }

    /// Each core sends at most 8 frames per millisecond; further frames wait. A system without
    /// power or cut off from the bus sends no frame: the waiting frames of its cores are dropped.
    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried)) {
        let now = clock::now();
        self.network.conditions = self.backplane.conditions();
        for node in &mut self.from_cores {
            node.follow(self.backplane, &mut self.network);
        }
        self.network.settle_bus(now, &mut self.noise);
        self.collect(now);
        let mut all = core::mem::take(&mut self.carried);
        all.extend(core::iter::from_fn(|| self.network.carried()));
        // The sort is stable, so the frames of one core keep their order even at equal times.
        all.sort_by_key(|carried| carried.sent.at);
        for carried in all.drain(..) {
            // Read the clock for each frame: this call may have started before the sender's time,
            // and this process may have been delayed since the previous frame.
            let at = clock::now();
            if let Sender::Core(CoreAddress { system, core }) = carried.sender {
                let (frame, Sent { at: sent, mark }) = (carried.frame, carried.sent);
                seen(system, core, Carried { frame, sent, at });
                if mark != 0 {
                    self.backplane.set_can_stamp(system, core, mark, at);
                }
            }
            self.publish(&carried, at);
        }
        self.carried = all;
        let at = clock::now();
        for of in CoreAddress::ALL {
            let errors = self.network.errors(of, at);
            self.backplane.set_can_errors(of.system, of.core, errors);
        }
        self.ring_receivers();
    }

    /// The next [`VehicleBus::transmitted`] or [`VehicleBus::ring_receivers`] notifies the cores.
    fn broadcast(&mut self, frame: &CanFrame) -> Instant {
        let at = clock::now();
        self.network.conditions = self.backplane.conditions();
        self.network.send_from_vehicle(frame, at, &mut self.noise);
        while let Some(carried) = self.network.carried() {
            self.publish(&carried, at);
        }
        at
    }

    fn ring_receivers(&mut self) {
        if !core::mem::take(&mut self.news) {
            return;
        }
        for node in &self.from_cores {
            let CoreAddress { system, core } = node.of;
            if self.backplane.wakes_on_receive(system, core) {
                self.ringers.ring(system, core);
            }
        }
    }
}

impl VehiclePort for HostVehiclePort {
    type Error = Infallible;

    /// Missed periods are returned immediately, one by one.
    fn tick(&mut self) -> Result<Instant, Infallible> {
        let ticker = self.ticker.get_or_insert_with(|| Ticker::new(PERIOD));
        Ok(ticker.wait())
    }

    /// A disturbed bus needs work in each period.
    fn wait_for(&mut self, event: Instant) -> Result<Pass, Infallible> {
        if self.launcher.is_over(clock::now()) {
            self.backplane.request_stop();
        }
        loop {
            let ticker = self.ticker.get_or_insert_with(|| Ticker::new(PERIOD));
            let next = ticker.next();
            let is_due = next <= clock::now();
            if is_due && next < self.quiet_until {
                return Ok(Pass::Quiet(ticker.wait()));
            }
            if core::mem::take(&mut self.rung) {
                return Ok(Pass::Frames);
            }
            if is_due {
                return Ok(Pass::Period(ticker.wait()));
            }
            if event <= next || self.is_disturbed() {
                clock::sleep_until(next);
                self.quiet_until = next;
            } else {
                self.rung = self.doorbell.wait(event);
                self.quiet_until = event;
            }
        }
    }

    fn set_ignition(&mut self, on: bool) {
        self.backplane.set_ignition(on);
    }

    fn stop_requested(&self) -> bool {
        self.backplane.stop_requested()
    }

    fn launcher_died(&self) -> Option<Instant> {
        let process = self.launcher.process.as_ref();
        let has_ended = || process.is_none_or(Watched::has_ended).then(clock::now);
        self.launcher.died.or_else(has_ended)
    }

    fn forgery(&self) -> Option<Forgery> {
        self.backplane.forgery()
    }

    fn drain_trace(&mut self, into: &mut dyn FnMut(Traced)) -> u32 {
        let mut lost = 0;
        for node in &mut self.from_cores {
            while let Some(traced) = node.traced(Reader::next) {
                into(traced);
            }
            let total = self.backplane.lost_trace(node.of.system, node.of.core);
            lost += total.wrapping_sub(core::mem::replace(&mut node.lost, total));
        }
        lost
    }

    fn salvage_trace(&mut self, into: &mut dyn FnMut(Traced)) {
        for node in &mut self.from_cores {
            while let Some(traced) = node.traced(Reader::salvage) {
                into(traced);
            }
        }
    }

    fn drain_supplies(&mut self, into: &mut dyn FnMut(Instant, SystemId, SupplyEvent)) {
        for (system, trace) in SystemId::ALL.into_iter().zip(&mut self.from_supplies) {
            while let Some((at, record)) = trace.next() {
                if let Some(event) = SupplyEvent::decode(record) {
                    into(at, system, event);
                }
            }
        }
    }

    fn drain_hands(&mut self, into: &mut dyn FnMut(Handled<'_>)) {
        self.outside.follow(self.backplane, into);
    }

    fn role(&self, system: SystemId) -> RoleLamp {
        self.backplane.role(system)
    }

    fn is_powered(&self, system: SystemId) -> bool {
        self.backplane.level(system)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RunName;
    use crate::args::{Common, Schedule};
    use crate::backplane::tests::ScratchRun;
    use crate::can::HostCan;
    use std::sync::Arc;
    use tandem_board::{Can, CanId, Generation, HardwareFault, Identity};
    use tandem_peripherals::codec::Reach;
    use tandem_peripherals::network::BusFault;

    /// Makes a run without other processes: this process is launcher and vehicle.
    fn port() -> (ScratchRun, HostVehiclePort) {
        let (run, backplane) = ScratchRun::create();
        let own = std::process::id();
        backplane.set_launcher(own);
        backplane.assemble([own; 2], own);
        let common = Common {
            run: (*run).clone(),
            schedule: Schedule::default(),
            network: None,
            extra: vec![],
        };
        let port = HostVehiclePort::attach(&VehicleArgs { common }).unwrap();
        (run, port)
    }

    /// Returns the CAN controller of a core in its first incarnation.
    fn attached(run: &RunName, port: &HostVehiclePort, system: SystemId, core: CoreId) -> HostCan {
        let generation = Generation(1);
        let of = Identity {
            system,
            core,
            generation,
        };
        let ringers = Arc::new(Ringers::new(run));
        HostCan::attach(port.backplane, of, ringers).unwrap()
    }

    /// T-RED-8: the bus corrects a reported time of sending that is too early or in the future. So
    /// a core that was frozen between reading the clock and sending cannot hide a gap.
    #[test]
    fn a_frame_is_as_old_as_the_bus_knows_it_to_be() {
        let (_run, mut port) = port();
        let ring = RINGS.transmit[CoreAddress::A0.index()];
        let words = port.backplane.ring(ring);
        let mut transmit = bare::fifo_producer(words, ring.shape).unwrap();
        let mut sent = |port: &mut HostVehiclePort, at: Instant| {
            let frame = CanFrame::new(CanId::Standard(1), true, &[]).unwrap();
            let frame = BusFrame {
                received: Received { frame, at },
                sender: Sender::Core(CoreAddress::A0),
                reach: Reach::NONE,
            };
            let words = Transmit {
                frame,
                discards: 0,
                mark: 0,
            };
            transmit.send(&words.encode()).unwrap();
            let mut seen = vec![];
            port.transmitted(&mut |_, _, carried| seen.push(carried.sent));
            seen
        };
        let begin = clock::now();
        assert!(sent(&mut port, begin)[0] >= begin);
        assert!(sent(&mut port, Instant::ORIGIN)[0] >= begin, "in the past");
        let [ahead] = sent(&mut port, Instant::NEVER)[..] else {
            panic!("one frame was sent");
        };
        assert!(ahead <= clock::now(), "in the future");
    }

    /// A log contains the frames in the order in which a receiver gets them, each with the
    /// receiver's time. It does not depend on which core sent a frame or when.
    #[test]
    fn a_frame_is_stamped_by_the_bus_as_its_receivers_stamp_it() {
        let (run, mut port) = port();
        let attach = |system, core| attached(&run, &port, system, core);
        let senders = [
            attach(SystemId::A, CoreId::CONTROL),
            attach(SystemId::B, CoreId::CONTROL),
        ];
        let receiver = attach(SystemId::A, CoreId::PERCEPTION);
        let mut stamped = vec![];
        for round in 0..20 {
            for (index, sender) in senders.iter().enumerate() {
                let id = CanId::Standard(0x100 + index as u16);
                sender
                    .try_send(&CanFrame::new(id, true, &[round]).unwrap())
                    .unwrap();
            }
            clock::sleep_until(clock::now() + Duration::from_ms(1));
            port.transmitted(&mut |_, _, carried| {
                assert!(carried.sent < carried.at);
                stamped.push((carried.frame, carried.at));
            });
            let own = CanFrame::new(CanId::Standard(0x700), true, &[round]).unwrap();
            let at = port.broadcast(&own);
            stamped.push((own, at));
        }
        let heard: Vec<_> = core::iter::from_fn(|| receiver.try_receive())
            .map(|received| (received.frame, received.at))
            .collect();
        assert_eq!(stamped.len(), 60);
        assert_eq!(heard, stamped);
        assert!(stamped.is_sorted_by_key(|(_, at)| *at));
    }

    #[test]
    fn a_frame_after_a_hold_up_carries_the_time_after_it() {
        let (run, mut port) = port();
        let can = attached(&run, &port, SystemId::A, CoreId::CONTROL);
        for id in 1..3 {
            let frame = CanFrame::new(CanId::Standard(id), true, &[]).unwrap();
            can.try_send(&frame).unwrap();
        }
        let held_up = Duration::from_ms(5);
        let mut stamps = vec![];
        port.transmitted(&mut |_, _, carried| {
            stamps.push(carried.at);
            clock::sleep_until(clock::now() + held_up);
        });
        assert_eq!(stamps.len(), 2);
        assert!(stamps[0] + held_up <= stamps[1], "{stamps:?}");
        Backplane::remove(&run);
    }

    /// A disturbed connection loses or delays sent or received frames; the other is not affected.
    #[test]
    fn a_disturbed_connection_affects_its_own_system_alone() {
        let (run, mut port) = port();
        let attach = |system| attached(&run, &port, system, CoreId::CONTROL);
        let [a, b] = SystemId::ALL.map(attach);
        let frame = |id| CanFrame::new(CanId::Standard(id), true, &[]).unwrap();
        let mut exchange = |fault: BusFault| {
            port.backplane.disturb_bus(SystemId::A, fault);
            clock::sleep_until(clock::now() + Duration::from_ms(2));
            let _ = (a.try_send(&frame(1)), b.try_send(&frame(2)));
            port.transmitted(&mut |_, _, _| {});
            let heard = |can: &HostCan| core::iter::from_fn(|| can.try_receive()).count();
            (heard(&a), heard(&b))
        };
        let sound = BusFault::default();
        assert_eq!(exchange(sound), (1, 1));
        let lost_out = 1_000;
        assert_eq!(exchange(BusFault { lost_out, ..sound }), (1, 0), "mute");
        let lost_in = 1_000;
        assert_eq!(exchange(BusFault { lost_in, ..sound }), (0, 1), "deaf");
        let late = Duration::from_ms(3);
        assert_eq!(exchange(BusFault { late, ..sound }), (1, 0), "late");
        clock::sleep_until(clock::now() + late);
        assert_eq!(exchange(BusFault { late, ..sound }), (1, 1), "one came");
        clock::sleep_until(clock::now() + late);
        assert_eq!(exchange(sound), (1, 2), "the second, which keeps its delay");
        Backplane::remove(&run);
    }

    /// T-RED-9: frames that wait when the output closes are not sent; later frames are sent.
    #[test]
    fn discarded_frames_do_not_reach_the_bus() {
        let (run, mut port) = port();
        let can = attached(&run, &port, SystemId::A, CoreId::CONTROL);
        let frame = |id| CanFrame::new(CanId::Standard(id), true, &[]).unwrap();
        for id in 1..4 {
            can.try_send(&frame(id)).unwrap();
        }
        can.discard_unsent();
        can.try_send(&frame(4)).unwrap();
        let mut seen = vec![];
        port.transmitted(&mut |_, _, received| seen.push(received.frame));
        assert_eq!(seen, [frame(4)]);
    }

    /// The vehicle sleeps until the period in which it sends a frame. A core's frame wakes it
    /// early; `wait_for` then first returns the periods that are already due.
    #[test]
    fn a_frame_of_a_core_wakes_a_bus_that_sleeps() {
        let (run, mut port) = port();
        let can = attached(&run, &port, SystemId::A, CoreId::CONTROL);
        let Ok(Pass::Period(first)) = port.wait_for(Instant::ORIGIN) else {
            panic!("the first period");
        };
        let never = clock::now() + Duration::from_ms(60_000);
        let (ask, asked) = std::sync::mpsc::channel();
        let sender = std::thread::spawn(move || {
            let frame = CanFrame::new(CanId::Standard(1), true, &[]).unwrap();
            while asked.recv().is_ok() {
                clock::sleep_until(clock::now() + Duration::from_ms(20));
                can.try_send(&frame).unwrap();
            }
        });
        // If this thread is delayed before its sleep, it finds a period or the frame: try again.
        let mut last = first;
        let mut slept = false;
        while !slept {
            ask.send(()).unwrap();
            loop {
                match port.wait_for(never).unwrap() {
                    Pass::Frames => break,
                    Pass::Quiet(due) => {
                        assert_eq!(due, last + PERIOD);
                        (slept, last) = (true, due);
                    }
                    Pass::Period(due) => {
                        assert_eq!(due, last + PERIOD);
                        last = due;
                    }
                }
            }
            assert!(clock::now() < never, "the frame woke the bus");
            let mut seen = 0;
            port.transmitted(&mut |_, _, _| seen += 1);
            assert_eq!(seen, 1);
        }
        drop(ask);
        sender.join().unwrap();
        // Even if the next period is due, the frame is reported first, so its wait is recorded.
        clock::sleep_until(clock::now() + PERIOD);
        (port.rung, port.quiet_until) = (true, Instant::ORIGIN);
        assert_eq!(port.wait_for(never), Ok(Pass::Frames));
        let pass = port.wait_for(never);
        assert!(matches!(pass, Ok(Pass::Period(_))), "{pass:?}");
        // A disturbed bus needs work in each period.
        port.backplane
            .set_fault(SystemId::A, HardwareFault::CanTransmit, true);
        let pass = port.wait_for(never);
        assert!(
            matches!(pass, Ok(Pass::Period(_) | Pass::Quiet(_))),
            "{pass:?}"
        );
        assert!(clock::now() < never);
    }
}
