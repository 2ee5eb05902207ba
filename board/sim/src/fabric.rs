//! The connections between the two systems: lines, data link, CAN bus.

use crate::config::Defect;
use crate::event::OnBus;
use crate::machine::Machine;
use crate::outbox::Output;
use std::sync::atomic::Ordering;
use tandem_board::{
    CanFrame, CoreAddress, CoreId, Edge, Line, LinkFull, Received, SystemId, TransmitFull,
};
use tandem_peripherals::codec::Sender;
use tandem_peripherals::network::{Arrival, Carried, Wire};
use tandem_peripherals::supply::Power;

impl Machine {
    pub(crate) fn send_edge(&mut self, from: SystemId, line: Line, edge: Edge) {
        let to = if self.has(Defect::LineLoopback) {
            from
        } else {
            from.peer()
        };
        if self.systems[to.index()].supply.power() == Power::Off {
            return;
        }
        let (now, sent) = (self.at(), Arrival::Edge(to, line, edge));
        if let Some(Arrival::Edge(..)) = self.network.send(Wire::Line(line), from, sent, now) {
            self.count_edge(to, line, edge);
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
        if !self.is_powered(to) {
            return Ok(());
        }
        let (now, sent) = (self.at(), Arrival::Datagram(to, words.to_vec()));
        match self.network.send(Wire::Link, from, sent, now) {
            Some(Arrival::Datagram(to, words)) => self.put_in_inbox(to, words),
            _ => Ok(()),
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
        self.network.discard(from);
        let core = self.core(from);
        core.outbox
            .retain(|(_, output)| !matches!(output, Output::Frame(_)));
        self.core(from).loses_next = self.has(Defect::DiscardsLaterFrame);
    }

    pub(crate) fn send_can(
        &mut self,
        from: CoreAddress,
        frame: &CanFrame,
    ) -> Result<(), TransmitFull> {
        let now = self.at();
        if core::mem::take(&mut self.core(from).loses_next) {
            return Ok(());
        }
        let tamper = self.systems[from.system.index()].tamper;
        let frame = &tamper.map_or(*frame, |tamper| tamper(frame));
        let sent = self
            .network
            .send_frame(from, frame, now, now, &mut self.noise);
        self.receive_carried();
        sent
    }

    pub(crate) fn send_from_vehicle(&mut self, frame: &CanFrame) {
        let now = self.at();
        self.network.send_from_vehicle(frame, now, &mut self.noise);
        self.receive_carried();
    }

    /// Every core that a frame on the bus reaches receives it.
    fn receive_carried(&mut self) {
        while let Some(carried) = self.network.carried() {
            let Carried {
                at, sender, frame, ..
            } = carried;
            let on_bus = OnBus { at, sender, frame };
            self.digest.frame(&on_bus);
            self.bus.push(on_bus);
            self.unheard.push(on_bus);
            for place in CoreAddress::ALL {
                let deaf = self.has(Defect::NoBroadcast)
                    && matches!(sender, Sender::Core(from) if from.system != place.system);
                let own = self.has(Defect::SelfReception) && sender == Sender::Core(place);
                if carried.reach.has(place) && !deaf || own {
                    self.hear_can(place, sender, &frame);
                }
            }
        }
    }

    fn hear_can(&mut self, place: CoreAddress, sender: Sender, frame: &CanFrame) {
        let at = self.local(place.system);
        if !self.core(place).alive {
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
        let core = self.core(place);
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
    /// Does what is due on the bus and the wires.
    pub(crate) fn settle_network(&mut self) {
        let now = self.at();
        self.network.settle_bus(now, &mut self.noise);
        self.receive_carried();
        while let Some(arrival) = self.network.arrived(now) {
            match arrival {
                Arrival::Edge(to, line, edge) => self.count_edge(to, line, edge),
                Arrival::Datagram(to, words) if self.is_powered(to) => {
                    // A receiver that does not fetch loses what arrives.
                    let _full = self.put_in_inbox(to, words);
                }
                Arrival::Datagram(..) => {}
            }
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
