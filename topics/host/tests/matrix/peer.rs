//! What every cell needs of a peer: a writer or a reader of the topic, in a participant of its own.

use crate::{cyclone, dust, tandem};
use tandem_topics::Qos;

/// A writer of frames.
pub(crate) trait Writer {
    /// Publishes the frame of this number. Returns whether it did: some block, and give up.
    fn write(&mut self, number: u32) -> bool;

    /// Returns how many readers it has refused because of their quality of service.
    fn incompatible(&mut self) -> u32;

    /// Returns how many readers it has refused because it had no place. Only Tandem does.
    fn refused(&mut self) -> u32 {
        0
    }
}

/// A reader of frames.
pub(crate) trait Reader {
    /// Returns the numbers of the frames that have arrived since the last call.
    fn take(&mut self) -> Vec<u32>;

    /// Returns how many writers it has refused because of their quality of service.
    fn incompatible(&mut self) -> u32;

    /// Returns how many samples it has counted as lost. `None` if it does not count them.
    fn lost(&mut self) -> Option<u32> {
        None
    }
}

/// An implementation of DDS.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Vendor {
    /// This project's.
    Tandem,
    /// Eclipse Cyclone DDS, in a process with Python.
    Cyclone,
    /// dust_dds, in this process.
    Dust,
}

impl Vendor {
    /// Returns its name in the names of cells.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Tandem => "tandem",
            Self::Cyclone => "cyclone",
            Self::Dust => "dust",
        }
    }

    /// Returns what this machine lacks to run it.
    pub(crate) fn missing(self) -> Option<String> {
        match self {
            Self::Cyclone => cyclone::missing(),
            Self::Tandem | Self::Dust => None,
        }
    }

    /// Opens a participant with a writer.
    pub(crate) fn writer(self, domain: u16, qos: Qos) -> Box<dyn Writer> {
        match self {
            Self::Tandem => Box::new(tandem::Tandem::writer(domain, qos)),
            Self::Cyclone => Box::new(cyclone::Cyclone::start("writer", domain, qos)),
            Self::Dust => Box::new(dust::DustWriter::open(domain, qos)),
        }
    }

    /// Opens a participant with a reader.
    pub(crate) fn reader(self, domain: u16, qos: Qos) -> Box<dyn Reader> {
        match self {
            Self::Tandem => Box::new(tandem::Tandem::reader(domain, qos)),
            Self::Cyclone => Box::new(cyclone::Cyclone::start("reader", domain, qos)),
            Self::Dust => Box::new(dust::DustReader::open(domain, qos)),
        }
    }
}
