//! The connections between the two systems: lines, data link, CAN bus.

use crate::event::OnBus;
use crate::machine::Machine;
use crate::outbox::Output;
use std::sync::atomic::Ordering;
use tandem_board::{
    CanFrame, CoreAddress, Edge, Line, LinkFull, NetworkFull, Received, SystemId, TimeEdge,
    TransmitFull,
};
use tandem_peripherals::codec::Sender;
use tandem_peripherals::network::{Arrival, Delivery, Sent, Station, Wire};
use tandem_peripherals::supply::Power;

impl Machine {
    pub(crate) fn send_edge(&mut self, from: SystemId, line: Line, edge: Edge) {
        let to = from.peer();
        if self.systems[to.index()].supply.power() == Power::Off {
            return;
        }
        let (now, sent) = (self.at(), Arrival::Edge(to, line, edge));
        if let Some(Arrival::Edge(..)) = self.network.send(Wire::Line(line), from, sent, now) {
            self.count_edge(to, line, edge);
        }
    }

    /// Counts an edge that arrives at a system now, and stamps it or interrupts core 0 if the line
    /// does so.
    pub(crate) fn count_edge(&mut self, to: SystemId, line: Line, edge: Edge) {
        let count = self.glance.edges(to, line, edge);
        let count = count.fetch_add(1, Ordering::Relaxed).wrapping_add(1);
        if (line, edge) == (Line::Time, Edge::Rising) {
            let at = self.local(to);
            self.system(to).time_edge = Some(TimeEdge { count, at });
        }
        if line.interrupts() {
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
        datagram: Vec<u32>,
    ) -> Result<(), LinkFull> {
        let limit = self.config.link_datagrams;
        let inbox = &mut self.system(to).inbox;
        if inbox.len() >= limit {
            return Err(LinkFull);
        }
        inbox.push_back(datagram);
        self.glance.link(to).store(true, Ordering::Relaxed);
        Ok(())
    }

    /// Returns the next datagram.
    pub(crate) fn receive_link(&mut self, system: SystemId) -> Option<Vec<u32>> {
        let inbox = &mut self.system(system).inbox;
        let datagram = inbox.pop_front();
        let waits = !inbox.is_empty();
        self.glance.link(system).store(waits, Ordering::Relaxed);
        datagram
    }

    pub(crate) fn discard_unsent(&mut self, from: CoreAddress) {
        self.network.discard(from);
        let core = self.core(from);
        core.outbox
            .retain(|(_, output)| !matches!(output, Output::Frame(..)));
    }

    /// Begins the record of the next stamped frame of a core; returns the frame's mark.
    pub(crate) fn begin_stamp(&mut self, from: CoreAddress) -> u32 {
        self.marks += 1;
        let (mark, core) = (self.marks, self.core(from));
        (core.mark, core.stamp) = (mark, None);
        mark
    }

    pub(crate) fn send_can(
        &mut self,
        from: CoreAddress,
        frame: &CanFrame,
        mark: u32,
    ) -> Result<(), TransmitFull> {
        let now = self.at();
        let tamper = self.systems[from.system.index()].tamper;
        let mut frame = tamper.map_or(*frame, |tamper| tamper(frame));
        let local = self.local(from.system);
        if let Some(filter) = &mut self.system(from.system).sent[from.core.index()] {
            let Some(filtered) = filter(local, frame) else {
                return Ok(());
            };
            frame = filtered;
        }
        let sent = Sent { at: now, mark };
        let sent = self
            .network
            .send_frame(from, &frame, sent, now, &mut self.noise);
        self.receive_carried();
        sent
    }

    pub(crate) fn send_from_vehicle(&mut self, frame: &CanFrame) {
        let now = self.at();
        self.network.send_from_vehicle(frame, now, &mut self.noise);
        self.receive_carried();
    }

    /// Puts each frame on the bus into the receive FIFOs of the cores that it reaches.
    fn receive_carried(&mut self) {
        while let Some(carried) = self.network.carried() {
            let Delivery {
                at,
                sender,
                frame,
                sent,
                ..
            } = carried;
            if let Sender::Core(from) = sender
                && sent.mark != 0
            {
                self.stamp_can(from, sent.mark);
            }
            let on_bus = OnBus { at, sender, frame };
            self.digest.frame(&on_bus);
            self.bus.push(on_bus);
            self.unheard.push(on_bus);
            for place in CoreAddress::ALL {
                if carried.reach.has(place) {
                    self.hear_can(place, frame);
                }
            }
        }
    }

    /// Stamps the frame with this mark, which is on the bus now, if its sender still waits for it.
    fn stamp_can(&mut self, from: CoreAddress, mark: u32) {
        let at = self.local(from.system);
        let core = self.core(from);
        if core.mark == mark {
            core.stamp = Some(at);
        }
    }

    fn hear_can(&mut self, place: CoreAddress, frame: CanFrame) {
        let at = self.local(place.system);
        let depth = self.config.can_fifo_frames;
        let filter = &mut self.system(place.system).heard[place.core.index()];
        let frame = match filter {
            Some(filter) => match filter(at, frame) {
                Some(frame) => frame,
                None => return,
            },
            None => frame,
        };
        let core = self.core(place);
        if !core.alive {
            return;
        }
        core.pending |= core.can_wakes;
        if core.can_fifo.len() >= depth {
            core.overruns = core.overruns.wrapping_add(1);
        } else {
            core.can_fifo.push_back(Received { frame, at });
            self.glance.can(place).store(true, Ordering::Relaxed);
        }
    }

    pub(crate) fn receive_can(&mut self, place: CoreAddress) -> Option<Received> {
        let fifo = &mut self.core(place).can_fifo;
        let received = fifo.pop_front();
        let waits = !fifo.is_empty();
        self.glance.can(place).store(waits, Ordering::Relaxed);
        received
    }

    pub(crate) fn wake_on_receive(&mut self, place: CoreAddress, on: bool) {
        let core = self.core(place);
        core.can_wakes = on;
        // By level, not by edge: a frame that arrived before this call also counts as pending.
        core.pending |= on && !core.can_fifo.is_empty();
    }
}

/// Arrivals, and outputs that wait until a core's job ends.
impl Machine {
    /// Carries out everything that is due on the bus and the wires.
    pub(crate) fn settle_network(&mut self) {
        let now = self.at();
        self.network.settle_bus(now, &mut self.noise);
        self.receive_carried();
        while let Some(arrival) = self.network.arrived(now) {
            match arrival {
                Arrival::Edge(to, line, edge) => self.count_edge(to, line, edge),
                Arrival::Datagram(to, words) if self.is_powered(to) => {
                    // A full receiver loses the datagram.
                    let _full = self.put_in_inbox(to, words);
                }
                Arrival::Datagram(..) => {}
            }
        }
    }

    /// Keeps the output until the core's job ends. Returns `false` if no job runs; the caller then
    /// performs the output.
    pub(crate) fn holds(&mut self, from: CoreAddress, output: impl FnOnce() -> Output) -> bool {
        let core = self.core(from);
        if let Some(job) = core.job {
            core.outbox.push((job, output()));
        }
        core.job.is_some()
    }

    /// Performs an output. If a receiver or buffer is full, the output is lost without an error.
    pub(crate) fn put_out(&mut self, from: CoreAddress, output: Output) {
        match output {
            Output::Edge(line, edge) => self.send_edge(from.system, line, edge),
            Output::Datagram(words) => {
                let _full: Result<(), LinkFull> = self.send_link(from.system, &words);
            }
            Output::Frame(frame, mark) => {
                let _full: Result<(), TransmitFull> = self.send_can(from, &frame, mark);
            }
            Output::Packet(channel, to, bytes) => {
                let end = (Station::of(from.system), channel);
                let _full: Result<(), NetworkFull> = self.send_packet(end, to, &bytes);
            }
            Output::Service(answer) => self.service_watchdog(from.system, answer),
        }
    }
}
