//! The LMU of a case, in the memory that the processes of a batch share.

use crate::shared::Shared;
use std::io;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::{Layout, Map};

/// Memory for a batch, with a formatted LMU in the words of the case.
pub(super) fn shared(layout: Layout) -> io::Result<(Shared, Map<'static>)> {
    let shared = Shared::with_case_words(layout.total_words())?;
    let map = Map::format(shared.case(), layout).map_err(|_| io::Error::other("no room"))?;
    Ok((shared, map))
}

/// Bytes that the LMU takes.
pub(super) const fn bytes(layout: Layout) -> u64 {
    4 * layout.total_words() as u64
}

/// Announces an incarnation of a core.
pub(super) fn announce(map: &Map<'_>, core: usize, generation: u32) -> Incarnation {
    let incarnation = Incarnation::new(core, generation).expect("an incarnation");
    let announced = map.incarnations().announce(incarnation);
    announced.expect("the latest incarnation");
    incarnation
}
