//! The participant: it composes discovery, writers and readers, and does no input or output.

use crate::discovery::{self, Kind, Peer, Remote};
use crate::endpoints::system_of;
use crate::reader::{Reader, Sample, Stream, WRITERS};
use crate::wire::{AckNack, Data, DataTo, EntityId, Gap, Guid, GuidPrefix, Heartbeat, Locator};
use crate::wire::{Message, Parameter, Parameters, Sequence, SequenceSet, Submessage};
use crate::wire::{Submessages, pid};
use crate::writer::{WriteError, Writer};
use crate::{Counts, Endpoint};
use tandem_board::{Duration, Instant};

/// Period of the heartbeat of a writer whose readers have not said that they have everything. D-4
pub const HEARTBEAT_PERIOD: Duration = Duration::from_ms(250);
/// Period of the announcement of the participant.
const ANNOUNCES_EVERY: Duration = Duration::from_ms(1_000);
/// After this time, a participant that has nothing for this one gives way to another one.
const SETTLES: Duration = Duration::from_ms(500);
/// With each announcement of this number, all are asked for their endpoints once more: this finds
/// what was lost to a damaged message, or to a link that failed in one direction.
const ASKS_WITH: u8 = 8;
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
    at: Locator,
    outputs: &'static [Endpoint; W],
    inputs: &'static [Endpoint; R],
    writers: [Writer<DEPTH, OUT>; W],
    readers: [Reader<DEPTH, IN>; R],
    remotes: [Option<Remote>; REMOTES],
    /// A count for all heartbeats of discovery, and for all ACKNACKs: each only has to rise.
    count: u32,
    announced: Option<Instant>,
    /// How many announcements were sent since all were asked.
    announcements: u8,
    beat: Instant,
    foreign: u32,
    refused: u32,
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
            announcements: 0,
            beat: Instant::ORIGIN,
            foreign: 0,
            refused: 0,
            waits: false,
            is_free: false,
        }
    }

    /// Returns how many datagrams were no message of RTPS.
    pub const fn foreign(&self) -> u32 {
        self.foreign
    }

    /// Returns how many announcements of participants found no place.
    pub const fn refused(&self) -> u32 {
        self.refused
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
    ///
    /// [`WriteError`] says why it was not published.
    pub fn write(
        &mut self,
        writer: usize,
        sample: &[u8],
        out: &mut impl Outlet,
    ) -> Result<(), WriteError> {
        let number = self.writers[writer].push(sample)?;
        for at in 0..REMOTES {
            if let Some(peer) = self.served(at, writer) {
                self.send_sample(writer, (number, true), (peer, EntityId::UNKNOWN), out);
            }
        }
        Ok(())
    }

    /// Takes the next sample of a reader. Those of one writer are in their order.
    pub fn take(&mut self, reader: usize) -> Option<Sample<IN>> {
        self.readers[reader].take()
    }

    /// Does what is due. Returns when it wants to be called again, at the latest.
    pub fn poll(&mut self, now: Instant, out: &mut impl Outlet) -> Instant {
        for at in 0..REMOTES {
            if let Some(remote) = &self.remotes[at]
                && now >= remote.expires
            {
                self.forget(remote.prefix);
            }
        }
        let is_due = |last: Instant| now.since(last) >= ANNOUNCES_EVERY;
        if self.announced.is_none_or(is_due) {
            self.announced = Some(now);
            self.announcements += 1;
            self.announce(None, out);
        }
        if now.since(self.beat) >= HEARTBEAT_PERIOD {
            self.beat = now;
            self.remind(out);
        }
        let frees = core::mem::take(&mut self.is_free) && core::mem::take(&mut self.waits);
        if frees || self.announcements >= ASKS_WITH {
            self.announcements = 0;
            self.ask_all(out);
        }
        self.ask_again(now, out);
        let announces = self.announced.unwrap_or(now) + ANNOUNCES_EVERY;
        announces.min(self.beat + HEARTBEAT_PERIOD)
    }

    /// Says to all that it ends.
    pub fn leave(&mut self, out: &mut impl Outlet) {
        let guid = self.prefix.guid(EntityId::PARTICIPANT);
        post(self.prefix, None, out, &mut |message| {
            message.ends(discovery::OF_PARTICIPANTS, guid);
        });
    }

    /// Hears a datagram.
    pub fn hear(&mut self, now: Instant, datagram: &[u8], out: &mut impl Outlet) {
        let Some((from, parts)) = Submessages::of(datagram) else {
            self.foreign = self.foreign.wrapping_add(1);
            return;
        };
        if from == self.prefix {
            return;
        }
        if let Some(remote) = self.remote(from) {
            remote.on_life(now);
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

    fn remote(&mut self, prefix: GuidPrefix) -> Option<&mut Remote> {
        let mut remotes = self.remotes.iter_mut().flatten();
        remotes.find(|remote| remote.prefix == prefix)
    }

    /// Returns where the participant in this place hears, if the writer serves a reader of it.
    fn served(&self, at: usize, writer: usize) -> Option<Peer> {
        let remote = self.remotes.get(at)?.as_ref()?;
        let mut readers = self.writers.get(writer)?.readers.iter().flatten();
        let is_served = readers.any(|reader| reader.guid.prefix == remote.prefix);
        is_served.then(|| remote.user())
    }

    fn on_data(&mut self, now: Instant, from: GuidPrefix, data: &Data<'_>, out: &mut impl Outlet) {
        if data.writer == EntityId::SPDP_WRITER {
            self.on_participant(now, from, data, out);
        } else if let Some(kind) = Kind::of_writer(data.writer) {
            let heard = self
                .remote(from)
                .map(|remote| &mut remote.heard[kind as usize]);
            // In their order: those behind a loss are asked for once more.
            if let Some(heard) = heard
                && heard.lacks(data.sequence)
                && heard.next() == data.sequence
            {
                heard.skip_to(data.sequence + 1);
                self.on_endpoint(kind, from, data);
            }
        } else if !data.is_key {
            for (index, reader) in self.readers.iter_mut().enumerate() {
                if [EntityId::UNKNOWN, EntityId::reader(index)].contains(&data.reader) {
                    reader.on_data(from.guid(data.writer), data);
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
        if data.ends() {
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
        let place = free.or_else(|| self.of_no_use(now));
        let Some(place) = place.and_then(|place| self.remotes.get_mut(place)) else {
            self.refused = self.refused.wrapping_add(1);
            return;
        };
        *place = Some(remote);
        let peer = remote.discovery();
        self.announce(Some(peer), out);
        for kind in Kind::ALL {
            self.send_endpoints(peer, kind, SequenceSet::FIRST, out);
        }
    }

    /// Returns the place of a participant without an endpoint that fits.
    fn of_no_use(&self, now: Instant) -> Option<usize> {
        let is_used = |prefix: GuidPrefix| {
            let mut readers = self
                .writers
                .iter()
                .flat_map(|it| it.readers.iter().flatten());
            let mut writers = self.readers.iter().flat_map(Reader::writers);
            readers.any(|it| it.guid.prefix == prefix) || writers.any(|it| it.prefix == prefix)
        };
        self.remotes.iter().position(|place| {
            place
                .as_ref()
                .is_some_and(|remote| now.since(remote.found) >= SETTLES && !is_used(remote.prefix))
        })
    }

    fn on_endpoint(&mut self, kind: Kind, from: GuidPrefix, data: &Data<'_>) {
        let Some(list) = Parameters::of_payload(data.payload) else {
            return;
        };
        let guid = list.find(pid::ENDPOINT_GUID).and_then(Parameter::guid);
        let Some(guid) = guid.filter(|guid| guid.prefix == from) else {
            return;
        };
        if data.ends() {
            self.remove(from, Some(guid.entity));
            return;
        }
        match kind {
            Kind::Publications => {
                for (reader, ours) in self.readers.iter_mut().zip(self.inputs) {
                    self.waits |= !reader.on_writer(guid, ours.judge(list, false));
                }
            }
            Kind::Subscriptions => {
                for (writer, ours) in self.writers.iter_mut().zip(self.outputs) {
                    self.waits |= !writer.on_reader(guid, ours.judge(list, true));
                }
            }
        }
    }

    fn forget(&mut self, prefix: GuidPrefix) {
        self.remove(prefix, None);
        let is_gone = |remote: &mut Remote| remote.prefix == prefix;
        for place in &mut self.remotes {
            let _gone = place.take_if(is_gone);
        }
    }

    fn remove(&mut self, prefix: GuidPrefix, entity: Option<EntityId>) {
        let writers = self.writers.iter_mut();
        writers.for_each(|one| one.remove(prefix, entity));
        let readers = self.readers.iter_mut();
        readers.for_each(|one| one.remove(prefix, entity));
        self.is_free = true;
    }

    fn on_heartbeat(
        &mut self,
        now: Instant,
        from: GuidPrefix,
        heartbeat: &Heartbeat,
        out: &mut impl Outlet,
    ) {
        let Some(remote) = self.remote(from) else {
            return;
        };
        let (user, discovery) = (remote.user(), remote.discovery());
        if let Some(kind) = Kind::of_writer(heartbeat.writer) {
            let heard = &mut remote.heard[kind as usize];
            if heard.on_heartbeat(heartbeat).is_some() {
                let set = heard.missing(heartbeat.last, 32, |_| false);
                if set.len > 0 || !heartbeat.is_final {
                    self.acknowledge(discovery, (kind.reader(), kind.writer()), set, out);
                }
            }
            return;
        }
        let guid = from.guid(heartbeat.writer);
        for index in 0..R {
            if let Some(set) = self.readers[index].on_heartbeat(now, guid, heartbeat) {
                self.acknowledge(user, (EntityId::reader(index), guid.entity), set, out);
            }
        }
    }

    /// Asks all for their endpoints once more: one that was refused a place, or was lost, may get
    /// a place now.
    fn ask_all(&mut self, out: &mut impl Outlet) {
        for at in 0..REMOTES {
            let Some(remote) = self.remotes.get_mut(at).and_then(Option::as_mut) else {
                continue;
            };
            remote.heard = [Stream::new(true); 2];
            let peer = remote.discovery();
            for kind in Kind::ALL {
                let of = (kind.reader(), kind.writer());
                self.acknowledge(peer, of, SequenceSet::FIRST, out);
            }
        }
    }

    fn ask_again(&mut self, now: Instant, out: &mut impl Outlet) {
        for index in 0..R * WRITERS {
            let (reader, writer) = (index / WRITERS, index % WRITERS);
            if let Some((guid, set)) = self.readers[reader].asks_again(now, writer)
                && let Some(remote) = self.remote(guid.prefix)
            {
                let user = remote.user();
                self.acknowledge(user, (EntityId::reader(reader), guid.entity), set, out);
            }
        }
    }

    #[inline(never)]
    fn acknowledge(
        &mut self,
        to: Peer,
        (reader, writer): (EntityId, EntityId),
        set: SequenceSet,
        out: &mut impl Outlet,
    ) {
        self.count = self.count.wrapping_add(1);
        let acknack = AckNack {
            reader,
            writer,
            set,
            count: self.count,
        };
        post(self.prefix, Some(to), out, &mut |message| {
            message.acknack(acknack);
        });
    }

    fn on_gap(&mut self, from: GuidPrefix, gap: &Gap) {
        if let Some(kind) = Kind::of_writer(gap.writer) {
            if let Some(remote) = self.remote(from) {
                remote.heard[kind as usize].on_gap(gap);
            }
            return;
        }
        let guid = from.guid(gap.writer);
        self.readers.iter_mut().for_each(|it| it.on_gap(guid, gap));
    }

    fn on_acknack(&mut self, from: GuidPrefix, acknack: &AckNack, out: &mut impl Outlet) {
        let Some(remote) = self.remote(from) else {
            return;
        };
        if let Some(kind) = Kind::of_writer(acknack.writer) {
            if remote.on_acknack(kind, acknack, [W, R][kind as usize]) {
                let peer = remote.discovery();
                self.send_endpoints(peer, kind, acknack.set, out);
            }
            return;
        }
        let (peer, guid) = (remote.user(), from.guid(acknack.reader));
        for index in 0..W {
            if EntityId::writer(index) == acknack.writer
                && let Some(first) = self.writers[index].on_acknack(guid, acknack)
            {
                self.repair(index, (peer, first), acknack, out);
            }
        }
    }

    /// Sends a reader again what it asks for, and tells what is dropped, or is older than the first
    /// one that it may get: a volatile reader of another vendor asks for history too.
    fn repair(
        &mut self,
        index: usize,
        (to, first): (Peer, Sequence),
        acknack: &AckNack,
        out: &mut impl Outlet,
    ) {
        let (reader, writer, set) = (acknack.reader, acknack.writer, acknack.set);
        let last = self.writers[index].last();
        if set.len == 0 && set.base <= last {
            // It is new, and asks what there is.
            self.send_heartbeat(index, (to, reader), out);
        }
        if set.len > 0 && set.base < first {
            let gap = Gap {
                reader,
                writer,
                start: set.base,
                set: SequenceSet::empty(first),
            };
            post(self.prefix, Some(to), out, &mut |message| message.gap(gap));
        }
        let last = set.last();
        for number in set.filter(|number| *number >= first) {
            // A heartbeat before the last one would have those behind it asked for again.
            let beats = Some(number) == last;
            if self.send_sample(index, (number, beats), (to, reader), out) {
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
        (peer, reader): (Peer, EntityId),
        out: &mut impl Outlet,
    ) -> bool {
        let id = EntityId::writer(index);
        let heartbeat = self.writers[index].heartbeat(id, reader, true);
        let Some(sample) = self.writers[index].sample(number) else {
            return false;
        };
        let to = DataTo {
            reader,
            writer: id,
            sequence: number,
        };
        post(self.prefix, Some(peer), out, &mut |message| {
            message.data(to, sample);
            if beats {
                message.heartbeat(heartbeat);
            }
        });
        true
    }

    fn send_heartbeat(
        &mut self,
        index: usize,
        (peer, reader): (Peer, EntityId),
        out: &mut impl Outlet,
    ) {
        let heartbeat = self.writers[index].heartbeat(EntityId::writer(index), reader, false);
        post(self.prefix, Some(peer), out, &mut |message| {
            message.heartbeat(heartbeat);
        });
    }

    fn announce(&self, to: Option<Peer>, out: &mut impl Outlet) {
        post(self.prefix, to, out, &mut |message| {
            discovery::write_participant(message, self.prefix, self.at);
        });
    }

    /// Sends a participant those of our endpoints that it asks for, and how many there are.
    fn send_endpoints(&mut self, to: Peer, kind: Kind, asks: SequenceSet, out: &mut impl Outlet) {
        let endpoints: &[Endpoint] = match kind {
            Kind::Publications => self.outputs,
            Kind::Subscriptions => self.inputs,
        };
        for number in asks {
            if let Some(endpoint) = endpoints.get(number as usize - 1) {
                post(self.prefix, Some(to), out, &mut |message| {
                    discovery::write_endpoint(message, (self.prefix, kind, number), endpoint);
                });
            }
        }
        self.count = self.count.wrapping_add(1);
        let (last, count) = (endpoints.len() as Sequence, self.count);
        post(self.prefix, Some(to), out, &mut |message| {
            discovery::write_heartbeat(message, kind, last, count);
        });
    }

    /// Reminds who has not said that it has everything.
    fn remind(&mut self, out: &mut impl Outlet) {
        for at in 0..REMOTES {
            let Some(remote) = self.remotes[at] else {
                continue;
            };
            for (kind, last) in Kind::ALL.into_iter().zip([W, R]) {
                if remote.has[kind as usize] <= last as Sequence {
                    self.send_endpoints(remote.discovery(), kind, SequenceSet::empty(1), out);
                }
            }
            for writer in 0..W {
                if self.writers[writer].is_awaited()
                    && let Some(peer) = self.served(at, writer)
                {
                    self.send_heartbeat(writer, (peer, EntityId::UNKNOWN), out);
                }
            }
        }
    }
}

/// Composes a message on the stack and sends it to one participant, or to all.
#[inline(never)]
fn post(
    from: GuidPrefix,
    to: Option<Peer>,
    out: &mut impl Outlet,
    write: &mut dyn FnMut(&mut Message),
) {
    let mut message = Message::new(from, to.map(|peer| peer.prefix));
    write(&mut message);
    let to = to.map_or(Destination::Everyone, |peer| Destination::At(peer.at));
    if let Some(message) = message.finish() {
        out.send(to, message);
    }
}
