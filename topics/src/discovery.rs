//! Discovery: the announcements of participants (SPDP) and of their endpoints (SEDP). (RTPS 8.5)

use crate::Endpoint;
use crate::reader::Stream;
use crate::wire::{Ends, EntityId, GuidPrefix, Message, Parameters, Part, Peer};
use crate::wire::{Sequence, SequenceSet, Submessage, pid, rises, submessages};
use tandem_board::{Duration, Instant, NetworkAddress};

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

    /// Returns its writer and its reader.
    pub(crate) const fn ends(self) -> Ends {
        Ends::of_discovery(match self {
            Self::Publications => EntityId::PUBLICATIONS_WRITER,
            Self::Subscriptions => EntityId::SUBSCRIPTIONS_WRITER,
        })
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
    let message = submessages(datagram).into_iter();
    message.flat_map(|(from, parts)| {
        parts.filter_map(move |part| match part {
            Submessage::Between(Ends { writer, .. }, Part::Data(data)) => Some(Announced {
                from,
                writer,
                ends: data.ends,
                list: Parameters::of_payload(data.payload)?,
            }),
            _ => None,
        })
    })
}

/// Another participant.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Remote {
    pub(crate) prefix: GuidPrefix,
    /// When it was heard first.
    pub(crate) found: Instant,
    /// Where it hears discovery, and samples.
    pub(crate) discovery: Peer,
    pub(crate) user: Peer,
    pub(crate) expires: Instant,
    /// It is taken for dead if nothing of it is heard for this time. Announcements alone do not
    /// suffice: some vendors repeat them just before the lease ends, and one may be lost.
    pub(crate) lease: Duration,
    /// How far its publications and subscriptions were heard.
    pub(crate) heard: [Stream; 2],
    /// Of ours it has all below these numbers.
    pub(crate) has: [Sequence; 2],
    acknack: [Option<u32>; 2],
}

impl Remote {
    pub(crate) fn new(prefix: GuidPrefix, found: Instant) -> Self {
        Self {
            prefix,
            found,
            heard: [Stream::new(true); 2],
            has: [1; 2],
            ..Self::default()
        }
    }

    /// Takes its announcement. Returns `false` if that does not say where it hears, or speaks for
    /// another one.
    pub(crate) fn on_announcement(&mut self, now: Instant, list: Parameters<'_>) -> bool {
        let (mut metatraffic, mut user) = (None, None);
        let mut seconds = DEFAULT_LEASE_SECONDS;
        for parameter in list {
            let is_own = || parameter.guid().is_some_and(|it| it.prefix == self.prefix);
            match parameter.id {
                pid::PARTICIPANT_GUID if !is_own() => return false,
                pid::METATRAFFIC_LOCATOR => metatraffic = metatraffic.or(parameter.locator()),
                pid::DEFAULT_LOCATOR => user = user.or(parameter.locator()),
                pid::LEASE => seconds = parameter.number(0).unwrap_or(0),
                _ => {}
            }
        }
        let Some(user) = user else { return false };
        self.discovery = (self.prefix, metatraffic.unwrap_or(user));
        self.user = (self.prefix, user);
        let seconds = seconds.clamp(1, LONGEST_LEASE_SECONDS);
        self.lease = Duration::from_ms(1_000).times(seconds);
        self.expires = now + self.lease;
        true
    }

    /// Notes which of `all` our endpoints it has. Returns whether it asks for some.
    pub(crate) fn asks(&mut self, kind: Kind, set: SequenceSet, count: u32, all: usize) -> bool {
        let is_new = set.base as usize <= all + 1 && rises(&mut self.acknack[kind as usize], count);
        if is_new {
            let has = &mut self.has[kind as usize];
            *has = set.base.max(*has);
        }
        is_new && set.bits > 0
    }
}

/// Writes the announcement of the participant itself.
pub(crate) fn write_participant(message: &mut Message, at: NetworkAddress) -> &mut Message {
    message.begin_list(Ends::of_discovery(EntityId::SPDP_WRITER), 1);
    message.words(pid::PROTOCOL_VERSION, &[2 | 3 << 8]);
    message.words(pid::VENDOR, &[0]);
    message.guid(pid::PARTICIPANT_GUID, EntityId::PARTICIPANT);
    message.locator(pid::METATRAFFIC_LOCATOR, at);
    message.locator(pid::DEFAULT_LOCATOR, at);
    message.words(pid::LEASE, &[LEASE_SECONDS, 0]);
    message.words(pid::BUILTIN_ENDPOINTS, &[BUILTIN_ENDPOINTS]);
    message.end_list()
}

/// Writes the announcement of an endpoint: the sample of this number in its topic of discovery.
pub(crate) fn write_endpoint(message: &mut Message, kind: Kind, number: Sequence, ours: &Endpoint) {
    let index = number as usize - 1;
    // XCDR1 is written; XCDR1 and XCDR2 are read.
    let (entity, representations) = match kind {
        Kind::Publications => (EntityId::writer(index), [1, 0]),
        Kind::Subscriptions => (EntityId::reader(index), [2, 2 << 16]),
    };
    message.begin_list(kind.ends(), number);
    message.guid(pid::ENDPOINT_GUID, entity);
    message.guid(pid::PARTICIPANT_GUID, EntityId::PARTICIPANT);
    message.text(pid::TOPIC_NAME, ours.topic);
    message.text(pid::TYPE_NAME, ours.type_name);
    let qos = &ours.qos;
    // A writer never blocks: the second and third word are its longest time to do so.
    message.words(pid::RELIABILITY, &[qos.reliability as u32, 0, 0]);
    message.words(pid::DURABILITY, &[qos.durability as u32]);
    // Keep the last ones.
    message.words(pid::HISTORY, &[0, qos.depth.into()]);
    message.words(pid::REPRESENTATION, &representations);
    message.end_list();
}
