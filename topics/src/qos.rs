//! Quality of service: what an endpoint offers or asks for, and whether two of them fit. (OMG DDS
//! 1.4, 2.2.3)

use crate::wire::{Cursor, Parameters, pid};

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

impl Endpoint {
    /// Judges an endpoint of another participant by its announcement, with the defaults of the
    /// standard. `we_write`: ours is the writer.
    pub(crate) fn judge(&self, list: Parameters<'_>, we_write: bool) -> Fit {
        let (mut is_of_topic, mut is_of_type, mut has_partition) = (false, false, false);
        let (mut durability, mut reliability) = (0, if we_write { 1 } else { 2 });
        // Exclusive ownership, or samples or signs of life within a time.
        let mut asks_more = false;
        let [mut xcdr1, mut xcdr2] = [true, false];
        for parameter in list {
            let first = parameter.number().unwrap_or(0);
            match parameter.id {
                pid::TOPIC_NAME => is_of_topic = parameter.is(self.topic),
                pid::TYPE_NAME => is_of_type = parameter.is(self.type_name),
                pid::PARTITION => has_partition = first > 0,
                pid::DURABILITY => durability = first,
                pid::RELIABILITY => reliability = first,
                pid::OWNERSHIP => asks_more |= first != 0,
                // A writer may offer that; ours does not.
                pid::DEADLINE if we_write => asks_more |= first != INFINITE_SECONDS,
                pid::LIVELINESS if we_write => {
                    let seconds = parameter.second().unwrap_or(INFINITE_SECONDS);
                    asks_more |= first != 0 || seconds != INFINITE_SECONDS;
                }
                pid::REPRESENTATION if first > 0 => {
                    [xcdr1, xcdr2] = representations(parameter.value);
                }
                _ => {}
            }
        }
        if !is_of_topic || !is_of_type || has_partition {
            return Fit::Stranger;
        }
        let ours = (self.qos.durability as u32, self.qos.reliability as u32);
        let fits = if we_write {
            durability <= ours.0 && reliability <= ours.1 && xcdr1
        } else {
            durability >= ours.0 && reliability >= ours.1 && (xcdr1 || xcdr2)
        };
        if !fits || asks_more {
            return Fit::Incompatible;
        }
        let reliability = match reliability {
            2 => Reliability::Reliable,
            _ => Reliability::BestEffort,
        };
        let durability = match durability {
            0 => Durability::Volatile,
            _ => Durability::TransientLocal,
        };
        Fit::Fits(reliability, durability)
    }
}

/// Returns whether XCDR1 and XCDR2 are in a list that begins with its length.
fn representations(mut list: Cursor<'_>) -> [bool; 2] {
    let _len = list.u32();
    let mut found = [false; 2];
    while let Some(id) = list.u16() {
        found[0] |= id == XCDR1;
        found[1] |= id == XCDR2;
    }
    found
}
