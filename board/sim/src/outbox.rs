//! What a core sends while a job of it still takes time: it leaves when the job ends.

use tandem_board::{CanFrame, Edge, Line};

/// What a core does to the outside.
#[derive(Clone, Debug)]
pub(crate) enum Output {
    Edge(Line, Edge),
    Datagram(Vec<u32>),
    Frame(CanFrame),
    /// The answer to the watchdog's question.
    Service(u8),
}
