//! The Ethernet port of core 0: datagrams on static channels, each with its times.

use crate::Instant;

/// Where a station hears on a channel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NetworkAddress {
    /// IPv4 address.
    pub address: [u8; 4],
    /// UDP port.
    pub port: u16,
}

/// A channel. Its addresses are configured before the start and never change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Channel {
    /// Topics over DDS. D-1
    Topics,
    /// Time synchronisation. S-2
    Time,
}

impl Channel {
    /// All channels, in the order of [`Channel::index`].
    pub const ALL: [Self; 2] = [Self::Topics, Self::Time];

    /// Returns 0 or 1.
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// The inverse of [`Channel::index`].
    #[must_use]
    pub const fn from_index(index: usize) -> Option<Self> {
        match index {
            0 => Some(Self::Topics),
            1 => Some(Self::Time),
            _ => None,
        }
    }
}

/// Who gets a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recipient {
    /// Every other station that hears on the channel: the channel's group.
    Everyone,
    /// The station with this address.
    One(NetworkAddress),
}

/// A datagram that was received.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Datagram {
    /// How many bytes were copied into the buffer.
    pub len: usize,
    /// The sender's own address on the channel.
    pub from: NetworkAddress,
    /// When the port received it, on this system's clock.
    pub at: Instant,
}

/// The transmit buffer of the port is full; the datagram was not accepted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct NetworkFull;

impl core::fmt::Display for NetworkFull {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("the transmit buffer of the port is full")
    }
}

impl core::error::Error for NetworkFull {}

/// A system's Ethernet port, which belongs to core 0. D-1, S-2
///
/// The channels are independent: one call at a time on each, so a task may have a channel of its
/// own. Any datagram may be lost, and one to [`Recipient::Everyone`] may arrive more than once.
/// Those of a sender to the same recipient arrive in the order of sending. Strangers may send too:
/// the receiver must check the content. A datagram does not end a [`wait`](crate::Board::wait).
pub trait Network {
    /// The largest datagram in bytes: what an Ethernet frame carries over UDP.
    const MAX_BYTES: usize = 1_472;

    /// Returns where this system hears; `None` while the port is not connected: then nothing is
    /// sent or received. So it is in a drive without a network, on cores 1 and 2, and on a board
    /// without a port. A cable that is cut later does not show. Any context.
    fn address(&self, channel: Channel) -> Option<NetworkAddress>;

    /// Sends one datagram of up to [`Network::MAX_BYTES`] bytes. One at a time. It never reaches
    /// this system itself.
    ///
    /// # Errors
    /// [`NetworkFull`] if the transmit buffer is full.
    ///
    /// # Panics
    /// If the datagram is longer than [`Network::MAX_BYTES`].
    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull>;

    /// Returns when the newest accepted datagram of this channel left: not before its `try_send`,
    /// and not after any station received it. `None` while it waits in the transmit buffer, and if
    /// this incarnation of core 0 has sent none. One at a time.
    fn sent_at(&self, channel: Channel) -> Option<Instant>;

    /// Copies the next datagram into `bytes`; `None` if there is none. One at a time. A datagram
    /// longer than `bytes` is cut off. [`Datagram::at`] never goes back on a channel, and is not
    /// after the call.
    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram>;
}

/// The port of a board that has none.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoNetwork;

impl Network for NoNetwork {
    fn address(&self, _: Channel) -> Option<NetworkAddress> {
        None
    }

    fn try_send(&self, _: Channel, _: Recipient, _: &[u8]) -> Result<(), NetworkFull> {
        Ok(())
    }

    fn sent_at(&self, _: Channel) -> Option<Instant> {
        None
    }

    fn try_receive(&self, _: Channel, _: &mut [u8]) -> Option<Datagram> {
        None
    }
}
