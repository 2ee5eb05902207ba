//! The master: it gives the time that its caller has.

use super::codec::{Body, Message, decode, send};
use super::delay::Responder;
use super::{Claims, DelayMechanism, EventId, PortIdentity, PtpProfile, TimeOutlet, next};
use crate::{GlobalTime, Scale};
use core::marker::PhantomData;
use tandem_board::{Duration, Instant};

/// Period of Announce, and its exponent.
const ANNOUNCE_EVERY: (Duration, i8) = (Duration::from_ms(1_000), 0);

/// How a master works.
#[derive(Clone, Copy, Debug)]
pub struct MasterSettings {
    /// The own port.
    pub identity: PortIdentity,
    /// What it has in common with its slaves.
    pub profile: PtpProfile,
    /// What it says of its time; the flag of the scale is that of `S`.
    pub claims: Claims,
    /// Exponent of the period of Sync, s, −7 to 0: −3 is 125 ms.
    pub sync_exponent: i8,
}

/// A master on one port. `global` is its caller's conversion of local into global time; while it
/// returns `None`, no time is sent.
#[derive(Clone, Debug)]
pub struct Master<S: Scale> {
    settings: MasterSettings,
    responder: Responder,
    /// Of the last Sync, and of the last Announce.
    sequence: u16,
    announce: u16,
    /// The Sync that waits for its time of sending.
    sync: Option<EventId>,
    sync_due: Instant,
    announce_due: Instant,
    /// Announces and Syncs of other masters in the domain; the count wraps. It has no effect.
    pub others: u32,
    scale: PhantomData<S>,
}

impl<S: Scale> Master<S> {
    /// Creates a master.
    #[must_use]
    pub fn new(mut settings: MasterSettings) -> Self {
        settings.claims.is_ptp_timescale = S::accepts(true) && !S::accepts(false);
        Self {
            settings,
            responder: Responder::new(settings.profile, settings.identity),
            sequence: 0,
            announce: 0,
            sync: None,
            sync_due: Instant::ORIGIN,
            announce_due: Instant::ORIGIN,
            others: 0,
            scale: PhantomData,
        }
    }

    /// Does what is due. Returns when it wants to be called again, at the latest.
    pub fn poll(
        &mut self,
        now: Instant,
        global: impl FnOnce(Instant) -> Option<GlobalTime<S>>,
        out: &mut impl TimeOutlet,
    ) -> Instant {
        let has_time = global(now).is_some();
        let exponent = self.settings.sync_exponent;
        if now >= self.announce_due {
            self.announce_due = next(self.announce_due, ANNOUNCE_EVERY.0, now);
            self.announce = self.announce.wrapping_add(1);
            if has_time {
                let body = Body::Announce(self.settings.identity.clock, self.settings.claims);
                self.send(body, self.announce, ANNOUNCE_EVERY.1, out);
            }
        }
        if now >= self.sync_due {
            let every = Duration::from_ns(1_000_000_000 >> exponent.clamp(-7, 0).unsigned_abs());
            self.sync_due = next(self.sync_due, every, now);
            self.sequence = self.sequence.wrapping_add(1);
            self.sync = None;
            if has_time {
                self.sync = self.send(Body::Sync, self.sequence, exponent, out);
            }
        }
        self.announce_due.min(self.sync_due)
    }

    /// Notes that an event message of this master left at `at`, and sends its Follow_Up.
    pub fn on_sent(
        &mut self,
        event: EventId,
        at: Instant,
        global: impl FnOnce(Instant) -> Option<GlobalTime<S>>,
        out: &mut impl TimeOutlet,
    ) {
        if self.sync.take_if(|sync| *sync == event).is_none() {
            self.responder.on_sent(event, at, out);
        } else if let Some(t1) = global(at) {
            let body = Body::FollowUp(t1.as_ns());
            self.send(body, self.sequence, self.settings.sync_exponent, out);
        }
    }

    /// Hears a message that was received at `at`, and answers a request for the delay.
    pub fn on_message(
        &mut self,
        at: Instant,
        bytes: &[u8],
        global: impl FnOnce(Instant) -> Option<GlobalTime<S>>,
        out: &mut impl TimeOutlet,
    ) {
        let MasterSettings {
            profile, identity, ..
        } = self.settings;
        let Ok(message) = decode(bytes, profile) else {
            return;
        };
        match message.body {
            _ if message.source.clock == identity.clock => {}
            Body::Announce(..) | Body::Sync => self.others = self.others.wrapping_add(1),
            Body::PeerRequest => self.responder.on_request(at, &message, out),
            Body::DelayRequest if profile.delay == DelayMechanism::EndToEnd => {
                if let Some(t4) = global(at) {
                    let body = Body::DelayResponse(t4.as_ns(), message.source);
                    let mut answer = Message::new(identity, message.sequence, body);
                    answer.correction = message.correction;
                    send(profile, &answer, self.settings.sync_exponent, out);
                }
            }
            _ => {}
        }
    }

    fn send(
        &self,
        body: Body,
        sequence: u16,
        interval: i8,
        out: &mut impl TimeOutlet,
    ) -> Option<EventId> {
        let message = Message::new(self.settings.identity, sequence, body);
        send(self.settings.profile, &message, interval, out)
    }
}
