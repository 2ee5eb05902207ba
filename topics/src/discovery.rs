//! Discovery: the announcements of participants (SPDP) and of their endpoints (SEDP). (RTPS 8.5)

use crate::Endpoint;
use crate::reader::Stream;
use crate::wire::{AckNack, DataTo, EntityId, GuidPrefix, Heartbeat, Locator, Message};
use crate::wire::{Parameters, Sequence, Submessage, Submessages, has_risen, pid};
use tandem_board::{Duration, Instant};

/// A participant that announces nothing for the time that it stated is taken for dead; one that
/// states no time, after this one.
const DEFAULT_LEASE_SECONDS: u32 = 100;
/// The time that this participant states.
const LEASE_SECONDS: u32 = 10;
/// Endpoints of discovery that this participant has: announcer and detector of participants, of
/// publications and of subscriptions.
const BUILTIN_ENDPOINTS: u32 = 0x3F;
/// The longest lease that is believed: for so long, one that is gone may hold a place.
const LONGEST_LEASE_SECONDS: u32 = 100;

/// The publications or the subscriptions of a participant: each is a topic of discovery.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub(crate) enum Kind {
    Publications = 0,
    Subscriptions = 1,
}

impl Kind {
    pub(crate) const ALL: [Self; 2] = [Self::Publications, Self::Subscriptions];

    pub(crate) const fn writer(self) -> EntityId {
        match self {
            Self::Publications => EntityId::PUBLICATIONS_WRITER,
            Self::Subscriptions => EntityId::SUBSCRIPTIONS_WRITER,
        }
    }

    pub(crate) const fn reader(self) -> EntityId {
        match self {
            Self::Publications => EntityId::PUBLICATIONS_READER,
            Self::Subscriptions => EntityId::SUBSCRIPTIONS_READER,
        }
    }

    /// Returns the topic of discovery of this writer.
    pub(crate) fn of_writer(id: EntityId) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.writer() == id)
    }
}

/// What a participant announces.
#[derive(Clone, Copy, Debug)]
pub struct Announced<'m> {
    /// The participant.
    pub from: GuidPrefix,
    /// Its writer of this announcement, as [`EntityId::SPDP_WRITER`]: tells of what kind it is.
    pub writer: EntityId,
    /// What it is about has ended.
    pub ends: bool,
    /// What it says.
    pub list: Parameters<'m>,
}

/// Returns what a datagram announces, for tools that list all participants and their endpoints.
pub fn announced(datagram: &[u8]) -> impl Iterator<Item = Announced<'_>> {
    let message = Submessages::of(datagram).into_iter();
    message.flat_map(|(from, parts)| {
        parts.filter_map(move |part| match part {
            Submessage::Data(data) => Some(Announced {
                from,
                writer: data.writer,
                ends: data.ends(),
                list: Parameters::of_payload(data.payload)?,
            }),
            _ => None,
        })
    })
}

/// Another participant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Remote {
    pub(crate) prefix: GuidPrefix,
    /// When it was heard first.
    pub(crate) found: Instant,
    metatraffic: Locator,
    user: Locator,
    pub(crate) expires: Instant,
    /// It is taken for dead if nothing of it is heard for this time.
    lease: Duration,
    /// How far its publications and subscriptions were heard.
    pub(crate) heard: [Stream; 2],
    /// Of ours it has all below these numbers.
    pub(crate) has: [Sequence; 2],
    acknack: [Option<u32>; 2],
}

/// A participant, and a place where it hears.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Peer {
    pub(crate) prefix: GuidPrefix,
    pub(crate) at: Locator,
}

impl Remote {
    pub(crate) const fn new(prefix: GuidPrefix, found: Instant) -> Self {
        const NOWHERE: Locator = Locator {
            address: [0; 4],
            port: 0,
        };
        Self {
            prefix,
            found,
            metatraffic: NOWHERE,
            user: NOWHERE,
            expires: Instant::ORIGIN,
            lease: Duration::from_ms(0),
            heard: [Stream::new(true); 2],
            has: [1; 2],
            acknack: [None; 2],
        }
    }

    /// Takes its announcement. Returns `false` if that does not say where it hears, or speaks for
    /// another one.
    pub(crate) fn on_announcement(&mut self, now: Instant, list: Parameters<'_>) -> bool {
        let (mut metatraffic, mut user) = (None, None);
        let mut seconds = DEFAULT_LEASE_SECONDS;
        for parameter in list {
            match parameter.id {
                pid::PARTICIPANT_GUID
                    if parameter.guid().map(|it| it.prefix) != Some(self.prefix) =>
                {
                    return false;
                }
                pid::METATRAFFIC_LOCATOR => metatraffic = metatraffic.or(parameter.locator()),
                pid::DEFAULT_LOCATOR => user = user.or(parameter.locator()),
                pid::LEASE => seconds = parameter.number().unwrap_or(0),
                _ => {}
            }
        }
        let Some(user) = user else {
            return false;
        };
        (self.metatraffic, self.user) = (metatraffic.unwrap_or(user), user);
        let seconds = seconds.clamp(1, LONGEST_LEASE_SECONDS);
        self.lease = Duration::from_ms(1_000).times(seconds);
        self.on_life(now);
        true
    }

    /// Notes that it lives. Announcements alone do not suffice: some vendors repeat them just
    /// before the lease ends, and one may be lost.
    pub(crate) fn on_life(&mut self, now: Instant) {
        self.expires = now + self.lease;
    }

    /// Notes which of our endpoints it has, of which there are `all`. Returns whether it asks for
    /// some.
    pub(crate) fn on_acknack(&mut self, kind: Kind, acknack: &AckNack, all: usize) -> bool {
        let last = &mut self.acknack[kind as usize];
        let is_new = has_risen(acknack.count, *last) && acknack.set.base as usize <= all + 1;
        if is_new {
            *last = Some(acknack.count);
            let has = &mut self.has[kind as usize];
            *has = acknack.set.base.max(*has);
        }
        is_new && acknack.set.len > 0
    }

    /// Where it hears discovery.
    pub(crate) const fn discovery(&self) -> Peer {
        Peer {
            prefix: self.prefix,
            at: self.metatraffic,
        }
    }

    /// Where it hears samples.
    pub(crate) const fn user(&self) -> Peer {
        Peer {
            prefix: self.prefix,
            at: self.user,
        }
    }
}

/// The sample of a participant in the topic of participants.
pub(crate) const OF_PARTICIPANTS: DataTo = DataTo {
    reader: EntityId::SPDP_READER,
    writer: EntityId::SPDP_WRITER,
    sequence: 1,
};

/// Writes the announcement of the participant itself.
pub(crate) fn write_participant(message: &mut Message, own: GuidPrefix, at: Locator) {
    message.begin_list(OF_PARTICIPANTS);
    message.words(pid::PROTOCOL_VERSION, &[2 | 3 << 8]);
    message.words(pid::VENDOR, &[0]);
    message.guid(pid::PARTICIPANT_GUID, own.guid(EntityId::PARTICIPANT));
    message.locator(pid::METATRAFFIC_LOCATOR, at);
    message.locator(pid::DEFAULT_LOCATOR, at);
    message.words(pid::LEASE, &[LEASE_SECONDS, 0]);
    message.words(pid::BUILTIN_ENDPOINTS, &[BUILTIN_ENDPOINTS]);
    message.end_list();
}

/// Writes the announcement of an endpoint: the sample of this number in its topic of discovery.
pub(crate) fn write_endpoint(
    message: &mut Message,
    (own, kind, number): (GuidPrefix, Kind, Sequence),
    endpoint: &Endpoint,
) {
    let index = number as usize - 1;
    // XCDR1 is written; XCDR1 and XCDR2 are read.
    let (entity, representations) = match kind {
        Kind::Publications => (EntityId::writer(index), [1, 0]),
        Kind::Subscriptions => (EntityId::reader(index), [2, 2 << 16]),
    };
    message.begin_list(DataTo {
        reader: kind.reader(),
        writer: kind.writer(),
        sequence: number,
    });
    message.guid(pid::ENDPOINT_GUID, own.guid(entity));
    message.guid(pid::PARTICIPANT_GUID, own.guid(EntityId::PARTICIPANT));
    message.text(pid::TOPIC_NAME, endpoint.topic);
    message.text(pid::TYPE_NAME, endpoint.type_name);
    let qos = &endpoint.qos;
    // A writer never blocks: the second and third word are its longest time to do so.
    message.words(pid::RELIABILITY, &[qos.reliability as u32, 0, 0]);
    message.words(pid::DURABILITY, &[qos.durability as u32]);
    // Keep the last ones.
    message.words(pid::HISTORY, &[0, qos.depth.into()]);
    message.words(pid::REPRESENTATION, &representations);
    message.end_list();
}

/// Writes what the participant has to announce in a topic of discovery.
pub(crate) fn write_heartbeat(message: &mut Message, kind: Kind, last: Sequence, count: u32) {
    message.heartbeat(Heartbeat {
        reader: kind.reader(),
        writer: kind.writer(),
        first: 1,
        last,
        count,
        is_final: false,
    });
}
