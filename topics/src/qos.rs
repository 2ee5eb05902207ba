//! Quality of service: what an endpoint offers or asks for, and whether two of them fit. (OMG DDS
//! 1.4, 2.2.3)

use crate::wire::{Parameters, pid};

/// Whether a reader that joins late gets the samples from before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Durability {
    /// It does not.
    #[default]
    Volatile = 0,
    /// It gets those that the writer still has, while the writer lives.
    TransientLocal = 1,
}

/// Whether what was lost is sent again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Reliability {
    /// It is not.
    BestEffort = 1,
    /// It is, as long as the writer has it.
    #[default]
    Reliable = 2,
}

/// What an endpoint offers (writer) or asks for (reader).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Qos {
    /// Whether what was lost is sent again.
    pub reliability: Reliability,
    /// What a late reader gets.
    pub durability: Durability,
    /// How many samples are kept, at most as many as the participant has room for.
    pub depth: u8,
}

impl Qos {
    /// Returns the depth within the room for `most` samples.
    pub(crate) const fn depth_within(self, most: usize) -> usize {
        match self.depth as usize {
            0 => 1,
            depth if depth < most => depth,
            _ => most,
        }
    }
}

/// A topic of a participant, as a writer or a reader of it announces it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Name of the topic.
    pub topic: &'static str,
    /// Name of its type, with its modules.
    pub type_name: &'static str,
    /// Its quality of service.
    pub qos: Qos,
}

/// How an endpoint of another participant fits one of ours.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fit {
    /// It is of another topic, type or partition.
    Stranger,
    /// Its quality of service does not fit.
    Incompatible,
    /// It fits, with this reliability and durability of the other one.
    Fits(Reliability, Durability),
}

/// The first word of a span without end.
const INFINITE_SECONDS: u32 = 0x7FFF_FFFF;
const XCDR1: u16 = 0;
const XCDR2: u16 = 2;

/// What the announcement of a foreign endpoint says, with the defaults of the standard.
struct Announced {
    durability: u32,
    reliability: u32,
    exclusive: bool,
    /// It asks for samples or signs of life within a time.
    in_time: bool,
    /// It reads or writes XCDR1, and XCDR2.
    representations: (bool, bool),
}

impl Endpoint {
    /// Judges an endpoint of another participant. `we_write`: ours is the writer.
    pub(crate) fn judge(&self, list: Parameters<'_>, we_write: bool) -> Fit {
        let is = |id, text| list.find(id).is_some_and(|parameter| parameter.is(text));
        let partitions = list
            .find(pid::PARTITION)
            .and_then(|parameter| parameter.number());
        if !is(pid::TOPIC_NAME, self.topic)
            || !is(pid::TYPE_NAME, self.type_name)
            || partitions.is_some_and(|count| count > 0)
        {
            return Fit::Stranger;
        }
        let announced = Announced::read(list, we_write);
        let (xcdr1, xcdr2) = announced.representations;
        let (durability, reliability) = (self.qos.durability as u32, self.qos.reliability as u32);
        let fits = if we_write {
            announced.durability <= durability
                && announced.reliability <= reliability
                && !announced.in_time
                && xcdr1
        } else {
            announced.durability >= durability
                && announced.reliability >= reliability
                && (xcdr1 || xcdr2)
        };
        if !fits || announced.exclusive {
            return Fit::Incompatible;
        }
        let reliability = match announced.reliability {
            2 => Reliability::Reliable,
            _ => Reliability::BestEffort,
        };
        let durability = match announced.durability {
            0 => Durability::Volatile,
            _ => Durability::TransientLocal,
        };
        Fit::Fits(reliability, durability)
    }
}

impl Announced {
    fn read(list: Parameters<'_>, is_reader: bool) -> Self {
        let number = |id, default| {
            list.find(id)
                .and_then(|parameter| parameter.number())
                .unwrap_or(default)
        };
        let reliability = if is_reader { 1 } else { 2 };
        let kind = number(pid::LIVELINESS, 0);
        let lease = list.find(pid::LIVELINESS).and_then(|mut parameter| {
            let _kind = parameter.value.u32()?;
            parameter.value.u32()
        });
        Self {
            durability: number(pid::DURABILITY, 0),
            reliability: number(pid::RELIABILITY, reliability),
            exclusive: number(pid::OWNERSHIP, 0) != 0,
            in_time: number(pid::DEADLINE, INFINITE_SECONDS) != INFINITE_SECONDS
                || kind != 0
                || lease.is_some_and(|seconds| seconds != INFINITE_SECONDS),
            representations: representations(list).unwrap_or((true, false)),
        }
    }
}

/// Returns whether XCDR1 and XCDR2 are in the list; `None` if there is no list.
fn representations(list: Parameters<'_>) -> Option<(bool, bool)> {
    let mut value = list.find(pid::REPRESENTATION)?.value;
    let count = value.u32().filter(|count| *count > 0)?;
    let (mut xcdr1, mut xcdr2) = (false, false);
    for _ in 0..count {
        match value.u16() {
            Some(XCDR1) => xcdr1 = true,
            Some(XCDR2) => xcdr2 = true,
            Some(_) => {}
            None => break,
        }
    }
    Some((xcdr1, xcdr2))
}
