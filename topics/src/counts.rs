//! What the endpoints of a participant count.

/// What a writer or a reader has counted; each wraps around.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples that a reader lacked after the writer had dropped them.
    pub lost: u32,
    /// Samples that the writer sent once more.
    pub repaired: u32,
    /// Samples that newer ones replaced before they were taken.
    pub replaced: u32,
    /// Samples that are longer than the reader's room.
    pub too_long: u32,
    /// Endpoints of others for which there was no place: `READERS`, `WRITERS`. They are asked again
    /// each 8 s, and counted again.
    pub refused: u32,
    /// Endpoints of others whose quality of service does not fit, each 8 s.
    pub incompatible: u32,
}
