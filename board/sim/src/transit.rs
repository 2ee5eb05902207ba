//! What is on its way: edges and datagrams that take time, and frames that wait for the bus.

use std::collections::BTreeMap;
use tandem_board::{CanFrame, CanId, CoreAddress, Duration, Edge, Line, SystemId};
use tandem_peripherals::codec::Sender;
use tandem_peripherals::frame_time::Bits;

/// What arrives later.
#[derive(Clone, Debug)]
pub(crate) enum Arrival {
    Edge(SystemId, Line, Edge),
    Datagram(SystemId, Vec<u32>),
}

/// A frame that waits for the bus.
#[derive(Clone, Debug)]
pub(crate) struct Waiting {
    pub(crate) sender: Sender,
    pub(crate) frame: CanFrame,
    pub(crate) bits: Bits,
}

/// The frame that the bus carries.
#[derive(Clone, Debug)]
pub(crate) struct OnAir {
    pub(crate) ends_ns: u64,
    /// `None`: its sender has lost power.
    pub(crate) frame: Option<Waiting>,
    pub(crate) destroyed: bool,
}

/// What is on its way.
#[derive(Clone, Debug, Default)]
pub(crate) struct Transit {
    /// By time, and in order.
    pub(crate) arrivals: BTreeMap<(u64, u64), Arrival>,
    count: u64,
    /// Those of one sender in its order.
    pub(crate) waiting: Vec<Waiting>,
    pub(crate) on_air: Option<OnAir>,
    /// The bus is idle from then on.
    pub(crate) free_ns: u64,
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

    /// A system has stopped, at this time. Its datagram ends in the middle. So does its frame, and
    /// the bus is idle again when the others have told the error: after `error`.
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
    pub(crate) fn winner(&self) -> Option<usize> {
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
