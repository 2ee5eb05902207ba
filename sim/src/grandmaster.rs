//! A grandmaster of gPTP on the simulated network: the clock that all others follow.

use tandem_board::{Channel, Instant, Network, Recipient};
use tandem_board_sim::{SimPair, SimStation};
use tandem_timesync::gptp::{
    Claims, EventId, Master, MasterSettings, PortIdentity, PtpProfile, TimeOutlet,
};
use tandem_timesync::{Arbitrary, GlobalTime};

/// A clock that may be wrong: its time is `begin_ns`, and one nanosecond more for each of virtual
/// time, changed by a rate.
#[derive(Clone, Copy, Debug)]
pub struct GrandmasterClock {
    /// Its time at virtual time zero, ns.
    pub begin_ns: u64,
    /// How much faster than virtual time it runs, ppb.
    pub rate_ppb: i64,
    /// By how much it has leapt, ns.
    pub leapt_ns: i64,
}

impl GrandmasterClock {
    /// A clock that is right. In 2026, so that its seconds need 31 bits.
    pub const RIGHT: Self = Self {
        begin_ns: 1_790_000_000_000_000_000,
        rate_ppb: 0,
        leapt_ns: 0,
    };

    /// Returns its time at this virtual time.
    #[must_use]
    pub fn at(&self, now: Instant) -> GlobalTime<Arbitrary> {
        let drift = i128::from(now.as_ns()) * i128::from(self.rate_ppb) / 1_000_000_000;
        let moved = i64::try_from(drift).unwrap_or(0) + self.leapt_ns;
        GlobalTime::from_ns(self.begin_ns + now.as_ns()).moved(moved)
    }
}

/// The station of the grandmaster. Its stamps are exact.
pub struct Grandmaster {
    /// Its end of the network.
    pub station: SimStation,
    /// Its clock.
    pub clock: GrandmasterClock,
    master: Master<Arbitrary>,
    unstamped: Option<EventId>,
}

/// The network, as the grandmaster sends.
struct Port<'a> {
    station: &'a SimStation,
    unstamped: &'a mut Option<EventId>,
}

impl TimeOutlet for Port<'_> {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        let sent = self
            .station
            .try_send(Channel::Time, Recipient::Everyone, message);
        *self.unstamped = event.filter(|_| sent.is_ok());
    }
}

impl Grandmaster {
    /// Connects a grandmaster with this number, 0 to 255.
    ///
    /// # Panics
    /// If the pair has no network.
    #[must_use]
    pub fn join(pair: &mut SimPair, number: u8, clock: GrandmasterClock) -> Self {
        let settings = MasterSettings {
            identity: PortIdentity::from_mac([2, 0x67, 0x6D, 0, 0, number]),
            profile: PtpProfile::END_TO_END,
            claims: Claims::default(),
            sync_exponent: -3,
        };
        Self {
            station: pair.join_network(),
            clock,
            master: Master::new(settings),
            unstamped: None,
        }
    }

    /// Sends and answers what is due. Call it each millisecond.
    pub fn turn(&mut self, now: Instant) {
        let Self {
            station,
            clock,
            master,
            unstamped,
        } = self;
        let global = |at| Some(clock.at(at));
        // Of two messages that were sent together only the newer one has a stamp: ask in between.
        if let (Some(event), Some(at)) = (*unstamped, station.sent_at(Channel::Time)) {
            *unstamped = None;
            master.on_sent(event, at, global, &mut Port { station, unstamped });
        }
        let mut bytes = [0; 128];
        while let Some(it) = station.try_receive(Channel::Time, &mut bytes) {
            let message = &bytes[..it.len];
            master.on_message(it.at, message, global, &mut Port { station, unstamped });
        }
        if unstamped.is_none() {
            master.poll(now, global, &mut Port { station, unstamped });
        }
    }
}
