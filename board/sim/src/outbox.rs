//! The outputs of a core's job, which are sent when the job ends.

use tandem_board::{CanFrame, Channel, Edge, Line, Recipient};

/// An output of a core.
#[derive(Clone, Debug)]
pub(crate) enum Output {
    Edge(Line, Edge),
    Datagram(Vec<u32>),
    /// A frame, and its mark: 0 if it is not stamped.
    Frame(CanFrame, u32),
    /// A datagram to the network.
    Packet(Channel, Recipient, Vec<u8>),
    /// The answer to the watchdog's question.
    Service(u8),
}
