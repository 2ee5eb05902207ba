//! The participant: it composes discovery, writers and readers, and does no input or output.

use crate::Endpoint;
use crate::discovery::{self, Announcement, Kind, Remote};
use crate::qos::Fit;
use crate::reader::{Reader, ReaderCounts, Sample, WRITERS};
use crate::wire::{AckNack, Data, DataTo, EntityId, Gap, Guid, GuidPrefix, Heartbeat, Locator};
use crate::wire::{Message, Parameters, ROOM, SequenceSet, Submessage, Submessages, pid};
use crate::writer::{TooLong, Writer, WriterCounts};
use tandem_board::{Duration, Instant};

/// Period of the heartbeat of a writer whose readers have not said that they have everything. D-4
pub const HEARTBEAT_PERIOD: Duration = Duration::from_ms(250);
/// Period of the announcement of the participant.
const ANNOUNCES_EVERY: Duration = Duration::from_ms(1_000);
/// How many other participants it knows.
const REMOTES: usize = 4;

/// Where a message goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Destination {
    /// To all participants of the domain: its multicast address, or a list of peers.
    Everyone,
    /// To one participant.
    At(Locator),
}

/// What a participant wants done.
pub trait Outlet {
    /// Sends a message. One that cannot be sent is lost.
    fn send(&mut self, to: Destination, message: &[u8]);
}

/// Counts of a participant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ParticipantCounts {
    /// Datagrams that are no message of RTPS.
    pub foreign: u32,
    /// Announcements of participants for which there was no place.
    pub refused: u32,
}

/// A participant with `W` writers and `R` readers, of which each keeps up to `DEPTH` samples of up
/// to `BYTES` bytes (at most 255).
#[derive(Debug)]
pub struct Participant<const W: usize, const R: usize, const DEPTH: usize, const BYTES: usize> {
    prefix: GuidPrefix,
    at: Locator,
    outputs: &'static [Endpoint; W],
    inputs: &'static [Endpoint; R],
    writers: [Writer<DEPTH, BYTES>; W],
    readers: [Reader<DEPTH, BYTES>; R],
    remotes: [Option<Remote>; REMOTES],
    /// A count for all heartbeats of discovery, and for all ACKNACKs: each only has to rise.
    count: u32,
    announced: Option<Instant>,
    beat: Instant,
    counts: ParticipantCounts,
}

impl<const W: usize, const R: usize, const DEPTH: usize, const BYTES: usize>
    Participant<W, R, DEPTH, BYTES>
{
    /// Creates a participant. `prefix` names it and must be new at each start; `at` is where it
    /// hears.
    pub fn new(
        prefix: GuidPrefix,
        at: Locator,
        outputs: &'static [Endpoint; W],
        inputs: &'static [Endpoint; R],
    ) -> Self {
        Self {
            prefix,
            at,
            outputs,
            inputs,
            writers: core::array::from_fn(|index| Writer::new(outputs[index].qos)),
            readers: core::array::from_fn(|index| Reader::new(inputs[index].qos)),
            remotes: [None; REMOTES],
            count: 0,
            announced: None,
            beat: Instant::ORIGIN,
            counts: ParticipantCounts::default(),
        }
    }

    /// Returns the counts of the participant.
    pub const fn counts(&self) -> ParticipantCounts {
        self.counts
    }

    /// Returns the counts of a writer.
    ///
    /// # Panics
    ///
    /// If it has no writer of this index.
    pub fn writer_counts(&self, writer: usize) -> WriterCounts {
        self.writers[writer].counts
    }

    /// Returns the counts of a reader.
    ///
    /// # Panics
    ///
    /// If it has no reader of this index.
    pub fn reader_counts(&self, reader: usize) -> ReaderCounts {
        self.readers[reader].counts
    }

    /// Returns how many readers of others a writer serves.
    ///
    /// # Panics
    ///
    /// If it has no writer of this index.
    pub fn readers_of(&self, writer: usize) -> usize {
        self.writers[writer].readers.iter().flatten().count()
    }

    /// Publishes a sample: representation and body.
    ///
    /// # Errors
    ///
    /// [`TooLong`] if it has more than `BYTES` bytes: it was not published.
    ///
    /// # Panics
    ///
    /// If it has no writer of this index.
    pub fn write(
        &mut self,
        writer: usize,
        sample: &[u8],
        out: &mut impl Outlet,
    ) -> Result<(), TooLong> {
        let number = self.writers[writer].push(sample)?;
        for index in 0..REMOTES {
            let Some(remote) = self.remotes[index] else {
                continue;
            };
            let mut readers = self.writers[writer].readers.iter().flatten();
            if readers.any(|reader| reader.guid.prefix == remote.prefix) {
                self.send_sample(writer, (number, true), (remote, EntityId::UNKNOWN), out);
            }
        }
        Ok(())
    }

    /// Takes the next sample of a reader. Those of one writer are in their order.
    ///
    /// # Panics
    ///
    /// If it has no reader of this index.
    pub fn take(&mut self, reader: usize) -> Option<Sample<BYTES>> {
        self.readers[reader].take()
    }

    /// Does what is due. Returns when it wants to be called again, at the latest.
    pub fn poll(&mut self, now: Instant, out: &mut impl Outlet) -> Instant {
        for index in 0..REMOTES {
            if let Some(remote) = self.remotes[index].filter(|remote| now >= remote.expires) {
                self.forget(remote.prefix);
            }
        }
        let is_due = |last: Instant| now.since(last) >= ANNOUNCES_EVERY;
        if self.announced.is_none_or(is_due) {
            self.announced = Some(now);
            self.announce(Destination::Everyone, None, out);
        }
        if now.since(self.beat) >= HEARTBEAT_PERIOD {
            self.beat = now;
            self.remind(out);
        }
        self.ask_again(now, out);
        let announces = self.announced.unwrap_or(now) + ANNOUNCES_EVERY;
        announces.min(self.beat + HEARTBEAT_PERIOD)
    }

    fn ask_again(&mut self, now: Instant, out: &mut impl Outlet) {
        for (index, writer) in (0..R).flat_map(|index| (0..WRITERS).map(move |it| (index, it))) {
            let Some((guid, set)) = self.readers[index].asks_again(now, writer) else {
                continue;
            };
            let remote = self.index_of(guid.prefix).and_then(|at| self.remotes[at]);
            if let Some(remote) = remote {
                let ends = (EntityId::reader(index), guid.entity);
                self.acknowledge((guid.prefix, remote.user), ends, set, out);
            }
        }
    }

    /// Says to all that it ends.
    pub fn leave(&mut self, out: &mut impl Outlet) {
        let to = DataTo {
            reader: EntityId::SPDP_READER,
            writer: EntityId::SPDP_WRITER,
            sequence: 2,
        };
        let ends = |message: &mut Message<'_>| {
            let guid = discovery::participant(self.prefix);
            message.ends(to, pid::PARTICIPANT_GUID, guid);
        };
        compose(self.prefix, None, Destination::Everyone, out, ends);
    }

    /// Hears a datagram.
    pub fn hear(&mut self, now: Instant, datagram: &[u8], out: &mut impl Outlet) {
        let Some((from, parts)) = Submessages::of(datagram) else {
            self.counts.foreign = self.counts.foreign.wrapping_add(1);
            return;
        };
        if from == self.prefix {
            return;
        }
        let mut is_ours = true;
        for part in parts {
            match part {
                Submessage::Destination(to) => {
                    is_ours = to == self.prefix || to == GuidPrefix::default();
                }
                _ if !is_ours => {}
                Submessage::Data(data) => self.on_data(now, from, &data, out),
                Submessage::Heartbeat(heartbeat) => self.on_heartbeat(now, from, &heartbeat, out),
                Submessage::Gap(gap) => self.on_gap(from, &gap),
                Submessage::AckNack(acknack) => self.on_acknack(from, &acknack, out),
                Submessage::Other => {}
            }
        }
    }

    fn index_of(&self, prefix: GuidPrefix) -> Option<usize> {
        let is = |remote: &Option<Remote>| remote.is_some_and(|remote| remote.prefix == prefix);
        self.remotes.iter().position(is)
    }

    fn next_count(&mut self) -> u32 {
        self.count = self.count.wrapping_add(1);
        self.count
    }

    fn on_data(&mut self, now: Instant, from: GuidPrefix, data: &Data<'_>, out: &mut impl Outlet) {
        let guid = Guid {
            prefix: from,
            entity: data.writer,
        };
        if data.writer == EntityId::SPDP_WRITER {
            self.on_participant(now, from, data, out);
        } else if let Some(kind) = Kind::of_writer(data.writer) {
            let Some(remote) = self.index_of(from).and_then(|at| self.remotes[at].as_mut()) else {
                return;
            };
            let heard = &mut remote.heard[kind as usize];
            // In their order: those behind a loss are asked for once more.
            if heard.lacks(data.sequence) && heard.next() == Some(data.sequence) {
                heard.skip_to(data.sequence + 1);
                self.on_endpoint(kind, from, data);
            }
        } else {
            for (index, reader) in self.readers.iter_mut().enumerate() {
                // One that is for one reader, and not for all that match.
                let is_for =
                    data.reader == EntityId::UNKNOWN || data.reader == EntityId::reader(index);
                if is_for && !data.is_key {
                    reader.on_data(guid, data);
                }
            }
        }
    }

    fn on_participant(
        &mut self,
        now: Instant,
        from: GuidPrefix,
        data: &Data<'_>,
        out: &mut impl Outlet,
    ) {
        if data.is_key || ended(data) {
            self.forget(from);
            return;
        }
        let list = Parameters::of_payload(data.payload);
        let Some(announced) = list.and_then(|list| Announcement::read(from, list)) else {
            return;
        };
        let known = self.index_of(from);
        let Some(at) = known.or_else(|| self.remotes.iter().position(Option::is_none)) else {
            self.counts.refused = self.counts.refused.wrapping_add(1);
            return;
        };
        let remote = self.remotes[at].get_or_insert(Remote::new(&announced));
        remote.expires = now + announced.lease;
        (remote.metatraffic, remote.user) = (announced.metatraffic, announced.user);
        if known.is_none() {
            let remote = *remote;
            let to = Destination::At(remote.metatraffic);
            self.announce(to, Some(remote.prefix), out);
            for kind in Kind::ALL {
                self.send_endpoints(&remote, kind, SequenceSet::empty(1), true, out);
            }
        }
    }

    fn on_endpoint(&mut self, kind: Kind, from: GuidPrefix, data: &Data<'_>) {
        let Some(list) = Parameters::of_payload(data.payload) else {
            return;
        };
        let guid = list.find(pid::ENDPOINT_GUID).and_then(|guid| guid.guid());
        let Some(guid) = guid.filter(|guid| guid.prefix == from) else {
            return;
        };
        if data.is_key || ended(data) {
            self.remove(|one| one == guid);
            return;
        }
        match kind {
            Kind::Publications => {
                for (reader, ours) in self.readers.iter_mut().zip(self.inputs) {
                    match ours.judge(list, false) {
                        Fit::Stranger => {}
                        Fit::Incompatible => {
                            reader.counts.incompatible = reader.counts.incompatible.wrapping_add(1);
                        }
                        Fit::Fits(reliability, _) => reader.add(guid, reliability),
                    }
                }
            }
            Kind::Subscriptions => {
                for (writer, ours) in self.writers.iter_mut().zip(self.outputs) {
                    match ours.judge(list, true) {
                        Fit::Stranger => {}
                        Fit::Incompatible => {
                            writer.counts.incompatible = writer.counts.incompatible.wrapping_add(1);
                        }
                        Fit::Fits(reliability, durability) => {
                            writer.add(guid, (reliability, durability));
                        }
                    }
                }
            }
        }
    }

    fn forget(&mut self, prefix: GuidPrefix) {
        self.remove(|guid| guid.prefix == prefix);
        if let Some(at) = self.index_of(prefix) {
            self.remotes[at] = None;
        }
    }

    fn remove(&mut self, is_gone: impl Fn(Guid) -> bool) {
        self.writers.iter_mut().for_each(|one| one.remove(&is_gone));
        self.readers.iter_mut().for_each(|one| one.remove(&is_gone));
    }

    fn on_heartbeat(
        &mut self,
        now: Instant,
        from: GuidPrefix,
        heartbeat: &Heartbeat,
        out: &mut impl Outlet,
    ) {
        let Some(at) = self.index_of(from) else {
            return;
        };
        let Some(remote) = self.remotes[at].as_mut() else {
            return;
        };
        let (metatraffic, user) = (remote.metatraffic, remote.user);
        if let Some(kind) = Kind::of_writer(heartbeat.writer) {
            let heard = &mut remote.heard[kind as usize];
            if heard.on_heartbeat(heartbeat).is_some() {
                let set = heard.missing(heartbeat.last, 32, |_| false);
                if set.len > 0 || !heartbeat.is_final {
                    let to = (from, metatraffic);
                    self.acknowledge(to, (kind.reader(), kind.writer()), set, out);
                }
            }
            return;
        }
        let guid = Guid {
            prefix: from,
            entity: heartbeat.writer,
        };
        for index in 0..R {
            if let Some(set) = self.readers[index].on_heartbeat(now, guid, heartbeat) {
                let ends = (EntityId::reader(index), heartbeat.writer);
                self.acknowledge((from, user), ends, set, out);
            }
        }
    }

    fn acknowledge(
        &mut self,
        (to, at): (GuidPrefix, Locator),
        (reader, writer): (EntityId, EntityId),
        set: SequenceSet,
        out: &mut impl Outlet,
    ) {
        let acknack = AckNack {
            reader,
            writer,
            set,
            count: self.next_count(),
        };
        compose(self.prefix, Some(to), Destination::At(at), out, |message| {
            message.acknack(acknack);
        });
    }

    fn on_gap(&mut self, from: GuidPrefix, gap: &Gap) {
        if let Some(kind) = Kind::of_writer(gap.writer) {
            if let Some(remote) = self.index_of(from).and_then(|at| self.remotes[at].as_mut()) {
                remote.heard[kind as usize].on_gap(gap);
            }
            return;
        }
        let guid = Guid {
            prefix: from,
            entity: gap.writer,
        };
        self.readers
            .iter_mut()
            .for_each(|one| one.on_gap(guid, gap));
    }

    fn on_acknack(&mut self, from: GuidPrefix, acknack: &AckNack, out: &mut impl Outlet) {
        let Some(at) = self.index_of(from) else {
            return;
        };
        let Some(remote) = self.remotes[at].as_mut() else {
            return;
        };
        if let Some(kind) = Kind::of_writer(acknack.writer) {
            let last = &mut remote.acknack[kind as usize];
            let is_new = last.is_none_or(|last| (acknack.count.wrapping_sub(last) as i32) > 0);
            if is_new {
                *last = Some(acknack.count);
                let has = &mut remote.has[kind as usize];
                *has = acknack.set.base.max(*has);
                let remote = *remote;
                if acknack.set.len > 0 {
                    self.send_endpoints(&remote, kind, acknack.set, false, out);
                }
            }
            return;
        }
        let remote = *remote;
        let guid = Guid {
            prefix: from,
            entity: acknack.reader,
        };
        for index in 0..W {
            if EntityId::writer(index) == acknack.writer {
                if self.writers[index].on_acknack(guid, acknack) {
                    self.repair(index, &remote, acknack, out);
                }
            }
        }
    }

    /// Sends a reader again what it asks for, and tells what is dropped.
    fn repair(&mut self, index: usize, remote: &Remote, acknack: &AckNack, out: &mut impl Outlet) {
        let first = self.writers[index].first();
        if acknack.set.len == 0 {
            // It is new, and asks what there is.
            if acknack.set.base <= self.writers[index].last() {
                self.beat(index, remote, acknack.reader, out);
            }
            return;
        }
        if acknack.set.base < first {
            let gap = Gap {
                reader: acknack.reader,
                writer: acknack.writer,
                start: acknack.set.base,
                set: SequenceSet::empty(first),
            };
            let to = Destination::At(remote.user);
            compose(self.prefix, Some(remote.prefix), to, out, |message| {
                message.gap(gap);
            });
        }
        let last = acknack.set.iter().last();
        for number in acknack.set.iter() {
            if self.writers[index].sample(number).is_some() {
                let counts = &mut self.writers[index].counts;
                counts.repaired = counts.repaired.wrapping_add(1);
                // A heartbeat before the last one would have those behind it asked for again.
                let beats = Some(number) == last;
                self.send_sample(index, (number, beats), (*remote, acknack.reader), out);
            }
        }
    }

    fn send_sample(
        &mut self,
        index: usize,
        (number, beats): (u64, bool),
        (remote, reader): (Remote, EntityId),
        out: &mut impl Outlet,
    ) {
        let id = EntityId::writer(index);
        // With each sample, what the writer has: the loss of the sample before is seen at once.
        let heartbeat = self.writers[index].heartbeat(id, reader, true);
        let Some(sample) = self.writers[index].sample(number) else {
            return;
        };
        let to = DataTo {
            reader,
            writer: id,
            sequence: number,
        };
        let at = Destination::At(remote.user);
        compose(self.prefix, Some(remote.prefix), at, out, |message| {
            message.data(to, sample);
            if beats {
                message.heartbeat(heartbeat);
            }
        });
    }

    fn beat(&mut self, index: usize, remote: &Remote, reader: EntityId, out: &mut impl Outlet) {
        let heartbeat = self.writers[index].heartbeat(EntityId::writer(index), reader, false);
        let at = Destination::At(remote.user);
        compose(self.prefix, Some(remote.prefix), at, out, |message| {
            message.heartbeat(heartbeat);
        });
    }

    fn announce(&self, to: Destination, prefix: Option<GuidPrefix>, out: &mut impl Outlet) {
        compose(self.prefix, prefix, to, out, |message| {
            discovery::write_participant(message, self.prefix, self.at);
        });
    }

    /// Sends a participant those of our endpoints that it asks for, or all of them and a heartbeat.
    fn send_endpoints(
        &mut self,
        remote: &Remote,
        kind: Kind,
        asked: SequenceSet,
        all: bool,
        out: &mut impl Outlet,
    ) {
        let endpoints: &[Endpoint] = match kind {
            Kind::Publications => self.outputs,
            Kind::Subscriptions => self.inputs,
        };
        let at = Destination::At(remote.metatraffic);
        for (number, endpoint) in (1..).zip(endpoints) {
            if all || asked.iter().any(|asked| asked == number) {
                compose(self.prefix, Some(remote.prefix), at, out, |message| {
                    let place = (self.prefix, kind, number);
                    discovery::write_endpoint(message, place, endpoint);
                });
            }
        }
        let (last, count) = (endpoints.len() as u64, self.next_count());
        compose(self.prefix, Some(remote.prefix), at, out, |message| {
            discovery::write_heartbeat(message, kind, last, count);
        });
    }

    /// Reminds who has not said that it has everything.
    fn remind(&mut self, out: &mut impl Outlet) {
        for index in 0..REMOTES {
            let Some(remote) = self.remotes[index] else {
                continue;
            };
            for (kind, last) in Kind::ALL.into_iter().zip([W, R]) {
                if remote.has[kind as usize] <= last as u64 {
                    self.send_endpoints(&remote, kind, SequenceSet::empty(1), false, out);
                }
            }
            for writer in 0..W {
                let mut readers = self.writers[writer].readers.iter().flatten();
                let is_here = readers.any(|reader| reader.guid.prefix == remote.prefix);
                if is_here && self.writers[writer].is_awaited() {
                    self.beat(writer, &remote, EntityId::UNKNOWN, out);
                }
            }
        }
    }
}

/// Composes a message on the stack and sends it.
fn compose(
    from: GuidPrefix,
    to: Option<GuidPrefix>,
    at: Destination,
    out: &mut impl Outlet,
    write: impl FnOnce(&mut Message<'_>),
) {
    let mut room = ROOM;
    let mut message = Message::new(&mut room, from, to);
    write(&mut message);
    if let Some(message) = message.finish() {
        out.send(at, message);
    }
}

/// Returns whether the sample says that what it is about has ended.
fn ended(data: &Data<'_>) -> bool {
    let inline = Parameters::new(crate::wire::Cursor::new(data.inline, data.is_little));
    // The status is big-endian in each message: the last byte holds the flags.
    let status = inline
        .find(pid::STATUS)
        .and_then(|mut status| status.value.array());
    status.is_some_and(|[_, _, _, flags]: [u8; 4]| flags & 3 != 0)
}
