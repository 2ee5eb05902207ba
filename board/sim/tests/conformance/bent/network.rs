//! Defects of the Ethernet port.

use super::{Bent, Defect};
use tandem_board::{
    Board, Channel, Datagram, Duration, Instant, Network, NetworkAddress, NetworkFull, Recipient,
};

/// A datagram on its way from or to a bent port, with its channel.
pub(super) struct Held {
    channel: Channel,
    to: Recipient,
    bytes: Vec<u8>,
    from: NetworkAddress,
    at: Instant,
}

fn before(at: Instant, by: Duration) -> Instant {
    Instant::from_ns(at.as_ns().saturating_sub(by.as_ns()))
}

impl Bent {
    /// Takes the datagrams out of the port, and applies the defects of order and of cutting.
    fn fetch_packets(&self, channel: Channel) {
        let mut packets = self.packets.borrow_mut();
        let mut buffer = [0; Self::MAX_BYTES];
        while let Some(it) = self.board.network().try_receive(channel, &mut buffer) {
            packets.push_back(Held {
                channel,
                to: Recipient::Everyone,
                bytes: buffer[..it.len].to_vec(),
                from: it.from,
                at: it.at,
            });
            if let (true, Some(before)) = (
                self.is(Defect::NetworkReordered),
                packets.len().checked_sub(2),
            ) {
                packets.swap(before, before + 1);
            }
        }
    }

    /// Sends what the port has refused, if it takes it now.
    fn send_refused(&self) {
        let mut refused = self.refused.borrow_mut();
        let network = self.board.network();
        refused.retain(|it| network.try_send(it.channel, it.to, &it.bytes).is_err());
    }
}

impl Network for Bent {
    fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        self.board.network().address(channel)
    }

    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        let held = || Held {
            channel,
            to,
            bytes: bytes.to_vec(),
            from: self.address(channel).unwrap_or_default(),
            at: self.board.now(),
        };
        let everyone = to == Recipient::Everyone;
        if self.is(Defect::NetworkHasNoGroup) && everyone {
            return Ok(());
        }
        if self.is(Defect::NetworkEchoes) && everyone {
            self.packets.borrow_mut().push_back(held());
        }
        self.send_refused();
        let on = match self.is(Defect::NetworkHasOneChannel) {
            true => Channel::Topics,
            false => channel,
        };
        let sent = self.board.network().try_send(on, to, bytes);
        if self.is(Defect::NetworkSendsRefused) && sent.is_err() {
            self.refused.borrow_mut().push(held());
        }
        sent
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        let sent_at = self.board.network().sent_at(channel)?;
        Some(match self.defect {
            Some(Defect::NetworkLeavesEarly) => before(sent_at, Duration::from_ms(1)),
            Some(Defect::NetworkLeavesLate) => sent_at + Duration::from_ms(9),
            _ => sent_at,
        })
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        self.fetch_packets(channel);
        let mut packets = self.packets.borrow_mut();
        let index = packets.iter().position(|it| it.channel == channel)?;
        let mut packet = packets.remove(index)?;
        let len = packet.bytes.len().min(bytes.len());
        bytes[..len].copy_from_slice(&packet.bytes[..len]);
        let (mut from, mut at) = (packet.from, packet.at);
        match self.defect {
            Some(Defect::NetworkHidesSender) => from.port ^= 1,
            Some(Defect::NetworkComesEarly) => at = before(at, Duration::from_ms(50)),
            Some(Defect::NetworkComesLate) => at += Duration::from_ms(9),
            Some(Defect::NetworkSplits) if len < packet.bytes.len() => {
                packet.bytes.drain(..len);
                packets.push_front(packet);
            }
            _ => {}
        }
        Some(Datagram { len, from, at })
    }
}
