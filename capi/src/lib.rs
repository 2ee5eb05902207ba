//! `shm` and `redundancy` for firmware in C: a static library and `include/tandem.h` (no_std).
//!
//! The header is generated from this crate by cbindgen, with the doc comments of this crate. `cargo
//! xtask c-header` writes it, and a test refuses a stale one.
//!
//! # What every function holds to
//!
//! - **Objects live in memory that C gives**: opaque types of known size and alignment, statically
//!   placed and zero at first. Nothing is allocated. An object that was not attached is refused
//!   with `TANDEM_STATUS_NOT_ATTACHED`, because it lacks a mark.
//! - **No panic crosses the boundary**: arguments are checked, and an error is a
//!   [`TandemStatus`]. Where Rust would panic nevertheless, `tandem_on_panic` is
//!   called, which the firmware defines.
//! - **Handlers that C registers run inside a call**, and may not use the object that called them:
//!   they get `TANDEM_STATUS_BUSY`.
//!
//! # The caller's contract
//!
//! It is the safety section of every function, which passes it on to what it calls; `SAFETY`
//! comments name its numbers.
//!
//! 1. A pointer is null or points to memory of its type that stays where it is.
//! 2. The LMU that a map was attached to stays mapped as long as any object attached through it is
//!    used.
//! 3. One object is used by one context of one core at a time.
#![no_std]
#![allow(
    unsafe_op_in_unsafe_fn,
    reason = "each function passes its caller's contract on; in `cell`, which follows the pointers, \
              each unsafe step has a block"
)]
#![allow(
    clippy::missing_safety_doc,
    reason = "the contract is the same for all functions, and stands above and in the header once"
)]

#[cfg(not(target_os = "none"))]
extern crate std;

mod cell;
mod channel;
mod config;
mod lock;
mod mailbox;
mod map;
mod pool;
mod redundancy;
mod status;
mod store;

pub use cell::{TandemWord, TandemWords};
pub use channel::*;
pub use config::*;
pub use lock::*;
pub use mailbox::*;
pub use map::*;
pub use pool::*;
pub use redundancy::*;
pub use status::*;
pub use store::*;

/// On bare metal the firmware defines the reaction to a panic.
#[cfg(target_os = "none")]
mod on_panic {
    unsafe extern "C" {
        /// Defined by the firmware: records what it can and resets the core. Must not return.
        fn tandem_on_panic() -> !;
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        // SAFETY: no argument, nothing shared; the firmware defines it, or the link fails.
        unsafe { tandem_on_panic() }
    }
}
