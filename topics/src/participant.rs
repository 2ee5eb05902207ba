//! The participant: it composes discovery, writers and readers, and does no input or output.

use crate::discovery::{self, Kind, Remote};
use crate::endpoints::system_of;
use crate::qos::{Counts, Endpoint};
use crate::reader::{Reader, Sample, Stream, WRITERS};
use crate::wire::{Data, Ends, EntityId, Guid, GuidPrefix, Heartbeat, Message};
use crate::wire::{Outlet, Parameters, Part, Peer, Sequence, SequenceSet, Submessage};
use crate::wire::{pid, submessages};
use crate::writer::{WriteError, Writer};
use tandem_board::{Duration, Instant, NetworkAddress};

/// Period of the heartbeat of a writer whose readers have not said that they have everything. D-4
pub const HEARTBEAT_PERIOD: Duration = Duration::from_ms(250);
/// Period of the announcement of the participant.
const ANNOUNCES_EVERY: Duration = Duration::from_ms(1_000);
/// After this time, a participant that has nothing for this one gives way to another one.
const SETTLES: Duration = Duration::from_ms(500);
/// With each eighth announcement all are asked for their endpoints once more. This finds what was
/// lost to a damaged message, or to a link that failed in one direction.
const ASKS_WITH: u8 = 8;
/// How many other participants it knows.
const REMOTES: usize = 4;

/// A participant with `W` writers and `R` readers, of which each keeps up to `DEPTH` samples of up
/// to `OUT` bytes (writers) and `IN` bytes (readers); at most 255. An index of a writer or a reader
/// beyond `W` or `R` panics.
#[derive(Clone, Debug)]
pub struct Participant<
    const W: usize,
    const R: usize,
    const DEPTH: usize,
    const OUT: usize,
    const IN: usize,
> {
    prefix: GuidPrefix,
    at: NetworkAddress,
    outputs: &'static [Endpoint; W],
    inputs: &'static [Endpoint; R],
    writers: [Writer<DEPTH, OUT>; W],
    readers: [Reader<DEPTH, IN>; R],
    remotes: [Option<Remote>; REMOTES],
    /// A count for all heartbeats of discovery, and for all ACKNACKs: each only has to rise.
    count: u32,
    /// When the next announcement and the next heartbeats are due.
    announces: Instant,
    beats: Instant,
    /// How many announcements were sent since all were asked.
    announcements: u8,
    /// The time of the last call.
    now: Instant,
    /// How many datagrams were no message of RTPS.
    pub foreign: u32,
    /// How many announcements of participants found no place.
    pub refused: u32,
    /// An endpoint of others was refused a place, and a place is free again.
    waits: bool,
    is_free: bool,
}

impl<const W: usize, const R: usize, const DEPTH: usize, const OUT: usize, const IN: usize>
    Participant<W, R, DEPTH, OUT, IN>
{
    /// Creates a participant. `prefix` names it and must be new at each start; `at` is where it
    /// hears.
    pub fn new(
        prefix: GuidPrefix,
        at: NetworkAddress,
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
            announces: Instant::ORIGIN,
            beats: Instant::ORIGIN,
            announcements: 0,
            now: Instant::ORIGIN,
            foreign: 0,
            refused: 0,
            waits: false,
            is_free: false,
        }
    }

    /// Returns the counts of a writer.
    pub fn writer_counts(&self, writer: usize) -> Counts {
        self.writers[writer].counts
    }

    /// Returns the counts of a reader.
    pub fn reader_counts(&self, reader: usize) -> Counts {
        self.readers[reader].counts
    }

    /// Returns how many readers of others a writer serves.
    pub fn readers_of(&self, writer: usize) -> usize {
        self.writers[writer].readers.iter().flatten().count()
    }

    /// Returns the writers of others that a reader hears.
    pub fn writers_of(&self, reader: usize) -> impl Iterator<Item = Guid> {
        self.readers[reader].writers()
    }

    /// Publishes a sample: representation and body.
    ///
    /// # Errors
    /// [`WriteError`] says why it was not published.
    pub fn write(
        &mut self,
        writer: usize,
        sample: &[u8],
        out: &mut impl Outlet,
    ) -> Result<(), WriteError> {
        let number = self.writers[writer].push(sample)?;
        for reader in self.writers[writer].readers.into_iter().flatten() {
            self.send_sample(writer, (number, true), reader.guid, out);
        }
        Ok(())
    }

    /// Takes the next sample of a reader. Those of one writer are in their order.
    pub fn take(&mut self, reader: usize) -> Option<Sample<IN>> {
        self.readers[reader].take()
    }

    /// Does what is due. Returns when it wants to be called again, at the latest.
    pub fn poll(&mut self, now: Instant, out: &mut impl Outlet) -> Instant {
        self.now = now;
        for remote in self.remotes.into_iter().flatten() {
            if now >= remote.expires {
                self.forget(remote.prefix);
            }
        }
        if now >= self.announces {
            self.announces = now + ANNOUNCES_EVERY;
            self.announcements += 1;
            self.announce(None, out);
        }
        if now >= self.beats {
            self.beats = now + HEARTBEAT_PERIOD;
            self.remind(out);
        }
        let frees = core::mem::take(&mut self.is_free) && core::mem::take(&mut self.waits);
        if frees || self.announcements >= ASKS_WITH {
            self.announcements = 0;
            self.ask_all(out);
        }
        self.ask_again(out);
        self.announces.min(self.beats)
    }

    /// Says to all that it ends.
    pub fn leave(&mut self, out: &mut impl Outlet) {
        let mut message = Message::new(self.prefix, None);
        message.end_of_participant().send(out);
    }

    /// Hears a datagram.
    pub fn hear(&mut self, now: Instant, datagram: &[u8], out: &mut impl Outlet) {
        let Some((from, parts)) = submessages(datagram) else {
            self.foreign = self.foreign.wrapping_add(1);
            return;
        };
        if from == self.prefix {
            return;
        }
        self.now = now;
        if let Some(remote) = self.remote(from) {
            remote.expires = now + remote.lease;
        }
        let mut is_ours = true;
        for part in parts {
            match part {
                Submessage::Destination(to) => {
                    is_ours = to == self.prefix || to == GuidPrefix::default();
                }
                Submessage::Between(ends, part) if is_ours => self.on_part(from, ends, &part, out),
                Submessage::Between(..) | Submessage::Other => {}
            }
        }
    }

    fn remote(&mut self, prefix: GuidPrefix) -> Option<&mut Remote> {
        let mut remotes = self.remotes.iter_mut().flatten();
        remotes.find(|remote| remote.prefix == prefix)
    }

    /// Hears what a participant says of itself and of its endpoints, and what it knows of ours.
    fn on_part(&mut self, from: GuidPrefix, ends: Ends, part: &Part<'_>, out: &mut impl Outlet) {
        if ends.writer == EntityId::SPDP_WRITER {
            if let Part::Data(data) = part {
                self.on_participant(from, data, out);
            }
            return;
        }
        let Some(remote) = self.remote(from) else {
            return;
        };
        let peer = remote.discovery;
        let mut kinds = Kind::ALL.into_iter();
        let Some(kind) = kinds.find(|kind| kind.ends().writer == ends.writer) else {
            let user = remote.user;
            self.on_user(user, ends, part, out);
            return;
        };
        let heard = &mut remote.heard[kind as usize];
        match *part {
            Part::Data(data) => {
                // In their order: those behind a loss are asked for once more.
                if heard.lacks(data.sequence) && heard.next == data.sequence {
                    heard.skip_to(data.sequence + 1);
                    self.on_endpoint(kind, from, &data);
                }
            }
            Part::Heartbeat(heartbeat) => {
                if heard.on_heartbeat(&heartbeat).is_some() {
                    let set = heard.missing(heartbeat.last, 32);
                    if set.bits > 0 || !heartbeat.is_final {
                        self.acknowledge(peer, kind.ends(), set, out);
                    }
                }
            }
            Part::Gap(start, set) => {
                heard.on_gap(start, set);
            }
            Part::AckNack(set, count) => {
                if remote.asks(kind, set, count, [W, R][kind as usize]) {
                    self.send_endpoints(peer, kind, set, out);
                }
            }
        }
    }

    /// Hears a sample of a writer, what it has, or what a reader has.
    fn on_user(&mut self, peer: Peer, ends: Ends, part: &Part<'_>, out: &mut impl Outlet) {
        let writer = peer.0.guid(ends.writer);
        match *part {
            Part::Data(data) => {
                for (index, ours) in self.readers.iter_mut().enumerate() {
                    let is_for = [EntityId::UNKNOWN, EntityId::reader(index)];
                    if data.is_sample && is_for.contains(&ends.reader) {
                        ours.on_data(writer, &data);
                    }
                }
            }
            Part::Heartbeat(heartbeat) => {
                for index in 0..R {
                    let ours = &mut self.readers[index];
                    if let Some(set) = ours.on_heartbeat(self.now, writer, &heartbeat) {
                        let reader = EntityId::reader(index);
                        self.acknowledge(peer, Ends { reader, ..ends }, set, out);
                    }
                }
            }
            Part::Gap(start, set) => {
                for ours in &mut self.readers {
                    ours.on_gap(writer, start, set);
                }
            }
            Part::AckNack(set, count) => self.serve(peer, ends, set, count, out),
        }
    }

    fn on_participant(&mut self, from: GuidPrefix, data: &Data<'_>, out: &mut impl Outlet) {
        let now = self.now;
        if data.ends {
            self.forget(from);
            return;
        }
        let Some(list) = Parameters::of_payload(data.payload) else {
            return;
        };
        if let Some(known) = self.remote(from) {
            known.on_announcement(now, list);
            return;
        }
        // A system that starts again replaces what it was before.
        let was_before =
            |one: &&Remote| system_of(from).is_some() && system_of(one.prefix) == system_of(from);
        if let Some(before) = self.remotes.iter().flatten().find(was_before) {
            self.forget(before.prefix);
        }
        let mut remote = Remote::new(from, now);
        if !remote.on_announcement(now, list) {
            return;
        }
        let free = self.remotes.iter().position(Option::is_none);
        let place = free.or_else(|| self.of_no_use());
        let Some(place) = place.and_then(|place| self.remotes.get_mut(place)) else {
            self.refused = self.refused.wrapping_add(1);
            return;
        };
        *place = Some(remote);
        let peer = remote.discovery;
        self.announce(Some(peer), out);
        for kind in Kind::ALL {
            self.send_endpoints(peer, kind, SequenceSet::FIRST, out);
        }
    }

    /// Returns the place of a participant without an endpoint that fits.
    fn of_no_use(&self) -> Option<usize> {
        let is_used = |prefix: GuidPrefix| {
            let ours = self.writers.iter();
            let mut readers = ours.flat_map(|it| it.readers.iter().flatten());
            let mut writers = self.readers.iter().flat_map(Reader::writers);
            readers.any(|it| it.guid.prefix == prefix) || writers.any(|it| it.prefix == prefix)
        };
        let is_idle = |one: &Remote| self.now.since(one.found) >= SETTLES && !is_used(one.prefix);
        let mut remotes = self.remotes.iter();
        remotes.position(|place| place.as_ref().is_some_and(is_idle))
    }

    fn on_endpoint(&mut self, kind: Kind, from: GuidPrefix, data: &Data<'_>) {
        let list = Parameters::of_payload(data.payload);
        let guid = list.and_then(|list| list.find(pid::ENDPOINT_GUID)?.guid());
        let (Some(list), Some(guid)) = (list, guid.filter(|guid| guid.prefix == from)) else {
            return;
        };
        if data.ends {
            self.remove(from, Some(guid.entity));
            return;
        }
        match kind {
            Kind::Publications => {
                for (reader, ours) in self.readers.iter_mut().zip(self.inputs) {
                    if let Some(fit) = ours.fit(list, false, &mut reader.counts) {
                        self.waits |= !reader.on_writer(guid, fit);
                    }
                }
            }
            Kind::Subscriptions => {
                for (writer, ours) in self.writers.iter_mut().zip(self.outputs) {
                    if let Some(fit) = ours.fit(list, true, &mut writer.counts) {
                        self.waits |= !writer.on_reader(guid, fit);
                    }
                }
            }
        }
    }

    fn forget(&mut self, prefix: GuidPrefix) {
        self.remove(prefix, None);
        for place in &mut self.remotes {
            let _gone = place.take_if(|remote| remote.prefix == prefix);
        }
    }

    fn remove(&mut self, prefix: GuidPrefix, entity: Option<EntityId>) {
        let writers = self.writers.iter_mut();
        writers.for_each(|one| one.remove(prefix, entity));
        let readers = self.readers.iter_mut();
        readers.for_each(|one| one.remove(prefix, entity));
        self.is_free = true;
    }

    /// Asks all for their endpoints once more: one that was refused or lost may get a place now.
    fn ask_all(&mut self, out: &mut impl Outlet) {
        for remote in self.remotes.iter_mut().flatten() {
            remote.heard = [Stream::new(true); 2];
        }
        for remote in self.remotes.into_iter().flatten() {
            for kind in Kind::ALL {
                self.acknowledge(remote.discovery, kind.ends(), SequenceSet::FIRST, out);
            }
        }
    }

    fn ask_again(&mut self, out: &mut impl Outlet) {
        for index in 0..R * WRITERS {
            let ours = index / WRITERS;
            if let Some((guid, set)) = self.readers[ours].asks_again(self.now, index % WRITERS)
                && let Some(remote) = self.remote(guid.prefix)
            {
                let (user, reader, writer) = (remote.user, EntityId::reader(ours), guid.entity);
                self.acknowledge(user, Ends { reader, writer }, set, out);
            }
        }
    }

    fn acknowledge(&mut self, to: Peer, ends: Ends, set: SequenceSet, out: &mut impl Outlet) {
        self.count = self.count.wrapping_add(1);
        self.to(to).acknack(ends, set, self.count).send(out);
    }

    /// Sends a reader again what it asks for, and tells what is dropped, or is older than the first
    /// one that it may get: a volatile reader of another vendor asks for history too.
    fn serve(&mut self, to: Peer, ends: Ends, set: SequenceSet, count: u32, out: &mut impl Outlet) {
        let Some(index) = (0..W).find(|index| EntityId::writer(*index) == ends.writer) else {
            return;
        };
        let reader = to.0.guid(ends.reader);
        let Some(first) = self.writers[index].on_ack(reader, set, count) else {
            return;
        };
        if set.bits == 0 && set.base <= self.writers[index].last {
            // It is new, and asks what there is.
            self.send_heartbeat(index, reader, out);
        }
        if set.bits > 0 && set.base < first {
            self.to(to).gap(ends, set.base, first).send(out);
        }
        let last = set.numbers().last();
        for number in set.numbers().filter(|number| *number >= first) {
            // A heartbeat before the last one would have those behind it asked for again.
            let beats = Some(number) == last;
            if self.send_sample(index, (number, beats), reader, out) {
                let counts = &mut self.writers[index].counts;
                counts.repaired = counts.repaired.wrapping_add(1);
            }
        }
    }

    /// Sends a sample, if the writer has it, with a heartbeat: so the loss of the sample before is
    /// seen at once. Returns whether it has it.
    fn send_sample(
        &mut self,
        index: usize,
        (number, beats): (Sequence, bool),
        to: Guid,
        out: &mut impl Outlet,
    ) -> bool {
        let heartbeat = self.writers[index].heartbeat(true);
        let (ends, mut message) = self.begin(index, to);
        let Some(sample) = self.writers[index].sample(number) else {
            return false;
        };
        message.data(ends, number, sample);
        if beats {
            message.heartbeat(ends, heartbeat);
        }
        message.send(out);
        true
    }

    fn send_heartbeat(&mut self, index: usize, to: Guid, out: &mut impl Outlet) {
        let heartbeat = self.writers[index].heartbeat(false);
        let (ends, mut message) = self.begin(index, to);
        message.heartbeat(ends, heartbeat).send(out);
    }

    /// Begins a message of a writer to a reader of others.
    fn begin(&mut self, index: usize, to: Guid) -> (Ends, Message) {
        let (reader, writer) = (to.entity, EntityId::writer(index));
        let user = self.remote(to.prefix).map(|remote| remote.user);
        (Ends { reader, writer }, Message::new(self.prefix, user))
    }

    fn to(&self, to: Peer) -> Message {
        Message::new(self.prefix, Some(to))
    }

    fn announce(&self, to: Option<Peer>, out: &mut impl Outlet) {
        let mut message = Message::new(self.prefix, to);
        discovery::write_participant(&mut message, self.at).send(out);
    }

    /// Sends a participant those of our endpoints that it asks for, and how many there are.
    fn send_endpoints(&mut self, to: Peer, kind: Kind, asks: SequenceSet, out: &mut impl Outlet) {
        let endpoints: &[Endpoint] = match kind {
            Kind::Publications => self.outputs,
            Kind::Subscriptions => self.inputs,
        };
        for number in asks.numbers() {
            if let Some(endpoint) = endpoints.get(number as usize - 1) {
                let mut message = self.to(to);
                discovery::write_endpoint(&mut message, kind, number, endpoint);
                message.send(out);
            }
        }
        self.count = self.count.wrapping_add(1);
        let heartbeat = Heartbeat {
            first: 1,
            last: endpoints.len() as Sequence,
            count: self.count,
            is_final: false,
        };
        self.to(to).heartbeat(kind.ends(), heartbeat).send(out);
    }

    /// Reminds who has not said that it has everything.
    fn remind(&mut self, out: &mut impl Outlet) {
        let none = SequenceSet { base: 1, bits: 0 };
        for remote in self.remotes.into_iter().flatten() {
            for (kind, last) in Kind::ALL.into_iter().zip([W, R]) {
                if remote.has[kind as usize] <= last as Sequence {
                    self.send_endpoints(remote.discovery, kind, none, out);
                }
            }
        }
        for writer in 0..W {
            for reader in self.writers[writer].readers.into_iter().flatten() {
                if reader.is_reliable && reader.needs <= self.writers[writer].last {
                    self.send_heartbeat(writer, reader.guid, out);
                }
            }
        }
    }
}
