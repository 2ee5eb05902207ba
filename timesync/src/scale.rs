//! Global time, with its time scale as a part of the type.

use core::fmt;
use core::marker::PhantomData;

use tandem_board::{Duration, Instant};

/// A time scale: what second 0 is, and whether leap seconds count.
pub trait Scale: Copy + Eq + fmt::Debug {
    /// Its name, for people.
    const NAME: &'static str;
    /// Whether a master's time may be taken as this scale. `is_ptp`: the flag PTP_TIMESCALE of IEEE
    /// 1588, which says that the master's time is TAI.
    fn accepts(is_ptp: bool) -> bool;
}

/// International atomic time since 1970-01-01 00:00:00 TAI: the time scale of PTP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tai {}

/// Coordinated universal time since 1970, without its leap seconds: 37 s behind TAI since 2017.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Utc {}

/// A time with an origin that only its master knows, such as the start of a vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arbitrary {}

impl Scale for Tai {
    const NAME: &'static str = "TAI";
    fn accepts(is_ptp: bool) -> bool {
        is_ptp
    }
}

impl Scale for Utc {
    const NAME: &'static str = "UTC";
    fn accepts(_: bool) -> bool {
        false
    }
}

impl Scale for Arbitrary {
    const NAME: &'static str = "arbitrary";
    fn accepts(_: bool) -> bool {
        true
    }
}

/// A point in global time: nanoseconds since the origin of its scale, up to the year 2554.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct GlobalTime<S: Scale> {
    ns: u64,
    scale: PhantomData<S>,
}

impl<S: Scale> GlobalTime<S> {
    /// The origin of the scale.
    pub const ORIGIN: Self = Self::from_ns(0);

    /// Returns the time `ns` nanoseconds after the origin.
    #[must_use]
    pub const fn from_ns(ns: u64) -> Self {
        Self {
            ns,
            scale: PhantomData,
        }
    }

    /// Returns the nanoseconds since the origin.
    #[must_use]
    pub const fn as_ns(self) -> u64 {
        self.ns
    }

    /// Returns this time moved by `ns`; saturates at both ends of the scale.
    #[must_use]
    pub const fn moved(self, ns: i64) -> Self {
        Self::from_ns(self.ns.saturating_add_signed(ns))
    }

    /// Returns how much later this is than `other`, ns; saturates.
    #[must_use]
    pub const fn after(self, other: Self) -> i64 {
        let span = self.ns.abs_diff(other.ns);
        let span = if span > i64::MAX as u64 {
            i64::MAX
        } else {
            span as i64
        };
        if self.ns < other.ns { -span } else { span }
    }
}

impl GlobalTime<Tai> {
    /// Returns the same moment in UTC. `leap_seconds`: how far TAI is ahead, s; 37 since 2017.
    #[must_use]
    pub const fn to_utc(self, leap_seconds: u16) -> GlobalTime<Utc> {
        GlobalTime::from_ns(self.ns.saturating_sub(leap_seconds as u64 * 1_000_000_000))
    }
}

impl GlobalTime<Utc> {
    /// The inverse of [`GlobalTime::to_utc`].
    #[must_use]
    pub const fn to_tai(self, leap_seconds: u16) -> GlobalTime<Tai> {
        GlobalTime::from_ns(self.ns.saturating_add(leap_seconds as u64 * 1_000_000_000))
    }
}

impl<S: Scale> fmt::Debug for GlobalTime<S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (seconds, ns) = (self.ns / 1_000_000_000, self.ns % 1_000_000_000);
        write!(f, "{seconds}.{ns:09} s {}", S::NAME)
    }
}

/// What a protocol has measured: at a local time it was this global time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sample<S: Scale> {
    /// Time on the local clock.
    pub local: Instant,
    /// The global time at that moment.
    pub global: GlobalTime<S>,
    /// The largest error of the pair that the protocol knows of: resolution of the stamps, and half
    /// of what it cannot tell from an asymmetry. Without the error of the master's own time.
    pub error: Duration,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// S-5: a time of PTP is not UTC; the leap seconds are said where one becomes the other.
    #[test]
    fn tai_is_ahead_of_utc_by_its_leap_seconds() {
        let tai = GlobalTime::<Tai>::from_ns(1_700_000_037_000_000_001);
        assert_eq!(tai.to_utc(37).as_ns(), 1_700_000_000_000_000_001);
        assert_eq!(tai.to_utc(37).to_tai(37), tai);
        assert!(Tai::accepts(true) && !Tai::accepts(false) && Arbitrary::accepts(false));
    }

    #[test]
    fn differences_saturate() {
        type Time = GlobalTime<Arbitrary>;
        let (first, last) = (Time::ORIGIN, Time::from_ns(u64::MAX));
        assert_eq!(
            (last.after(first), first.after(last)),
            (i64::MAX, -i64::MAX)
        );
        assert_eq!(Time::from_ns(7).moved(-9), first);
        assert_eq!(Time::from_ns(7).after(Time::from_ns(9)), -2);
    }
}
