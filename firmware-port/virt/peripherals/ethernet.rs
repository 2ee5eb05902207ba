//! The Ethernet: a port for each system, between them a cable or the vehicle process.

use super::ring::Ring;
use super::{now, system};
use crate::hart;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::Relaxed;
use tandem_board::{Channel, HardwareFault, Instant, NetworkAddress, Recipient, SystemId};
use tandem_peripherals::codec::{PACKET_MAX_BYTES, PACKET_WORDS, PacketHead};

const CHANNELS: usize = Channel::ALL.len();

/// The carrier's registers for a system's port.
#[repr(C)]
pub(crate) struct Registers {
    /// Where the system hears on each channel: address and port; 0 while it is not connected.
    addresses: [[AtomicU32; 2]; CHANNELS],
    /// When the newest datagram of each channel was sent, in words; 0 for none.
    sent: [[AtomicU32; 2]; CHANNELS],
    /// Datagrams that have not left the system.
    pub(crate) transmit: Ring<32, PACKET_WORDS>,
    /// Datagrams that were received on each channel.
    pub(crate) receive: [Ring<32, PACKET_WORDS>; CHANNELS],
}

fn read(words: &[AtomicU32; 2]) -> [u32; 2] {
    [words[0].load(Relaxed), words[1].load(Relaxed)]
}

fn write(words: &[AtomicU32; 2], values: [u32; 2]) {
    words[0].store(values[0], Relaxed);
    words[1].store(values[1], Relaxed);
}

impl Registers {
    pub(crate) fn connect(&self, channel: Channel, at: NetworkAddress) {
        let address = u32::from_le_bytes(at.address);
        write(&self.addresses[channel.index()], [address, at.port.into()]);
    }

    pub(crate) fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        let [address, port] = read(&self.addresses[channel.index()]);
        (port != 0).then(|| NetworkAddress {
            address: address.to_le_bytes(),
            port: port as u16,
        })
    }

    /// Puts a datagram into the transmit buffer; returns whether there was room. Any context.
    pub(crate) fn send(&self, channel: Channel, peer: Recipient, bytes: &[u8]) -> bool {
        let at = now();
        let mut words = [0; PACKET_WORDS];
        let len = PacketHead { channel, peer, at }.encode(bytes, &mut words);
        // Two tasks may send, but the ring may have only one writer at a time.
        hart::without_interrupts(|| {
            let has_room = self.transmit.put(&words[..len]);
            if has_room {
                write(&self.sent[channel.index()], at.to_words());
            }
            has_room
        })
    }

    pub(crate) fn sent_at(&self, channel: Channel) -> Option<Instant> {
        let at = Instant::from_words(read(&self.sent[channel.index()]));
        (at != Instant::ORIGIN).then_some(at)
    }

    /// Restarts the port. Core 0 must be stopped.
    pub(crate) fn restart(&self) {
        self.transmit.clear();
        for channel in Channel::ALL {
            self.receive[channel.index()].clear();
            write(&self.sent[channel.index()], [0; 2]);
        }
    }
}

/// Returns the next datagram that leaves a system.
pub(super) fn leaving(from: SystemId) -> Option<[u32; PACKET_WORDS]> {
    loop {
        let words = system(from).network.transmit.take()?;
        if !is_cut(from) {
            return Some(words);
        }
    }
}

fn is_cut(of: SystemId) -> bool {
    system(of).has_faults().has(HardwareFault::Network)
}

/// Gives a datagram from outside to a system. One that does not fit is lost.
pub(super) fn receive(to: SystemId, words: &[u32]) {
    let mut content = [0; PACKET_MAX_BYTES];
    if let Some((head, len)) = PacketHead::decode(words, &mut content) {
        put(to, head, &content[..len]);
    }
}

fn put(to: SystemId, head: PacketHead, content: &[u8]) {
    if is_cut(to) || !system(to).powered.load(Relaxed) {
        return;
    }
    let mut words = [0; PACKET_WORDS];
    let len = PacketHead { at: now(), ..head }.encode(content, &mut words);
    // If the buffer is full, the datagram is lost: the core did not receive in time.
    let _ = system(to).network.receive[head.channel.index()].put(&words[..len]);
}

/// Passes on what a system has sent, over a cable to the other system in this machine.
pub(super) fn pass_on(from: SystemId) {
    let mut content = [0; PACKET_MAX_BYTES];
    while let Some(words) = leaving(from) {
        let Some((head, len)) = PacketHead::decode(&words, &mut content) else {
            continue;
        };
        let to = from.peer();
        let address = |of: SystemId| system(of).network.address(head.channel);
        let hears = match head.peer {
            Recipient::Everyone => true,
            Recipient::One(at) => address(to) == Some(at),
        };
        if let Some(sender) = address(from).filter(|_| hears) {
            let peer = Recipient::One(sender);
            put(to, PacketHead { peer, ..head }, &content[..len]);
        }
    }
}
