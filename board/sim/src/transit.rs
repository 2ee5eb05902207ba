//! What is on its way: edges and datagrams that take time, and frames that wait for the bus.

use crate::machine::Machine;
use std::collections::BTreeMap;
use tandem_board::{CanFrame, CanId, CoreAddress, Duration, Edge, Line, SystemId};
use tandem_peripherals::codec::Sender;
use tandem_peripherals::frame_time::{BitRates, Bits};

/// Times of the connections. The default takes no time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wires {
    /// From an edge to its count at the other system.
    pub line: Duration,
    /// From the hand-over of a datagram to its arrival.
    pub link: Duration,
    /// The bit rates of the bus; `None`: a frame takes no time, and no frame waits for another.
    pub bus: Option<BitRates>,
    /// Of a billion bits on the bus, this many are wrong. The frame is destroyed and sent again.
    pub wrong_bits: u32,
}

/// What arrives later.
#[derive(Clone, Debug)]
pub(crate) enum Arrival {
    Edge(SystemId, Line, Edge),
    Datagram(SystemId, Vec<u32>),
}

/// A frame that waits for the bus.
#[derive(Clone, Debug)]
struct Waiting {
    sender: Sender,
    frame: CanFrame,
    bits: Bits,
}

/// The frame that the bus carries.
#[derive(Clone, Debug)]
struct OnAir {
    ends_ns: u64,
    /// `None`: its sender has lost power.
    frame: Option<Waiting>,
    destroyed: bool,
}

/// What is on its way.
#[derive(Clone, Debug, Default)]
pub(crate) struct Transit {
    /// By time, and in order.
    arrivals: BTreeMap<(u64, u64), Arrival>,
    count: u64,
    /// Those of one sender in its order.
    waiting: Vec<Waiting>,
    on_air: Option<OnAir>,
    /// The bus is idle from then on.
    free_ns: u64,
}

impl Transit {
    pub(crate) fn arrives(&mut self, at_ns: u64, what: Arrival) {
        self.count += 1;
        self.arrivals.insert((at_ns, self.count), what);
    }

    /// A frame waits for the bus.
    pub(crate) fn wait(&mut self, sender: Sender, frame: &CanFrame) {
        self.waiting.push(Waiting {
            sender,
            frame: *frame,
            bits: Bits::of(frame),
        });
    }

    /// A controller forgets its frames, but not the one that the bus carries.
    pub(crate) fn discard(&mut self, from: CoreAddress) {
        self.waiting.retain(|it| it.sender != Sender::Core(from));
    }

    /// A system has stopped, at this time. Its datagram ends in the middle. So does its frame, and the
    /// bus is idle again when the others have told the error: after `error`.
    pub(crate) fn cut_off(&mut self, system: SystemId, now_ns: u64, error: Duration) {
        let is_of = |it: &Waiting| matches!(it.sender, Sender::Core(from) if from.system == system);
        self.waiting.retain(|it| !is_of(it));
        let goes_to = |what: &Arrival, to| matches!(what, Arrival::Datagram(it, _) if *it == to);
        self.arrivals
            .retain(|_, what| !goes_to(what, system.peer()));
        if let Some(air) = self
            .on_air
            .as_mut()
            .filter(|air| air.frame.as_ref().is_some_and(is_of))
        {
            (air.frame, air.ends_ns) = (None, now_ns + error.as_ns());
        }
    }

    /// When something happens next.
    pub(crate) fn next_ns(&self) -> u64 {
        let arrival = self
            .arrivals
            .first_key_value()
            .map(|((at_ns, _), _)| *at_ns);
        let bus = match &self.on_air {
            Some(air) => Some(air.ends_ns),
            None if self.waiting.is_empty() => None,
            None => Some(self.free_ns),
        };
        let next = arrival.into_iter().chain(bus).min();
        next.unwrap_or(u64::MAX)
    }

    /// The frame that wins the arbitration: each sender offers its oldest one.
    fn winner(&self) -> Option<usize> {
        let is_oldest = |index: usize| {
            let sender = self.waiting[index].sender;
            !self.waiting[..index].iter().any(|it| it.sender == sender)
        };
        let offered = (0..self.waiting.len()).filter(|index| is_oldest(*index));
        offered.min_by_key(|index| priority(self.waiting[*index].frame.id()))
    }
}

/// The order in which identifiers win: the identifier's first 11 bits, then standard before
/// extended, then the rest.
const fn priority(id: CanId) -> u32 {
    match id {
        CanId::Standard(id) => (id as u32) << 19,
        CanId::Extended(id) => (id >> 18) << 19 | 1 << 18 | id & 0x3_FFFF,
    }
}

impl Machine {
    /// Does what is due on the wires.
    pub(crate) fn settle_transit(&mut self) {
        while let Some(first) = self.transit.arrivals.first_entry()
            && first.key().0 <= self.now_ns
        {
            match first.remove() {
                Arrival::Edge(to, line, edge) => self.count_edge(to, line, edge),
                Arrival::Datagram(to, words) if self.is_powered(to) => {
                    // A receiver that does not fetch loses what arrives.
                    let _full = self.put_in_inbox(to, words);
                }
                Arrival::Datagram(..) => {}
            }
        }
        if self.config.wires.bus.is_some() {
            self.settle_air();
        }
    }

    fn settle_air(&mut self) {
        let Some(rates) = self.config.wires.bus else {
            return;
        };
        let now_ns = self.now_ns;
        loop {
            if let Some(air) = self.transit.on_air.take_if(|air| air.ends_ns <= now_ns) {
                self.transit.free_ns = air.ends_ns + rates.time(Bits::INTERMISSION).as_ns();
                match air.frame {
                    None => {}
                    Some(again) if air.destroyed => self.transit.waiting.insert(0, again),
                    Some(Waiting { sender, frame, .. }) => self.put_on_bus(sender, &frame),
                }
            }
            if self.transit.on_air.is_some() || now_ns < self.transit.free_ns {
                return;
            }
            let Some(index) = self.transit.winner() else {
                return;
            };
            let frame = self.transit.waiting.remove(index);
            let bits = frame.bits;
            let whole = rates.time(bits);
            let permillion =
                u64::from(self.config.wires.wrong_bits) * u64::from(bits.nominal + bits.data);
            let destroyed = self.draws_below(permillion, 1_000_000_000);
            let takes = if destroyed {
                // Anywhere in the frame, and the error frame.
                let part = Duration::from_ns(self.draw_below(whole.as_ns()));
                part + rates.time(Bits::ERROR)
            } else {
                whole
            };
            self.transit.on_air = Some(OnAir {
                ends_ns: now_ns + takes.as_ns(),
                frame: Some(frame),
                destroyed,
            });
        }
    }
}
