//! A reliable reader: it gives the samples of each writer in their order. (RTPS 8.4.12)

use crate::qos::Fit;
use crate::wire::{Data, EntityId, Gap, Guid, GuidPrefix, Heartbeat, Sequence, SequenceSet};
use crate::wire::{OVERTAKEN, has_risen};
use crate::{Counts, Durability, Qos, Reliability};
use core::ops::Range;
use tandem_board::{Duration, Instant};

/// How many writers of other participants one reader hears. D-4
pub const WRITERS: usize = 2;

/// What is missing is asked for with each heartbeat, and in this time once more.
pub(crate) const ASKS_EVERY: Duration = Duration::from_ms(5);
/// How often it is asked for, until the next heartbeat: for longer than its period.
const ASKS: u8 = 64;

/// How far a reliable writer was heard.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stream {
    /// All below are there or given up; 0 until something was heard that tells where to begin.
    next: Sequence,
    /// What the writer still has of before is wanted too.
    with_history: bool,
    heartbeat: Option<u32>,
}

impl Stream {
    pub(crate) const fn new(with_history: bool) -> Self {
        Self {
            next: 0,
            with_history,
            heartbeat: None,
        }
    }

    /// Begins again at a sample without guarantee that is too old for one that was overtaken: a
    /// number of before was wrong.
    pub(crate) fn begin_again(&mut self, number: Sequence) {
        if self.next > number.saturating_add(OVERTAKEN) {
            self.next = number;
        }
    }

    /// Returns whether a sample is one that is missing. Without history, the first one that arrives
    /// is where the stream begins; with it, a heartbeat tells that.
    pub(crate) fn lacks(&mut self, number: Sequence) -> bool {
        if self.next == 0 && (!self.with_history || number == 1) {
            self.next = number;
        }
        self.next > 0 && number >= self.next
    }

    /// Returns the number below which all are there or given up.
    pub(crate) const fn next(&self) -> Sequence {
        self.next
    }

    /// Gives up what is below this number.
    pub(crate) fn skip_to(&mut self, number: Sequence) {
        self.next = self.next.max(number);
    }

    /// Gives up what the writer has dropped. Returns that range; `None` if a newer heartbeat, or
    /// the same, was heard before.
    pub(crate) fn on_heartbeat(&mut self, heartbeat: &Heartbeat) -> Option<Range<Sequence>> {
        if !has_risen(heartbeat.count, self.heartbeat) {
            return None;
        }
        self.heartbeat = Some(heartbeat.count);
        let end = heartbeat.last + 1;
        // The writer has not come so far: a number of before was wrong.
        let is_wrong = self.next > end.saturating_add(OVERTAKEN);
        let next = match self.next {
            next if next > 0 && !is_wrong => next,
            _ if self.with_history => heartbeat.first,
            _ => end,
        };
        self.next = next.max(heartbeat.first);
        Some(next..heartbeat.first)
    }

    /// Gives up what will not come. Returns that range.
    pub(crate) fn on_gap(&mut self, gap: &Gap) -> Range<Sequence> {
        let next = self.next;
        if gap.start > next {
            return 0..0;
        }
        let mut at = next.max(gap.set.base);
        for number in gap.set {
            if number == at {
                at = at.saturating_add(1);
            }
        }
        self.next = at;
        next..at
    }

    /// Returns what to ask for: at most `most` samples up to `last`, without those that are there.
    pub(crate) fn missing(
        &self,
        last: Sequence,
        most: u32,
        has: impl Fn(Sequence) -> bool,
    ) -> SequenceSet {
        // Before the first heartbeat, nothing is known to be missing.
        let next = self.next.max(1);
        let mut set = SequenceSet::empty(next);
        for number in next..=last.min(next.saturating_add(most - 1)) {
            if !has(number) {
                set.insert(number);
            }
        }
        set
    }
}

#[derive(Clone, Copy, Debug)]
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
    /// It has ended, and another one may get its place.
    is_gone: bool,
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
    len: u8,
    bytes: [u8; BYTES],
}

impl<const BYTES: usize> Sample<BYTES> {
    /// Representation and body.
    pub fn payload(&self) -> &[u8] {
        self.bytes.get(..self.len.into()).unwrap_or_default()
    }
}

#[derive(Clone, Debug)]
pub(crate) struct Reader<const DEPTH: usize, const BYTES: usize> {
    qos: Qos,
    depth: usize,
    writers: [Option<RemoteWriter>; WRITERS],
    samples: [Option<Slot<BYTES>>; DEPTH],
    pub(crate) counts: Counts,
}

impl<const DEPTH: usize, const BYTES: usize> Reader<DEPTH, BYTES> {
    pub(crate) fn new(qos: Qos) -> Self {
        Self {
            qos,
            depth: qos.depth_within(DEPTH),
            writers: [None; WRITERS],
            samples: [None; DEPTH],
            counts: Counts::default(),
        }
    }

    /// Gives a writer that fits a place. Returns `false` if none is free.
    pub(crate) fn on_writer(&mut self, guid: Guid, fit: Fit) -> bool {
        let reliability = match fit {
            Fit::Stranger => return true,
            Fit::Incompatible => {
                self.counts.incompatible = self.counts.incompatible.wrapping_add(1);
                return true;
            }
            Fit::Fits(reliability, _) => reliability,
        };
        if self.index_of(guid).is_some() {
            return true;
        }
        let is_free = |place: &Option<RemoteWriter>| place.is_none_or(|writer| writer.is_gone);
        let empty = self.writers.iter().position(Option::is_none);
        let Some(index) = empty.or_else(|| self.writers.iter().position(is_free)) else {
            self.counts.refused = self.counts.refused.wrapping_add(1);
            return false;
        };
        let is_reliable =
            reliability == Reliability::Reliable && reliability == self.qos.reliability;
        // Without guarantee, no heartbeat tells where the history begins.
        let with_history = is_reliable && self.qos.durability == Durability::TransientLocal;
        self.writers[index] = Some(RemoteWriter {
            guid,
            is_reliable,
            stream: Stream::new(with_history),
            last: 0,
            asked: Instant::ORIGIN,
            asks: 0,
            is_gone: false,
        });
        for slot in &mut self.samples {
            let _unread = slot.take_if(|slot| usize::from(slot.from) == index);
        }
        true
    }

    /// Takes the places of these writers back, when another one needs them. What they have sent can
    /// be taken until then; what is missing between does not come any more.
    pub(crate) fn remove(&mut self, prefix: GuidPrefix, entity: Option<EntityId>) {
        for index in 0..WRITERS {
            if let Some(writer) = &mut self.writers[index]
                && !writer.is_gone
                && writer.guid.is_of(prefix, entity)
            {
                writer.is_gone = true;
                let missing = match writer.stream.next() {
                    0 => 0..0,
                    next => next..writer.last.saturating_add(1),
                };
                writer.stream.skip_to(Sequence::MAX);
                self.count_lost(index, missing);
            }
        }
    }

    pub(crate) fn writers(&self) -> impl Iterator<Item = Guid> {
        let writers = self.writers.iter().flatten();
        let writers = writers.filter(|writer| !writer.is_gone);
        writers.map(|writer| writer.guid)
    }

    fn index_of(&self, guid: Guid) -> Option<usize> {
        let is = |writer: &RemoteWriter| writer.guid == guid && !writer.is_gone;
        let mut writers = self.writers.iter();
        writers.position(|writer| writer.as_ref().is_some_and(is))
    }

    fn has(&self, index: usize, number: Sequence) -> bool {
        let mut slots = self.samples.iter().flatten();
        slots.any(|slot| usize::from(slot.from) == index && slot.number == number)
    }

    /// Lets the stream pass what is there.
    fn advance(&mut self, index: usize) {
        while let Some(writer) = &self.writers[index]
            && let next = writer.stream.next()
            && self.has(index, next)
            && let Some(writer) = &mut self.writers[index]
        {
            writer.stream.skip_to(next + 1);
        }
    }

    /// Returns whether the sample in this place can be taken: all before it are there or given up.
    fn is_due(&self, slot: &Slot<BYTES>) -> bool {
        let writer = self.writers.get(usize::from(slot.from));
        writer
            .and_then(Option::as_ref)
            .is_some_and(|writer| slot.number < writer.stream.next())
    }

    /// Returns the place of the oldest sample that can be taken.
    fn oldest(&self) -> Option<usize> {
        let due = self.samples.iter().enumerate().filter_map(|(at, slot)| {
            let slot = slot.as_ref().filter(|slot| self.is_due(slot))?;
            Some((slot.number, at))
        });
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
        let Some(writer) = &mut self.writers[index] else {
            return;
        };
        let is_reliable = writer.is_reliable;
        if !is_reliable {
            writer.stream.begin_again(data.sequence);
        }
        if !writer.stream.lacks(data.sequence) || self.has(index, data.sequence) {
            return;
        }
        let next = self.writers[index].map(|writer| writer.stream.next());
        let is_next = next == Some(data.sequence);
        let mut slot = Slot {
            from: index as u8,
            number: data.sequence,
            len: data.payload.len() as u8,
            bytes: [0; BYTES],
        };
        let Some(bytes) = slot.bytes.get_mut(..data.payload.len()) else {
            // It is of no use, and asking for it again would not help.
            self.counts.too_long = self.counts.too_long.wrapping_add(1);
            self.skip_to(index, data.sequence + 1);
            return;
        };
        bytes.copy_from_slice(data.payload);
        if !is_reliable {
            // It does not send again what is missing.
            self.skip_to(index, data.sequence);
        }
        let mut places = self.samples.iter().take(self.depth);
        let (place, replaces) = match (places.position(Option::is_none), self.oldest()) {
            (Some(free), _) => (Some(free), 0),
            (None, Some(oldest)) => (Some(oldest), 1),
            // All wait for others, perhaps for this one. Who is replaced is asked for once more.
            (None, None) => (self.farthest().filter(|_| is_next), 0),
        };
        if let Some(place) = place.and_then(|place| self.samples.get_mut(place)) {
            *place = Some(slot);
            self.counts.replaced = self.counts.replaced.wrapping_add(replaces);
        }
        self.advance(index);
    }

    /// Counts what was given up and is not there.
    fn count_lost(&mut self, index: usize, dropped: Range<Sequence>) {
        let slots = self.samples.iter().flatten();
        let is_in =
            |slot: &&Slot<BYTES>| usize::from(slot.from) == index && dropped.contains(&slot.number);
        let there = slots.filter(is_in).count() as u32;
        let all = dropped.end.saturating_sub(dropped.start);
        let lost = all.saturating_sub(there);
        self.counts.lost = self.counts.lost.saturating_add(lost);
    }

    fn skip_to(&mut self, index: usize, number: Sequence) {
        if let Some(writer) = &mut self.writers[index] {
            writer.stream.skip_to(number);
        }
        self.advance(index);
    }

    /// Returns the answer to a heartbeat, if one is due: what the reader asks for.
    pub(crate) fn on_heartbeat(
        &mut self,
        now: Instant,
        guid: Guid,
        heartbeat: &Heartbeat,
    ) -> Option<SequenceSet> {
        let index = self.index_of(guid)?;
        let writer = self.writers[index]
            .as_mut()
            .filter(|writer| writer.is_reliable)?;
        let dropped = writer.stream.on_heartbeat(heartbeat)?;
        (writer.last, writer.asked, writer.asks) = (heartbeat.last, now, 0);
        self.count_lost(index, dropped);
        self.advance(index);
        let set = self.missing(index)?;
        (set.len > 0 || !heartbeat.is_final).then_some(set)
    }

    fn missing(&self, index: usize) -> Option<SequenceSet> {
        let writer = self.writers[index].as_ref()?;
        let depth = self.depth as u32;
        let has = |number| self.has(index, number);
        Some(writer.stream.missing(writer.last, depth, has))
    }

    /// Returns of which writer, and for what, it asks once more: question or answer were lost.
    pub(crate) fn asks_again(&mut self, now: Instant, index: usize) -> Option<(Guid, SequenceSet)> {
        let set = self.missing(index).filter(|set| set.len > 0)?;
        let writer = self.writers[index].as_mut()?;
        let is_due = now.since(writer.asked) >= ASKS_EVERY && writer.asks < ASKS;
        is_due.then(|| {
            (writer.asked, writer.asks) = (now, writer.asks + 1);
            (writer.guid, set)
        })
    }

    pub(crate) fn on_gap(&mut self, guid: Guid, gap: &Gap) {
        let Some(index) = self.index_of(guid) else {
            return;
        };
        if let Some(writer) = &mut self.writers[index] {
            let dropped = writer.stream.on_gap(gap);
            self.count_lost(index, dropped);
        }
        self.advance(index);
    }

    /// Takes a sample of which all before it, of the same writer, are there or given up.
    pub(crate) fn take(&mut self) -> Option<Sample<BYTES>> {
        let oldest = self.oldest()?;
        let slot = self.samples.get_mut(oldest)?.take()?;
        let writer = self.writers.get(usize::from(slot.from))?.as_ref()?.guid;
        Some(Sample {
            writer,
            len: slot.len,
            bytes: slot.bytes,
        })
    }
}
