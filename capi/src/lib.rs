//! `shm` and `redundancy` for firmware in C: a static library and `include/tandem.h` (no_std).
//!
//! cbindgen generates the header from this crate, with the doc comments of this crate. `cargo xtask
//! c-header` writes it, and a test fails if it is out of date.
//!
//! # Rules for every function
//!
//! - **C provides the memory of objects**: their types are opaque, with known size and alignment;
//!   objects are static and zero at first. Nothing is allocated. A function returns
//!   `TANDEM_STATUS_NOT_ATTACHED` for an object without the mark of an attached one.
//! - **No panic crosses the boundary**: functions check their arguments and return errors as
//!   [`TandemStatus`]. If the library panics nevertheless, it calls `tandem_on_panic`, which the
//!   firmware defines.
//! - **Handlers that C registers run inside a call**, and may not use the object that called them:
//!   they get `TANDEM_STATUS_BUSY`.
//!
//! # The caller's contract
//!
//! These rules are the safety section of every function, and of the functions that it calls inside
//! this crate. `SAFETY` comments refer to their numbers.
//!
//! 1. A pointer is null or points to memory of its type that does not move.
//! 2. The LMU that a map was attached to stays mapped as long as any object attached through that
//!    map is used.
//! 3. One object is used by one context of one core at a time.
//!
//! # Example
//!
//! ```c
#![doc = include_str!("../examples/two_cores.c")]
//! ```
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

/// The panic handler on bare metal: calls a function that the firmware defines.
#[cfg(target_os = "none")]
mod on_panic {
    unsafe extern "C" {
        /// The firmware defines it. It should record the panic and reset the core, and not return.
        fn tandem_on_panic() -> !;
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        // SAFETY: takes no argument and shares no data. If it is not defined, the link fails.
        unsafe { tandem_on_panic() }
    }
}
