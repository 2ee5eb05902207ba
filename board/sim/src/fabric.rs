//! The connections between the two systems: lines, data link, CAN bus.

use crate::config::Defect;
use crate::event::OnBus;
use crate::machine::Machine;
use crate::outbox::Output;
use crate::transit::{Arrival, OnAir, Waiting};
use std::sync::atomic::Ordering;
use tandem_board::{
    CanFrame, CoreAddress, CoreId, Duration, Edge, HardwareFault, Line, LinkFull, Received,
    SystemId, TransmitFull,
};
use tandem_peripherals::codec::Sender;
use tandem_peripherals::frame_time::Bits;
use tandem_peripherals::supply::Power;
use tandem_peripherals::wires::Wire;

/// Frames that wait for the bus in the transmit buffer of a core.
const TRANSMIT_BUFFER: usize = 32;

impl Machine {
    pub(crate) fn send_edge(&mut self, from: SystemId, line: Line, edge: Edge) {
        if self.cuts.is_cut(Wire::Line(line), from) {
            return;
        }
        let to = if self.has(Defect::LineLoopback) {
            from
        } else {
            from.peer()
        };
        if self.systems[to.index()].supply.power() == Power::Off {
            return;
        }
        match self.config.wires.line {
            Duration::ZERO => self.count_edge(to, line, edge),
            delay => {
                let at_ns = self.now_ns + delay.as_ns();
                self.transit.arrives(at_ns, Arrival::Edge(to, line, edge));
            }
        }
    }

    /// An edge arrives.
    pub(crate) fn count_edge(&mut self, to: SystemId, line: Line, edge: Edge) {
        let counted = if self.has(Defect::WrongEdge) {
            Edge::Rising
        } else {
            edge
        };
        let count = self.glance.edges(to, line, counted);
        count.fetch_add(1, Ordering::Relaxed);
        if line.interrupts() && !self.has(Defect::SilentStart) {
            self.raise_peer(to.peer());
        }
    }

    pub(crate) fn send_link(&mut self, from: SystemId, words: &[u32]) -> Result<(), LinkFull> {
        let to = from.peer();
        if self.cuts.is_cut(Wire::Link, from) || !self.is_powered(to) {
            return Ok(());
        }
        match self.config.wires.link {
            Duration::ZERO => self.put_in_inbox(to, words.to_vec()),
            delay => {
                let at_ns = self.now_ns + delay.as_ns();
                let datagram = Arrival::Datagram(to, words.to_vec());
                self.transit.arrives(at_ns, datagram);
                Ok(())
            }
        }
    }

    pub(crate) fn put_in_inbox(
        &mut self,
        to: SystemId,
        mut datagram: Vec<u32>,
    ) -> Result<(), LinkFull> {
        let (limit, torn) = (self.config.link_datagrams, self.has(Defect::LinkTorn));
        let (overtakes, drops) = (self.has(Defect::LinkReordered), self.has(Defect::LinkDrops));
        let inbox = &mut self.system(to).inbox;
        if inbox.len() >= limit {
            return if drops { Ok(()) } else { Err(LinkFull) };
        }
        if let (true, Some(last)) = (torn, inbox.back_mut()) {
            let half = last.len().min(datagram.len()) / 2;
            last[..half].swap_with_slice(&mut datagram[..half]);
        }
        inbox.push_back(datagram);
        self.glance.link(to).store(true, Ordering::Relaxed);
        let inbox = &mut self.system(to).inbox;
        if overtakes {
            inbox.make_contiguous().reverse();
        }
        Ok(())
    }

    /// The next datagram, for a buffer of `room` words.
    pub(crate) fn receive_link(&mut self, system: SystemId, room: usize) -> Option<Vec<u32>> {
        let splits = self.has(Defect::LinkSplits);
        let inbox = &mut self.system(system).inbox;
        let datagram = inbox.pop_front();
        if let Some(datagram) = &datagram
            && splits
            && datagram.len() > room
        {
            inbox.push_front(datagram[room..].to_vec());
        }
        let waits = !inbox.is_empty();
        self.glance.link(system).store(waits, Ordering::Relaxed);
        datagram
    }

    pub(crate) fn discard_unsent(&mut self, from: CoreAddress) {
        let core = self.core(from);
        core.unsent.clear();
        core.outbox
            .retain(|(_, output)| !matches!(output, Output::Frame(_)));
        self.transit.discard(from);
        self.core(from).loses_next = self.has(Defect::DiscardsLaterFrame);
    }

    /// Sends a frame of a core, unless the core has used up its share of this millisecond.
    pub(crate) fn send_can(
        &mut self,
        from: CoreAddress,
        frame: &CanFrame,
    ) -> Result<(), TransmitFull> {
        if self.cuts.is_cut(Wire::Can, from.system) {
            return Ok(());
        }
        let now = self.at();
        let tamper = self.systems[from.system.index()].tamper;
        let frame = &tamper.map_or(*frame, |tamper| tamper(frame));
        let core = self.core(from);
        if !core.transmit.allows(now) {
            return Err(TransmitFull);
        }
        core.transmit.count(now);
        if core::mem::take(&mut core.loses_next) {
            return Ok(());
        }
        let lost_out = self.systems[from.system.index()].bus_fault.lost_out;
        if self.loses(lost_out) {
            return Ok(());
        }
        if self.core(from).unsent.is_empty() && self.sends(from) {
            self.transmit(from, frame);
            return Ok(());
        }
        let unsent = &mut self.core(from).unsent;
        if unsent.len() >= TRANSMIT_BUFFER {
            return Err(TransmitFull);
        }
        unsent.push_back(*frame);
        Ok(())
    }

    /// A frame of this sender waits for the bus, which takes no time unless the wires have one.
    pub(crate) fn offer(&mut self, sender: Sender, frame: &CanFrame) {
        if self.config.wires.bus.is_some() {
            self.transit.wait(sender, frame);
        } else {
            self.put_on_bus(sender, frame);
        }
    }

    /// Puts a frame on the bus: every connected core but its sender receives it.
    pub(crate) fn put_on_bus(&mut self, sender: Sender, frame: &CanFrame) {
        let at = self.at();
        let on_bus = OnBus {
            at,
            sender,
            frame: *frame,
        };
        self.digest.frame(&on_bus);
        self.bus.push(on_bus);
        self.unheard.push(on_bus);
        for place in CoreAddress::ALL {
            let own = sender == Sender::Core(place);
            let deaf = self.has(Defect::NoBroadcast)
                && matches!(sender, Sender::Core(from) if from.system != place.system);
            let lost_in = self.systems[place.system.index()].bus_fault.lost_in;
            let deaf = deaf || self.loses(lost_in);
            if (!own || self.has(Defect::SelfReception)) && !deaf {
                self.hear_can(place, sender, frame);
            }
        }
    }

    fn hear_can(&mut self, place: CoreAddress, sender: Sender, frame: &CanFrame) {
        let at = self.local(place.system);
        if self.cuts.is_cut(Wire::Can, place.system) || !self.core(place).alive {
            return;
        }
        let depth = self.config.can_fifo_frames;
        let uncounted = self.has(Defect::OverrunNotCounted);
        let hasty = |core| {
            let from = CoreAddress::new(SystemId::B, core);
            sender == Sender::Core(from) && place.system == SystemId::B
        };
        let swapped = self.has(Defect::CanReordered) && self.bus.len().is_multiple_of(5)
            || self.has(Defect::CanTwoOrders) && hasty(CoreId::CONTROL);
        let (mute, eager) = (
            self.has(Defect::NoWakeOnReceive),
            self.has(Defect::AlwaysWakeOnReceive),
        );
        let frame = if self.has(Defect::FdTruncated) {
            truncated(frame)
        } else {
            *frame
        };
        let broken = self.systems[place.system.index()]
            .faults
            .has(HardwareFault::CanReceive);
        let core = self.core(place);
        core.confinement.hears(broken);
        if broken {
            return;
        }
        if core.can_fifo.len() >= depth {
            core.overruns = core.overruns.wrapping_add(u32::from(!uncounted));
        } else {
            core.can_fifo.push_back(Received { frame, at });
            self.glance.can(place).store(true, Ordering::Relaxed);
            let core = self.core(place);
            if let (true, Some(before)) = (swapped, core.can_fifo.len().checked_sub(2)) {
                core.can_fifo.swap(before, before + 1);
            }
        }
        let core = self.core(place);
        core.pending |= (core.can_wakes && !mute) || eager;
    }

    pub(crate) fn receive_can(&mut self, place: CoreAddress) -> Option<Received> {
        let fifo = &mut self.core(place).can_fifo;
        let received = fifo.pop_front();
        let waits = !fifo.is_empty();
        self.glance.can(place).store(waits, Ordering::Relaxed);
        received
    }

    pub(crate) fn wake_on_receive(&mut self, place: CoreAddress, on: bool) {
        let mute = self.has(Defect::NoWakeOnReceive);
        let core = self.core(place);
        core.can_wakes = on;
        // Level, not edge: a frame that arrived before the request is also pending.
        core.pending |= on && !mute && !core.can_fifo.is_empty();
    }
}

/// What is on its way, and what a core sends while a job of it takes time.
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

    /// Whether the output waits for the end of the core's job; if not, it is for the caller to do.
    pub(crate) fn holds(&mut self, from: CoreAddress, output: impl FnOnce() -> Output) -> bool {
        let core = self.core(from);
        if let Some(job) = core.job {
            core.outbox.push((job, output()));
        }
        core.job.is_some()
    }

    /// A full receiver or buffer loses what arrives: its sender has gone on.
    pub(crate) fn put_out(&mut self, from: CoreAddress, output: Output) {
        match output {
            Output::Edge(line, edge) => self.send_edge(from.system, line, edge),
            Output::Datagram(words) => {
                let _full: Result<(), LinkFull> = self.send_link(from.system, &words);
            }
            Output::Frame(frame) => {
                let _full: Result<(), TransmitFull> = self.send_can(from, &frame);
            }
            Output::Service(answer) => self.service_watchdog(from.system, answer),
        }
    }
}

fn truncated(frame: &CanFrame) -> CanFrame {
    let data = frame.data();
    let kept = if data.len() > 8 { 8 } else { data.len() };
    CanFrame::new(frame.id(), frame.is_fd(), &data[..kept]).unwrap_or(*frame)
}
