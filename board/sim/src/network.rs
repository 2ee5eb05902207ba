//! The Ethernet of a pair: the ports of core 0, and further stations for tests and the world.

use crate::board::SimNetwork;
use crate::machine::{Machine, Shared};
use crate::outbox::Output;
use crate::pair::SimPair;
use std::sync::Arc;
use tandem_board::{
    Channel, Datagram, Instant, Network, NetworkAddress, NetworkFull, Recipient, SystemId,
};
use tandem_peripherals::network::{Packet, PortFault, Station};

/// A further station of the network, as a computer outside both systems. Its clock is the virtual
/// time.
#[derive(Clone)]
pub struct SimStation {
    shared: Arc<Shared>,
    station: Station,
}

impl SimPair {
    /// Connects a further station.
    ///
    /// # Panics
    /// If the pair has no network: see [`Config::network`](crate::Config::network).
    pub fn join_network(&mut self) -> SimStation {
        let shared = Arc::clone(&self.shared);
        let joined = shared.lock().ethernet.as_mut().map(|it| it.join());
        let Some(station) = joined else {
            panic!("the pair is configured without a network")
        };
        SimStation { shared, station }
    }

    /// Sets what is wrong with the cable of a system. No effect without a network.
    pub fn disturb_network(&mut self, of: SystemId, fault: PortFault) {
        if let Some(ethernet) = &mut self.shared.lock().ethernet {
            ethernet.disturb(Station::of(of), fault);
        }
    }
}

impl SimStation {
    /// Sets what is wrong with the cable of this station.
    pub fn disturb(&self, fault: PortFault) {
        if let Some(ethernet) = &mut self.shared.lock().ethernet {
            ethernet.disturb(self.station, fault);
        }
    }
}

impl Network for SimStation {
    fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        Some(self.station.address(channel))
    }

    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        must_fit(bytes);
        let mut machine = self.shared.lock();
        machine.send_packet((self.station, channel), to, bytes)
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        self.shared.lock().packet_left((self.station, channel))
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        let mut machine = self.shared.lock();
        let packet = machine.receive_packet((self.station, channel))?;
        Some(copied(&packet, packet.at, bytes))
    }
}

fn must_fit(bytes: &[u8]) {
    let most = SimStation::MAX_BYTES;
    assert!(bytes.len() <= most, "a datagram has at most {most} bytes");
}

fn copied(packet: &Packet, at: Instant, into: &mut [u8]) -> Datagram {
    let len = packet.bytes.len().min(into.len());
    into[..len].copy_from_slice(&packet.bytes[..len]);
    let from = packet.from;
    Datagram { len, from, at }
}

impl SimNetwork {
    /// Returns this core's end of the channel; `None` if it is not connected to a network.
    fn end(&self, channel: Channel) -> Option<(Station, Channel)> {
        let is_connected = self.0.shared.config.network.is_some() && self.0.is_control();
        is_connected.then(|| (Station::of(self.0.place.system), channel))
    }
}

impl Network for SimNetwork {
    fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        let (station, channel) = self.end(channel)?;
        Some(station.address(channel))
    }

    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        must_fit(bytes);
        let Some(end) = self.end(channel) else {
            return Ok(());
        };
        let sent = self
            .0
            .alive(|machine| {
                if machine.holds(self.0.place, || Output::Packet(channel, to, bytes.into())) {
                    machine.forget_sent(end);
                    return Ok(());
                }
                machine.send_packet(end, to, bytes)
            })
            .unwrap_or(Ok(()));
        if sent.is_err() {
            self.0.look();
        }
        sent
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        self.0.look();
        let end = self.end(channel)?;
        self.0.alive(|machine| {
            let left = machine.packet_left(end)?;
            Some(machine.local_at(self.0.place.system, left))
        })?
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        let received = self.end(channel).and_then(|end| {
            self.0.alive(|machine| {
                let packet = machine.receive_packet(end)?;
                let at = machine.local_at(self.0.place.system, packet.at);
                Some(copied(&packet, at, bytes))
            })?
        });
        if received.is_none() {
            self.0.look();
        }
        received
    }
}

impl Machine {
    pub(crate) fn send_packet(
        &mut self,
        end: (Station, Channel),
        to: Recipient,
        bytes: &[u8],
    ) -> Result<(), NetworkFull> {
        let now = self.at();
        let Some(ethernet) = &mut self.ethernet else {
            return Ok(());
        };
        ethernet.send(end, to, bytes, now, &mut self.noise)
    }

    fn forget_sent(&mut self, end: (Station, Channel)) {
        if let Some(ethernet) = &mut self.ethernet {
            ethernet.forget_sent(end);
        }
    }

    fn packet_left(&self, end: (Station, Channel)) -> Option<Instant> {
        self.ethernet.as_ref()?.sent_at(end, self.at())
    }

    fn receive_packet(&mut self, end: (Station, Channel)) -> Option<Packet> {
        let now = self.at();
        self.ethernet.as_mut()?.receive(end, now)
    }

    /// Returns what the clock of a system showed at this virtual time.
    fn local_at(&self, system: SystemId, at: Instant) -> Instant {
        let clock = self.config.clocks[system.index()];
        Instant::from_ns(clock.local_ns(at.as_ns()))
    }
}
