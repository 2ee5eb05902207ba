//! The delay of a link and the rate of the clock at its other end: filters, exchanges, answers.

use super::codec::{Body, Message, correction_ns, send};
use super::{
    DelayMechanism, EventId, PortIdentity, PtpProfile, SlaveSettings, TimeOutlet, Why, next,
};
use tandem_board::{Duration, Instant};

/// The median is over this many delays.
const DEPTH: usize = 8;
/// After this many requests in a row without a delay, the old one counts no more.
const LOST: u8 = 3;
/// A rate is measured over 4 to 8 s, and used from 0.5 s on.
const RATE_OVER: Duration = Duration::from_ms(4_000);
const RATE_FROM: Duration = Duration::from_ms(500);
/// Two clocks of 100 ppm each differ by a 5,000th at most. 802.1AS, B.1.1
const WILD: u64 = 5_000;
/// The master is asked this long after a Sync.
const ASKS_AFTER: Duration = Duration::from_ms(10);
/// With an older Sync it is not asked: at 200 ppm the clocks drift apart by half of the stamps'
/// error in software, before their rate is known.
const OLDEST_SYNC: Duration = Duration::from_ms(50);
/// The exponent of an interval that is not told.
const NO_INTERVAL: i8 = 0x7F;

/// The last delays, ns; the newest first.
#[derive(Clone, Copy, Debug, Default)]
struct Filter {
    values: [i64; DEPTH],
    len: usize,
}

impl Filter {
    fn push(&mut self, mut value: i64) {
        for place in &mut self.values {
            core::mem::swap(place, &mut value);
        }
        self.len = DEPTH.min(self.len + 1);
    }

    /// Returns the lower median.
    fn median(&self) -> Option<i64> {
        let values = || self.values.iter().take(self.len);
        let half = self.len.saturating_sub(1) / 2;
        let is_median = |it: &&i64| {
            let below = values().filter(|other| other < it).count();
            let up_to = values().filter(|other| *other <= *it).count();
            below <= half && half < up_to
        };
        values().find(is_median).copied()
    }
}

/// How much faster a remote clock runs than the local one.
#[derive(Clone, Copy, Debug, Default)]
struct Rate {
    /// Local and remote time of an older and of a newer measurement.
    older: Option<(Instant, u64)>,
    newer: Option<(Instant, u64)>,
    /// The last measurement was wild.
    struck: bool,
    /// 10^-9.
    ppb: Option<i64>,
}

impl Rate {
    /// Notes that the remote clock showed `remote` at `local`. Returns whether that is possible, if
    /// stamps err by `error`. A second impossible pair in a row is a new beginning.
    fn measure(&mut self, local: Instant, remote: u64, error: Duration) -> bool {
        let older = *self.older.get_or_insert((local, remote));
        let span = local.since(older.0);
        let span_ns = signed(span);
        let gained = (remote.wrapping_sub(older.1) as i64).wrapping_sub(span_ns);
        let bound = error.times(4).as_ns().saturating_add(span.as_ns() / WILD);
        if gained.unsigned_abs() > bound {
            let ppb = self.ppb;
            if core::mem::replace(&mut self.struck, true) {
                *self = Self {
                    ppb,
                    ..Self::default()
                };
            }
            return false;
        }
        self.struck = false;
        if span >= RATE_FROM {
            self.ppb = gained.saturating_mul(1_000_000_000).checked_div(span_ns);
        }
        if self
            .newer
            .is_none_or(|newer| local.since(newer.0) >= RATE_OVER)
        {
            self.older = self.newer.or(self.older);
            self.newer = Some((local, remote));
        }
        true
    }

    /// Returns what the remote clock gains in a local span, ns.
    fn gain(&self, span: Duration) -> i64 {
        (signed(span) / 1_000).saturating_mul(self.ppb.unwrap_or(0)) / 1_000_000
    }
}

fn signed(span: Duration) -> i64 {
    i64::try_from(span.as_ns()).unwrap_or(i64::MAX)
}

/// A request and what has come of it, in any order.
#[derive(Clone, Copy, Debug, Default)]
struct Exchange {
    id: Option<EventId>,
    /// Of the last Sync: t2 and t1.
    sync: Option<(Instant, u64)>,
    sent: Option<Instant>,
    /// Pdelay_Resp or Delay_Resp: from whom, the time in it, its arrival.
    answer: Option<(PortIdentity, u64, Instant)>,
    /// Pdelay_Resp_Follow_Up.
    follow_up: Option<(PortIdentity, u64, Instant)>,
    /// A second port has answered.
    is_ambiguous: bool,
}

/// The delay to the other end of a link.
#[derive(Clone, Debug)]
pub(super) struct Link {
    pub(super) settings: SlaveSettings,
    exchange: Option<Exchange>,
    /// The last Sync, for the end-to-end delay: t2 and t1.
    sync: Option<(Instant, u64)>,
    sequence: u16,
    due: Instant,
    filter: Filter,
    /// Of the peer's clock, or of the master's for the end-to-end delay.
    rate: Rate,
    /// Whose delay it is.
    peer: Option<PortIdentity>,
    /// Requests in a row without a delay.
    failed: u8,
    /// How many exchanges gave no delay.
    pub(super) refused: u32,
    pub(super) why: Why,
}

impl Link {
    pub(super) fn new(settings: SlaveSettings) -> Self {
        Self {
            settings,
            exchange: None,
            sync: None,
            sequence: 0,
            due: Instant::ORIGIN,
            filter: Filter::default(),
            rate: Rate::default(),
            peer: None,
            failed: 0,
            refused: 0,
            why: Why::NoAnswer,
        }
    }

    pub(super) fn is_peer(&self) -> bool {
        self.settings.profile.delay == DelayMechanism::Peer
    }

    /// Forgets the delay, as the other end is a new one. A request that is under way is void.
    pub(super) fn reset(&mut self) {
        (self.exchange, self.failed, self.why) = (None, 0, Why::NoAnswer);
        (self.filter, self.rate, self.sync) = (Filter::default(), Rate::default(), None);
    }

    /// Forgets what was measured on the local clock, which has jumped back to `now`. The delay
    /// stays.
    pub(super) fn clock_jumped(&mut self, now: Instant) {
        (self.exchange, self.rate, self.sync) = (None, Rate::default(), None);
        self.due = self.due.min(now);
    }

    pub(super) fn delay(&self) -> Option<Duration> {
        let ns = self.filter.median()?;
        Some(Duration::from_ns(ns.unsigned_abs()))
    }

    pub(super) fn rate_ppb(&self) -> i64 {
        self.rate.ppb.unwrap_or(0)
    }

    /// Asks the other end when it is time. Returns when it will be time again.
    ///
    /// The last exchange is judged here: all that answer have done so by now.
    pub(super) fn poll(&mut self, now: Instant, out: &mut impl TimeOutlet) -> Instant {
        self.sync = self.sync.filter(|(t2, _)| now.since(*t2) <= OLDEST_SYNC);
        let can_ask = self.is_peer() || self.sync.is_some();
        if can_ask && now >= self.due {
            if let Some(exchange) = self.exchange.take() {
                let delay = self.peer_delay(&exchange);
                self.judge(delay);
            }
            self.ask(now, out);
        } else if !can_ask {
            return Instant::NEVER;
        }
        self.due
    }

    /// Hears of a Sync that arrived at t2 and left at t1. The master is asked soon after it, so
    /// that the clocks cannot drift far apart, but not at once: a warm cache would send faster than
    /// the master did.
    pub(super) fn on_pair(&mut self, now: Instant, (t2, t1): (Instant, u64)) {
        let is_sound = !self.is_peer() && self.rate.measure(t2, t1, self.settings.stamp_error);
        if is_sound && self.rate.ppb.is_some() && self.sync.replace((t2, t1)).is_none() {
            self.due = self.due.max(now + ASKS_AFTER);
        }
    }

    fn ask(&mut self, now: Instant, out: &mut impl TimeOutlet) {
        self.due = next(self.due, self.settings.ask_every, now);
        self.sequence = self.sequence.wrapping_add(1);
        let sync = self.sync.take();
        let body = sync.map_or(Body::PeerRequest, |_| Body::DelayRequest);
        let message = Message::new(self.settings.identity, self.sequence, body);
        self.exchange = Some(Exchange {
            id: send(self.settings.profile, &message, NO_INTERVAL, out),
            sync,
            ..Exchange::default()
        });
    }

    /// Notes when a request left.
    pub(super) fn on_sent(&mut self, event: EventId, at: Instant) {
        if let Some(exchange) = &mut self.exchange
            && exchange.id == Some(event)
        {
            exchange.sent.get_or_insert(at);
            self.complete();
        }
    }

    /// Hears an answer; of one port only the first one counts.
    pub(super) fn on_answer(&mut self, at: Instant, message: &Message) {
        let Some(exchange) = self.exchange.as_mut() else {
            return;
        };
        let correction = correction_ns(message.correction);
        let (place, time) = match message.body {
            Body::PeerResponse(time, _) | Body::DelayResponse(time, _) => (
                &mut exchange.answer,
                time.wrapping_sub(correction.cast_unsigned()),
            ),
            Body::PeerResponseFollowUp(time, _) => (
                &mut exchange.follow_up,
                time.wrapping_add(correction.cast_unsigned()),
            ),
            _ => return,
        };
        if message.sequence == self.sequence {
            let (first, ..) = *place.get_or_insert((message.source, time, at));
            exchange.is_ambiguous |= first != message.source;
            self.complete();
        }
    }

    /// Judges an exchange with the master as soon as it is complete.
    fn complete(&mut self) {
        if let Some(exchange) = self.exchange
            && let (Some((t2, t1)), Some(t3), Some((_, t4, _))) =
                (exchange.sync, exchange.sent, exchange.answer)
        {
            self.exchange = None;
            let forth = t2.as_ns().wrapping_sub(t1);
            let back = t4.wrapping_sub(t3.as_ns());
            // What the clocks have drifted apart from t2 to t3 is no delay.
            let drift = self.rate.gain(t3.since(t2));
            let both = forth.wrapping_add(back) as i64;
            self.judge(Ok(both.saturating_sub(drift) / 2));
        }
    }

    /// Computes ((t4 − t1) · rate ratio − (t3 − t2)) / 2.
    fn peer_delay(&mut self, exchange: &Exchange) -> Result<i64, Why> {
        if exchange.is_ambiguous {
            return Err(Why::ManyPeers);
        }
        let t1 = exchange.sent.ok_or(Why::NoStamp)?;
        let (from, t2, t4) = exchange.answer.ok_or(Why::NoAnswer)?;
        let (same, t3, _) = exchange.follow_up.ok_or(Why::NoAnswer)?;
        if same != from {
            return Err(Why::ManyPeers);
        }
        if self.peer.replace(from) != Some(from) {
            self.reset();
        }
        let turnaround = t3.wrapping_sub(t2) as i64;
        if !self.rate.measure(t4, t3, self.settings.stamp_error) || turnaround < 0 {
            return Err(Why::WildRate);
        }
        let round = t4.since(t1);
        let remote = signed(round).saturating_add(self.rate.gain(round));
        Ok(remote.saturating_sub(turnaround) / 2)
    }

    fn judge(&mut self, delay: Result<i64, Why>) {
        let least = -signed(self.settings.stamp_error);
        let most = signed(self.settings.max_delay);
        let delay = delay.and_then(|ns| match ns {
            ns if ns < least => Err(Why::NegativeDelay),
            ns if ns > most => Err(Why::DelayAboveThreshold),
            ns => Ok(ns.max(0)),
        });
        match delay {
            Ok(ns) => {
                self.filter.push(ns);
                self.failed = 0;
            }
            Err(why) => {
                self.why = why;
                self.refused = self.refused.wrapping_add(1);
                self.failed = self.failed.saturating_add(1);
                if self.failed >= LOST || why == Why::ManyPeers {
                    self.filter = Filter::default();
                }
            }
        }
    }
}

/// Answers requests for the peer delay, one after the other: a link has one peer.
#[derive(Clone, Debug)]
pub(super) struct Responder {
    profile: PtpProfile,
    own: PortIdentity,
    /// The request whose answer waits for its time of sending, when it came, and the answer's id.
    pending: Option<(Message, Instant, Option<EventId>)>,
}

impl Responder {
    /// An answer of which no time of sending is told is given up after this time.
    const GIVES_UP: Duration = Duration::from_ms(500);

    pub(super) const fn new(profile: PtpProfile, own: PortIdentity) -> Self {
        Self {
            profile,
            own,
            pending: None,
        }
    }

    pub(super) fn on_request(&mut self, at: Instant, ask: &Message, out: &mut impl TimeOutlet) {
        let is_busy = |(_, since, _): &(_, Instant, _)| at.since(*since) < Self::GIVES_UP;
        if self.profile.delay != DelayMechanism::Peer || self.pending.as_ref().is_some_and(is_busy)
        {
            return;
        }
        let body = Body::PeerResponse(at.as_ns(), ask.source);
        let message = Message::new(self.own, ask.sequence, body);
        let event = send(self.profile, &message, NO_INTERVAL, out);
        self.pending = Some((*ask, at, event));
    }

    pub(super) fn on_sent(&mut self, event: EventId, at: Instant, out: &mut impl TimeOutlet) {
        let is_it = |(_, _, id): &mut (_, _, Option<EventId>)| *id == Some(event);
        if let Some((ask, ..)) = self.pending.take_if(is_it) {
            let body = Body::PeerResponseFollowUp(at.as_ns(), ask.source);
            let mut message = Message::new(self.own, ask.sequence, body);
            message.correction = ask.correction;
            send(self.profile, &message, NO_INTERVAL, out);
        }
    }
}
