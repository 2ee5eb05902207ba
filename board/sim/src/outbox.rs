//! The outputs of a core's job, which are sent when the job ends.

use tandem_board::{CanFrame, Channel, Edge, Line, Recipient};

/// An output of a core.
#[derive(Clone, Debug)]
pub(crate) enum Output {
    Edge(Line, Edge),
    Datagram(Vec<u32>),
    Frame(CanFrame),
    /// A datagram to the network.
    Packet(Channel, Recipient, Vec<u8>),
    /// The answer to the watchdog's question.
    Service(u8),
}
