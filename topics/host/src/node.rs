//! A participant on its sockets: the loop that brings it datagrams and the time.

use crate::udp::Udp;
use std::io;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use tandem_board::Instant;
use tandem_board_udp::UdpPlace;
use tandem_topics::{Endpoint, GuidPrefix, Participant, Sample, WriteError};

/// How many samples an endpoint of the host keeps at most.
pub const DEPTH: usize = 32;
/// The longest sample, bytes.
pub const BYTES: usize = 255;

/// A participant of this process, with `W` writers and `R` readers.
#[derive(Debug)]
pub struct Node<const W: usize, const R: usize> {
    /// The participant.
    pub participant: Participant<W, R, DEPTH, BYTES, BYTES>,
    /// Its name.
    prefix: GuidPrefix,
    udp: Udp,
    start: std::time::Instant,
    /// The time that it was told.
    told: Option<Instant>,
}

impl<const W: usize, const R: usize> Node<W, R> {
    /// Opens a participant with a new name.
    ///
    /// # Errors
    /// As [`Udp::open`].
    pub fn open(
        place: UdpPlace,
        outputs: &'static [Endpoint; W],
        inputs: &'static [Endpoint; R],
    ) -> io::Result<Self> {
        let since = SystemTime::now().duration_since(UNIX_EPOCH);
        let time = since.unwrap_or_default().as_nanos() as u64;
        let mut prefix = [0; 12];
        prefix[..4].copy_from_slice(&std::process::id().to_le_bytes());
        prefix[4..].copy_from_slice(&time.to_le_bytes());
        Self::open_as(GuidPrefix(prefix), place, outputs, inputs)
    }

    /// Opens a participant with this name, which must be new at each start.
    ///
    /// # Errors
    /// As [`Udp::open`].
    pub fn open_as(
        prefix: GuidPrefix,
        place: UdpPlace,
        outputs: &'static [Endpoint; W],
        inputs: &'static [Endpoint; R],
    ) -> io::Result<Self> {
        let udp = Udp::open(place)?;
        Ok(Self {
            participant: Participant::new(prefix, udp.at(), outputs, inputs),
            prefix,
            udp,
            start: std::time::Instant::now(),
            told: None,
        })
    }

    /// Returns the name of the participant.
    pub const fn prefix(&self) -> GuidPrefix {
        self.prefix
    }

    /// Returns the time: the one that was told, or else the time since the participant was opened.
    pub fn now(&self) -> Instant {
        let elapsed = || Instant::from_ns(self.start.elapsed().as_nanos() as u64);
        self.told.unwrap_or_else(elapsed)
    }

    /// Tells the time. After the first call it stands still between calls: this is for a peer in an
    /// emulated machine.
    pub const fn tell_time(&mut self, now: Instant) {
        self.told = Some(now);
    }

    /// Does what is due, waits for a datagram at most for this time, and hears it. Returns whether
    /// one has arrived. Take the samples after each turn: a reader of a short history has no room
    /// for those of many datagrams.
    ///
    /// # Errors
    /// As [`Udp::wait`].
    pub fn turn(&mut self, most: Duration) -> io::Result<bool> {
        self.turn_watched(most, |_| {})
    }

    /// As [`turn`](Self::turn); shows the datagram.
    ///
    /// # Errors
    /// As [`Udp::wait`].
    pub fn turn_watched(
        &mut self,
        most: Duration,
        mut watch: impl FnMut(&[u8]),
    ) -> io::Result<bool> {
        let due = self.participant.poll(self.now(), &mut self.udp);
        let until = Duration::from_nanos(due.since(self.now()).as_ns());
        self.udp.wait(most.min(until))?;
        let datagram = self.udp.receive();
        if let Some(datagram) = &datagram {
            watch(datagram);
            self.participant.hear(self.now(), datagram, &mut self.udp);
        }
        Ok(datagram.is_some())
    }

    /// Publishes a sample: representation and body.
    ///
    /// # Errors
    /// [`WriteError`] says why it was not published.
    pub fn write(&mut self, writer: usize, sample: &[u8]) -> Result<(), WriteError> {
        self.participant.write(writer, sample, &mut self.udp)
    }

    /// Takes the next sample of a reader.
    pub fn take(&mut self, reader: usize) -> Option<Sample<BYTES>> {
        self.participant.take(reader)
    }
}

impl<const W: usize, const R: usize> Drop for Node<W, R> {
    /// Says that the participant ends, so that others do not wait for its lease.
    fn drop(&mut self) {
        self.participant.leave(&mut self.udp);
    }
}
