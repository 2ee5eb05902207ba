//! What the suite needs of a transport, and a topic with its ends in this process.

use std::fmt::Debug;
use std::ops::Range;
use tandem_shm::topic::{Publish, Subscribe};

/// Turns of a transport after which nothing more is expected.
const QUIET: usize = 20;

/// The place of a value in a transport, and the view of one.
pub(crate) type PlaceOf<'a, R> =
    <<R as Transport>::Publisher as Publish<<R as Transport>::Value>>::Place<'a>;
pub(crate) type ViewOf<'a, R> =
    <<R as Transport>::Subscriber as Subscribe<<R as Transport>::Value>>::View<'a>;

/// A transport of topics; each value of this type is a topic of its own.
pub(crate) trait Transport: Sized + 'static {
    type Value: Copy + Debug + PartialEq;
    type Publisher: Publish<Self::Value>;
    type Subscriber: Subscribe<Self::Value>;
    /// How many values a subscriber that does not take keeps at least.
    const DEPTH: u32;
    /// How many of the last values of before a late subscriber gets.
    const LATE: u32;
    /// How many subscribers the suite may make.
    const SUBSCRIBERS: usize;

    fn start() -> Self;
    /// Returns the value of a number; each is another one.
    fn value(number: u32) -> Self::Value;
    /// Makes the publisher; `life` counts them from 1.
    fn publisher(&self, life: u32) -> Self::Publisher;
    /// Makes a subscriber, which may need a publisher.
    fn subscriber(&self) -> Self::Subscriber;
    /// Writes a value in place; returns where.
    fn fill(place: &mut PlaceOf<'_, Self>, value: Self::Value) -> *const u8;
    /// Reads a value in place; returns where.
    fn read(view: &ViewOf<'_, Self>) -> (Self::Value, *const u8);

    /// Lets a publisher do what is due. Returns whether it knows this many subscribers.
    fn turn_publisher(_: &mut Self::Publisher, _subscribers: usize) -> bool {
        true
    }
    /// Lets a subscriber hear what has arrived. Returns whether it knows this many publishers.
    fn turn_subscriber(_: &mut Self::Subscriber, _publishers: usize) -> bool {
        true
    }
    /// What is published is there at once.
    const IS_INSTANT: bool = true;
}

/// A transport that recognises what is no value.
pub(crate) trait Checked: Transport {
    /// Publishes bytes that are no value.
    fn publish_garbage(publisher: &mut Self::Publisher);
}

/// A topic, its publisher if it lives, and its subscribers.
pub(crate) struct Topic<'r, R: Transport> {
    pub(crate) rig: &'r R,
    pub(crate) publisher: Option<R::Publisher>,
    pub(crate) subscribers: Vec<R::Subscriber>,
}

impl<'r, R: Transport> Topic<'r, R> {
    pub(crate) fn with_subscribers(rig: &'r R, count: usize) -> Self {
        let mut topic = Self {
            rig,
            publisher: Some(rig.publisher(1)),
            subscribers: Vec::new(),
        };
        for _ in 0..count {
            topic.join();
        }
        topic
    }

    /// Adds a subscriber.
    pub(crate) fn join(&mut self) {
        self.subscribers.push(self.rig.subscriber());
        self.meet(1);
    }

    /// Waits until all ends know each other; subscribers know this many publishers.
    pub(crate) fn meet(&mut self, publishers: usize) {
        while !self.turn(publishers) {}
    }

    fn turn(&mut self, publishers: usize) -> bool {
        let count = self.subscribers.len();
        let mut all = self
            .publisher
            .as_mut()
            .is_none_or(|publisher| R::turn_publisher(publisher, count));
        for subscriber in &mut self.subscribers {
            all &= R::turn_subscriber(subscriber, publishers);
        }
        all
    }

    pub(crate) fn publish(&mut self, numbers: Range<u32>) {
        let publisher = self.publisher.as_mut().unwrap();
        numbers.for_each(|number| publisher.publish(&R::value(number)).unwrap());
    }

    /// Lets this many values arrive, and takes none.
    pub(crate) fn ignore(&mut self, count: u32) {
        if !R::IS_INSTANT {
            // A turn hears one at least.
            for _ in 0..count {
                self.turn(1);
            }
        }
    }

    /// Takes what arrives, until at least `count` values are there and nothing is under way.
    pub(crate) fn taken(&mut self, subscriber: usize, count: u32) -> Vec<R::Value> {
        let (mut all, mut quiet) = (Vec::new(), 0);
        while quiet < QUIET {
            self.turn(1);
            let subscriber = &mut self.subscribers[subscriber];
            let before = all.len();
            all.extend(std::iter::from_fn(|| subscriber.take()));
            if R::IS_INSTANT {
                break;
            }
            let is_quiet = all.len() == before && before >= count as usize;
            quiet = if is_quiet { quiet + 1 } else { 0 };
        }
        all
    }

    /// Checks that exactly these values arrive.
    pub(crate) fn expect(&mut self, subscriber: usize, numbers: Range<u32>) {
        let expected: Vec<_> = numbers.map(R::value).collect();
        assert_eq!(self.taken(subscriber, expected.len() as u32), expected);
    }
}
