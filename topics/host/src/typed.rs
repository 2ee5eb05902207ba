//! Typed ends of a node's writers and readers, with the interface of `tandem_shm::topic`.
//!
//! DDS has no shared memory: a value is encoded when it is published, and decoded when it is taken.
//! Nothing here waits or hears: [`Node::turn`] does, in the loop of the node's owner.

use crate::node::{BYTES, Node};
use std::borrow::BorrowMut;
use std::marker::PhantomData;
use tandem_shm::topic::{Publish, Subscribe};
use tandem_topics::{CdrError, TopicType, WriteError};

/// Why a value was not published.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TypedError {
    /// A member is out of its range.
    #[error(transparent)]
    Value(#[from] CdrError),
    /// The writer refused the sample.
    #[error("the sample was not written: {0:?}")]
    Write(WriteError),
}

/// Writer number `writer` of a node, as the publisher of values of type `T`.
#[derive(Debug)]
pub struct TypedWriter<N, T, const W: usize, const R: usize> {
    /// The node, or a reference to it.
    pub node: N,
    writer: usize,
    of: PhantomData<fn(&T)>,
}

/// Reader number `reader` of a node, as a subscriber of values of type `T`.
#[derive(Debug)]
pub struct TypedReader<N, T, const W: usize, const R: usize> {
    /// The node, or a reference to it.
    pub node: N,
    reader: usize,
    /// Samples that were no value of the type.
    invalid: u32,
    of: PhantomData<fn() -> T>,
}

impl<N: BorrowMut<Node<W, R>>, T, const W: usize, const R: usize> TypedWriter<N, T, W, R> {
    /// Makes the end of this writer.
    ///
    /// # Panics
    /// If the node has no such writer.
    pub const fn new(node: N, writer: usize) -> Self {
        assert!(writer < W);
        Self {
            node,
            writer,
            of: PhantomData,
        }
    }
}

impl<N: BorrowMut<Node<W, R>>, T, const W: usize, const R: usize> TypedReader<N, T, W, R> {
    /// Makes the end of this reader.
    ///
    /// # Panics
    /// If the node has no such reader.
    pub const fn new(node: N, reader: usize) -> Self {
        assert!(reader < R);
        Self {
            node,
            reader,
            invalid: 0,
            of: PhantomData,
        }
    }
}

impl<N, T, const W: usize, const R: usize> Publish<T> for TypedWriter<N, T, W, R>
where
    N: BorrowMut<Node<W, R>>,
    T: TopicType,
{
    type Place<'a>
        = T
    where
        Self: 'a;
    type Error = TypedError;

    fn publish_with(&mut self, fill: impl FnOnce(&mut T)) -> Result<(), TypedError> {
        let mut value = T::default();
        fill(&mut value);
        self.publish(&value)
    }

    fn publish(&mut self, value: &T) -> Result<(), TypedError> {
        let sample = value.encode()?;
        let written = self.node.borrow_mut().write(self.writer, sample.as_ref());
        written.map_err(TypedError::Write)
    }
}

impl<N, T, const W: usize, const R: usize> Subscribe<T> for TypedReader<N, T, W, R>
where
    N: BorrowMut<Node<W, R>>,
    T: TopicType,
{
    type View<'a>
        = T
    where
        Self: 'a;

    fn take_with<R2>(&mut self, mut read: impl FnMut(&T) -> R2) -> Option<R2> {
        self.take().map(|value| read(&value))
    }

    fn take(&mut self) -> Option<T> {
        loop {
            let sample: tandem_topics::Sample<BYTES> = self.node.borrow_mut().take(self.reader)?;
            match T::decode(sample.payload()) {
                Ok(value) => return Some(value),
                Err(_) => self.invalid = self.invalid.wrapping_add(1),
            }
        }
    }

    fn lost(&self) -> u32 {
        let counts = self.node.borrow().participant.reader_counts(self.reader);
        let sums = [counts.lost, counts.replaced, counts.too_long, self.invalid];
        sums.into_iter().fold(0, u32::wrapping_add)
    }
}
