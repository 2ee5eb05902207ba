//! The memory that the linker script lays out: the two LMUs, and the straps.

#[path = "../lmu.rs"]
mod lmu;

use core::ptr::addr_of;

use tandem_board::SystemId;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::{Layout, Map};

use crate::{hart, must};

pub use lmu::{LMU_WORDS, lmu};

unsafe extern "C" {
    static __straps: u32;
    static __recording: u32;
    static __stacks: u32;
}

/// Waits until another core has formatted system A's LMU, attaches to it, and announces the first
/// incarnation of `core`.
///
/// # Panics
/// If there is no such core.
#[must_use]
pub fn attach(core: usize, layout: Layout) -> (Map<'static>, Incarnation) {
    let Some(own) = Incarnation::new(core, 1) else {
        panic!("a first incarnation")
    };
    loop {
        if let Ok(map) = Map::attach(lmu(SystemId::A), layout) {
            must(map.incarnations().announce(own));
            return (map, own);
        }
        hart::yield_turn();
    }
}

/// Bytes of the stack of one hart; must be the same as in link.x and start.S.
const STACK_BYTES: usize = 256 << 10;

/// Returns the largest number of bytes of its stack that a hart has used so far. The memory of a
/// machine is zero at its start, so the unused part is still zero.
#[must_use]
pub fn stack_used(hart: usize) -> usize {
    let words = STACK_BYTES / 4;
    let hart = hart % crate::hart::HARTS;
    // SAFETY: link.x reserves these bytes for each hart; any value of a word is valid, even if its
    // hart writes to it at this time.
    let is_zero = |index: &usize| unsafe {
        let stack = addr_of!(__stacks).add(hart * words);
        stack.add(*index).read_volatile() == 0
    };
    STACK_BYTES - 4 * (0..words).take_while(is_zero).count()
}

/// Bytes that link.x gives to the recording.
const RECORDING_BYTES: usize = 64 << 20;

/// Returns the recorded frames that the emulator has loaded.
#[must_use]
pub fn recording() -> &'static [u32] {
    let begin = addr_of!(__recording);
    // SAFETY: link.x reserves the memory, which only the emulator writes, before the start; the
    // length is limited to its size.
    unsafe {
        let len = begin.read_volatile() as usize;
        core::slice::from_raw_parts(begin.add(1), len.min(RECORDING_BYTES / 4 - 1))
    }
}

/// Returns a word that the emulator writes before the start, like pins that are tied high or low on
/// a carrier board. Returns 0 if the word was not set.
#[must_use]
pub fn strap(strap: Strap) -> u32 {
    // SAFETY: link.x reserves 4 KiB there, which no code writes after the start.
    unsafe { addr_of!(__straps).add(strap as usize).read_volatile() }
}

/// The straps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strap {
    /// Mode of the program; each program documents its modes.
    Mode = 0,
    /// First parameter of the program.
    First = 1,
    /// Second parameter of the program.
    Second = 2,
    /// Third parameter of the program.
    Third = 3,
}
