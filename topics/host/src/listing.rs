//! All participants and endpoints of a domain, from what they announce, and which do not fit.

use std::collections::BTreeMap;

use tandem_topics::endpoints::system_of;
use tandem_topics::{Announced, EntityId, GuidPrefix, announced, pid};

/// More endpoints than a vehicle has; those of others are not kept.
const ENDPOINTS: usize = 4_096;
/// Seconds of a time without end.
const INFINITE: u32 = 0x7FFF_FFFF;
/// The name of an endpoint: participant and entity.
type Name = ([u8; 12], [u8; 4]);

/// An endpoint that a participant has announced.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedEndpoint {
    /// It writes; otherwise it reads.
    pub writes: bool,
    /// Name of its participant, for people.
    pub from: String,
    /// Name of the topic.
    pub topic: String,
    /// Name of its type.
    pub type_name: String,
    /// It asks for, or offers, that what is lost is sent again.
    pub is_reliable: bool,
    /// 0: volatile, 1: transient-local, 2: transient, 3: persistent.
    pub durability: u32,
    /// How many samples it keeps; `None` if it does not say so, or keeps all.
    pub depth: Option<u32>,
    is_exclusive: bool,
    deadline_s: u32,
    has_partition: bool,
    /// The representations that it reads; of a writer, the first one.
    representations: Vec<u16>,
}

/// What is known of a domain.
#[derive(Clone, Debug, Default)]
pub struct Listing {
    participants: BTreeMap<[u8; 12], String>,
    endpoints: BTreeMap<Name, ListedEndpoint>,
}

/// Returns the name of a participant, for people. The vendor stands in the head of its messages.
fn name_of(prefix: GuidPrefix, vendor: [u8; 2]) -> String {
    // (OMG DDS vendor and product ids)
    let vendor = match vendor {
        [1, 1] => "rti",
        [1, 3] => "opendds",
        [1, 15] => "fastdds",
        [1, 16] => "cyclone",
        [0, 0] => "tandem",
        _ => "other",
    };
    let [a, b, c, d, e, f, g, h, ..] = prefix.0;
    match system_of(prefix) {
        Some(0) => "A".to_owned(),
        Some(_) => "B".to_owned(),
        // A participant of this project on a host begins with its process id.
        None if vendor == "tandem" => format!("tandem-{}", u32::from_le_bytes([a, b, c, d])),
        None => format!("{vendor}-{e:02x}{f:02x}{g:02x}{h:02x}"),
    }
}

impl ListedEndpoint {
    fn read(announced: &Announced<'_>, writes: bool, from: &str) -> Option<Self> {
        let text = |id| Some(announced.list.find(id)?.text()?.to_owned());
        let number = |id| announced.list.find(id).and_then(|one| one.number(0));
        let second = |id| announced.list.find(id).and_then(|one| one.number(1));
        let reliability = number(pid::RELIABILITY).unwrap_or(if writes { 2 } else { 1 });
        let keeps_last = number(pid::HISTORY) == Some(0);
        let ids = second(pid::REPRESENTATION).unwrap_or(0);
        let ids = [ids as u16, (ids >> 16) as u16];
        let count = number(pid::REPRESENTATION).unwrap_or(0).clamp(1, 2) as usize;
        Some(Self {
            writes,
            from: from.to_owned(),
            topic: text(pid::TOPIC_NAME)?,
            type_name: text(pid::TYPE_NAME)?,
            is_reliable: reliability == 2,
            durability: number(pid::DURABILITY).unwrap_or(0),
            depth: second(pid::HISTORY).filter(|_| keeps_last),
            is_exclusive: number(pid::OWNERSHIP) == Some(1),
            deadline_s: number(pid::DEADLINE).unwrap_or(INFINITE),
            has_partition: number(pid::PARTITION).is_some_and(|count| count > 0),
            representations: ids[..if writes { 1 } else { count }].to_vec(),
        })
    }

    /// Returns its quality of service in words.
    pub fn quality(&self) -> String {
        let reliability = reliability_word(self.is_reliable);
        let durability = durability_word(self.durability);
        let depth = self.depth.map(|depth| format!(", keeps {depth}"));
        format!("{reliability}, {durability}{}", depth.unwrap_or_default())
    }

    /// Returns why no sample flows from this writer to this reader of the same topic; `None` if
    /// they fit. (DDS 1.4, 2.2.3)
    pub fn misfit(&self, reader: &Self) -> Option<String> {
        let asks = |what: &str, offers: &str| Some(format!("asks for {what}, is offered {offers}"));
        if self.type_name != reader.type_name {
            return asks(&format!("the type {}", reader.type_name), &self.type_name);
        }
        if reader.is_reliable && !self.is_reliable {
            return asks(reliability_word(true), reliability_word(false));
        }
        if reader.durability > self.durability {
            let [asked, offered] = [reader, self].map(|one| durability_word(one.durability));
            return asks(asked, offered);
        }
        if reader.is_exclusive != self.is_exclusive {
            let [asked, offered] = [reader, self].map(|one| ownership_word(one.is_exclusive));
            return asks(asked, offered);
        }
        if reader.deadline_s < self.deadline_s {
            return asks("a deadline", "none as short");
        }
        if reader.has_partition != self.has_partition {
            return asks("a partition", "another one");
        }
        let writes = self.representations.first().copied().unwrap_or(0);
        if !reader.representations.contains(&writes) {
            let xcdr = |id: u16| if id == 2 { "XCDR2" } else { "XCDR1" };
            let reads = reader.representations.first().copied().unwrap_or(0);
            return asks(xcdr(reads), xcdr(writes));
        }
        None
    }
}

const fn reliability_word(is_reliable: bool) -> &'static str {
    if is_reliable {
        "reliable"
    } else {
        "best effort"
    }
}

const fn ownership_word(is_exclusive: bool) -> &'static str {
    if is_exclusive {
        "exclusive ownership"
    } else {
        "shared ownership"
    }
}

const fn durability_word(durability: u32) -> &'static str {
    match durability {
        0 => "volatile",
        1 => "transient-local",
        2 => "transient",
        _ => "persistent",
    }
}

impl Listing {
    /// Hears a datagram. `own`: the participant that listens, which is not listed.
    pub fn hear(&mut self, own: GuidPrefix, datagram: &[u8]) {
        let vendor = datagram.get(6..8).and_then(|two| two.try_into().ok());
        for one in announced(datagram).filter(|one| one.from != own) {
            let name = name_of(one.from, vendor.unwrap_or_default());
            let participant = one.from.0;
            let writes = match one.writer {
                EntityId::PUBLICATIONS_WRITER => true,
                EntityId::SUBSCRIPTIONS_WRITER => false,
                EntityId::SPDP_WRITER if one.ends => {
                    self.participants.remove(&participant);
                    self.endpoints.retain(|(from, _), _| *from != participant);
                    continue;
                }
                EntityId::SPDP_WRITER if self.participants.len() < ENDPOINTS => {
                    self.participants.insert(participant, name);
                    continue;
                }
                _ => continue,
            };
            let guid = one.list.find(pid::ENDPOINT_GUID).and_then(|it| it.guid());
            let Some(guid) = guid.filter(|guid| guid.prefix == one.from) else {
                continue;
            };
            let key = (participant, guid.entity.0);
            if one.ends {
                self.endpoints.remove(&key);
            } else if let Some(endpoint) = ListedEndpoint::read(&one, writes, &name)
                && self.endpoints.len() < ENDPOINTS
            {
                self.endpoints.insert(key, endpoint);
            }
        }
    }

    /// Returns the endpoints: by topic, writers first, by participant.
    pub fn endpoints(&self) -> Vec<&ListedEndpoint> {
        let mut all: Vec<_> = self.endpoints.values().collect();
        all.sort_by_key(|one| (&one.topic, !one.writes, &one.from));
        all
    }

    /// Returns the names of the participants.
    pub fn participants(&self) -> impl Iterator<Item = &str> {
        self.participants.values().map(String::as_str)
    }

    /// Returns what a reader of these endpoints is told: of each writer of its topic that does not
    /// fit, who it is and why.
    pub fn misfits(&self, reader: &ListedEndpoint) -> Vec<(String, String)> {
        let writers = self.endpoints().into_iter().filter(|one| one.writes);
        let of_topic = writers.filter(|writer| writer.topic == reader.topic);
        let told = of_topic.filter_map(|it| Some((it.from.clone(), it.misfit(reader)?)));
        told.collect()
    }
}
