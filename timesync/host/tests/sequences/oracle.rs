//! Judges what readers see. It knows the true time, and nothing of how the product works: its
//! limits are those of the product's documentation.

use tandem_board::Instant;
use tandem_timesync::{Arbitrary, TimeReading, TimeStatus};

/// What a reader must never see.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Violation {
    /// The time is earlier than the last one.
    GoesBack,
    /// The time moves faster than its clock and corrections explain, and no leap is told.
    LeapsUntold,
    /// The time moves more slowly, and it is not told.
    StopsUntold,
    /// The time leaps, and the status did not say so before.
    LeapsUnannounced,
    /// For two seconds or more without faults, the time is farther from the truth than is stated,
    /// and the status says that it is synchronised to a master that is.
    WrongUntold,
    /// Its samples have stopped, and the status does not say so.
    StaleUntold,
    /// It is farther from the truth than the error that is stated.
    ErrorIsGreater,
    /// The status says that it is not synchronised, long after all faults.
    DoesNotRecover,
}

/// The rates of two crystals, and a correction: 200 ppm and 488 ppm. Rounded up.
const MOST_PPM: u64 = 700;
/// A step of the shown time from one conversion to the next, ns.
const ROUNDING_NS: u64 = 2_100;
/// A clock that jumps back reads times again that were shown with the correction that has been
/// slewed in since, 488 ppm for a period of up to 160 ms.
const SLEWED_NS: u64 = 80_000;
/// Without a sample that is followed for this long, the time is in holdover: gPTP and pulse, CAN.
const TIMEOUT_NS: [u64; 2] = [500_000_000, 400_000_000];

/// A clock has recovered from a jump when its time was right for so long: a jump that is no larger
/// than noise bends the rate for as long as the servo remembers it, 64 samples.
const RIGHT_AGAIN_NS: u64 = 8_000_000_000;

/// A deviation beyond this is a leap, ns.
const LEAP_NS: u64 = 1_000_000;
/// Two leaps in a row, each of which needs three samples, and before them three that are learned
/// from, ns.
const UNTOLD_NS: u64 = 2_000_000_000;

/// When a stated error was last exceeded with an excuse: a clock of the chain has jumped, or the
/// time began anew. Stated errors need not hold until all have held for [`RIGHT_AGAIN_NS`].
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Excuse(Option<u64>);

impl Excuse {
    pub(crate) fn begin(&mut self, now: u64) {
        self.0 = Some(now);
    }

    /// Notes whether a reading is right. Returns whether that breaks a rule.
    fn note(&mut self, now: u64, is_right: bool) -> bool {
        self.0 = self.0.filter(|at| now - at <= RIGHT_AGAIN_NS);
        if !is_right && self.0.is_some() {
            self.0 = Some(now);
        }
        !is_right && self.0.is_none()
    }
}

/// What a node has of the time, as the oracle sees it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Watched {
    /// Local and global time of the last reading of each reader.
    last: [Option<(u64, u64)>; 2],
    /// When a sample was last followed, on the local clock.
    followed: Option<u64>,
    /// When the time changed last, on the local clock.
    changed: Instant,
    /// Since when the time is wrong, and the status does not say so.
    untold: Option<u64>,
    /// The local clock has jumped since the last reading of each reader.
    has_jumped: [bool; 2],
}

impl Watched {
    /// Notes that a sample was followed.
    pub(crate) fn follows(&mut self, local: Instant) {
        self.followed = Some(local.as_ns());
    }

    /// Notes that the local clock has jumped.
    pub(crate) fn jumps(&mut self) {
        (self.followed, self.untold) = (None, None);
        self.has_jumped = [true; 2];
    }

    /// Notes that the node is its own master.
    pub(crate) fn is_origin(&mut self) {
        self.followed = None;
    }

    /// Judges a change of the time by what both conversions show at `now`. If the local clock has
    /// gone back, nothing could be told before.
    pub(crate) fn judge_change(
        &mut self,
        now: Instant,
        before: &TimeReading<Arbitrary>,
        after: &TimeReading<Arbitrary>,
    ) -> Option<Violation> {
        let was_told = before.status.has(TimeStatus::TIMELEAP_FUTURE)
            || before.status.has(TimeStatus::TIMELEAP_PAST);
        let leaps = after.time.after(before.time).unsigned_abs() > LEAP_NS;
        let went_back = now < core::mem::replace(&mut self.changed, now);
        (leaps && !was_told && !went_back).then_some(Violation::LeapsUnannounced)
    }

    /// Judges what a new reader would see now, while there are no faults. `later`: how much later
    /// than right it is, `further`: which error is stated elsewhere, ns.
    pub(crate) fn judge_untold(
        &mut self,
        now: u64,
        reading: &TimeReading<Arbitrary>,
        (later, further): (i64, u64),
    ) -> Option<Violation> {
        let is_right = later.unsigned_abs() <= reading.error.as_ns() + further;
        let is_told =
            !reading.status.is_synchronised() || reading.status.has(TimeStatus::SYNC_TO_GATEWAY);
        if is_right || is_told {
            self.untold = None;
            return None;
        }
        let since = *self.untold.get_or_insert(now);
        (now - since > UNTOLD_NS).then_some(Violation::WrongUntold)
    }

    /// Judges a reading. `truth`: how much later than right it is, ns, and which further error is
    /// stated elsewhere; `None` if there is no truth.
    pub(crate) fn judge(
        &mut self,
        (now, excuse): (u64, &mut Excuse),
        reader: usize,
        (local, is_sensor): (Instant, bool),
        reading: &TimeReading<Arbitrary>,
        truth: Option<(i64, u64)>,
    ) -> Option<Violation> {
        let (local, time) = (local.as_ns(), reading.time.as_ns());
        let status = reading.status;
        let is_told =
            status.has(TimeStatus::TIMELEAP_FUTURE) || status.has(TimeStatus::TIMELEAP_PAST);
        if let Some((last_local, last_time)) = self.last[reader].replace((local, time)) {
            if time < last_time {
                return Some(Violation::GoesBack);
            }
            let passed = local as i64 - last_local as i64;
            let moved = (time - last_time) as i64;
            let jumped = core::mem::take(&mut self.has_jumped[reader]);
            let again = if jumped { SLEWED_NS } else { 0 };
            let slack = passed.max(0) as u64 * MOST_PPM / 1_000_000 + ROUNDING_NS + again;
            if moved.abs_diff(passed) > slack && !is_told {
                let leaps = moved > passed;
                return Some(match leaps {
                    true => Violation::LeapsUntold,
                    false => Violation::StopsUntold,
                });
            }
        }
        let silent = self.followed.map(|at| local.saturating_sub(at));
        if silent.is_some_and(|ns| ns > TIMEOUT_NS[usize::from(is_sensor)])
            && status.is_synchronised()
        {
            return Some(Violation::StaleUntold);
        }
        if let Some((later, further)) = truth {
            let is_right = later.unsigned_abs() <= reading.error.as_ns() + further;
            // A leap that is told is not over.
            let is_wrong = excuse.note(now, is_right && !(is_told && excuse.0.is_some()));
            if is_wrong {
                return Some(Violation::ErrorIsGreater);
            }
        }
        None
    }
}
