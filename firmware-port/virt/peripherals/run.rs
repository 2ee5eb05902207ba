//! The carrier's hart: it moves frames, checks the watchdogs, and switches systems on and off.

use super::host::Host;
use super::{core, ethernet, interrupt, now, set_fault, system};
use crate::exit::exit;
use crate::hart::{self, CARRIER, time};
use crate::memory::{self, Strap, stack_used, strap};
use crate::{doorbell, interrupts, log, trap};
use core::sync::atomic::Ordering::{Acquire, Relaxed};
use tandem_board::{
    Channel, CoreAddress, CoreId, Edge, HardwareFault, Instant, Line, NetworkAddress, ResetCause,
    ResetRequest, RoleLamp, SystemId,
};
use tandem_cosim::{Assembly, Item};
use tandem_peripherals::codec::{FRAME_WORDS, Sender, decode_service, set_sender, set_time};
use tandem_peripherals::memory::scribble;
use tandem_peripherals::network::controller::Confinement;
use tandem_peripherals::stamp::TimeStamp;
use tandem_peripherals::supply::{Change, Config, Power, Supply, starts_after};

/// Maximum number of cycles between two reads of the counter if no hart used the yielded turn.
/// Without another hart, four cycles pass; a hart that works takes more than this limit.
const YIELD_CYCLES: u32 = 6;

/// The carrier, on its own hart.
pub struct Peripherals {
    /// The supplies, by [`SystemId::index`].
    supplies: [Supply; 2],
    /// Whether each system is in this machine, by [`SystemId::index`].
    here: [bool; 2],
    host: Option<Host>,
    /// The time in ticks at which to carry out an item between two exchanges, and the item.
    later: Option<(u64, Option<Item>)>,
    /// The datagram of the Ethernet to each system whose parts arrive.
    assemblies: [Assembly; 2],
    /// The fault confinement of each CAN controller, by [`CoreAddress::index`].
    confinements: [Confinement; CoreAddress::COUNT],
}

impl Peripherals {
    pub(crate) const fn new() -> Self {
        Self {
            supplies: [Supply::new(Config::TARGET); 2],
            here: [true; 2],
            host: None,
            later: None,
            assemblies: [const { Assembly::new() }; 2],
            confinements: [const { Confinement::new() }; CoreAddress::COUNT],
        }
    }

    /// Connects to the vehicle process on the host, through two pipes in the emulator's folder.
    /// From now on the carrier exchanges messages. Only the systems `here` are in this machine.
    pub fn connect(&mut self, here: [bool; 2]) {
        self.here = here;
        self.host = Some(Host::open());
    }

    /// Connects the two systems in this machine by an Ethernet cable.
    pub fn connect_stations(&self) {
        for (index, which) in (0..).zip(SystemId::ALL) {
            for (port, channel) in (7_410..).zip(Channel::ALL) {
                let address = [10, 0, 0, 1 + index];
                let at = NetworkAddress { address, port };
                system(which).network.connect(channel, at);
            }
        }
    }

    /// Sets whether the watchdogs reset their systems. All systems must be off.
    pub const fn set_watchdogs(&mut self, watches: bool) {
        let config = Config {
            watches,
            ..Config::TARGET
        };
        self.supplies = [Supply::new(config); 2];
    }

    /// Switches on at the same time all systems of `all` that are off, with a zeroed LMU, no edges,
    /// and generation 1.
    pub fn power_on(&mut self, all: &[SystemId]) {
        let off = |supplies: &[Supply; 2], which: &SystemId| {
            supplies[which.index()].power() == Power::Off
        };
        for which in all.iter().filter(|which| off(&self.supplies, which)) {
            for word in memory::lmu(*which) {
                word.store(0, Relaxed);
            }
            let registers = system(*which);
            registers.forget_edges();
            registers.link.clear();
            registers.generation.store(0, Relaxed);
        }
        // A separate loop: the first loop must not clear edges that a started system has sent.
        for which in all {
            let change = self.supplies[which.index()].power_on(now());
            self.carry_out(*which, change);
        }
    }

    /// Switches a system off, in any state.
    pub fn power_off(&mut self, which: SystemId) {
        let change = self.supplies[which.index()].power_off();
        // Also if it was off: when the machine starts, the cores have not stopped yet.
        self.carry_out(which, change.or(Some(Change::PowerOff)));
    }

    /// Resets a system to its state when new: erases its data flash and removes all faults of its
    /// hardware. The system must be off.
    pub fn renew(&mut self, which: SystemId) {
        system(which).flash.erase_all();
        system(which).faults.store(0, Relaxed);
        system(which).level_cut.store(false, Relaxed);
    }

    /// Emulates the hardware around the systems in this machine, for a vehicle process on the host.
    /// The systems are off at first: that process connects the battery, and later ends the machine.
    ///
    /// Strap `First`: the systems in this machine, 1 A, 2 B, 3 both.
    pub fn play_for_world(&mut self) -> ! {
        let systems = strap(Strap::First);
        self.connect([systems & 1 != 0, systems & 2 != 0]);
        self.set_watchdogs(true);
        for system in self.systems() {
            self.power_off(system);
            self.renew(system);
        }
        loop {
            self.step(u64::MAX);
        }
    }

    /// Does all pending work, and waits until there is more, at most until `deadline` (in ticks).
    /// If a supply changes, returns early with that change.
    pub fn step(&mut self, deadline: u64) -> Option<(SystemId, Change)> {
        self.move_frames();
        if self.host.is_none() {
            self.systems().for_each(ethernet::pass_on);
        }
        self.exchange();
        if let Some((_, Some(item))) = self.later.take_if(|(at, _)| time() >= *at) {
            self.act(item);
            // The host measures from this time: the cores that `act` had to stop have stopped.
            log!("carried out at {} ns", now().as_ns());
        }
        for which in self.systems() {
            let change = self.look_after(which);
            self.carry_out(which, change);
            if let Some(change) = change {
                return Some((which, change));
            }
        }
        let supplies = self
            .systems()
            .map(|which| self.supplies[which.index()].next());
        let next = supplies
            .chain(self.retries())
            .map(|next| next.as_ns().div_ceil(interrupts::TICK_NS))
            .chain(self.host.as_ref().map(Host::due))
            .chain(self.later.map(|(at, _)| at))
            .fold(deadline, u64::min);
        self.rest(next);
        None
    }

    /// Waits until the carrier's doorbell rings or `deadline` has passed. If no hart has work, sets
    /// the clock to the next time at which one has.
    ///
    /// The emulator could do this: if all harts sleep, its main loop advances the clock. But then
    /// two of its threads serve the timers, in varying order on a busy host, and the turns of the
    /// harts vary. So the carrier does not sleep, and one thread serves the timers.
    fn rest(&self, deadline: u64) {
        while !doorbell::take() {
            let now = time();
            if now >= deadline {
                return;
            }
            let before = hart::cycles();
            hart::yield_turn();
            if hart::cycles().wrapping_sub(before) > YIELD_CYCLES {
                continue;
            }
            let timers = (0..CARRIER)
                .map(interrupts::timer)
                .filter(|timer| *timer > now);
            match interrupts::settable(timers.fold(deadline, u64::min)) {
                Some(next) => interrupts::jump_to(next),
                // The carrier must sleep, so that the emulator advances the clock.
                None => {
                    doorbell::wait(Some(deadline));
                    return;
                }
            }
        }
    }

    /// Returns the systems in this machine.
    pub fn systems(&self) -> impl Iterator<Item = SystemId> + use<> {
        let here = self.here;
        SystemId::ALL
            .into_iter()
            .filter(move |system| here[system.index()])
    }

    /// If an exchange is due, reports to the vehicle process, and carries out its answer.
    fn exchange(&mut self) {
        // `act` needs `self`, so the host is taken out of it during the call.
        if let Some(mut host) = self.host.take() {
            if time() >= host.due() {
                host.exchange(self.here, &mut |item| self.act(item));
            }
            self.host = Some(host);
        }
    }

    /// Carries out one item of the answer from the host.
    fn act(&mut self, item: Item) {
        if let Some((_, later @ None)) = &mut self.later {
            *later = Some(item);
            return;
        }
        match item {
            Item::Frame(mut words) => {
                set_time(&mut words, now());
                // `None`: no core of this machine sent the frame.
                self.broadcast(None, &words);
            }
            Item::Edges {
                to,
                line,
                edge,
                count,
                at,
            } => {
                let edge = [Edge::Rising, Edge::Falling].get(edge);
                if let (Some(line), Some(edge)) = (Line::ALL.get(line), edge) {
                    system(to).count_edges((*line, *edge), count, || at);
                    if line.interrupts() {
                        interrupt(to);
                    }
                }
            }
            Item::Datagram { to, words } => {
                // If the queue is full, the datagram is lost: the core did not receive in time.
                let _ = system(to).link.put(&words);
            }
            Item::Level { of, high } => self.set_power(of, high),
            Item::Feed { of, on: true } => self.power_on(&[of]),
            Item::Feed { of, on: false } => self.power_off(of),
            Item::Fault { of, fault, present } => set_fault(of, fault, present),
            Item::Crash { of } => {
                let change = self.supplies[of.index()].reset(now(), ResetCause::Trap);
                self.carry_out(of, change);
            }
            Item::Scribble { of, seed } => scribble(memory::lmu(of), seed),
            Item::Hang { of } => {
                trap::hold(CoreAddress::new(of, CoreId::CONTROL).index());
                Self::until_stopped(of, &[CoreId::CONTROL]);
            }
            Item::CutLevel { of, cut } => system(of).level_cut.store(cut, Relaxed),
            Item::Later { us } => {
                let ticks = u64::from(us) * 1_000 / interrupts::TICK_NS;
                self.later = Some((time() + ticks, None));
            }
            Item::End => {
                log!("bytes of stack: {:?}", [0, 1, 2, 3, 4, 5].map(stack_used));
                exit(0)
            }
            Item::Connect { of, channel, at } => system(of).network.connect(channel, at),
            Item::Packet {
                of,
                is_first,
                words,
            } => {
                if let Some(packet) = self.assemblies[of.index()].add(is_first, &words) {
                    ethernet::receive(of, packet);
                }
            }
            Item::Trace { .. } => {}
        }
    }

    /// Passes a system's registers to its supply, then polls the supply.
    fn look_after(&mut self, which: SystemId) -> Option<Change> {
        let registers = system(which);
        // Acquire pairs with the Release in `release_core`.
        let released = registers.released.swap(0, Acquire);
        for core in CoreId::ALL {
            let hart = CoreAddress::new(which, core).index();
            if released >> core.index() & 1 == 1 && trap::stands(hart) {
                trap::release(hart);
            }
        }
        let supply = &mut self.supplies[which.index()];
        // Acquire pairs with the Release in `request_reset`. 0 means no request.
        if let Some(code) = registers.request.swap(0, Acquire).checked_sub(1) {
            supply.request(ResetRequest::from_code(code).unwrap_or(ResetRequest::Suspend));
        }
        let change = supply.observe(now(), registers.has_faults());
        if change.is_some() {
            return change;
        }
        while let Some(service) = registers.services.take() {
            let (at, answer) = decode_service(service);
            let change = supply.service(now(), at, answer);
            if change.is_some() {
                return change;
            }
        }
        // True, because all cores have stopped when `hold` returns.
        supply.poll(now(), true)
    }

    fn carry_out(&mut self, which: SystemId, change: Option<Change>) {
        match change {
            None => {}
            Some(Change::Start(cause)) => self.release(which, cause),
            Some(Change::Reset(_) | Change::PowerOff) => self.hold(which, RoleLamp::Starting),
            Some(Change::Suspend) => self.hold(which, RoleLamp::Suspended),
        }
    }

    /// Stops a system and lowers its level line. Sets the lamp, because a chip in reset cannot.
    fn hold(&mut self, which: SystemId, lamp: RoleLamp) {
        let registers = system(which);
        for core in CoreId::ALL {
            trap::hold(CoreAddress::new(which, core).index());
        }
        Self::until_stopped(which, &CoreId::ALL);
        registers.request.store(0, Relaxed);
        registers.released.store(0, Relaxed);
        registers.lamp.store(lamp.code(), Relaxed);
        self.set_power(which, false);
    }

    /// Waits until these held cores of a system have stopped: each needs a turn of the emulator.
    fn until_stopped(which: SystemId, cores: &[CoreId]) {
        for core in cores {
            while !trap::stands(CoreAddress::new(which, *core).index()) {
                hart::yield_turn();
            }
        }
    }

    pub(super) fn set_power(&self, which: SystemId, on: bool) {
        let registers = system(which);
        if registers.powered.swap(on, Relaxed) != on && !registers.level_cut.load(Relaxed) {
            interrupt(which.peer());
        }
    }

    /// Starts the next incarnation of a system that is held.
    fn release(&mut self, which: SystemId, cause: ResetCause) {
        let registers = system(which);
        registers.cores.iter().for_each(super::CoreRegisters::clear);
        registers.network.restart();
        for core in CoreId::ALL {
            let core = CoreAddress::new(which, core).index();
            self.confinements[core] = Confinement::default();
        }
        registers.request.store(0, Relaxed);
        registers.cause.store(cause.code(), Relaxed);
        let starts = starts_after(registers.starts.load(Relaxed), cause);
        registers.starts.store(starts, Relaxed);
        let generation = registers.generation.load(Relaxed).wrapping_add(1);
        registers.generation.store(generation, Relaxed);
        registers.services.clear();
        registers.service_count.store(0, Relaxed);
        self.set_power(which, true);
        // Core 0 releases the other cores. T-BOOT-2
        trap::release(CoreAddress::new(which, CoreId::CONTROL).index());
    }

    /// Moves frames as the bus does: to all cores except the sender, to all in the same order.
    fn move_frames(&mut self) {
        loop {
            let mut moved = false;
            for sender in CoreAddress::ALL {
                let faults = system(sender.system).has_faults();
                let destroys = faults.has(HardwareFault::CanTransmit);
                let confinement = &mut self.confinements[sender.index()];
                let sends = || confinement.sends(now(), destroys);
                if let Some(mut frame) = core(sender).transmit.take_if(sends) {
                    moved = true;
                    // On its way to the bus, a frame carries its mark in place of its time.
                    let (mark, at) = (frame[0], now());
                    if mark != 0 {
                        TimeStamp(&core(sender).stamp).write(mark, at);
                    }
                    set_time(&mut frame, at);
                    // The sender is the core whose ring held the frame, whatever the frame says.
                    set_sender(&mut frame, Sender::Core(sender));
                    self.broadcast(Some(sender), &frame);
                    if let Some(host) = &mut self.host {
                        host.on_bus(&frame);
                    }
                }
            }
            if !moved {
                break;
            }
        }
        for (address, confinement) in CoreAddress::ALL.iter().zip(&mut self.confinements) {
            let errors = confinement.errors(now());
            core(*address).can_errors.store(errors.to_word(), Relaxed);
        }
    }

    /// Returns the times at which frames that the bus has destroyed are sent again.
    fn retries(&self) -> impl Iterator<Item = Instant> {
        let waiting = CoreAddress::ALL.into_iter().zip(&self.confinements);
        let waiting = waiting.filter(|(address, _)| !core(*address).transmit.is_empty());
        waiting.map(|(_, confinement)| confinement.due())
    }

    /// Passes a frame to all cores except its sender.
    pub(super) fn broadcast(&mut self, sender: Option<CoreAddress>, frame: &[u32; FRAME_WORDS]) {
        for receiver in CoreAddress::ALL {
            let to = receiver.system;
            let hears = self.here[to.index()] && system(to).powered.load(Relaxed);
            if !hears || sender == Some(receiver) {
                continue;
            }
            let broken = system(to).has_faults().has(HardwareFault::CanReceive);
            self.confinements[receiver.index()].hears(broken);
            if broken {
                continue;
            }
            let registers = core(receiver);
            if !registers.receive.put(frame) {
                registers.overruns.fetch_add(1, Relaxed);
            }
            // Acquire pairs with the Release in `wake_on_receive`.
            if registers.wake_on_receive.load(Acquire) {
                interrupts::post(receiver.index());
            }
        }
    }
}
