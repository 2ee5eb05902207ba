//! The two watchdogs of a supply: window and functional. T-CHIP-6

use tandem_board::{Duration, Instant, watchdog_answer};

/// When a service of the watchdog is in time.
///
/// The requirements name a TLF35584 but give no figures. That chip counts both windows in units of
/// 50 cycles of 0.1 ms or 1 ms; these values are valid settings of that chip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Earliest service after the previous one, in microseconds: the closed window.
    pub opens_us: u32,
    /// Latest service after the previous one, in microseconds: closed and open window.
    pub closes_us: u32,
    /// Latest first service after a start, in microseconds. The first service is never early.
    pub first_us: u32,
}

impl Window {
    /// For hardware cores: closed for 50 × 0.1 ms, open for 150; together two control periods.
    pub const TARGET: Self = Self {
        opens_us: 5_000,
        closes_us: 20_000,
        first_us: 100_000,
    };
    /// For cores that are processes. Open for 950 cycles of 0.1 ms: takeover does not depend on the
    /// watchdog, so the window tolerates the delays of a busy desktop. The time limit of the first
    /// service includes the start of a process.
    pub const DESKTOP: Self = Self {
        closes_us: 100_000,
        first_us: 1_000_000,
        ..Self::TARGET
    };
}

/// Returns the question that follows `services` services of one incarnation: each of 0 ..= 15 in
/// turn, in a scrambled order. A core that counts its services need not read the question.
#[must_use]
pub const fn question(services: u32) -> u8 {
    // An odd factor permutes the residues.
    (services.wrapping_mul(7).wrapping_add(3) & 0xF) as u8
}

/// The fault of a watchdog service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WatchdogFault {
    /// No service arrived in time.
    Late,
    /// The service arrived before the window opened.
    Early,
    /// The service did not answer the question.
    WrongAnswer,
}

impl core::fmt::Display for WatchdogFault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Late => "no service arrived in time",
            Self::Early => "the service arrived before the window opened",
            Self::WrongAnswer => "the service did not answer the question",
        })
    }
}

impl core::error::Error for WatchdogFault {}

/// Monitors one incarnation of a system.
#[derive(Clone, Copy, Debug)]
pub struct Watchdog {
    window: Window,
    /// The last service, or the start of this incarnation.
    last: Instant,
    services: u32,
    served: bool,
    /// The last span in which the supply could not run: from, to.
    blind: [Instant; 2],
}

impl Watchdog {
    /// Starts monitoring.
    #[must_use]
    pub const fn new(window: Window, now: Instant) -> Self {
        Self {
            window,
            last: now,
            services: 0,
            served: false,
            blind: [Instant::ORIGIN; 2],
        }
    }

    /// Returns the question that the next service must answer.
    #[must_use]
    pub const fn question(&self) -> u8 {
        question(self.services)
    }

    /// Accepts or rejects a service that the core claims to have sent at `at` and that the supply
    /// reads at `now`. `None` is an answer that is not a byte.
    ///
    /// # Errors
    /// The fault of the service.
    pub fn service(
        &mut self,
        now: Instant,
        at: Instant,
        answer: Option<u8>,
    ) -> Result<(), WatchdogFault> {
        // The core's time is unchecked input: clamp it to the span from the last service to now.
        let at = at.clamp(self.last.min(now), now);
        if answer != Some(watchdog_answer(self.question())) {
            return Err(WatchdogFault::WrongAnswer);
        }
        let opens = Duration::from_us(self.window.opens_us.into());
        if self.served && at.since(self.last) < opens {
            return Err(WatchdogFault::Early);
        }
        self.check(at)?;
        self.services = self.services.wrapping_add(1);
        self.served = true;
        self.last = at;
        Ok(())
    }

    /// Returns the last instant at which the next service is in time.
    #[must_use]
    pub fn closes(&self) -> Instant {
        let window_us = if self.served {
            self.window.closes_us
        } else {
            self.window.first_us
        };
        let closes = self.last + Duration::from_us(window_us.into());
        if closes < self.blind[0] {
            return closes;
        }
        closes + self.blind_since_last()
    }

    /// Checks at `now` that the next service is not overdue.
    ///
    /// # Errors
    /// [`WatchdogFault::Late`] if it is overdue.
    pub fn check(&self, now: Instant) -> Result<(), WatchdogFault> {
        if now > self.closes() {
            Err(WatchdogFault::Late)
        } else {
            Ok(())
        }
    }

    /// Records that the supply itself could not run from `from` to `to`. This time does not count
    /// against the core, which may have been delayed too.
    pub fn was_blind(&mut self, from: Instant, to: Instant) {
        // Two such spans in one window add up: store them as one that ends with the second.
        let before = self.blind_since_last();
        let from = Instant::from_ns(from.as_ns().saturating_sub(before.as_ns()));
        self.blind = [from, to];
    }

    /// Returns for how long the supply could not run after the last service.
    fn blind_since_last(&self) -> Duration {
        let [from, to] = self.blind;
        to.since(from.max(self.last))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use WatchdogFault::{Early, Late, WrongAnswer};

    const START: Instant = Instant::from_ns(1_000_000_000);
    const WINDOW: Window = Window::TARGET;
    const OPENS: u64 = WINDOW.opens_us as u64;
    const CLOSES: u64 = WINDOW.closes_us as u64;
    const FIRST: u64 = WINDOW.first_us as u64;

    fn at(us: u64) -> Instant {
        START + Duration::from_us(us)
    }

    fn just_after(us: u64) -> Instant {
        at(us) + Duration::from_ns(1)
    }

    fn just_before(us: u64) -> Instant {
        Instant::from_ns(at(us).as_ns() - 1)
    }

    fn serve(dog: &mut Watchdog, now: Instant) -> Result<(), WatchdogFault> {
        let answer = watchdog_answer(dog.question());
        dog.service(now, now, Some(answer))
    }

    fn served_once() -> Watchdog {
        let mut dog = Watchdog::new(WINDOW, START);
        assert_eq!(serve(&mut dog, START), Ok(()));
        dog
    }

    /// T-CHIP-6: the window opens and closes exactly, to the nanosecond.
    #[test]
    fn a_service_is_accepted_in_the_window_and_nowhere_else() {
        for (now, expected) in [
            (at(0), Err(Early)),
            (just_before(OPENS), Err(Early)),
            (at(OPENS), Ok(())),
            (at(CLOSES), Ok(())),
            (just_after(CLOSES), Err(Late)),
        ] {
            assert_eq!(serve(&mut served_once(), now), expected, "{now:?}");
        }
    }

    /// T-CHIP-6: the first service has a separate limit and is never early.
    #[test]
    fn the_first_service_has_only_an_end() {
        for (now, expected) in [
            (START, Ok(())),
            (at(FIRST), Ok(())),
            (just_after(FIRST), Err(Late)),
        ] {
            let mut dog = Watchdog::new(WINDOW, START);
            assert_eq!(serve(&mut dog, now), expected, "{now:?}");
        }
    }

    /// T-CHIP-6: a missing service is a fault as soon as the window is over.
    #[test]
    fn a_missing_service_is_late_after_the_window() {
        let fresh = Watchdog::new(WINDOW, START);
        for (dog, closes) in [(fresh, FIRST), (served_once(), CLOSES)] {
            assert_eq!(dog.closes(), at(closes));
            assert_eq!(dog.check(at(closes)), Ok(()));
            assert_eq!(dog.check(just_after(closes)), Err(Late));
        }
    }

    /// T-CHIP-6: each question has one right answer, and each question is asked.
    #[test]
    fn one_answer_is_right_to_each_question() {
        let mut dog = Watchdog::new(WINDOW, START);
        let mut asked = [0; 16];
        for round in 0..32 {
            let now = at(10_000 * round);
            let right = watchdog_answer(dog.question());
            for wrong in (0..=u8::MAX).filter(|answer| *answer != right).map(Some) {
                assert_eq!(dog.clone().service(now, now, wrong), Err(WrongAnswer));
            }
            assert_eq!(dog.clone().service(now, now, None), Err(WrongAnswer));
            asked[usize::from(dog.question())] += 1;
            assert_eq!(dog.service(now, now, Some(right)), Ok(()));
        }
        assert_eq!(asked, [2; 16]);
    }

    #[test]
    fn questions_go_on_when_the_count_of_services_wraps() {
        let mut dog = served_once();
        dog.services = u32::MAX;
        assert_eq!(serve(&mut dog, at(OPENS)), Ok(()));
        // This is still the normal window, not that of the first service.
        assert_eq!(dog.closes(), at(OPENS + CLOSES));
    }

    /// The core gains nothing by claiming a time in the future or before its last service.
    #[test]
    fn a_false_time_gains_nothing() {
        let mut dog = Watchdog::new(WINDOW, START);
        let answer = Some(watchdog_answer(dog.question()));
        assert_eq!(dog.service(at(10), at(90_000), answer), Ok(()));
        assert_eq!(dog.closes(), at(10 + CLOSES), "ahead");
        let answer = Some(watchdog_answer(dog.question()));
        let past = dog.service(at(10 + OPENS), Instant::ORIGIN, answer);
        assert_eq!(past, Err(Early), "before the last service");
    }

    /// Services that the supply reads late are judged by the times at which they were sent.
    #[test]
    fn services_that_are_seen_late_are_as_far_apart_as_they_were_sent() {
        let mut dog = Watchdog::new(WINDOW, START);
        let seen = at(60_000);
        for sent in [5_000, 15_000, 30_000, 45_000] {
            let answer = Some(watchdog_answer(dog.question()));
            assert_eq!(dog.service(seen, at(sent), answer), Ok(()));
        }
        assert_eq!(dog.closes(), at(45_000 + CLOSES));
    }

    #[test]
    fn the_time_in_which_the_supply_was_held_up_does_not_count() {
        let mut dog = served_once();
        dog.was_blind(at(1_000), at(101_000));
        assert_eq!(dog.closes(), at(100_000 + CLOSES));
        // A second span in the same window.
        dog.was_blind(at(110_000), at(210_000));
        assert_eq!(dog.closes(), at(200_000 + CLOSES));
        assert_eq!(dog.check(just_after(200_000 + CLOSES)), Err(Late));
        // After the next service the window has its normal length.
        assert_eq!(serve(&mut dog, at(215_000)), Ok(()));
        assert_eq!(dog.closes(), at(215_000 + CLOSES));
        assert_eq!(serve(&mut dog, just_after(215_000 + CLOSES)), Err(Late));
    }

    /// The supply reads an old service after a long delay; the queue has lost the later services.
    #[test]
    fn services_from_the_time_of_a_supply_that_was_held_up_excuse_nothing() {
        let mut dog = served_once();
        dog.was_blind(at(0), at(1_000_000));
        let answer = Some(watchdog_answer(dog.question()));
        assert_eq!(dog.service(at(1_000_000), at(10_000), answer), Ok(()));
        assert_eq!(dog.closes(), at(1_000_000 + CLOSES));
    }

    #[test]
    fn a_core_that_was_late_before_the_supply_was_held_up_is_late() {
        let mut dog = served_once();
        dog.was_blind(just_after(CLOSES), at(CLOSES + 100_000));
        assert_eq!(dog.check(at(CLOSES + 50_000)), Err(Late));
    }
}
