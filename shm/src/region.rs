//! Typed regions: one `const` map of the LMU, in which each region has only the ends of its kind.
//!
//! A [`Region`] holds its place; its type gives its kind, shape and payload. So a mailbox cannot be
//! attached to the region of a scene, and all ends of a region have the same shape. The map is a
//! chain of constants; its end is the [`Layout`], whose hash must be equal in all images.
//!
//! A unique end (a sender, a receiver, a writer, a producer, a consumer) is *claimed*: a separate
//! word of the region names the incarnation that attached it. A second attachment is refused while
//! that incarnation is alive; a successor of a dead incarnation may attach.
//!
//! ```
//! use core::sync::atomic::AtomicU32;
//! use tandem_shm::incarnation::Incarnation;
//! use tandem_shm::mailbox::{Ring, TaskId};
//! use tandem_shm::map::{Layout, Map};
//! use tandem_shm::region::{Mailbox, Newest, Region};
//!
//! const NEWS: Region<Mailbox> = Region::first("news");
//! const SPEED: Region<Newest<u32>> = NEWS.then("speed");
//! const LAYOUT: Layout = SPEED.end();
//!
//! # #[repr(align(64))]
//! # struct Lmu([AtomicU32; LAYOUT.total_words()]);
//! # let lmu = Lmu([const { AtomicU32::new(0) }; LAYOUT.total_words()]);
//! # let words = &lmu.0;
//! let map = Map::format(words, LAYOUT).unwrap();
//! let [one, two] = [0, 1].map(|core| Incarnation::new(core, 1).unwrap());
//! for incarnation in [one, two] {
//!     map.incarnations().announce(incarnation).unwrap();
//! }
//! let mut speed = SPEED.writer(&map, one).unwrap();
//! let mut to = NEWS.sender(&map, one).unwrap();
//! assert!(NEWS.sender(&map, two).is_err(), "there is one sender");
//!
//! speed.publish(&42);
//! if to.signal(TaskId::new(1).unwrap()) == Ring::Needed {
//!     // The receiver sleeps: ring its doorbell, board.ring(core).
//! }
//!
//! let mut from = NEWS.receiver(&map, two).unwrap();
//! let mut read = SPEED.reader(&map).unwrap();
//! from.poll(|_signals| assert_eq!(read.fetch(), Ok(Some(42))));
//! ```

use core::marker::PhantomData;

use crate::incarnation::{Incarnation, Incarnations};
use crate::lock::{self, Lock};
use crate::map::{Layout, Map};
use crate::payload::Payload;
use crate::plain::{self, PlainMap};
use crate::pool::{self, Pool};
use crate::shape::{FitError, Shape};
use crate::sync::{AtomicU32, Ordering};
use crate::{broadcast, fifo, mailbox, newest, ring};

/// The kind of a region.
pub trait RegionKind {
    /// Words of a region of this kind.
    const WORDS: usize;
}

/// A sync mailbox: see [`mailbox`].
#[derive(Debug)]
pub enum Mailbox {}

/// A lock: see [`lock`].
#[derive(Debug)]
pub enum SharedLock {}

/// A pool of this many blocks: see [`pool`].
#[derive(Debug)]
pub enum SharedPool<const BLOCKS: usize> {}

/// Plain words, without a protocol.
#[derive(Debug)]
pub enum Words<const COUNT: usize> {}

/// A newest-value channel: see [`newest`]. With 4 slots a reader that has started to read the
/// newest value can finish while the writer writes three more.
#[derive(Debug)]
pub struct Newest<T, const SLOTS: usize = 4>(PhantomData<fn() -> T>);

/// A queue: see [`fifo`].
#[derive(Debug)]
pub struct Fifo<T, const SLOTS: usize>(PhantomData<fn() -> T>);

/// A queue of `SLOTS` blocks of `BYTES` bytes, for plain access: see [`plain`].
#[derive(Debug)]
pub enum Plain<const BYTES: usize, const SLOTS: usize> {}

/// A broadcast ring: see [`broadcast`].
#[derive(Debug)]
pub struct Broadcast<T, const SLOTS: usize>(PhantomData<fn() -> T>);

impl RegionKind for Mailbox {
    const WORDS: usize = mailbox::WORDS;
}

impl RegionKind for SharedLock {
    const WORDS: usize = lock::WORDS;
}

impl<const BLOCKS: usize> RegionKind for SharedPool<BLOCKS> {
    const WORDS: usize = pool::words(BLOCKS);
}

impl<const COUNT: usize> RegionKind for Words<COUNT> {
    const WORDS: usize = COUNT;
}

impl<T: Payload, const SLOTS: usize> Newest<T, SLOTS> {
    const SHAPE: Shape = Shape::new(SLOTS, T::WORDS);
}

impl<T: Payload, const SLOTS: usize> RegionKind for Newest<T, SLOTS> {
    const WORDS: usize = newest::words(Self::SHAPE);
}

impl<T: Payload, const SLOTS: usize> Fifo<T, SLOTS> {
    const SHAPE: Shape = Shape::new(SLOTS, T::WORDS);
}

impl<T: Payload, const SLOTS: usize> RegionKind for Fifo<T, SLOTS> {
    const WORDS: usize = fifo::words(Self::SHAPE);
}

impl<const BYTES: usize, const SLOTS: usize> Plain<BYTES, SLOTS> {
    const SHAPE: Shape = plain::shape(BYTES, SLOTS);
}

impl<const BYTES: usize, const SLOTS: usize> RegionKind for Plain<BYTES, SLOTS> {
    const WORDS: usize = fifo::words(Self::SHAPE);
}

impl<T: Payload, const SLOTS: usize> Broadcast<T, SLOTS> {
    const SHAPE: Shape = Shape::new(SLOTS, T::WORDS);
}

impl<T: Payload, const SLOTS: usize> RegionKind for Broadcast<T, SLOTS> {
    const WORDS: usize = broadcast::words(Self::SHAPE);
}

/// One region of a map: its place in the LMU. The type parameter gives its kind.
#[derive(Debug)]
pub struct Region<K> {
    /// First word in the LMU.
    begin: usize,
    /// The layout up to the end of this region.
    layout: Layout,
    kind: PhantomData<fn() -> K>,
}

impl<K> Clone for Region<K> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<K> Copy for Region<K> {}

/// Why an end of a region cannot be attached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum EndError {
    /// The end is unique, and this living incarnation holds it.
    Claimed(Incarnation),
    /// The incarnation that asks for an end of plain blocks was not announced or is dead: another
    /// core could take the end from it.
    NotAlive(Incarnation),
    /// The region is not part of this map's layout.
    Fit(FitError),
}

impl core::fmt::Display for EndError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Claimed(holder) => write!(f, "the end is held by {holder:?}"),
            Self::NotAlive(asking) => write!(f, "{asking:?} is not announced"),
            Self::Fit(error) => write!(f, "the region is not part of this layout: {error}"),
        }
    }
}

impl core::error::Error for EndError {}

impl From<FitError> for EndError {
    fn from(error: FitError) -> Self {
        Self::Fit(error)
    }
}

impl<K: RegionKind> Region<K> {
    /// Returns the first region of a map. The name is part of the layout's hash.
    #[must_use]
    pub const fn first(name: &'static str) -> Self {
        Self::after(Layout::EMPTY, name)
    }

    const fn after(layout: Layout, name: &'static str) -> Self {
        Self {
            begin: layout.total_words(),
            layout: layout.with(name, K::WORDS),
            kind: PhantomData,
        }
    }

    /// Returns the region that follows this one.
    #[must_use]
    pub const fn then<L: RegionKind>(self, name: &'static str) -> Region<L> {
        Region::after(self.layout, name)
    }

    /// Returns the layout that ends with this region.
    #[must_use]
    pub const fn end(self) -> Layout {
        self.layout
    }

    fn words<'a>(&self, map: &Map<'a>) -> Result<&'a [AtomicU32], FitError> {
        map.words(self.begin, K::WORDS)
    }

    /// Claims the end whose claim word is `at`, and returns the words of the region.
    fn claimed<'a>(
        &self,
        map: &Map<'a>,
        at: usize,
        incarnation: Incarnation,
    ) -> Result<&'a [AtomicU32], EndError> {
        let words = self.words(map)?;
        claim(&words[at], incarnation, map.incarnations())?;
        Ok(words)
    }
}

/// Claims the end whose claim word is `word` for this incarnation.
fn claim(
    word: &AtomicU32,
    incarnation: Incarnation,
    incarnations: Incarnations<'_>,
) -> Result<(), EndError> {
    // Core + 1 in the low bits: a zeroed region has no claims.
    let own = incarnation.generation() << 2 | (incarnation.core() as u32 + 1);
    // A retry is needed only if another core claims at the same time, and there are three cores.
    for _ in 0..4 {
        // Acquire pairs with the Release below: the holder's announcement is seen with its claim.
        let seen = word.load(Ordering::Acquire);
        let holder = Incarnation::new((seen as usize & 3).wrapping_sub(1), seen >> 2);
        if let Some(holder) = holder.filter(|&holder| incarnations.is_alive(holder)) {
            return Err(EndError::Claimed(holder));
        }
        // Acquire is not needed: the call of `is_alive` made the last holder's writes visible.
        let claimed = word.compare_exchange(seen, own, Ordering::Release, Ordering::Relaxed);
        if claimed.is_ok() {
            return Ok(());
        }
    }
    Err(EndError::Claimed(incarnation))
}

impl<const COUNT: usize> Region<Words<COUNT>> {
    /// Returns the words of the region.
    ///
    /// # Errors
    /// [`FitError`] if the region is not part of this map's layout.
    pub fn attach<'a>(&self, map: &Map<'a>) -> Result<&'a [AtomicU32], FitError> {
        Ok(&self.words(map)?[..COUNT])
    }
}

impl Region<SharedLock> {
    /// Attaches an end of the lock. Each task that takes the lock attaches its own end.
    ///
    /// # Errors
    /// [`FitError`] if the region is not part of this map's layout.
    pub fn attach<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<Lock<'a>, FitError> {
        Lock::attach(self.words(map)?, incarnation, map.incarnations())
    }
}

impl<const BLOCKS: usize> Region<SharedPool<BLOCKS>> {
    /// Attaches this incarnation to the pool.
    ///
    /// # Errors
    /// [`FitError`] if the region is not part of this map's layout.
    pub fn attach<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<Pool<'a>, FitError> {
        Pool::attach(self.words(map)?, BLOCKS, incarnation, map.incarnations())
    }
}

impl Region<Mailbox> {
    /// Attaches the sending end. Ring the receiver's doorbell once afterwards: an earlier
    /// incarnation of this core may have died after it signalled and before it rang.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn sender<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<mailbox::Sender<'a>, EndError> {
        let words = self.claimed(map, mailbox::SENDER_CLAIM_AT, incarnation)?;
        Ok(mailbox::Sender::attach(words)?)
    }

    /// Attaches the receiving end. Its first poll returns the signals that earlier incarnations of
    /// this core left open.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn receiver<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<mailbox::Receiver<'a>, EndError> {
        let words = self.claimed(map, mailbox::RECEIVER_CLAIM_AT, incarnation)?;
        Ok(mailbox::Receiver::attach(words)?)
    }
}

impl<T: Payload, const SLOTS: usize> Region<Newest<T, SLOTS>> {
    /// Attaches the writing end.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn writer<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<newest::Writer<'a, T>, EndError> {
        let words = self.claimed(map, ring::CLAIM_AT, incarnation)?;
        let ring = newest::ring(words, Newest::<T, SLOTS>::SHAPE)?;
        Ok(newest::Writer::attach(ring))
    }

    /// Attaches a reading end; there may be any number of them.
    ///
    /// # Errors
    /// [`FitError`] if the region is not part of this map's layout.
    pub fn reader<'a>(&self, map: &Map<'a>) -> Result<newest::Reader<'a, T, SLOTS>, FitError> {
        let words = self.words(map)?;
        let ring = newest::ring(words, Newest::<T, SLOTS>::SHAPE)?;
        Ok(newest::Reader::attach(ring))
    }
}

impl<T: Payload, const SLOTS: usize> Region<Fifo<T, SLOTS>> {
    /// Attaches the sending end.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn producer<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<fifo::Producer<'a, T, SLOTS>, EndError> {
        let words = self.claimed(map, fifo::PRODUCER_CLAIM_AT, incarnation)?;
        Ok(fifo::Producer::attach(words, Fifo::<T, SLOTS>::SHAPE)?)
    }

    /// Attaches the receiving end.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn consumer<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<fifo::Consumer<'a, T, SLOTS>, EndError> {
        let words = self.claimed(map, fifo::CONSUMER_CLAIM_AT, incarnation)?;
        Ok(fifo::Consumer::attach(words, Fifo::<T, SLOTS>::SHAPE)?)
    }
}

impl<const BYTES: usize, const SLOTS: usize> Region<Plain<BYTES, SLOTS>> {
    /// Claims an end for an incarnation that keeps it: nobody takes it from one that is alive.
    fn claimed_alive<'a>(
        &self,
        map: &PlainMap<'a>,
        at: usize,
        incarnation: Incarnation,
    ) -> Result<&'a [AtomicU32], EndError> {
        if !map.incarnations().is_alive(incarnation) {
            return Err(EndError::NotAlive(incarnation));
        }
        self.claimed(map, at, incarnation)
    }

    /// Attaches the sending end.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn producer<'a>(
        &self,
        map: &PlainMap<'a>,
        incarnation: Incarnation,
    ) -> Result<plain::Producer<'a, BYTES>, EndError> {
        let words = self.claimed_alive(map, fifo::PRODUCER_CLAIM_AT, incarnation)?;
        Ok(plain::Producer::attach(
            words,
            Plain::<BYTES, SLOTS>::SHAPE,
        )?)
    }

    /// Attaches the receiving end.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn consumer<'a>(
        &self,
        map: &PlainMap<'a>,
        incarnation: Incarnation,
    ) -> Result<plain::Consumer<'a, BYTES>, EndError> {
        let words = self.claimed_alive(map, fifo::CONSUMER_CLAIM_AT, incarnation)?;
        Ok(plain::Consumer::attach(
            words,
            Plain::<BYTES, SLOTS>::SHAPE,
        )?)
    }
}

impl<T: Payload, const SLOTS: usize> Region<Broadcast<T, SLOTS>> {
    /// Attaches the writing end.
    ///
    /// # Errors
    /// [`EndError`]
    pub fn writer<'a>(
        &self,
        map: &Map<'a>,
        incarnation: Incarnation,
    ) -> Result<broadcast::Writer<'a, T>, EndError> {
        let words = self.claimed(map, ring::CLAIM_AT, incarnation)?;
        let ring = broadcast::ring(words, Broadcast::<T, SLOTS>::SHAPE)?;
        Ok(broadcast::Writer::attach(ring))
    }

    /// Attaches a receiving end for values published from now on; there may be any number of them.
    ///
    /// # Errors
    /// [`FitError`] if the region is not part of this map's layout.
    pub fn receiver<'a>(&self, map: &Map<'a>) -> Result<broadcast::Receiver<'a, T>, FitError> {
        let words = self.words(map)?;
        let ring = broadcast::ring(words, Broadcast::<T, SLOTS>::SHAPE)?;
        Ok(broadcast::Receiver::attach(ring))
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault::zeroed;
    use crate::ring::Stamp;

    const NEWS: Region<Mailbox> = Region::first("news");
    const PAIR: Region<Newest<[u32; 2]>> = NEWS.then("pair");
    const ORDERS: Region<Fifo<u32, 8>> = PAIR.then("orders");
    const SMALL: Region<Newest<[u32; 6], 2>> = ORDERS.then("small");
    const NOTES: Region<Broadcast<u32, 4>> = SMALL.then("notes");
    const LOCK: Region<SharedLock> = NOTES.then("lock");
    const POOL: Region<SharedPool<3>> = LOCK.then("pool");
    const GUARDED: Region<Words<2>> = POOL.then("guarded");
    const LAYOUT: Layout = GUARDED.end();

    fn start(map: &Map<'_>, core: usize, generation: u32) -> Incarnation {
        let incarnation = Incarnation::new(core, generation).unwrap();
        map.incarnations().announce(incarnation).unwrap();
        incarnation
    }

    fn map() -> Map<'static> {
        Map::format(zeroed(LAYOUT.total_words()), LAYOUT).unwrap()
    }

    /// A small newest-value or broadcast channel fits in one cache line. In a larger newest-value
    /// channel and in a queue, a slot crosses a line only if it is longer than a line.
    #[test]
    fn a_channel_takes_no_more_words_than_it_needs() {
        for (slots, slot_words, expected) in [
            (4, 2, [13, 13, 32]),
            (2, 6, [15, 15, 32]),
            (2, 7, [48, 32, 32]),
            (4, 3, [80, 32, 32]),
            (2, 15, [48, 48, 48]),
            (2, 16, [80, 50, 80]),
        ] {
            let shape = Shape::new(slots, slot_words);
            let words = [newest::words, broadcast::words, fifo::words].map(|words| words(shape));
            assert_eq!(words, expected, "{shape:?}");
        }
        assert_eq!([1, 16, 17, 511].map(pool::words), [48, 288, 320, 8704]);
    }

    #[test]
    fn values_of_each_kind_of_region_go_from_core_to_core() {
        let map = map();
        let [one, two] = [0, 1].map(|core| start(&map, core, 1));
        let mut writer = PAIR.writer(&map, one).unwrap();
        let mut reader = PAIR.reader(&map).unwrap();
        let mut producer = ORDERS.producer(&map, one).unwrap();
        let mut consumer = ORDERS.consumer(&map, two).unwrap();
        let mut notes = NOTES.writer(&map, one).unwrap();
        let mut receiver = NOTES.receiver(&map).unwrap();
        let mut small = SMALL.writer(&map, one).unwrap();
        let mut read_small = SMALL.reader(&map).unwrap();
        assert_eq!(reader.fetch(), Ok(None));
        for k in 0..20 {
            writer.publish(&[k, !k]);
            assert_eq!(reader.fetch(), Ok(Some([k, !k])));
            assert_eq!(reader.fetch(), Ok(None), "fetched once");
            producer.send(&k).unwrap();
            assert_eq!(consumer.receive(), Ok(Some(k)));
            notes.publish(&k);
            assert_eq!(receiver.receive(), Ok(Some((Stamp(k), k))));
            small.publish(&[k; 6]);
            assert_eq!(read_small.fetch(), Ok(Some([k; 6])));
        }
        let mut lock = LOCK.attach(&map, one).unwrap();
        let guard = lock.try_lock().unwrap();
        assert!(LOCK.attach(&map, two).unwrap().try_lock().is_none());
        drop(guard);
        let handle = POOL.attach(&map, one).unwrap().get(48).unwrap();
        assert!(POOL.attach(&map, two).unwrap().open(handle).is_err());
        assert_eq!(GUARDED.attach(&map).unwrap().len(), 2);
        // The claim words, which lie beside the words of each end, were not overwritten.
        assert!(SMALL.writer(&map, two).is_err() && NEWS.sender(&map, two).is_ok());
    }

    /// While its holder is alive, a unique end cannot be claimed again, even by the holder. A
    /// successor of the holder gets the end.
    #[test]
    fn an_end_exists_once() {
        let map = map();
        let [one, two] = [0, 1].map(|core| start(&map, core, 1));
        type Claim = fn(&Map<'static>, Incarnation) -> Result<(), EndError>;
        let claims: [Claim; 6] = [
            |map, incarnation| NEWS.sender(map, incarnation).map(drop),
            |map, incarnation| NEWS.receiver(map, incarnation).map(drop),
            |map, incarnation| PAIR.writer(map, incarnation).map(drop),
            |map, incarnation| ORDERS.producer(map, incarnation).map(drop),
            |map, incarnation| ORDERS.consumer(map, incarnation).map(drop),
            |map, incarnation| NOTES.writer(map, incarnation).map(drop),
        ];
        for claim in claims {
            assert_eq!(claim(&map, one), Ok(()));
            assert_eq!(claim(&map, one), Err(EndError::Claimed(one)));
            assert_eq!(claim(&map, two), Err(EndError::Claimed(one)));
        }
        let successor = start(&map, 0, 2);
        for claim in claims {
            assert_eq!(claim(&map, successor), Ok(()));
        }
        assert!(map.incarnations().mark_dead(successor));
        for claim in claims {
            assert_eq!(claim(&map, two), Ok(()));
        }
    }

    /// A mailbox does not mistake a claim word for a signal.
    #[test]
    fn claims_are_no_signals() {
        let map = map();
        let one = start(&map, 0, (1 << 30) - 1);
        let mut receiver = NEWS.receiver(&map, one).unwrap();
        let mut sender = NEWS.sender(&map, one).unwrap();
        assert_eq!(receiver.poll(|_| panic!("nothing was sent")), 0);
        let task = mailbox::TaskId::new(1).unwrap();
        let _ = sender.signal_with(task, 7);
        assert_eq!(receiver.poll(|open| assert_eq!(open.value, 7)), 1);
        assert_eq!(sender.open(task), 0);
    }

    #[test]
    fn a_region_of_another_map_is_refused() {
        const ALONE: Region<Words<1>> = Region::first("alone");
        let map = Map::format(zeroed(ALONE.end().total_words()), ALONE.end()).unwrap();
        assert_eq!(GUARDED.attach(&map).unwrap_err(), FitError::TooSmall);
        assert!(NEWS.sender(&map, start(&map, 0, 1)).is_err());
    }
}
