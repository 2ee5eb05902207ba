//! The ability to drive: what each system says of itself, and which of them drives better.

use core::cmp::Ordering;
use strum::{FromRepr, VariantArray};
use tandem_board::{Duration, Instant};

/// A word of the other system about its ability counts when this many reports in a row confirm it:
/// a single wrong report changes nothing.
const REPORTS: usize = 3;
/// A standby that has been no backup for this long counts as failed, if its master is more able: a
/// loss that both have may last longer in one of them.
const UNABLE_LIMIT: Duration = Duration::from_ms(500);

/// How well a system can drive. A greater ability is a better one.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, FromRepr, VariantArray, Hash,
)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Ability {
    /// Neither lanes nor the vehicle's motion: it could only brake.
    None = 0,
    /// No lanes, or no motion: it can only stop the vehicle.
    StopOnly = 1,
    /// Drives, but a sensor is missing.
    Lacks = 2,
    /// Drives with all sensors.
    #[default]
    All = 3,
}

impl Ability {
    /// Returns whether a system with this ability is a backup: it takes over and drives on.
    #[must_use]
    pub const fn is_backup(self) -> bool {
        matches!(self, Self::Lacks | Self::All)
    }

    /// Returns how long a master must be less able than its standby before it offers its role: if
    /// both lose the same sensor, the other one reports it within this time. A master without a
    /// motion stops the vehicle after 100 ms, so it cannot wait longer.
    const fn offer_after(self) -> Duration {
        Duration::from_ms(if self.is_backup() { 100 } else { 25 })
    }

    /// Returns the two bits of a report. A system that reports no ability sends 0, which is
    /// [`Ability::All`].
    #[must_use]
    pub const fn bits(self) -> u8 {
        3 - self as u8
    }

    /// Returns the ability in the lowest two bits.
    #[must_use]
    pub const fn from_bits(bits: u8) -> Self {
        match bits & 3 {
            0 => Self::All,
            1 => Self::Lacks,
            2 => Self::StopOnly,
            _ => Self::None,
        }
    }
}

/// The abilities of both systems.
#[derive(Clone, Debug, Default)]
pub(crate) struct Abilities {
    pub(crate) own: Ability,
    /// The other system's abilities in its last reports.
    peer: [Ability; REPORTS],
    /// Whether this system is less able or has no backup, and since when.
    differs: Option<(Ordering, Instant)>,
    /// The ability that both systems have had since this one lost more.
    shared: Option<Ability>,
    /// The other system has started since: it does not know what both have lost.
    has_forgotten: bool,
}

impl Abilities {
    pub(crate) fn on_report(&mut self, ability: Ability) {
        self.peer.rotate_left(1);
        self.peer[REPORTS - 1] = ability;
    }

    /// Handles a start of the other system.
    pub(crate) const fn on_start(&mut self) {
        self.has_forgotten = self.shared.is_some();
    }

    /// Compares both abilities. `heard`: the other system is heard as standby. Must be called at
    /// each poll.
    pub(crate) fn compare(&mut self, now: Instant, heard: bool) {
        let least = self.peer.into_iter().min().unwrap_or_default();
        let most = self.peer.into_iter().max().unwrap_or_default();
        let both = (least == most && least == self.own && heard).then_some(least);
        self.shared = self.shared.filter(|it| *it == self.own).or(both);
        self.has_forgotten &= self.shared.is_some();
        let order = match self.own {
            _ if !heard => None,
            own if own < least => (!self.has_forgotten).then_some(Ordering::Less),
            own if own > most && !most.is_backup() => Some(Ordering::Greater),
            _ => None,
        };
        let lasts = self.differs.filter(|(last, _)| Some(*last) == order);
        self.differs = lasts.or(order.map(|order| (order, now)));
    }

    fn lasts(&self, now: Instant, order: Ordering, limit: Duration) -> bool {
        self.differs
            .is_some_and(|(is, since)| is == order && now.since(since) >= limit)
    }

    /// Returns whether the standby has been better for long enough: this master offers its role.
    pub(crate) fn offers(&self, now: Instant) -> bool {
        self.lasts(now, Ordering::Less, self.own.offer_after())
    }

    /// Returns whether the standby has not been a backup for long enough. A loss that both systems
    /// have is no difference.
    pub(crate) fn has_no_backup(&self, now: Instant) -> bool {
        self.lasts(now, Ordering::Greater, UNABLE_LIMIT)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: fn(u64) -> Instant = |ms| Instant::from_ns(ms * 1_000_000);

    /// T-RED-9: bits without an ability, as of a system that reports none, count as able.
    #[test]
    fn abilities_round_trip() {
        for &ability in Ability::VARIANTS {
            assert_eq!(Ability::from_bits(ability.bits()), ability);
        }
        assert_eq!(Ability::from_bits(0), Ability::All);
    }

    /// T-RED-9: for each pair of abilities: who offers the role, and who has no backup. Neither
    /// happens before its time, to a standby that is not heard, or for two reports only.
    #[test]
    fn every_pair_of_abilities() {
        for &own in Ability::VARIANTS {
            for &peer in Ability::VARIANTS {
                for (reports, heard) in [(REPORTS, true), (REPORTS, false), (REPORTS - 1, true)] {
                    let mut both = Abilities {
                        own,
                        peer: [own; REPORTS],
                        ..Abilities::default()
                    };
                    for _ in 0..reports {
                        both.on_report(peer);
                    }
                    let counts = heard && reports == REPORTS;
                    let what = std::format!("{own:?} {peer:?} {reports} {heard}");
                    for ms in 0..=1_000 {
                        both.compare(MS(ms), heard);
                        let after = Duration::from_ms(ms);
                        let offers = counts && own < peer && after >= own.offer_after();
                        let alone =
                            counts && own > peer && !peer.is_backup() && after >= UNABLE_LIMIT;
                        assert_eq!(both.offers(MS(ms)), offers, "{what}");
                        assert_eq!(both.has_no_backup(MS(ms)), alone, "{what}");
                    }
                }
            }
        }
    }

    /// T-RED-9: a standby that has started does not know that a sensor lies to both; its master
    /// keeps the role until it is sound itself.
    #[test]
    fn a_started_system_has_forgotten_what_both_have_lost() {
        for (both_know, starts) in [(true, true), (true, false), (false, true)] {
            let mut both = Abilities::default();
            let mut now = 0;
            let mut run = |both: &mut Abilities, own, peer, ms: u64| {
                both.own = own;
                for _ in 0..ms {
                    now += 1;
                    both.on_report(peer);
                    both.compare(MS(now), true);
                }
                both.offers(MS(now))
            };
            let (all, stops) = (Ability::All, Ability::StopOnly);
            run(&mut both, stops, if both_know { stops } else { all }, 20);
            if starts {
                both.on_start();
            }
            let offers = run(&mut both, stops, all, 1_000);
            assert_eq!(offers, !(both_know && starts), "{both_know} {starts}");
            // What this system has lost later counts again.
            run(&mut both, all, all, 20);
            assert!(run(&mut both, stops, all, 1_000));
        }
    }

    /// T-RED-9: a difference that ends begins anew.
    #[test]
    fn a_short_difference_changes_nothing() {
        let mut both = Abilities::default();
        for ms in 0..2_000 {
            let ability = [Ability::All, Ability::StopOnly][usize::from(ms % 400 < 300)];
            both.on_report(ability);
            both.compare(MS(ms), true);
            assert!(!both.has_no_backup(MS(ms)), "{ms}");
        }
    }
}
