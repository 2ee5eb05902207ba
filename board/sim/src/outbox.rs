//! The outputs of a core's job, which are sent when the job ends.

use tandem_board::{CanFrame, Edge, Line};

/// An output of a core.
#[derive(Clone, Debug)]
pub(crate) enum Output {
    Edge(Line, Edge),
    Datagram(Vec<u32>),
    Frame(CanFrame),
    /// The answer to the watchdog's question.
    Service(u8),
}
