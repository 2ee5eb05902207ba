//! Attaches ends to plain words whose place and shape are known only at run time: for C, for words
//! outside an LMU (a board's own rings), and for models.
//!
//! Only size and alignment are checked. The caller must pass the same words, shape and payload to
//! each end of an object, and attach a unique end only once. Rust code with a map uses
//! [`Region`](crate::region::Region), which checks all of this.
//!
//! # Errors
//! Each function returns [`FitError`] if the words are too few or do not start at a cache line.

#![allow(clippy::missing_errors_doc, reason = "stands once above")]

use crate::fifo::{Consumer, Producer};
use crate::incarnation::{Incarnation, Incarnations};
use crate::lock::Lock;
use crate::mailbox::{Receiver, Sender};
use crate::newest::{Reader, Writer};
use crate::pool::Pool;
use crate::shape::{FitError, Shape};
use crate::sync::AtomicU32;
use crate::{broadcast, newest};

/// Attaches an end of the lock in these words. `incarnation` must be announced in `incarnations`.
pub fn lock<'a>(
    words: &'a [AtomicU32],
    incarnation: Incarnation,
    incarnations: Incarnations<'a>,
) -> Result<Lock<'a>, FitError> {
    Lock::attach(words, incarnation, incarnations)
}

/// Attaches to the pool of `blocks` blocks in these words. `incarnation` must be announced in
/// `incarnations`.
///
/// # Panics
/// If `blocks` is not 1 ..= [`MAX_BLOCKS`](crate::pool::MAX_BLOCKS).
pub fn pool<'a>(
    words: &'a [AtomicU32],
    blocks: usize,
    incarnation: Incarnation,
    incarnations: Incarnations<'a>,
) -> Result<Pool<'a>, FitError> {
    Pool::attach(words, blocks, incarnation, incarnations)
}

/// Attaches the sending end of a mailbox. Ring the receiver's doorbell once afterwards.
pub fn mailbox_sender(words: &[AtomicU32]) -> Result<Sender<'_>, FitError> {
    Sender::attach(words)
}

/// Attaches the receiving end of a mailbox.
pub fn mailbox_receiver(words: &[AtomicU32]) -> Result<Receiver<'_>, FitError> {
    Receiver::attach(words)
}

/// Attaches the writing end of a newest-value channel.
pub fn newest_writer<T>(words: &[AtomicU32], shape: Shape) -> Result<Writer<'_, T>, FitError> {
    Ok(Writer::attach(newest::ring(words, shape)?))
}

/// Attaches a reading end of a newest-value channel.
pub fn newest_reader<T>(words: &[AtomicU32], shape: Shape) -> Result<Reader<'_, T, 0>, FitError> {
    Ok(Reader::attach(newest::ring(words, shape)?))
}

/// Attaches the writing end of a broadcast ring.
pub fn broadcast_writer<T>(words: &[AtomicU32], shape: Shape) -> Result<Writer<'_, T>, FitError> {
    Ok(Writer::attach(broadcast::ring(words, shape)?))
}

/// Attaches a receiving end of a broadcast ring, for values published from now on.
pub fn broadcast_receiver<T>(
    words: &[AtomicU32],
    shape: Shape,
) -> Result<broadcast::Receiver<'_, T>, FitError> {
    Ok(broadcast::Receiver::attach(broadcast::ring(words, shape)?))
}

/// Attaches the sending end of a queue.
pub fn fifo_producer<T>(words: &[AtomicU32], shape: Shape) -> Result<Producer<'_, T>, FitError> {
    Producer::attach(words, shape)
}

/// Attaches the receiving end of a queue.
pub fn fifo_consumer<T>(words: &[AtomicU32], shape: Shape) -> Result<Consumer<'_, T>, FitError> {
    Consumer::attach(words, shape)
}
