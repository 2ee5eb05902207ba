//! The witness of the reports: the other system's reports about itself, over the link and on CAN.

use crate::ability::Abilities;
use crate::{LinkReport, Mode, PeerReport, Role, Term};
use tandem_board::{Duration, Instant};

/// A report that was sent earlier than the last one by less than this is an old one, µs. If it is
/// earlier by more, the last one had a wrong time, which must not silence the link for long.
const OLD_US: u32 = 1_000_000;

/// The last reports of the other system.
#[derive(Clone, Debug, Default)]
pub(crate) struct Reports {
    /// Its last report over the link, and when it arrived.
    link: Option<(PeerReport, Instant)>,
    /// Start and time of the last datagram, on its sender's clock.
    last_sent: Option<(u16, u32)>,
    /// Its last report over any path.
    newest: Option<(PeerReport, Instant)>,
    /// When it began to report over the link, without a pause, that it drives in a higher term than
    /// this system and hears the bus.
    claims_since: Option<Instant>,
    /// When its status frame last reported on CAN that it is standby.
    standby_at: Option<Instant>,
    /// How well both systems can drive.
    pub(crate) abilities: Abilities,
}

/// The position of a datagram relative to the last one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Next {
    Yes,
    /// It is the first one since its sender has started, or has set its clock.
    Restarted,
    /// It repeats the last one, or is older.
    No,
}

impl Reports {
    /// Compares a datagram's time with that of the last one, and stores it unless it is old.
    pub(crate) fn is_next(&mut self, link: &LinkReport) -> Next {
        let next = match self.last_sent {
            Some((start, _)) if start != link.start => Next::Restarted,
            Some((_, last_us)) => match last_us.wrapping_sub(link.sent_us) {
                ..OLD_US => Next::No,
                behind if behind as i32 > 0 => Next::Restarted,
                _ => Next::Yes,
            },
            None => Next::Yes,
        };
        if next != Next::No {
            self.last_sent = Some((link.start, link.sent_us));
        }
        next
    }

    /// Handles a report over the link. `own`: the term of this system. Returns how long the other
    /// system has claimed to drive in a higher term, if it claims that now.
    pub(crate) fn on_link(
        &mut self,
        now: Instant,
        report: PeerReport,
        own: Term,
    ) -> Option<Duration> {
        self.link = Some((report, now));
        self.abilities.on_report(report.ability);
        self.newest = self.link;
        let claims = report.role == Role::Master && report.can_alive && report.term > own;
        self.claims_since = claims.then(|| self.claims_since.unwrap_or(now));
        self.claims_since.map(|since| now.since(since))
    }

    pub(crate) fn on_status(&mut self, now: Instant, report: PeerReport) {
        self.newest = Some((report, now));
        self.abilities.on_report(report.ability);
        if report.role == Role::Standby {
            self.standby_at = Some(now);
        }
    }

    /// Returns the last report over the link, unless it is older than `limit`.
    pub(crate) fn fresh(&self, now: Instant, limit: Duration) -> Option<PeerReport> {
        self.link
            .filter(|(_, at)| now.since(*at) <= limit)
            .map(|(report, _)| report)
    }

    /// Returns the time at which the last report over the link arrived; `None` if there was none.
    pub(crate) fn heard_at(&self) -> Option<Instant> {
        self.link.map(|(_, at)| at)
    }

    /// Returns the time since the last report over the link.
    pub(crate) fn silent_for(&self, now: Instant) -> Option<Duration> {
        self.heard_at().map(|at| now.since(at))
    }

    /// Returns whether the other system reported over the link within `limit` that it drives.
    pub(crate) fn drives(&self, now: Instant, limit: Duration) -> bool {
        self.fresh(now, limit)
            .is_some_and(|report| report.role == Role::Master)
    }

    /// Returns whether the other system's last report, if not older than `limit`, says that it
    /// drives and stops the vehicle.
    pub(crate) fn resigns(&self, now: Instant, limit: Duration) -> bool {
        self.newest.is_some_and(|(report, at)| {
            now.since(at) <= limit && report.role == Role::Master && report.mode == Mode::SafeStop
        })
    }

    /// Returns whether the other system was heard on CAN as standby within `limit`.
    pub(crate) fn standby_within(&self, now: Instant, limit: Duration) -> bool {
        self.standby_at.is_some_and(|at| now.since(at) <= limit)
    }

    /// Returns whether the other system was ever heard on CAN as standby.
    pub(crate) const fn was_standby(&self) -> bool {
        self.standby_at.is_some()
    }
}
