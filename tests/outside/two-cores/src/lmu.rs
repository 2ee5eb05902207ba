//! The memory that both cores share: who writes what to whom.

use core::sync::atomic::AtomicU32;

use tandem_bus::Encoded;
use tandem_redundancy::LinkReport;
use tandem_shm::map::Layout;
use tandem_shm::region::{Broadcast, Newest, Region, SharedLock};
use tandem_shm::{Corrupt, Payload};

/// The frames of one node: a bus of three nodes is three rings that everyone reads.
pub type Ring = Region<Broadcast<Frame, 16>>;
/// Counts of the edges that a system has sent, by line and edge.
pub type Wires = Region<Newest<[u32; 8]>>;
/// The last report of a system over the link.
pub type Link = Region<Newest<[u32; LinkReport::WORDS]>>;

const FRAMES_A: Ring = Region::first("frames of A");
const FRAMES_B: Ring = FRAMES_A.then("frames of B");
/// What the vehicle sends.
pub const FRAMES_VEHICLE: Ring = FRAMES_B.then("frames of the vehicle");
const WIRES_A: Wires = FRAMES_VEHICLE.then("wires of A");
const WIRES_B: Wires = WIRES_A.then("wires of B");
const LINK_A: Link = WIRES_B.then("link of A");
const LINK_B: Link = LINK_A.then("link of B");
/// Taken while a line is written to the console.
pub const CONSOLE: Region<SharedLock> = LINK_B.then("console");
/// All of it.
pub const LAYOUT: Layout = CONSOLE.end();

/// What each system sends: A, B.
pub const FRAMES: [Ring; 2] = [FRAMES_A, FRAMES_B];
/// The lines of each system.
pub const WIRES: [Wires; 2] = [WIRES_A, WIRES_B];
/// The link of each system.
pub const LINKS: [Link; 2] = [LINK_A, LINK_B];

/// The shared words begin on a cache line.
#[repr(align(64))]
pub struct Lmu(pub [AtomicU32; LAYOUT.total_words()]);

/// The memory itself.
pub static LMU: Lmu = Lmu([const { AtomicU32::new(0) }; LAYOUT.total_words()]);

/// A frame as it crosses the shared memory: id and length, then the data.
#[derive(Clone, Copy)]
pub struct Frame(pub Encoded);

const DATA_WORDS: usize = 16;

impl Payload for Frame {
    const WORDS: usize = 1 + DATA_WORDS;

    fn store(&self, put: &mut impl FnMut(u32)) {
        let Encoded { id, len, bytes } = self.0;
        put(u32::from(id) << 8 | len as u32);
        let (words, _) = bytes.as_chunks::<4>();
        words.iter().for_each(|word| put(u32::from_le_bytes(*word)));
    }

    fn load(take: &mut impl FnMut() -> u32) -> Result<Self, Corrupt> {
        let head = take();
        let (id, len) = ((head >> 8) as u16, (head & 0xFF) as usize);
        let mut bytes = [0; 4 * DATA_WORDS];
        let (words, _) = bytes.as_chunks_mut::<4>();
        words
            .iter_mut()
            .for_each(|word| *word = take().to_le_bytes());
        if len > bytes.len() {
            return Err(Corrupt);
        }
        Ok(Self(Encoded { id, len, bytes }))
    }
}
