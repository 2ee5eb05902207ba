//! The slave: it follows one master, and makes a sample of each Sync with its Follow_Up.

use super::codec::{Body, Message, correction_ns, decode};
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
    /// How often the master's time leapt by 10 ms or more.
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

/// A slave on one port.
#[derive(Clone, Debug)]
pub struct Slave<S: Scale> {
    link: Link,
    responder: Responder,
    followed: Option<Followed>,
    /// The grandmaster of the last Announce.
    announced: ClockId,
    /// When the master was chosen, or its last pair was heard.
    heard: Instant,
    /// The Sync that waits for its Follow_Up, and its time of arrival.
    sync: Option<(Message, Instant)>,
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
            heard: Instant::ORIGIN,
            sync: None,
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
            Err(why) => {
                let is_malformed = why == Why::Malformed;
                self.counts.malformed = self.counts.malformed.wrapping_add(is_malformed.into());
                self.refuse(why);
                return None;
            }
        };
        let from = message.source;
        match message.body {
            Body::Announce(grandmaster, claims) => self.on_announce(at, from, grandmaster, claims),
            Body::Sync if self.hears(at, from) => self.on_sync(at, message),
            Body::FollowUp(t1) if self.follows(from) => return self.on_follow_up(at, &message, t1),
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

    fn refuse(&mut self, why: Why) {
        self.refusal = self.refusal.max(why);
    }

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
        self.counts.chosen = self.counts.chosen.wrapping_add(followed.is_some().into());
        self.refusal = followed.map_or(Why::Silent, |_| Why::NoFollowUp);
        (self.followed, self.heard) = (followed, at);
        (self.sync, self.sequence, self.pair) = (None, None, None);
        if !self.link.is_peer() {
            self.link.reset();
        }
    }

    fn on_sync(&mut self, at: Instant, sync: Message) {
        let is_ahead = |last| (1..AHEAD).contains(&sync.sequence.wrapping_sub(last));
        let is_pending = |(before, _): &mut (Message, _)| before.sequence == sync.sequence;
        if !sync.is_two_step {
            self.refusal = Why::OneStep;
        } else if self.sequence.is_none_or(is_ahead) {
            self.sequence = Some(sync.sequence);
            self.sync = Some((sync, at));
        } else {
            // Doubled, or its number is wrong: nothing tells which of the two is the right one.
            self.sync.take_if(is_pending);
        }
    }

    /// A Follow_Up whose Sync was not heard before is of no use: links keep the order.
    fn on_follow_up(&mut self, at: Instant, it: &Message, t1: u64) -> Option<Sample<S>> {
        let is_its = |(sync, _): &mut (Message, _)| sync.sequence == it.sequence;
        let (sync, t2) = self.sync.take_if(is_its)?;
        let correction = sync.correction.saturating_add(it.correction);
        let t1 = t1.checked_add_signed(correction_ns(correction))?;
        if self.followed?.grandmaster != self.announced {
            return None;
        }
        if self.pair.is_some_and(|(last, _)| t2 <= last) {
            // The numbers say that it is later: the local clock has jumped.
            self.pair = None;
            self.link.clock_jumped(at);
        }
        let (last_t2, last_t1) = self.pair.unwrap_or((t2, t1));
        let moved = t1
            .wrapping_sub(last_t1)
            .wrapping_sub(t2.since(last_t2).as_ns());
        (self.heard, self.pair) = (at, Some((t2, t1)));
        self.link.on_pair(at, (t2, t1));
        if (moved as i64).unsigned_abs() >= LEAP_NS {
            // It is told first. A second pair without a leap shows that it was no damaged message.
            self.counts.leaps = self.counts.leaps.wrapping_add(1);
            return None;
        }
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
