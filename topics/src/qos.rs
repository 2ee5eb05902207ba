//! Quality of service: what an endpoint offers or asks for, whether two of them fit, and what it
//! counts. (OMG DDS 1.4, 2.2.3)

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
    pub(crate) fn depth_within(self, most: usize) -> u32 {
        u32::from(self.depth).max(1).min(most as u32)
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

/// What a writer or a reader has counted; each wraps around.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples that a reader lacked after the writer had dropped them.
    pub lost: u32,
    /// Samples that the writer sent once more.
    pub repaired: u32,
    /// Samples that newer ones replaced before they were taken.
    pub replaced: u32,
    /// Samples that are longer than the reader's room.
    pub too_long: u32,
    /// Endpoints of others for which there was no place: `READERS`, `WRITERS`. They are asked again
    /// each 8 s, and counted again.
    pub refused: u32,
    /// Endpoints of others whose quality of service does not fit, each 8 s.
    pub incompatible: u32,
}

/// An endpoint of another participant that fits one of ours.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fit {
    pub(crate) is_reliable: bool,
    /// It offers or wants samples from before.
    pub(crate) with_history: bool,
}

/// The first word of a span without end.
const INFINITE_SECONDS: u32 = 0x7FFF_FFFF;
const XCDR1: u16 = 0;
const XCDR2: u16 = 2;

impl Endpoint {
    /// Judges an endpoint of another participant by its announcement, with the defaults of the
    /// standard. `writes`: ours is the writer. Returns `None` if it is of another topic, type or
    /// partition, or if its quality of service does not fit, which is counted.
    pub(crate) fn fit(
        &self,
        list: Parameters<'_>,
        writes: bool,
        counts: &mut Counts,
    ) -> Option<Fit> {
        let (mut is_of_topic, mut is_of_type, mut has_partition) = (false, false, false);
        let (mut durability, mut reliability) = (0, if writes { 1 } else { 2 });
        // Exclusive ownership, or samples or signs of life within a time.
        let mut asks_more = false;
        let [mut xcdr1, mut xcdr2] = [true, false];
        for parameter in list {
            let first = parameter.number(0).unwrap_or(0);
            let is = |text: &str| parameter.bytes() == Some(text.as_bytes());
            match parameter.id {
                pid::TOPIC_NAME => is_of_topic = is(self.topic),
                pid::TYPE_NAME => is_of_type = is(self.type_name),
                pid::PARTITION => has_partition = first > 0,
                pid::DURABILITY => durability = first,
                pid::RELIABILITY => reliability = first,
                pid::OWNERSHIP => asks_more |= first != 0,
                // A writer may offer that; ours does not.
                pid::DEADLINE if writes => asks_more |= first != INFINITE_SECONDS,
                pid::LIVELINESS if writes => {
                    let seconds = parameter.number(1).unwrap_or(INFINITE_SECONDS);
                    asks_more |= first != 0 || seconds != INFINITE_SECONDS;
                }
                pid::REPRESENTATION if first > 0 => {
                    [xcdr1, xcdr2] = [false; 2];
                    let mut ids = parameter.value;
                    let _len = ids.u32();
                    while let Some(id) = ids.u16() {
                        xcdr1 |= id == XCDR1;
                        xcdr2 |= id == XCDR2;
                    }
                }
                _ => {}
            }
        }
        if !is_of_topic || !is_of_type || has_partition {
            return None;
        }
        let ours = (self.qos.durability as u32, self.qos.reliability as u32);
        let fits = if writes {
            durability <= ours.0 && reliability <= ours.1 && xcdr1
        } else {
            durability >= ours.0 && reliability >= ours.1 && (xcdr1 || xcdr2)
        };
        if !fits || asks_more {
            counts.incompatible = counts.incompatible.wrapping_add(1);
            return None;
        }
        Some(Fit {
            is_reliable: reliability == Reliability::Reliable as u32,
            with_history: durability > Durability::Volatile as u32,
        })
    }
}
