//! The network as one sans-IO model.
//!
//! A frame of a core passes four stages: the core's controller (its share of the bus, its fault
//! confinement), its system's connection (cut, loss, delay), the bus (arbitration, bit errors), and
//! the connection of each receiver (cut, loss, receiver faults).

use alloc::collections::{BTreeMap, VecDeque};
use alloc::vec::Vec;

use rand::{Rng, RngExt};
use tandem_board::{
    CanErrors, CanFrame, CanId, CanState, CoreAddress, CoreId, Duration, Edge, HardwareFault,
    Instant, Line, SystemId, TransmitFull,
};

use super::conditions::{Conditions, Wire};
use super::controller::{Confinement, TransmitLimit};
use super::frame_time::{BitRates, Bits};
use crate::codec::{Reach, Sender};

/// How many frames the transmit buffer of a core can hold.
const TRANSMIT_BUFFER: usize = 32;

/// Transfer times of the connections. By default they are zero.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WireTimes {
    /// Time from an edge to its count at the other system.
    pub line: Duration,
    /// Time from `send` of a datagram to its arrival.
    pub link: Duration,
    /// The bit rates of the bus; `None`: a frame takes no time and never waits for another frame.
    pub bus: Option<BitRates>,
    /// How many of a billion bits on the bus are wrong. The frame is then destroyed and sent again.
    pub wrong_bits: u32,
}

/// An edge or a datagram that arrives at a system.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// An edge.
    Edge(SystemId, Line, Edge),
    /// A datagram of the link.
    Datagram(SystemId, Vec<u32>),
}

/// A frame on the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Delivery {
    /// Its sender.
    pub sender: Sender,
    /// The frame.
    pub frame: CanFrame,
    /// When its sender passed it to its controller, and its mark.
    pub sent: Sent,
    /// When it was on the bus.
    pub at: Instant,
    /// The cores whose controllers receive it.
    pub reach: Reach,
}

/// What a board says of a frame that a core passes to its controller.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sent {
    /// When.
    pub at: Instant,
    /// By this number the board recognises the frame when it was on the bus; 0 if it need not.
    pub mark: u32,
}

impl Sent {
    /// Makes the record of a frame without a mark.
    #[must_use]
    pub const fn at(at: Instant) -> Self {
        Self { at, mark: 0 }
    }
}

/// A frame between its sender and the bus.
#[derive(Clone, Copy, Debug)]
struct Handed {
    sender: Sender,
    frame: CanFrame,
    sent: Sent,
}

impl Handed {
    fn is_of(&self, system: SystemId) -> bool {
        matches!(self.sender, Sender::Core(from) if from.system == system)
    }
}

/// The frame that is on the bus now.
#[derive(Clone, Debug)]
struct OnAir {
    ends: Instant,
    /// `None` if its sender has lost power.
    frame: Option<Handed>,
    is_destroyed: bool,
}

/// The CAN controller of a core.
#[derive(Clone, Debug, Default)]
struct Controller {
    limit: TransmitLimit,
    confinement: Confinement,
    /// Frames that the bus has not accepted yet.
    unsent: VecDeque<Handed>,
}

/// The network of a run.
#[derive(Clone, Debug, Default)]
pub struct Network {
    /// Cut wires and disturbances. A change takes effect at the next call.
    pub conditions: Conditions,
    times: WireTimes,
    controllers: [Controller; CoreAddress::COUNT],
    /// Frames that a slow connection delays, by the time at which each reaches the bus.
    late: VecDeque<(Instant, Handed)>,
    /// Frames that wait for the bus. The frames of one sender are in the order of sending.
    waiting: Vec<Handed>,
    on_air: Option<OnAir>,
    /// From this time on the bus is idle.
    free: Instant,
    /// Frames that were on the bus and have not been fetched yet.
    carried: VecDeque<Delivery>,
    /// Edges and datagrams in transit, sorted by time of arrival, then by order of sending.
    under_way: BTreeMap<(Instant, u64), Arrival>,
    sent_count: u64,
}

impl Network {
    /// Makes a network without faults.
    #[must_use]
    pub fn new(times: WireTimes) -> Self {
        Self {
            times,
            ..Self::default()
        }
    }

    /// Sends an edge or a datagram over this wire. Returns it if it arrives immediately.
    pub fn send(
        &mut self,
        wire: Wire,
        from: SystemId,
        what: Arrival,
        now: Instant,
    ) -> Option<Arrival> {
        if self.conditions.cuts.is_cut(wire, from) {
            return None;
        }
        let delay = match what {
            Arrival::Edge(..) => self.times.line,
            Arrival::Datagram(..) => self.times.link,
        };
        if delay == Duration::ZERO {
            return Some(what);
        }
        self.sent_count += 1;
        self.under_way.insert((now + delay, self.sent_count), what);
        None
    }

    /// Returns the next edge or datagram that has arrived by `now`.
    pub fn arrived(&mut self, now: Instant) -> Option<Arrival> {
        let first = self.under_way.first_entry()?;
        (first.key().0 <= now).then(|| first.remove())
    }

    /// Returns whether the controller of this core can accept a frame and try to send it at once.
    #[must_use]
    pub fn is_ready(&self, of: CoreAddress, now: Instant) -> bool {
        let controller = &self.controllers[of.index()];
        let is_cut = self.conditions.cuts.is_cut(Wire::Can, of.system);
        is_cut || controller.limit.allows(now) && controller.unsent.is_empty()
    }

    /// Passes a core's frame to its controller. `sent`: for [`Delivery::sent`].
    ///
    /// # Errors
    /// [`TransmitFull`] if the core has used up its share of this millisecond, or its transmit
    /// buffer is full.
    pub fn send_frame(
        &mut self,
        from: CoreAddress,
        frame: &CanFrame,
        sent: Sent,
        now: Instant,
        noise: &mut impl Rng,
    ) -> Result<(), TransmitFull> {
        if self.conditions.cuts.is_cut(Wire::Can, from.system) {
            return Ok(());
        }
        let controller = &mut self.controllers[from.index()];
        if !controller.limit.allows(now) || controller.unsent.len() >= TRANSMIT_BUFFER {
            return Err(TransmitFull);
        }
        controller.limit.count(now);
        let handed = Handed {
            sender: Sender::Core(from),
            frame: *frame,
            sent,
        };
        if self.controllers[from.index()].unsent.is_empty() && self.sends(from, now) {
            self.connect(from, handed, now, noise);
        } else {
            self.controllers[from.index()].unsent.push_back(handed);
        }
        Ok(())
    }

    /// Returns whether the first frame of a controller reaches the system's connection now.
    fn sends(&mut self, from: CoreAddress, now: Instant) -> bool {
        let faults = self.conditions.hardware[from.system.index()];
        let confinement = &mut self.controllers[from.index()].confinement;
        confinement.sends(now, faults.has(HardwareFault::CanTransmit))
    }

    /// Sends a frame that has left its core's controller: the connection of the system may lose or
    /// delay it. A board whose cores have separate controllers calls this directly.
    pub fn send_from_controller(
        &mut self,
        from: CoreAddress,
        frame: &CanFrame,
        now: Instant,
        noise: &mut impl Rng,
    ) {
        let handed = Handed {
            sender: Sender::Core(from),
            frame: *frame,
            sent: Sent::at(now),
        };
        if !self.conditions.cuts.is_cut(Wire::Can, from.system) {
            self.connect(from, handed, now, noise);
        }
    }

    fn connect(&mut self, from: CoreAddress, handed: Handed, now: Instant, noise: &mut impl Rng) {
        let fault = self.conditions.bus[from.system.index()];
        if is_lost(fault.lost_out, noise) {
            return;
        }
        if fault.late == Duration::ZERO {
            self.offer(handed, now, noise);
        } else {
            let due = now + fault.late;
            let behind = self.late.partition_point(|(other, _)| *other <= due);
            self.late.insert(behind, (due, handed));
        }
    }

    /// Sends a frame of a vehicle node. No connection disturbs it.
    pub fn send_from_vehicle(&mut self, frame: &CanFrame, now: Instant, noise: &mut impl Rng) {
        let handed = Handed {
            sender: Sender::Vehicle,
            frame: *frame,
            sent: Sent::at(now),
        };
        self.offer(handed, now, noise);
    }

    /// Queues a frame for the bus. Without bit rates the frame is on the bus immediately.
    fn offer(&mut self, handed: Handed, now: Instant, noise: &mut impl Rng) {
        if self.times.bus.is_some() {
            self.waiting.push(handed);
        } else {
            self.put_on_bus(handed, now, noise);
        }
    }

    /// Puts a frame on the bus: all connected controllers except the sender's receive it.
    fn put_on_bus(&mut self, handed: Handed, at: Instant, noise: &mut impl Rng) {
        let Handed {
            sender,
            frame,
            sent,
        } = handed;
        let mut reach = Reach::NONE;
        for place in CoreAddress::ALL {
            let system = place.system.index();
            // Drawn for every core, so that the random numbers do not depend on the sender.
            let is_lost = is_lost(self.conditions.bus[system].lost_in, noise);
            let is_cut = self.conditions.cuts.is_cut(Wire::Can, place.system);
            let deaf_to = self.conditions.bus[system].deaf_to;
            let deaf_to = deaf_to.get(place.core.index()).copied().flatten();
            let is_deaf = deaf_to.is_some_and(|id| frame.id() == CanId::Standard(id));
            if is_lost || is_cut || is_deaf || sender == Sender::Core(place) {
                continue;
            }
            let fails = self.conditions.hardware[system].has(HardwareFault::CanReceive);
            self.controllers[place.index()].confinement.hears(fails);
            if !fails {
                reach.add(place);
            }
        }
        self.carried.push_back(Delivery {
            sender,
            frame,
            sent,
            at,
            reach,
        });
    }

    /// Returns the next frame that was on the bus.
    pub fn carried(&mut self) -> Option<Delivery> {
        self.carried.pop_front()
    }

    /// Carries out what is due on the bus at `now`: controllers try again, slow connections
    /// deliver, a frame on the bus ends and the next begins.
    pub fn settle_bus(&mut self, now: Instant, noise: &mut impl Rng) {
        for from in CoreAddress::ALL {
            if self.controllers[from.index()].unsent.is_empty() {
                continue;
            }
            if self.conditions.cuts.is_cut(Wire::Can, from.system) {
                self.controllers[from.index()].unsent.clear();
            }
            while !self.controllers[from.index()].unsent.is_empty() && self.sends(from, now) {
                if let Some(handed) = self.controllers[from.index()].unsent.pop_front() {
                    self.connect(from, handed, now, noise);
                }
            }
        }
        while let Some((_, handed)) = self.late.front().copied().filter(|(due, _)| *due <= now) {
            self.late.pop_front();
            self.offer(handed, now, noise);
        }
        if let Some(rates) = self.times.bus {
            self.settle_air(rates, now, noise);
        }
    }

    fn settle_air(&mut self, rates: BitRates, now: Instant, noise: &mut impl Rng) {
        loop {
            if let Some(air) = self.on_air.take_if(|air| air.ends <= now) {
                self.free = air.ends + rates.time(Bits::INTERMISSION);
                match air.frame {
                    None => {}
                    Some(again) if air.is_destroyed => self.waiting.insert(0, again),
                    Some(handed) => self.put_on_bus(handed, now, noise),
                }
            }
            if self.on_air.is_some() || now < self.free {
                return;
            }
            let Some(index) = self.winner() else {
                return;
            };
            let handed = self.waiting.remove(index);
            let bits = Bits::of(&handed.frame);
            let whole = rates.time(bits);
            let per_billion =
                u64::from(self.times.wrong_bits) * u64::from(bits.nominal + bits.data);
            let is_destroyed =
                per_billion > 0 && noise.random_range(0..1_000_000_000) < per_billion;
            let takes = if is_destroyed {
                // The error may be anywhere in the frame; an error frame follows.
                let part = noise.random_range(0..whole.as_ns().max(1));
                Duration::from_ns(part) + rates.time(Bits::ERROR)
            } else {
                whole
            };
            self.on_air = Some(OnAir {
                ends: now + takes,
                frame: Some(handed),
                is_destroyed,
            });
        }
    }

    /// Returns the index of the frame that wins the arbitration; a sender offers its oldest frame.
    fn winner(&self) -> Option<usize> {
        let is_oldest = |index: usize| {
            let sender = self.waiting[index].sender;
            !self.waiting[..index].iter().any(|it| it.sender == sender)
        };
        let offered = (0..self.waiting.len()).filter(|index| is_oldest(*index));
        offered.min_by_key(|index| priority(self.waiting[*index].frame.id()))
    }

    /// Returns the time at which the network next acts by itself.
    #[must_use]
    pub fn next(&self) -> Instant {
        let busy = self.controllers.iter().filter(|it| !it.unsent.is_empty());
        let tries = busy.map(|it| it.confinement.due());
        let late = self.late.front().map(|(due, _)| *due);
        let arrives = self.under_way.first_key_value().map(|((at, _), _)| *at);
        let bus = match &self.on_air {
            Some(air) => Some(air.ends),
            None if self.waiting.is_empty() => None,
            None => Some(self.free),
        };
        let others = late.into_iter().chain(arrives).chain(bus);
        tries.chain(others).min().unwrap_or(Instant::NEVER)
    }

    /// Returns whether the bus must be settled in each period: frames wait, a controller counts
    /// errors, or a fault disturbs it.
    #[must_use]
    pub fn is_disturbed(&self) -> bool {
        let is_busy = |it: &Controller| {
            !it.unsent.is_empty() || it.confinement.state() != CanState::ErrorActive
        };
        self.conditions.disturb_bus()
            || !self.late.is_empty()
            || self.controllers.iter().any(is_busy)
    }

    /// Returns the error counters of a core's controller.
    pub fn errors(&mut self, of: CoreAddress, now: Instant) -> CanErrors {
        self.controllers[of.index()].confinement.errors(now)
    }

    /// Discards the frames that a controller has not sent, except a frame that is on the bus now.
    pub fn discard(&mut self, from: CoreAddress) {
        self.controllers[from.index()].unsent.clear();
        self.waiting.retain(|it| it.sender != Sender::Core(from));
    }

    /// Restarts the controller of a core: no waiting frames, no counted errors.
    pub fn restart(&mut self, core: CoreAddress) {
        self.controllers[core.index()] = Controller::default();
    }

    /// Records the death of a core: the frames in its controller are not sent.
    pub fn stop_core(&mut self, core: CoreAddress) {
        self.controllers[core.index()].unsent.clear();
    }

    /// Stops a system. Its datagrams in transit are lost, and its frame on the bus is cut off: the
    /// bus is idle again after the error frame of the other nodes.
    pub fn stop(&mut self, system: SystemId, now: Instant) {
        for core in CoreId::ALL {
            self.stop_core(CoreAddress::new(system, core));
        }
        self.waiting.retain(|it| !it.is_of(system));
        let to = system.peer();
        self.under_way
            .retain(|_, what| !matches!(what, Arrival::Datagram(of, _) if *of == to));
        let error = self
            .times
            .bus
            .map_or(Duration::ZERO, |it| it.time(Bits::ERROR));
        if let Some(air) = &mut self.on_air
            && air.frame.as_ref().is_some_and(|it| it.is_of(system))
        {
            (air.frame, air.ends) = (None, now + error);
        }
    }
}

/// Decides at random whether a frame or a datagram is lost; the probability is `permille` in a
/// thousand. Draws no random number if `permille` is 0.
pub(super) fn is_lost(permille: u16, noise: &mut impl Rng) -> bool {
    permille > 0 && noise.random_range(0..1000) < permille
}

/// Returns the rank of an identifier in the arbitration: its first 11 bits, then standard before
/// extended, then the remaining bits.
const fn priority(id: CanId) -> u32 {
    match id {
        CanId::Standard(id) => (id as u32) << 19,
        CanId::Extended(id) => (id >> 18) << 19 | 1 << 18 | id & 0x3_FFFF,
    }
}

#[cfg(test)]
mod tests;
