//! The Ethernet of emulated systems: UDP sockets of this machine for each of them.

use std::io;

use tandem_board::{Channel, Instant, Recipient, SystemId};
use tandem_board_udp::{UdpChannel, UdpPlace};
use tandem_cosim::{Assembly, Item, packet_parts};
use tandem_peripherals::codec::{DATAGRAM_WORDS, PACKET_MAX_BYTES, PACKET_WORDS, PacketHead};

/// How many datagrams of a channel a system gets in a step: those of both systems fit into one
/// answer. The others wait in the socket.
const AT_ONCE: usize = 4;

/// The stations of systems A and B. A datagram from one to the other takes the way outside, too.
#[derive(Debug)]
pub(crate) struct Bridge {
    ends: [[UdpChannel; Channel::ALL.len()]; 2],
    /// The datagram of each system whose parts arrive.
    assemblies: [Assembly; 2],
}

impl Bridge {
    /// Opens the sockets.
    pub(crate) fn open(place: UdpPlace) -> io::Result<Self> {
        let station = || -> io::Result<_> {
            let [topics, time] = Channel::ALL.map(|channel| UdpChannel::open(place, channel));
            Ok([topics?, time?])
        };
        Ok(Self {
            ends: [station()?, station()?],
            assemblies: [const { Assembly::new() }; 2],
        })
    }

    /// Returns the items that connect a system.
    pub(crate) fn connects(&self, of: SystemId) -> impl Iterator<Item = Item> {
        let ends = Channel::ALL.into_iter().zip(&self.ends[of.index()]);
        ends.map(move |(channel, end)| Item::Connect {
            of,
            channel,
            at: end.address(),
        })
    }

    /// Takes a part of what a system has sent, and sends it when it is whole.
    pub(crate) fn send(&mut self, of: SystemId, is_first: bool, part: &[u32; DATAGRAM_WORDS]) {
        let Some(words) = self.assemblies[of.index()].add(is_first, part) else {
            return;
        };
        let mut bytes = [0; PACKET_MAX_BYTES];
        if let Some((head, len)) = PacketHead::decode(words, &mut bytes) {
            let end = &self.ends[of.index()][head.channel.index()];
            // What does not fit into the socket is lost, as on the wire.
            let _full = end.send(head.peer, &bytes[..len]);
        }
    }

    /// Passes on what has arrived for a system.
    pub(crate) fn receive(&self, to: SystemId, mut each: impl FnMut(Item)) {
        let mut bytes = [0; PACKET_MAX_BYTES];
        let mut words = [0; PACKET_WORDS];
        for (channel, end) in Channel::ALL.into_iter().zip(&self.ends[to.index()]) {
            for _ in 0..AT_ONCE {
                let Some(heard) = end.receive(&mut bytes) else {
                    break;
                };
                let head = PacketHead {
                    channel,
                    peer: Recipient::One(heard.from),
                    // The machine sets the time.
                    at: Instant::ORIGIN,
                };
                let len = head.encode(&bytes[..heard.len], &mut words);
                packet_parts(to, &words[..len]).for_each(&mut each);
            }
        }
    }
}
