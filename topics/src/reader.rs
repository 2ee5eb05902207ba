//! A reliable reader: it gives the samples of each writer in their order. (RTPS 8.4.12)

use crate::qos::{Counts, Durability, Fit, Qos, Reliability};
use crate::wire::{Data, EntityId, Guid, GuidPrefix, Heartbeat, Sequence, SequenceSet};
use crate::wire::{OVERTAKEN, rises};
use tandem_board::{Duration, Instant};

/// How many writers of other participants one reader hears. D-4
pub const WRITERS: usize = 2;

/// What is missing is asked for with each heartbeat, and in this time once more.
pub(crate) const ASKS_EVERY: Duration = Duration::from_ms(5);
/// How often it is asked for, until the next heartbeat: for longer than its period.
const ASKS: u8 = 64;

/// The first bit of [`Stream::there`].
const HERE: u32 = 1 << 31;

/// How far a reliable writer was heard.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Stream {
    /// All below are there or given up; 0 until something was heard that tells where to begin.
    pub(crate) next: Sequence,
    /// Bit `n`, from the most significant one, tells that `next + n` is there. The first one is 0.
    there: u32,
    /// What the writer still has of before is wanted too.
    with_history: bool,
    heartbeat: Option<u32>,
}

impl Stream {
    pub(crate) fn new(with_history: bool) -> Self {
        Self {
            with_history,
            ..Self::default()
        }
    }

    /// Begins again if what is next is far above what the writer has reached: that was wrong.
    fn doubt(&mut self, reached: Sequence) {
        if self.next > reached.saturating_add(OVERTAKEN) {
            (self.next, self.there) = (0, 0);
        }
    }

    /// Returns whether a sample is one that is missing; of those far ahead, none is. Without
    /// history, the first one that arrives is where the stream begins; with it, a heartbeat tells
    /// that.
    pub(crate) fn lacks(&mut self, number: Sequence) -> bool {
        if self.next == 0 && (!self.with_history || number == 1) {
            self.next = number;
        }
        let offset = number.wrapping_sub(self.next);
        self.next > 0 && offset < u32::BITS && self.there << offset >> 31 == 0
    }

    /// Notes that a sample is there which is one that it lacks.
    pub(crate) fn insert(&mut self, number: Sequence) {
        self.there |= HERE.wrapping_shr(number.wrapping_sub(self.next));
        self.skip_to(self.next);
    }

    /// Gives up what is below this number, passes what is there. Returns how many were given up.
    pub(crate) fn skip_to(&mut self, number: Sequence) -> u32 {
        let mut lost = 0;
        while self.there >= HERE || self.there > 0 && self.next < number {
            lost += u32::from(self.there < HERE);
            self.there <<= 1;
            self.next += 1;
        }
        let rest = number.saturating_sub(self.next);
        self.next += rest;
        lost + rest
    }

    /// Gives up what the writer has dropped. Returns how many these are; `None` if a newer
    /// heartbeat, or the same, was heard before.
    pub(crate) fn on_heartbeat(&mut self, heartbeat: &Heartbeat) -> Option<u32> {
        if !rises(&mut self.heartbeat, heartbeat.count) {
            return None;
        }
        self.doubt(heartbeat.last + 1);
        self.next = match self.next {
            0 if self.with_history => heartbeat.first,
            0 => heartbeat.last + 1,
            next => next,
        };
        Some(self.skip_to(heartbeat.first))
    }

    /// Gives up what will not come. Returns how many these are.
    pub(crate) fn on_gap(&mut self, start: Sequence, set: SequenceSet) -> u32 {
        if start > self.next {
            return 0;
        }
        let mut lost = self.skip_to(set.base);
        for number in set.numbers() {
            if number == self.next {
                lost += self.skip_to(number.saturating_add(1));
            }
        }
        lost
    }

    /// Returns what to ask for: at most `most` samples up to `last`, without those that are there.
    #[inline(never)]
    pub(crate) fn missing(&self, last: Sequence, most: u32) -> SequenceSet {
        // Before the first heartbeat, nothing is known to be missing.
        let base = self.next.max(1);
        let len = most.min((last + 1).saturating_sub(base));
        let bits = !self.there & !u32::MAX.unbounded_shr(len);
        SequenceSet { base, bits }
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct RemoteWriter {
    guid: Guid,
    is_reliable: bool,
    stream: Stream,
    /// The newest sample that it has told of.
    last: Sequence,
    /// When it was asked for what is missing.
    asked: Instant,
    /// How often since its last heartbeat.
    asks: u8,
    /// Otherwise another one may get its place: it has ended, or there was none.
    is_alive: bool,
}

#[derive(Clone, Copy, Debug)]
struct Slot<const BYTES: usize> {
    /// Which writer, and which sample of it.
    from: u8,
    number: Sequence,
    len: u8,
    bytes: [u8; BYTES],
}

/// A sample that a reader gives.
#[derive(Clone, Copy, Debug)]
pub struct Sample<const BYTES: usize> {
    /// Its writer.
    pub writer: Guid,
    slot: Slot<BYTES>,
}

impl<const BYTES: usize> Sample<BYTES> {
    /// Representation and body.
    pub fn payload(&self) -> &[u8] {
        let Slot { len, bytes, .. } = &self.slot;
        bytes.get(..usize::from(*len)).unwrap_or_default()
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Reader<const DEPTH: usize, const BYTES: usize> {
    qos: Qos,
    depth: u32,
    writers: [RemoteWriter; WRITERS],
    samples: [Option<Slot<BYTES>>; DEPTH],
    pub(crate) counts: Counts,
}

impl<const DEPTH: usize, const BYTES: usize> Reader<DEPTH, BYTES> {
    pub(crate) fn new(qos: Qos) -> Self {
        Self {
            qos,
            depth: qos.depth_within(DEPTH),
            writers: [RemoteWriter::default(); WRITERS],
            samples: [None; DEPTH],
            counts: Counts::default(),
        }
    }

    /// Gives a writer that fits a place. Returns `false` if none is free.
    pub(crate) fn on_writer(&mut self, guid: Guid, fit: Fit) -> bool {
        if self.index_of(guid).is_some() {
            return true;
        }
        let unread = |index: usize| {
            let slots = self.samples.iter().flatten();
            slots.filter(|slot| usize::from(slot.from) == index).count()
        };
        let places = self.writers.iter_mut().enumerate();
        let free = places.filter(|(_, writer)| !writer.is_alive);
        let Some((index, place)) = free.min_by_key(|(index, _)| unread(*index)) else {
            self.counts.refused = self.counts.refused.wrapping_add(1);
            return false;
        };
        let is_reliable = fit.is_reliable && self.qos.reliability == Reliability::Reliable;
        // Without guarantee, no heartbeat tells where the history begins.
        let with_history = is_reliable && self.qos.durability == Durability::TransientLocal;
        *place = RemoteWriter {
            guid,
            is_reliable,
            stream: Stream::new(with_history),
            is_alive: true,
            ..RemoteWriter::default()
        };
        self.drop_from(index, 0);
        true
    }

    /// Drops the samples of a writer from this number on.
    #[inline(never)]
    fn drop_from(&mut self, index: usize, number: Sequence) {
        let is_of =
            |slot: &mut Slot<BYTES>| usize::from(slot.from) == index && slot.number >= number;
        for slot in &mut self.samples {
            let _dropped = slot.take_if(is_of);
        }
    }

    /// Takes the places of these writers back, when another one needs them. What they have sent can
    /// be taken until then; what is missing between does not come any more.
    pub(crate) fn remove(&mut self, prefix: GuidPrefix, entity: Option<EntityId>) {
        for writer in &mut self.writers {
            if writer.is_alive && writer.guid.is_of(prefix, entity) {
                writer.is_alive = false;
                if writer.stream.next > 0 {
                    let lost = writer.stream.skip_to(writer.last + 1);
                    self.counts.lost = self.counts.lost.saturating_add(lost);
                }
                writer.stream.next = Sequence::MAX;
            }
        }
    }

    pub(crate) fn writers(&self) -> impl Iterator<Item = Guid> {
        let writers = self.writers.iter().filter(|writer| writer.is_alive);
        writers.map(|writer| writer.guid)
    }

    fn index_of(&self, guid: Guid) -> Option<usize> {
        let mut writers = self.writers.iter();
        writers.position(|writer| writer.guid == guid && writer.is_alive)
    }

    /// Returns the place of the oldest sample that can be taken: all before it are there or given
    /// up.
    fn oldest(&self) -> Option<usize> {
        let is_due = |slot: &&Slot<BYTES>| {
            let writer = self.writers.get(usize::from(slot.from));
            writer.is_some_and(|writer| slot.number < writer.stream.next)
        };
        let slots = self.samples.iter().enumerate();
        let due = slots.filter_map(|(at, slot)| Some((slot.as_ref().filter(is_due)?.number, at)));
        due.min().map(|(_, at)| at)
    }

    /// Returns the place of the sample with the highest number.
    fn farthest(&self) -> Option<usize> {
        let slots = self.samples.iter().enumerate();
        let all = slots.filter_map(|(at, slot)| Some((slot.as_ref()?.number, at)));
        all.max().map(|(_, at)| at)
    }

    pub(crate) fn on_data(&mut self, guid: Guid, data: &Data<'_>) {
        let Some(index) = self.index_of(guid) else {
            return;
        };
        let number = data.sequence;
        let writer = &mut self.writers[index];
        let before = writer.stream.next;
        if !writer.is_reliable {
            // It does not send again what is missing.
            writer.stream.doubt(number);
            writer.stream.skip_to(number);
        }
        if writer.stream.next < before {
            self.drop_from(index, number);
        }
        let writer = &mut self.writers[index];
        if !writer.stream.lacks(number) {
            return;
        }
        let is_next = writer.stream.next == number;
        let mut slot = Slot {
            from: index as u8,
            number,
            len: data.payload.len() as u8,
            bytes: [0; BYTES],
        };
        let Some(bytes) = slot.bytes.get_mut(..data.payload.len()) else {
            // It is of no use, and asking for it again would not help.
            self.counts.too_long = self.counts.too_long.wrapping_add(1);
            writer.stream.insert(number);
            return;
        };
        bytes.copy_from_slice(data.payload);
        let mut places = self.samples.iter().take(self.depth as usize);
        let place = places.position(Option::is_none).or_else(|| self.oldest());
        // All wait for others, perhaps for this one. What is replaced is asked for once more.
        let place = place.or_else(|| self.farthest().filter(|_| is_next));
        let Some(place) = place.and_then(|place| self.samples.get_mut(place)) else {
            return;
        };
        if let Some(Slot { from, number, .. }) = place.replace(slot) {
            match self.writers.get_mut(usize::from(from)) {
                Some(RemoteWriter { stream, .. }) if stream.next <= number => {
                    stream.there &= !HERE.wrapping_shr(number - stream.next);
                }
                _ => self.counts.replaced = self.counts.replaced.wrapping_add(1),
            }
        }
        self.writers[index].stream.insert(number);
    }

    /// Returns the answer to a heartbeat, if one is due: what the reader asks for.
    pub(crate) fn on_heartbeat(
        &mut self,
        now: Instant,
        guid: Guid,
        heartbeat: &Heartbeat,
    ) -> Option<SequenceSet> {
        let index = self.index_of(guid)?;
        let writer = &mut self.writers[index];
        if !writer.is_reliable {
            return None;
        }
        let before = writer.stream.next;
        let lost = writer.stream.on_heartbeat(heartbeat)?;
        (writer.last, writer.asked, writer.asks) = (heartbeat.last, now, 0);
        self.counts.lost = self.counts.lost.saturating_add(lost);
        let set = writer.stream.missing(writer.last, self.depth);
        let next = writer.stream.next;
        if next < before {
            self.drop_from(index, next);
        }
        (set.bits > 0 || !heartbeat.is_final).then_some(set)
    }

    /// Returns of which writer, and for what, it asks once more: question or answer were lost.
    pub(crate) fn asks_again(&mut self, now: Instant, index: usize) -> Option<(Guid, SequenceSet)> {
        let writer = &mut self.writers[index];
        let set = writer.stream.missing(writer.last, self.depth);
        let is_due = now.since(writer.asked) >= ASKS_EVERY && writer.asks < ASKS;
        (set.bits > 0 && is_due).then(|| {
            (writer.asked, writer.asks) = (now, writer.asks + 1);
            (writer.guid, set)
        })
    }

    pub(crate) fn on_gap(&mut self, guid: Guid, start: Sequence, set: SequenceSet) {
        if let Some(index) = self.index_of(guid) {
            let lost = self.writers[index].stream.on_gap(start, set);
            self.counts.lost = self.counts.lost.saturating_add(lost);
        }
    }

    /// Takes a sample of which all before it, of the same writer, are there or given up.
    pub(crate) fn take(&mut self) -> Option<Sample<BYTES>> {
        let oldest = self.oldest()?;
        let slot = self.samples.get_mut(oldest)?.take()?;
        let writer = self.writers.get(usize::from(slot.from))?.guid;
        Some(Sample { writer, slot })
    }
}
