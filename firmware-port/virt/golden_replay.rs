//! Runs the driving functions over recorded frames in the emulator's memory, and prints the digest
//! of their outputs. A host prints the same digest. Strap `First`: duration in milliseconds.

use crate::memory::{Strap, strap};
use crate::{exit, hart, log, memory};

/// Plays the recording on hart 0: the main of every hart.
pub fn main(hart: usize) -> ! {
    if hart != 0 {
        hart::park()
    }
    let recording = memory::recording();
    let begin = hart::cycles();
    let digest = tandem_golden::play(recording, strap(Strap::First).into());
    log!("{digest:?}");
    log!("{} kilocycles", hart::cycles().wrapping_sub(begin) / 1_000);
    exit::exit(0)
}
