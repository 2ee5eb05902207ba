//! The slave: it follows one master, and makes a sample of each Sync with its Follow_Up.

use super::codec::{Body, Message, Refused, correction_ns, decode};
use super::delay::{Link, Responder};
use super::{Claims, ClockId, EventId, PortIdentity, SlaveSettings, TimeOutlet, Why};
use crate::{GlobalTime, Sample, Scale};
use core::marker::PhantomData;
use tandem_board::{Duration, Instant};

/// A Sync that is further ahead than this is not a later one but wrong.
const AHEAD: u16 = 0x1000;
/// A master's time leaps when it moves this much further than the local clock, or less far.
const LEAP_NS: u64 = 10_000_000;

/// The master that is followed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Followed {
    /// The port whose Sync is heard.
    pub port: PortIdentity,
    /// The clock whose time it gives. Without Announce that of the port.
    pub grandmaster: ClockId,
    /// What is said of that clock.
    pub claims: Claims,
}

/// What a slave has counted; the counts wrap.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SlaveCounts {
    /// Samples.
    pub samples: u32,
    /// Messages that were no valid ones.
    pub malformed: u32,
    /// Announces and Syncs of other masters than the followed one, in its domain.
    pub others: u32,
    /// How often a master was chosen.
    pub chosen: u32,
    /// How often the master's time leapt by 10 ms or more, or it said so.
    pub leaps: u32,
    /// Exchanges that gave no delay.
    pub refused_delays: u32,
}

/// The state of a slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SlaveStatus {
    /// Whom it follows.
    pub followed: Option<Followed>,
    /// The delay of the link.
    pub delay: Option<Duration>,
    /// How much faster the clock at the other end runs than the own one, 10^-9.
    pub rate_ppb: i64,
    /// Why there are no samples; `None` while there are.
    pub why: Option<Why>,
    /// What was counted.
    pub counts: SlaveCounts,
}

/// The first half of a pair that was heard.
#[derive(Clone, Copy, Debug)]
enum Half {
    /// Its time of arrival.
    Sync(Message, Instant),
    /// It has overtaken its Sync.
    FollowUp(Message),
}

/// A slave on one port.
#[derive(Clone, Debug)]
pub struct Slave<S: Scale> {
    link: Link,
    responder: Responder,
    followed: Option<Followed>,
    /// The grandmaster of the last Announce.
    announced: ClockId,
    /// The number of its time base in the last Follow_Up.
    time_base: Option<u16>,
    /// When the master was chosen, or its last pair was heard.
    heard: Instant,
    half: Option<Half>,
    /// The last Sync.
    sequence: Option<u16>,
    /// The last pair: t2 and t1.
    pair: Option<(Instant, u64)>,
    /// Why no master is followed, or the one that is followed has no pair yet.
    refusal: Why,
    counts: SlaveCounts,
    scale: PhantomData<S>,
}

impl<S: Scale> Slave<S> {
    /// Creates a slave that follows no master yet.
    #[must_use]
    pub fn new(settings: SlaveSettings) -> Self {
        Self {
            link: Link::new(settings),
            responder: Responder::new(settings.profile, settings.identity),
            followed: None,
            announced: ClockId::default(),
            time_base: None,
            heard: Instant::ORIGIN,
            half: None,
            sequence: None,
            pair: None,
            refusal: Why::Silent,
            counts: SlaveCounts::default(),
            scale: PhantomData,
        }
    }

    /// Returns the state.
    #[must_use]
    pub fn status(&self) -> SlaveStatus {
        let delay = self.link.delay();
        let why = match &self.followed {
            None => Some(self.refusal),
            Some(followed) if followed.grandmaster != self.announced => Some(Why::OtherGrandmaster),
            Some(_) if self.pair.is_none() => Some(self.refusal),
            Some(_) => delay.is_none().then_some(self.link.why),
        };
        let refused_delays = self.link.refused;
        SlaveStatus {
            followed: self.followed,
            delay,
            rate_ppb: self.link.rate_ppb(),
            why,
            counts: SlaveCounts {
                refused_delays,
                ..self.counts
            },
        }
    }

    /// Does what is due. Returns when it wants to be called again, at the latest.
    pub fn poll(&mut self, now: Instant, out: &mut impl TimeOutlet) -> Instant {
        let silent_from = self.heard + self.link.settings.time_out;
        if self.followed.is_some() && now >= silent_from {
            self.choose(now, None);
        }
        let asks = self.link.poll(now, out);
        let until = self.followed.map_or(Instant::NEVER, |_| silent_from);
        asks.min(until)
    }

    /// Notes that an event message of this slave left at `at`.
    pub fn on_sent(&mut self, event: EventId, at: Instant, out: &mut impl TimeOutlet) {
        self.link.on_sent(event, at);
        self.responder.on_sent(event, at, out);
    }

    /// Hears a message that was received at `at`. Returns a sample if this completes one; its local
    /// time is not after `at`, and later than that of the sample before.
    pub fn on_message(
        &mut self,
        at: Instant,
        bytes: &[u8],
        out: &mut impl TimeOutlet,
    ) -> Option<Sample<S>> {
        let own = self.link.settings.identity;
        let message = match decode(bytes, self.link.settings.profile) {
            Ok(message) if message.source.clock == own.clock => return None,
            Ok(message) => message,
            Err(Refused::Malformed) => {
                self.counts.malformed = self.counts.malformed.wrapping_add(1);
                return None;
            }
            Err(Refused::OtherProfile) => return self.refuse(Why::OtherProfile),
            Err(Refused::OtherDomain) => return self.refuse(Why::OtherDomain),
        };
        let from = message.source;
        match message.body {
            Body::Announce(grandmaster, claims) => self.on_announce(at, from, grandmaster, claims),
            Body::Sync if self.hears(at, from) => return self.on_sync(at, message),
            Body::FollowUp(..) if self.follows(from) => {
                return self.on_follow_up(at, message);
            }
            Body::DelayResponse(_, to) if to == own && self.follows(from) => {
                self.link.on_answer(at, &message);
            }
            Body::PeerResponse(_, to) | Body::PeerResponseFollowUp(_, to)
                if to == own && self.link.is_peer() =>
            {
                self.link.on_answer(at, &message);
            }
            Body::PeerRequest => self.responder.on_request(at, &message, out),
            _ => {}
        }
        None
    }

    fn refuse(&mut self, why: Why) -> Option<Sample<S>> {
        self.refusal = self.refusal.max(why);
        None
    }

    /// Returns whether this port is the one that is followed. If it is another one, counts it.
    fn follows(&self, port: PortIdentity) -> bool {
        self.followed.is_some_and(|followed| followed.port == port)
    }

    /// Returns whether a Sync of this port counts. The first one chooses the master, if masters
    /// send no Announce.
    fn hears(&mut self, at: Instant, port: PortIdentity) -> bool {
        match self.link.settings.unannounced {
            _ if self.follows(port) => {}
            Some(claims) => self.on_announce(at, port, port.clock, claims),
            None if self.followed.is_some() => {
                self.counts.others = self.counts.others.wrapping_add(1)
            }
            None => self.refusal = self.refusal.max(Why::NoAnnounce),
        }
        self.follows(port)
    }

    fn on_announce(
        &mut self,
        at: Instant,
        port: PortIdentity,
        grandmaster: ClockId,
        claims: Claims,
    ) {
        let wanted = self.link.settings.master.unwrap_or(port.clock);
        if self.followed.is_some() && !self.follows(port) {
            self.counts.others = self.counts.others.wrapping_add(1);
        } else if wanted != port.clock {
            self.refuse(Why::OtherMaster);
        } else if !S::accepts(claims.is_ptp_timescale) {
            self.choose(at, None);
            self.refuse(Why::OtherScale);
        } else {
            self.announced = grandmaster;
            let followed = Followed {
                port,
                grandmaster,
                claims,
            };
            match &mut self.followed {
                None => self.choose(at, Some(followed)),
                Some(before) if before.grandmaster == grandmaster => *before = followed,
                // Its messages are of no use until the time-out says that the old time has ended.
                Some(_) => {}
            }
        }
    }

    /// Follows a master, or none.
    fn choose(&mut self, at: Instant, followed: Option<Followed>) {
        let chosen = u32::from(followed.is_some());
        self.counts.chosen = self.counts.chosen.wrapping_add(chosen);
        self.refusal = followed.map_or(Why::Silent, |_| Why::NoFollowUp);
        (self.followed, self.heard) = (followed, at);
        (self.half, self.sequence, self.pair, self.time_base) = (None, None, None, None);
        if !self.link.is_peer() {
            self.link.reset();
        }
    }

    fn is_new(&self, message: &Message) -> bool {
        let is_ahead = |last| (1..AHEAD).contains(&message.sequence.wrapping_sub(last));
        self.sequence.is_none_or(is_ahead)
    }

    fn on_sync(&mut self, at: Instant, sync: Message) -> Option<Sample<S>> {
        if !sync.is_two_step {
            self.refusal = Why::OneStep;
            return None;
        }
        if !self.is_new(&sync) {
            return None;
        }
        self.sequence = Some(sync.sequence);
        match self.half.replace(Half::Sync(sync, at)) {
            Some(Half::FollowUp(follow_up)) if follow_up.sequence == sync.sequence => {
                self.on_pair(at, (sync, at), follow_up)
            }
            _ => None,
        }
    }

    fn on_follow_up(&mut self, at: Instant, it: Message) -> Option<Sample<S>> {
        match self.half {
            Some(Half::Sync(sync, t2)) if sync.sequence == it.sequence => {
                self.on_pair(at, (sync, t2), it)
            }
            _ if self.is_new(&it) => {
                self.half = Some(Half::FollowUp(it));
                None
            }
            _ => None,
        }
    }

    fn on_pair(
        &mut self,
        at: Instant,
        (sync, t2): (Message, Instant),
        follow_up: Message,
    ) -> Option<Sample<S>> {
        self.half = None;
        let Body::FollowUp(t1, base) = follow_up.body else {
            return None;
        };
        let correction = sync.correction.saturating_add(follow_up.correction);
        let t1 = t1.checked_add_signed(correction_ns(correction))?;
        let last = self.pair.unwrap_or((Instant::ORIGIN, t1));
        if self.followed?.grandmaster != self.announced || self.pair.is_some() && t2 <= last.0 {
            return None;
        }
        let (span, moved) = (t2.since(last.0).as_ns(), t1.wrapping_sub(last.1));
        let gained = (moved.wrapping_sub(span) as i64).unsigned_abs();
        let is_new_base = base.is_some() && self.time_base.is_some_and(|it| Some(it) != base);
        let leaps = self.pair.is_some() && gained >= LEAP_NS || is_new_base;
        self.counts.leaps = self.counts.leaps.wrapping_add(u32::from(leaps));
        (self.heard, self.pair, self.time_base) = (at, Some((t2, t1)), base);
        self.link.on_pair(at, (t2, t1));
        let delay = self.link.delay()?;
        let global = GlobalTime::from_ns(t1.checked_add(delay.as_ns())?);
        self.counts.samples = self.counts.samples.wrapping_add(1);
        Some(Sample {
            local: t2,
            global,
            // All of the way there and back may be in one direction: the half of it is the error.
            error: delay + self.link.settings.stamp_error,
        })
    }
}
