//! The carrier's hart: it moves frames, watches the watchdogs, and switches systems on and off.

use super::host::Host;
use super::{core, system};
use crate::hart::{self, CARRIER, time};
use crate::{clint, doorbell, memory, trap};
use core::sync::atomic::Ordering::{Acquire, Relaxed};
use tandem_board::{CoreAddress, CoreId, Instant, ResetCause, SystemId};
use tandem_peripherals::codec::{FRAME_WORDS, Sender, set_sender, set_time};

/// What the carrier has to tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// A system was reset, for this cause.
    Reset(SystemId, ResetCause),
    /// A system is held in reset for good: it asked for it.
    Suspended(SystemId),
}

/// A request of the watchdog's: above one plus any [`tandem_board::ResetRequest::code`].
pub(crate) const BY_WATCHDOG: u32 = 4;

/// Cycles from reading to reading of a turn that was given away and that nobody used: four, and
/// fewer than any hart takes that does something.
const YIELD_CYCLES: u32 = 6;

/// The carrier, on its own hart.
pub struct Carrier {
    watchdogs: bool,
    /// The systems in this machine, by [`SystemId::index`].
    here: [bool; 2],
    host: Option<Host>,
}

impl Carrier {
    pub(crate) const fn new() -> Self {
        Self {
            watchdogs: false,
            here: [true; 2],
            host: None,
        }
    }

    /// From now on exchanges with the world outside, which is the host's, through two pipes in the
    /// emulator's folder. Only the systems `here` are in this machine.
    pub fn connect(&mut self, here: [bool; 2]) {
        self.here = here;
        self.host = Some(Host::open());
    }

    /// Whether the watchdogs reset systems that are switched on from now on.
    pub const fn set_watchdogs(&mut self, watch: bool) {
        self.watchdogs = watch;
    }

    /// Switches systems on, at the same time: LMU zero, no edges, generation 1. They must be off.
    pub fn power_on(&mut self, all: &[SystemId]) {
        for which in all {
            for word in memory::lmu(*which) {
                word.store(0, Relaxed);
            }
            let registers = system(*which);
            for edges in registers.edges.iter().flatten() {
                edges.store(0, Relaxed);
            }
            registers.link.clear();
            registers.generation.store(0, Relaxed);
        }
        // What the first one sends is not wiped by the start of the second.
        for which in all {
            self.release(*which, ResetCause::PowerOn);
        }
    }

    /// Switches a system off, wherever it is.
    pub fn power_off(&mut self, which: SystemId) {
        self.hold(which);
    }

    /// Makes the data flash of a system as it comes from the factory. The system must be off.
    pub fn new_flash(&mut self, which: SystemId) {
        system(which).flash.erase_all();
    }

    /// Does what there is to do, and sleeps until there is more, at most until `deadline` (in
    /// ticks). The event that ended the sleep, if there was one.
    pub fn step(&mut self, deadline: u64) -> Option<Event> {
        self.move_frames();
        self.exchange();
        for which in self.systems() {
            let event = self.look_after(which);
            if event.is_some() {
                return event;
            }
        }
        let now = time();
        let next = self
            .systems()
            .filter_map(|which| self.watchdog_left(which, now).and_then(Result::ok))
            .map(|left| now + u64::from(left) + 1)
            .chain(self.host.as_ref().map(Host::due))
            .fold(deadline, u64::min);
        self.rest(next);
        None
    }

    /// Rests until it is called or `deadline` has come. When nobody else has anything to do, it
    /// lets the clock jump to where somebody has.
    ///
    /// The emulator could do that: with all harts asleep its main loop moves the virtual clock.
    /// But then two of its threads look after the timers, and on a busy host they do so in varying
    /// order, and the harts take varying turns. So the carrier never sleeps, and the timers are the
    /// business of one thread.
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
            let timers = (0..CARRIER).map(clint::timer).filter(|timer| *timer > now);
            match u32::try_from(timers.fold(deadline, u64::min)) {
                Ok(next) => clint::jump_to(next),
                // After 429 s it is the emulator's turn.
                Err(_) => {
                    doorbell::wait(Some(deadline));
                    return;
                }
            }
        }
    }

    /// The systems in this machine.
    pub fn systems(&self) -> impl Iterator<Item = SystemId> + use<> {
        let here = self.here;
        SystemId::ALL
            .into_iter()
            .filter(move |system| here[system.index()])
    }

    /// Tells the world what happened, and does what it answers, if the time has come.
    fn exchange(&mut self) {
        // Taken out for as long as it works on the rest.
        if let Some(mut host) = self.host.take() {
            if time() >= host.due() {
                host.exchange(self);
            }
            self.host = Some(host);
        }
    }

    fn watchdog_left(&self, which: SystemId, now: u64) -> Option<Result<u32, u32>> {
        let registers = system(which);
        let watches = registers.powered.load(Relaxed) && registers.watchdog.watches.load(Relaxed);
        watches.then(|| registers.watchdog.left(now as u32))
    }

    /// A reset that the system asked for, or that its watchdog wants.
    fn look_after(&mut self, which: SystemId) -> Option<Event> {
        // Acquire pairs with the Release of the core that asks.
        let mut request = system(which).request.load(Acquire);
        if matches!(self.watchdog_left(which, time()), Some(Err(_))) {
            request = BY_WATCHDOG;
        }
        let cause = match request {
            0 => return None,
            1 => ResetCause::Software,
            2 => ResetCause::Trap,
            BY_WATCHDOG => ResetCause::Watchdog,
            _ => {
                self.hold(which);
                return Some(Event::Suspended(which));
            }
        };
        self.hold(which);
        self.release(which, cause);
        Some(Event::Reset(which, cause))
    }

    /// Stops a system and lets its level line fall.
    fn hold(&mut self, which: SystemId) {
        let registers = system(which);
        for core in CoreId::ALL {
            trap::hold(CoreAddress::new(which, core).index());
        }
        for core in CoreId::ALL {
            while !trap::stands(CoreAddress::new(which, core).index()) {
                hart::yield_turn();
            }
        }
        registers.request.store(0, Relaxed);
        // Outputs of a chip in reset are low.
        registers.lamp.store(0, Relaxed);
        self.set_power(which, false);
    }

    pub(super) fn set_power(&self, which: SystemId, on: bool) {
        if system(which).powered.swap(on, Relaxed) != on {
            super::interrupt(which.peer());
        }
    }

    /// Begins the next life of a system that is held.
    fn release(&mut self, which: SystemId, cause: ResetCause) {
        let registers = system(which);
        registers.cores.iter().for_each(super::CoreRegisters::clear);
        registers.request.store(0, Relaxed);
        registers.cause.store(cause.code(), Relaxed);
        let generation = registers.generation.load(Relaxed).wrapping_add(1);
        registers.generation.store(generation, Relaxed);
        registers.watchdog.start(self.watchdogs, time() as u32);
        self.set_power(which, true);
        for core in CoreId::ALL {
            trap::release(CoreAddress::new(which, core).index());
        }
    }

    /// The bus: every frame goes to all cores but its sender, in one order.
    fn move_frames(&mut self) {
        loop {
            let mut moved = false;
            for sender in CoreAddress::ALL {
                if let Some(mut frame) = core(sender).transmit.take() {
                    moved = true;
                    set_time(&mut frame, now());
                    // Who sent it is known from the ring, whatever the words say.
                    set_sender(&mut frame, Sender::Core(sender));
                    self.broadcast(Some(sender), &frame);
                    if let Some(host) = &mut self.host {
                        host.on_bus(&frame);
                    }
                }
            }
            if !moved {
                return;
            }
        }
    }

    /// Gives a frame to all cores but its sender.
    pub(super) fn broadcast(&self, sender: Option<CoreAddress>, frame: &[u32; FRAME_WORDS]) {
        for receiver in CoreAddress::ALL {
            let to = receiver.system;
            let hears = self.here[to.index()] && system(to).powered.load(Relaxed);
            if !hears || sender == Some(receiver) {
                continue;
            }
            let registers = core(receiver);
            if !registers.receive.put(frame) {
                registers.overruns.fetch_add(1, Relaxed);
            }
            // Acquire pairs with the Release in `wake_on_receive`.
            if registers.wake_on_receive.load(Acquire) {
                clint::post(receiver.index());
            }
        }
    }
}

/// The time on the bus.
pub(super) fn now() -> Instant {
    Instant::from_ns(time() * clint::TICK_NS)
}
