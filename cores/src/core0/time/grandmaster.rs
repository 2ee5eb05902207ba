//! The grandmaster on the Ethernet: core 0 is its slave, with the end-to-end delay. S-2
//!
//! All stations hang on one switch, so the peers of a link cannot ask each other.

use crate::trace::Event;
use tandem_board::{
    Board, Channel, Datagram, Duration, Instant, Network, NetworkAddress, Recipient,
};
use tandem_timesync::gptp::{EventId, PortIdentity, PtpProfile, Slave, SlaveSettings, TimeOutlet};
use tandem_timesync::{Arbitrary, Conversion, MasterQuality, Sample};

/// Datagrams that one job reads at most.
const DATAGRAMS: u8 = 16;
/// Length of the longest message that is read, bytes.
const LONGEST: usize = 128;
/// Two times that differ by more are told: several errors of stamps in software. What an asymmetry
/// might be is not added to it, because an asymmetry is what this finds.
const TOLERANCE: Duration = Duration::from_us(50);
/// After this many samples in succession that differ: a second.
const DIFFERENT: u8 = 8;

/// How often another grandmaster is told.
const TELLS_OF_OTHERS_EVERY: Duration = Duration::from_ms(1_000);

/// The Ethernet port, as the slave sends.
struct Port<'a, N> {
    network: &'a N,
    /// The request whose time of sending is not known yet.
    unstamped: &'a mut Option<EventId>,
}

impl<N: Network> TimeOutlet for Port<'_, N> {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        let sent = self
            .network
            .try_send(Channel::Time, Recipient::Everyone, message);
        // The time of sending is that of the newest datagram.
        *self.unstamped = event.filter(|_| sent.is_ok());
    }
}

/// The slave, and what was last told of it.
#[derive(Default)]
pub(super) struct Grandmaster {
    slave: Option<Slave<Arbitrary>>,
    unstamped: Option<EventId>,
    /// Code of the reason why nothing is followed, as last traced.
    told: Option<u8>,
    /// How many messages of others were heard when that was last traced, and when it was.
    others: (u32, Instant),
    /// Samples in succession that differ from the time that is followed.
    different: u8,
    read: u8,
}

impl Grandmaster {
    /// Returns whether this system has a port.
    pub(super) const fn is_open(&self) -> bool {
        self.slave.is_some()
    }

    /// Opens the slave if there is a port, and lets it ask what is due.
    pub(super) fn open<B: Board>(&mut self, board: &B) {
        self.read = 0;
        if self.slave.is_none() {
            let Some(at) = board.network().address(Channel::Time) else {
                return;
            };
            let settings = SlaveSettings::new(identity(at), PtpProfile::END_TO_END);
            self.slave = Some(Slave::new(settings));
        }
        let Some(slave) = &mut self.slave else { return };
        let network = board.network();
        if let (Some(event), Some(at)) = (self.unstamped, network.sent_at(Channel::Time)) {
            self.unstamped = None;
            let unstamped = &mut self.unstamped;
            slave.on_sent(event, at, &mut Port { network, unstamped });
        }
        let unstamped = &mut self.unstamped;
        slave.poll(board.now(), &mut Port { network, unstamped });
    }

    /// Reads what has arrived. Returns the next sample, what it is worth, and the delay of the
    /// link.
    pub(super) fn next<B: Board>(
        &mut self,
        board: &B,
    ) -> Option<(Sample<Arbitrary>, MasterQuality, Duration)> {
        let slave = self.slave.as_mut()?;
        let network = board.network();
        let mut bytes = [0; LONGEST];
        while self.read < DATAGRAMS {
            self.read += 1;
            let Datagram { len, at, .. } = network.try_receive(Channel::Time, &mut bytes)?;
            let unstamped = &mut self.unstamped;
            let out = &mut Port { network, unstamped };
            let message = bytes.get(..len).unwrap_or_default();
            if let Some(sample) = slave.on_message(at, message, out) {
                let delay = slave.status().delay.unwrap_or_default();
                return Some((sample, MasterQuality::default(), delay));
            }
        }
        None
    }

    /// Compares a sample with the time that this system follows instead. Returns how much later the
    /// grandmaster says it is, ns, once several samples in succession differ.
    pub(super) fn disagrees(
        &mut self,
        sample: &Sample<Arbitrary>,
        own: Option<Conversion<Arbitrary>>,
    ) -> Option<i64> {
        let own = own?;
        let apart = sample.global.after(own.at(sample.local));
        let differs = apart.unsigned_abs() > TOLERANCE.as_ns();
        self.different = if differs {
            self.different.saturating_add(1)
        } else {
            0
        };
        (self.different == DIFFERENT).then_some(apart)
    }

    /// Returns the event that tells that another grandmaster sends in the domain, each second.
    pub(super) fn others(&mut self, now: Instant) -> Option<Event> {
        let others = self.slave.as_ref()?.status().counts.others;
        let (told, at) = self.others;
        let is_new = others != told && now.since(at) >= TELLS_OF_OTHERS_EVERY;
        is_new.then(|| {
            self.others = (others, now);
            Event::OtherGrandmaster { others }
        })
    }

    /// Returns the event that tells whether the grandmaster is followed, when that has changed.
    pub(super) fn change(&mut self) -> Option<Event> {
        let status = self.slave.as_ref()?.status();
        let why = status.why.map_or(0, |why| why as u8 + 1);
        (self.told.replace(why) != Some(why)).then_some(Event::GrandmasterTime { why })
    }
}

/// Returns the port of the slave, named by its address.
fn identity(NetworkAddress { address, port }: NetworkAddress) -> PortIdentity {
    let [a, b, c, d] = address;
    let [_, low] = port.to_be_bytes();
    // A MAC address that is locally administered.
    PortIdentity::from_mac([0x02, low, a, b, c, d])
}
