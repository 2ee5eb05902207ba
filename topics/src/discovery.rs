//! Discovery: the announcements of participants (SPDP) and of their endpoints (SEDP). (RTPS 8.5)

use crate::Endpoint;
use crate::reader::Stream;
use crate::wire::{DataTo, EntityId, Guid, GuidPrefix, Heartbeat, Locator, Message};
use crate::wire::{ParameterWriter, Parameters, Sequence, pid};
use tandem_board::{Duration, Instant};

/// A participant that announces nothing for the time that it stated is taken for dead; one that
/// states no time, after this one.
const DEFAULT_LEASE: Duration = Duration::from_ms(100_000);
/// The time that this participant states.
const LEASE_SECONDS: u32 = 10;
/// Endpoints of discovery that this participant has: announcer and detector of participants, of
/// publications and of subscriptions.
const BUILTIN_ENDPOINTS: u32 = 0x3F;
/// The longest lease that is believed.
const LONGEST_LEASE_SECONDS: u32 = 3_600;

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

/// Another participant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Remote {
    pub(crate) prefix: GuidPrefix,
    /// Where it hears discovery, and where samples.
    pub(crate) metatraffic: Locator,
    pub(crate) user: Locator,
    pub(crate) expires: Instant,
    /// How far its publications and subscriptions were heard.
    pub(crate) heard: [Stream; 2],
    /// Of ours it has all below these numbers.
    pub(crate) has: [Sequence; 2],
    pub(crate) acknack: [Option<u32>; 2],
}

/// What another participant says of itself.
pub(crate) struct Announcement {
    pub(crate) prefix: GuidPrefix,
    pub(crate) metatraffic: Locator,
    pub(crate) user: Locator,
    pub(crate) lease: Duration,
}

impl Announcement {
    /// Reads it; `None` if it does not say where the participant hears, or speaks for another one.
    pub(crate) fn read(from: GuidPrefix, list: Parameters<'_>) -> Option<Self> {
        let guid = list.find(pid::PARTICIPANT_GUID)?.guid()?;
        if guid.prefix != from {
            return None;
        }
        let locator = |id| {
            let mut all = list.filter(|parameter| parameter.id == id);
            all.find_map(crate::wire::Parameter::locator)
        };
        let user = locator(pid::DEFAULT_LOCATOR)?;
        let seconds = list.find(pid::LEASE).and_then(|lease| lease.number());
        let lease = seconds.map_or(DEFAULT_LEASE, |seconds| {
            Duration::from_ms(1_000).times(seconds.clamp(1, LONGEST_LEASE_SECONDS))
        });
        Some(Self {
            prefix: from,
            metatraffic: locator(pid::METATRAFFIC_LOCATOR).unwrap_or(user),
            user,
            lease,
        })
    }
}

impl Remote {
    pub(crate) const fn new(announced: &Announcement) -> Self {
        Self {
            prefix: announced.prefix,
            metatraffic: announced.metatraffic,
            user: announced.user,
            expires: Instant::ORIGIN,
            heard: [Stream::new(true); 2],
            has: [1; 2],
            acknack: [None; 2],
        }
    }
}

/// Writes the announcement of the participant itself.
pub(crate) fn write_participant(message: &mut Message<'_>, own: GuidPrefix, at: Locator) {
    let to = DataTo {
        reader: EntityId::SPDP_READER,
        writer: EntityId::SPDP_WRITER,
        sequence: 1,
    };
    message.data_list(to, |list| {
        list.bytes(pid::PROTOCOL_VERSION, &[2, 3]);
        list.bytes(pid::VENDOR, &[0, 0]);
        list.guid(pid::PARTICIPANT_GUID, participant(own));
        list.locator(pid::METATRAFFIC_LOCATOR, at);
        list.locator(pid::DEFAULT_LOCATOR, at);
        list.numbers(pid::LEASE, [LEASE_SECONDS, 0]);
        list.numbers(pid::BUILTIN_ENDPOINTS, [BUILTIN_ENDPOINTS]);
    });
}

pub(crate) const fn participant(prefix: GuidPrefix) -> Guid {
    Guid {
        prefix,
        entity: EntityId::PARTICIPANT,
    }
}

/// Writes the announcement of an endpoint: the sample of this number in its topic of discovery.
pub(crate) fn write_endpoint(
    message: &mut Message<'_>,
    (own, kind, number): (GuidPrefix, Kind, Sequence),
    endpoint: &Endpoint,
) {
    let to = DataTo {
        reader: kind.reader(),
        writer: kind.writer(),
        sequence: number,
    };
    let index = number as usize - 1;
    let entity = match kind {
        Kind::Publications => EntityId::writer(index),
        Kind::Subscriptions => EntityId::reader(index),
    };
    let guid = Guid {
        prefix: own,
        entity,
    };
    message.data_list(to, |list| {
        list.guid(pid::ENDPOINT_GUID, guid);
        list.guid(pid::PARTICIPANT_GUID, participant(own));
        list.text(pid::TOPIC_NAME, endpoint.topic);
        list.text(pid::TYPE_NAME, endpoint.type_name);
        write_qos(list, kind, endpoint);
    });
}

fn write_qos(list: &mut ParameterWriter<'_, '_>, kind: Kind, endpoint: &Endpoint) {
    let qos = &endpoint.qos;
    // A writer never blocks: the second and third word are its longest time to do so.
    list.numbers(pid::RELIABILITY, [qos.reliability as u32, 0, 0]);
    list.numbers(pid::DURABILITY, [qos.durability as u32]);
    // Keep the last ones.
    list.numbers(pid::HISTORY, [0, qos.depth.into()]);
    match kind {
        Kind::Publications => list.numbers(pid::REPRESENTATION, [1, 0]),
        // XCDR1 and XCDR2.
        Kind::Subscriptions => list.numbers(pid::REPRESENTATION, [2, 2 << 16]),
    }
}

/// Writes what the participant has to announce in a topic of discovery.
pub(crate) fn write_heartbeat(message: &mut Message<'_>, kind: Kind, last: Sequence, count: u32) {
    message.heartbeat(Heartbeat {
        reader: kind.reader(),
        writer: kind.writer(),
        first: 1,
        last,
        count,
        is_final: false,
    });
}
