//! The LMU: map, lock, sync mailbox, pool, channels (no_std).
//!
//! The LMU is a slice of 32-bit atomic words that every core maps, each at its own address. All
//! primitives use sub-slices of it and access single words. So this crate needs no atomic wider
//! than 32 bits, and Miri and loom can check it. Only [`plain`] has `unsafe` code. Cores exchange
//! only indices with stamps, never addresses.
//!
//! | module | what it is | who writes |
//! |---|---|---|
//! | [`map`] | header, regions | boot core |
//! | [`region`] | the content of each region, as a type | at attachment |
//! | [`incarnation`] | which incarnation of each core is the current one | each core, supervisor |
//! | [`lock`] | mutual exclusion, recovered from a dead owner | any core |
//! | [`mailbox`] | signals to tasks of another core, none lost | one sender, one receiver |
//! | [`pool`] | words that cores borrow and give back | any core |
//! | [`newest`] | the newest value, never torn | one writer, any number of readers |
//! | [`fifo`] | every value, in order, or full | one producer, one consumer |
//! | [`plain`] | blocks of bytes that change hands, as plain slices | one producer, one consumer |
//! | [`broadcast`] | every value, in order, or how many were lost | one writer, many receivers |
//! | [`topic`] | one interface for topics over any transport | one publisher, many subscribers |
//! | [`wait`] | spin, spin then sleep, sleep | no core |
//!
//! # Rules for every module
//!
//! - **All zero is a valid initial state**: the LMU is zero at power-on, and [`map::Map::format`]
//!   zeroes it.
//! - **Another core may die, freeze or write garbage between any two instructions.** Whatever the
//!   words hold, nothing here panics, indexes out of bounds or loops without bound.
//! - **A successor continues where its predecessor stopped**: the private memory of an end is only
//!   a copy of words that this end alone writes.
//! - **Two incarnations of one core do not run at once**: a reset ends an incarnation before the
//!   next one starts, and everything that the old incarnation wrote is visible to the new one (a
//!   reset drains store buffers and, where they are not coherent, caches). [`lock`] and [`pool`]
//!   also tolerate a *straggler*: an old incarnation that was declared dead and still runs.
//! - **Cache lines**: a region starts on a line of 64 bytes; words of different writers are on
//!   different lines.
//!
//! A core attaches to a [`region`], a constant that defines kind, shape and payload. The region
//! records who claimed a unique end, and refuses a second claim. [`bare`] is for C and for words
//! outside an LMU. Its ends are the same, so a core in Rust and one in C can share a region, but it
//! neither makes nor checks claims.
//!
//! # Example
//!
//! Core 0 passes a value to core 1: core 0 publishes and signals, core 1 reads when it is
//! signalled. The map is a chain of constants. A region defines its shape and its payload, and
//! refuses a second claim of a unique end, for example of a writer. See also [`region`].
//!
//! ```
//! use tandem_shm::incarnation::Incarnation;
//! use tandem_shm::mailbox::{Ring, TaskId};
//! use tandem_shm::map::Map;
//! use tandem_shm::region::{EndError, Mailbox, Newest, Region};
//!
//! const NEWS: Region<Mailbox> = Region::first("news");
//! const SPEED: Region<Newest<u32>> = NEWS.then("speed");
//!
//! fn hand_over(
//!     map: &Map<'_>,
//!     here: Incarnation,
//!     there: Incarnation,
//! ) -> Result<Option<u32>, EndError> {
//!     let (mut writer, mut to) = (SPEED.writer(map, here)?, NEWS.sender(map, here)?);
//!     let (mut reader, mut from) = (SPEED.reader(map)?, NEWS.receiver(map, there)?);
//!
//!     writer.publish(&42);
//!     if to.signal(TaskId::FIRST) == Ring::Needed {
//!         // The receiver sleeps: ring its doorbell, board.ring(core).
//!     }
//!
//!     let mut speed = None;
//!     from.poll(|_signals| speed = reader.fetch().ok().flatten());
//!     Ok(speed)
//! }
//!
//! // The LMU begins on a cache line; on a chip the linker or the board ensures that.
//! use core::sync::atomic::AtomicU32;
//! #[repr(align(64))]
//! struct Lmu([AtomicU32; SPEED.end().total_words()]);
//! static LMU: Lmu = Lmu([const { AtomicU32::new(0) }; SPEED.end().total_words()]);
//!
//! let map = Map::format(&LMU.0, SPEED.end()).unwrap();
//! let [here, there] = [0, 1].map(|core| Incarnation::new(core, 1).unwrap());
//! for incarnation in [here, there] {
//!     map.incarnations().announce(incarnation).unwrap();
//! }
//! assert_eq!(hand_over(&map, here, there), Ok(Some(42)));
//! ```
#![cfg_attr(not(test), no_std)]
#![deny(unsafe_code)]

#[cfg(any(loom, stepped))]
extern crate std;

pub mod bare;
pub mod broadcast;
#[cfg(all(test, not(any(loom, stepped))))]
mod fault;
#[cfg(any(loom, stepped))]
pub mod fault;
pub mod fifo;
pub mod incarnation;
pub mod lock;
pub mod mailbox;
pub mod map;
pub mod newest;
mod payload;
pub mod plain;
pub mod pool;
pub mod region;
mod ring;
#[cfg(all(test, not(loom), not(miri)))]
#[path = "tests/schedules.rs"]
mod schedules;
mod shape;
pub mod sync;
pub mod topic;
pub mod wait;

pub use payload::{Corrupt, Payload, WordsMut, WordsRef};
pub use shape::{FitError, LINE_WORDS, Shape};
