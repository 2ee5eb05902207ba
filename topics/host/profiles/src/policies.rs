//! The items of all policies of the standard: where each stands, and which values are supported.

use core::fmt;

use Kind::{Participant, Publisher, Reader, Subscriber, Topic, Writer};
use Rule::{Empty, Limit, Number, Time, Unlimited, Word};

/// Kind of an entity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Participant,
    Publisher,
    Subscriber,
    Topic,
    Writer,
    Reader,
}

/// An item that has an effect.
#[derive(Clone, Copy, Debug)]
pub(super) enum Key {
    /// 0: best effort. 1: reliable.
    Reliability,
    /// 0: volatile. 1: transient-local.
    Durability,
    Depth,
    MaxSamples,
    MaxSamplesPerInstance,
}

/// The value of an item, and where the file sets it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Set {
    pub value: u32,
    /// Offset in the text, bytes.
    pub at: usize,
}

/// The items that an element sets, by their keys.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Items([Option<Set>; 5]);

/// What an item may be.
#[derive(Clone, Copy, Debug)]
pub(super) enum Rule {
    /// One of the first words, whose places are their values. The other words are not supported.
    Word(&'static [&'static str], &'static [&'static str]),
    /// A whole number, from the first to the second. Above that it is not supported.
    Number(u32, u32),
    /// A whole number from 1, or no limit.
    Limit,
    /// No limit. Others are not supported.
    Unlimited,
    /// Nothing. Others are not supported.
    Empty,
    /// Seconds and nanoseconds; if some are given here, others are not supported.
    Time(Option<(u32, u32)>),
    /// The first part of a time.
    Sec,
    /// The second part of a time.
    Nanosec,
}

/// Why a value is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// It is none of the standard's.
    Wrong,
    /// It is valid, and the participant does not have it.
    Unsupported,
}

/// Value of a limit that is none.
pub(super) const UNLIMITED: u32 = u32::MAX;
/// Largest number of the standard's type `long`. As seconds or nanoseconds it is an infinite time.
pub(super) const MOST: u32 = i32::MAX as u32;
/// Longest fraction of a second, ns.
const NANOSEC_MAX: u32 = 999_999_999;
/// Most samples that the participant counts.
const DEPTH_MAX: u32 = u8::MAX as u32;

const ENDS: &[Kind] = &[Topic, Writer, Reader];
const OUT: &[Kind] = &[Topic, Writer];
const GROUPS: &[Kind] = &[Publisher, Subscriber];
const ANY_TIME: Rule = Time(None);
const NO_TIME: Rule = Time(Some((0, 0)));
const FOREVER: Rule = Time(Some((MOST, MOST)));
const TRUE: Rule = Word(&["true", "1"], &["false", "0"]);
const FALSE: Rule = Word(&["false", "0"], &["true", "1"]);
const RELIABILITY: Rule = Word(
    &["BEST_EFFORT_RELIABILITY_QOS", "RELIABLE_RELIABILITY_QOS"],
    &[],
);
const DURABILITY: Rule = Word(
    &["VOLATILE_DURABILITY_QOS", "TRANSIENT_LOCAL_DURABILITY_QOS"],
    &["TRANSIENT_DURABILITY_QOS", "PERSISTENT_DURABILITY_QOS"],
);
const HISTORY: Rule = Word(&["KEEP_LAST_HISTORY_QOS"], &["KEEP_ALL_HISTORY_QOS"]);
const LIVELINESS: Rule = Word(
    &["AUTOMATIC_LIVELINESS_QOS"],
    &[
        "MANUAL_BY_PARTICIPANT_LIVELINESS_QOS",
        "MANUAL_BY_TOPIC_LIVELINESS_QOS",
    ],
);
const OWNERSHIP: Rule = Word(&["SHARED_OWNERSHIP_QOS"], &["EXCLUSIVE_OWNERSHIP_QOS"]);
const ORDER: Rule = Word(
    &["BY_RECEPTION_TIMESTAMP_DESTINATIONORDER_QOS"],
    &["BY_SOURCE_TIMESTAMP_DESTINATIONORDER_QOS"],
);
const SCOPE: Rule = Word(
    &["INSTANCE_PRESENTATION_QOS"],
    &["TOPIC_PRESENTATION_QOS", "GROUP_PRESENTATION_QOS"],
);

/// A policy, one of its items, the entities that have it, and what it may be.
pub(super) type Row = (&'static str, &'static str, &'static [Kind], Rule);

/// All items, those of one policy together. (DDS-XML 1.0, dds-xml_qos_definitions_nonamespace.xsd)
#[rustfmt::skip]
const ROWS: &[Row] = &[
    ("reliability", "kind", ENDS, RELIABILITY),
    ("reliability", "max_blocking_time", ENDS, ANY_TIME),
    ("durability", "kind", ENDS, DURABILITY),
    ("history", "kind", ENDS, HISTORY),
    ("history", "depth", ENDS, Number(1, DEPTH_MAX)),
    ("resource_limits", "max_samples", ENDS, Limit),
    ("resource_limits", "max_instances", ENDS, Limit),
    ("resource_limits", "max_samples_per_instance", ENDS, Limit),
    ("resource_limits", "initial_samples", ENDS, Number(1, MOST)),
    ("resource_limits", "initial_instances", ENDS, Number(1, MOST)),
    ("durability_service", "service_cleanup_delay", OUT, NO_TIME),
    ("durability_service", "history_kind", OUT, HISTORY),
    ("durability_service", "history_depth", OUT, Number(1, 1)),
    ("durability_service", "max_samples", OUT, Unlimited),
    ("durability_service", "max_instances", OUT, Unlimited),
    ("durability_service", "max_samples_per_instance", OUT, Unlimited),
    ("deadline", "period", ENDS, FOREVER),
    ("latency_budget", "duration", ENDS, NO_TIME),
    ("lifespan", "duration", OUT, FOREVER),
    ("liveliness", "kind", ENDS, LIVELINESS),
    ("liveliness", "lease_duration", ENDS, FOREVER),
    ("ownership", "kind", ENDS, OWNERSHIP),
    ("ownership_strength", "value", &[Writer], Number(0, 0)),
    ("destination_order", "kind", ENDS, ORDER),
    ("transport_priority", "value", OUT, Number(0, 0)),
    ("time_based_filter", "minimum_separation", &[Reader], NO_TIME),
    ("reader_data_lifecycle", "autopurge_nowriter_samples_delay", &[Reader], FOREVER),
    ("reader_data_lifecycle", "autopurge_disposed_samples_delay", &[Reader], FOREVER),
    ("writer_data_lifecycle", "autodispose_unregistered_instances", &[Writer], TRUE),
    ("presentation", "access_scope", GROUPS, SCOPE),
    ("presentation", "coherent_access", GROUPS, FALSE),
    ("presentation", "ordered_access", GROUPS, FALSE),
    ("partition", "name", GROUPS, Empty),
    ("group_data", "value", GROUPS, Empty),
    ("topic_data", "value", &[Topic], Empty),
    ("user_data", "value", &[Participant, Writer, Reader], Empty),
    ("entity_factory", "autoenable_created_entities", &[Participant, Publisher, Subscriber], TRUE),
];

impl Kind {
    /// The elements of the kinds, without their second names.
    pub(super) const ELEMENTS: [&str; 6] = [
        "datawriter_qos",
        "datareader_qos",
        "topic_qos",
        "publisher_qos",
        "subscriber_qos",
        "domain_participant_qos",
    ];

    /// Returns the kind of an element, by its name.
    pub(super) fn of(element: &str) -> Option<Self> {
        Some(match element {
            "domain_participant_qos" | "domainparticipant_qos" | "participant_qos" => Participant,
            "publisher_qos" => Publisher,
            "subscriber_qos" => Subscriber,
            "topic_qos" => Topic,
            "datawriter_qos" => Writer,
            "datareader_qos" => Reader,
            _ => return None,
        })
    }

    /// Returns the items of the policies of this kind, those of one policy together.
    pub(super) fn rows(self) -> impl Iterator<Item = &'static Row> {
        ROWS.iter().filter(move |(_, _, on, _)| on.contains(&self))
    }
}

impl Key {
    /// Returns the key of an item; `None` if the item has no effect.
    pub(super) fn of(policy: &str, item: &str) -> Option<Self> {
        Some(match (policy, item) {
            ("reliability", "kind") => Self::Reliability,
            ("durability", "kind") => Self::Durability,
            ("history", "depth") => Self::Depth,
            ("resource_limits", "max_samples") => Self::MaxSamples,
            ("resource_limits", "max_samples_per_instance") => Self::MaxSamplesPerInstance,
            _ => return None,
        })
    }
}

impl Items {
    /// Returns an item, if it is set.
    pub(super) const fn get(&self, key: Key) -> Option<Set> {
        self.0[key as usize]
    }

    /// Returns the value of an item, or a default.
    pub(super) fn value(&self, key: Key, default: u32) -> u32 {
        self.get(key).map_or(default, |set| set.value)
    }

    /// Sets an item.
    pub(super) const fn set(&mut self, key: Key, set: Set) {
        self.0[key as usize] = Some(set);
    }

    /// Sets the items that are not set from the layer below.
    pub(super) fn fill(&mut self, below: &Self) {
        for (own, below) in self.0.iter_mut().zip(below.0) {
            *own = own.or(below);
        }
    }
}

impl Rule {
    /// Reads the text of an element without elements. Returns its value.
    pub(super) fn read(self, text: &str) -> Result<u32, Refusal> {
        let is_among = |words: &[&str]| words.contains(&text);
        match (self, number(text)) {
            (Word(words, others), _) => {
                let place = words.iter().position(|word| *word == text);
                let refusal = if is_among(others) {
                    Refusal::Unsupported
                } else {
                    Refusal::Wrong
                };
                place.map(|place| place as u32).ok_or(refusal)
            }
            (Number(least, most), Some(number)) if number >= least => match number <= most {
                true => Ok(number),
                false => Err(Refusal::Unsupported),
            },
            (Limit | Unlimited, _) if text == "LENGTH_UNLIMITED" => Ok(UNLIMITED),
            (Limit, Some(number)) if number >= 1 => Ok(number),
            (Unlimited, Some(number)) if number >= 1 => Err(Refusal::Unsupported),
            (Empty, _) if text.is_empty() => Ok(0),
            (Empty, _) => Err(Refusal::Unsupported),
            (Self::Sec, _) if is_among(&["DURATION_INFINITE_SEC", "DURATION_INFINITY"]) => Ok(MOST),
            (Self::Sec, _) if text == "DURATION_ZERO_SEC" => Ok(0),
            (Self::Sec, Some(sec)) => Ok(sec),
            (Self::Nanosec, _) if is_among(&["DURATION_INFINITE_NSEC", "DURATION_INFINITY"]) => {
                Ok(MOST)
            }
            (Self::Nanosec, _) if text == "DURATION_ZERO_NSEC" => Ok(0),
            (Self::Nanosec, Some(ns)) if ns <= NANOSEC_MAX || ns == MOST => Ok(ns),
            _ => Err(Refusal::Wrong),
        }
    }
}

/// Says what is expected.
impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Word(words, _) => f.write_str(&words.join(" or ")),
            Number(least, most) if least == most => write!(f, "{least}"),
            Number(least, most) => write!(f, "a whole number, {least} to {most}"),
            Limit => write!(f, "a whole number, 1 to {MOST}, or LENGTH_UNLIMITED"),
            Unlimited => f.write_str("LENGTH_UNLIMITED"),
            Empty => f.write_str("nothing"),
            Time(None) => f.write_str("a time"),
            Time(Some((MOST, _))) => f.write_str("an infinite time (DURATION_INFINITE_SEC)"),
            Time(Some((sec, 0))) => write!(f, "{sec} s"),
            Time(Some((sec, nanosec))) => write!(f, "{sec} s and {nanosec} ns"),
            Self::Sec => write!(f, "seconds, 0 to {MOST}, or DURATION_INFINITE_SEC"),
            Self::Nanosec => {
                write!(
                    f,
                    "nanoseconds, 0 to {NANOSEC_MAX}, or DURATION_INFINITE_NSEC"
                )
            }
        }
    }
}

/// Reads a number of type `long`, decimal, or hexadecimal after 0x. (DDS-XML 1.0, table 7.1)
fn number(text: &str) -> Option<u32> {
    let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"));
    let number = match digits {
        Some(digits) => u32::from_str_radix(digits, 16),
        None => text.parse(),
    };
    number.ok().filter(|number| *number <= MOST)
}
