//! Topics: values of one type, from one publisher to several subscribers, over any transport.
//!
//! [`Publish`] and [`Subscribe`] are the one interface of three transports: the broadcast ring in
//! the LMU (here), the services of iceoryx2 between processes (`tandem_observers`), and
//! DDS between machines (`tandem_topics_host::typed`). `topics/host/tests/transports` checks all of
//! them by one suite. They all promise:
//!
//! - **Order**: a subscriber gets the values in the order in which they were published.
//! - **Depth**: a subscriber that does not take keeps at least the newest values, as many as the
//!   transport's depth. Newer values replace older ones, and never wait for a subscriber.
//! - **Loss**: [`Subscribe::lost`] counts each value that was replaced or did not arrive.
//! - **Nothing blocks**: no call waits, whatever the other ends do or fail to do.
//! - **Death**: a publisher that dies while it writes a value has not published it. What arrived
//!   before can still be taken. A successor may publish; its values follow.
//! - **No copy in shared memory**: [`Publish::publish_with`] writes a value where
//!   [`Subscribe::take_with`] reads it. DDS has no shared memory; there a value is encoded.
//!
//! | | in the LMU | iceoryx2 | DDS |
//! |---|---|---|---|
//! | depth | half of the slots | of the service | of the quality of service |
//! | who joins late gets | what follows, or the ring's values | what follows | by its durability |
//! | loss is counted from | joining | the first value taken | joining |
//! | subscribers | any number | 8 | 2 participants |

use core::convert::Infallible;

use crate::broadcast::{Lost, Receiver, Writer};
use crate::payload::{Payload, WordsMut, WordsRef};

/// How often [`Subscribe::take`] continues after a loss, if the writer overtakes it each time.
const ATTEMPTS: u32 = 4;

/// The end of a topic that publishes values of type `T`.
pub trait Publish<T> {
    /// The memory of a value that is being published; in shared memory that of the subscribers.
    type Place<'a>
    where
        Self: 'a;
    /// Why a value was not published.
    type Error: core::fmt::Debug;

    /// Publishes the value that `fill` writes in place. Before, the place holds any old or default
    /// value. Never blocks; a panic in `fill` publishes nothing. A topic that nothing subscribes to
    /// may do nothing.
    ///
    /// # Errors
    /// If the value was not published; the topic is unchanged.
    fn publish_with(&mut self, fill: impl FnOnce(&mut Self::Place<'_>)) -> Result<(), Self::Error>;

    /// Publishes a value that the caller has. Never blocks.
    ///
    /// # Errors
    /// As [`Publish::publish_with`].
    fn publish(&mut self, value: &T) -> Result<(), Self::Error>;
}

/// The end of a topic that takes values of type `T`, each once.
pub trait Subscribe<T> {
    /// A value where it arrived; in shared memory where its publisher has written it.
    type View<'a>
    where
        Self: 'a;

    /// Takes the next value: returns what `read` makes of it; `None` if there is none, or if values
    /// are replaced faster than they are read. Never blocks. A run of `read` on a value that was
    /// replaced during the run does not count; `read` then runs again for the next one.
    fn take_with<R>(&mut self, read: impl FnMut(&Self::View<'_>) -> R) -> Option<R>;

    /// Takes the next value; `None` if there is none. Never blocks. What is not a value of the type
    /// counts as lost.
    fn take(&mut self) -> Option<T>;

    /// Returns how many values this subscriber has lost. The count wraps around.
    fn lost(&self) -> u32;
}

impl<'w, T: Payload> Publish<T> for Writer<'w, T> {
    type Place<'a>
        = WordsMut<'w>
    where
        Self: 'a;
    type Error = Infallible;

    fn publish_with(&mut self, fill: impl FnOnce(&mut WordsMut<'w>)) -> Result<(), Infallible> {
        let mut loan = self.loan();
        fill(loan.words());
        loan.publish();
        Ok(())
    }

    fn publish(&mut self, value: &T) -> Result<(), Infallible> {
        Writer::publish(self, value);
        Ok(())
    }
}

/// A subscriber of a [`Broadcast`](crate::region::Broadcast) region.
#[derive(Debug)]
pub struct RingSubscriber<'w, T> {
    receiver: Receiver<'w, T>,
    lost: u32,
}

impl<'w, T> RingSubscriber<'w, T> {
    /// Subscribes with this receiver.
    #[must_use]
    pub const fn new(receiver: Receiver<'w, T>) -> Self {
        Self { receiver, lost: 0 }
    }

    /// Returns what `receive` receives, and counts the losses before it.
    fn next<R>(
        &mut self,
        mut receive: impl FnMut(&mut Receiver<'w, T>) -> Result<Option<R>, Lost>,
    ) -> Option<R> {
        for _ in 0..ATTEMPTS {
            match receive(&mut self.receiver) {
                Ok(received) => return received,
                Err(Lost { count }) => self.lost = self.lost.wrapping_add(count),
            }
        }
        None
    }
}

impl<'w, T: Payload> Subscribe<T> for RingSubscriber<'w, T> {
    type View<'a>
        = WordsRef<'w>
    where
        Self: 'a;

    fn take_with<R>(&mut self, mut read: impl FnMut(&WordsRef<'w>) -> R) -> Option<R> {
        self.next(|receiver| {
            let Some(item) = receiver.item()? else {
                return Ok(None);
            };
            let result = read(&item.words());
            item.finish()?;
            Ok(Some(result))
        })
    }

    fn take(&mut self) -> Option<T> {
        self.next(|receiver| Ok(receiver.receive()?.map(|(_, value)| value)))
    }

    fn lost(&self) -> u32 {
        self.lost
    }
}
