//! The watchdogs of the supply: window and functional. Pure logic, told the time. T-CHIP-6

use tandem_board::{Duration, Instant, watchdog_answer};

/// Earliest service after the previous one, in microseconds. Short enough that a cycle which was
/// late once and is on time again is no fault.
pub(crate) const WINDOW_OPENS_US: u32 = 500;
/// Latest service after the previous one, in microseconds: ten control cycles. Takeover does not
/// depend on it (heartbeats do that), so it may wait out what the scheduler of a busy desktop does.
pub(crate) const WINDOW_CLOSES_US: u32 = 100_000;
/// Latest first service after a start, in microseconds.
pub(crate) const FIRST_SERVICE_US: u32 = 1_000_000;

/// The question that follows `services` services; 0 ..= 15, each in turn in a scrambled order.
pub(crate) const fn question(services: u32) -> u8 {
    // An odd factor permutes the residues.
    (services.wrapping_mul(7).wrapping_add(3) & 0xF) as u8
}

/// What was wrong with the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WatchdogFault {
    /// None came in time.
    Late,
    /// It came before the window was open.
    Early,
    /// It did not answer the question.
    WrongAnswer,
}

/// Watches over one life of a system.
#[derive(Debug)]
pub(crate) struct Watchdog {
    started: Instant,
    last: Option<Instant>,
    /// Time since the last service in which the supply itself was held up.
    excused: Duration,
    services: u32,
}

impl Watchdog {
    /// Starts to watch.
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            started: now,
            last: None,
            excused: Duration::ZERO,
            services: 0,
        }
    }

    /// A service came, at `at` by the core's word, and was seen at `now`. Whether it was late is
    /// for [`Watchdog::check`], which is asked all the time.
    pub(crate) fn on_service(
        &mut self,
        now: Instant,
        at: Instant,
        answer: u8,
    ) -> Result<(), WatchdogFault> {
        // The core's time is an allegation: it can neither lie ahead nor before what was seen.
        let floor = self.last.unwrap_or(self.started);
        let at = at.clamp(floor.min(now), now);
        if answer != watchdog_answer(question(self.services)) {
            return Err(WatchdogFault::WrongAnswer);
        }
        if let Some(last) = self.last
            && at.since(last) < Duration::from_us(WINDOW_OPENS_US.into())
        {
            return Err(WatchdogFault::Early);
        }
        self.services = self.services.wrapping_add(1);
        self.last = Some(at);
        self.excused = Duration::ZERO;
        Ok(())
    }

    /// The supply was held up for `span`: nobody was watched, and nobody is to blame.
    pub(crate) fn excuse(&mut self, span: Duration) {
        self.excused = self.excused + span;
    }

    /// Nothing more has come until `now`.
    pub(crate) fn check(&self, now: Instant) -> Result<(), WatchdogFault> {
        let closes = match self.last {
            Some(last) => last + Duration::from_us(WINDOW_CLOSES_US.into()),
            None => self.started + Duration::from_us(FIRST_SERVICE_US.into()),
        };
        if now > closes + self.excused {
            Err(WatchdogFault::Late)
        } else {
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Instant = Instant::from_ns(1_000_000_000);

    fn at(us: u64) -> Instant {
        START + Duration::from_us(us)
    }

    fn serve(dog: &mut Watchdog, us: u64) -> Result<(), WatchdogFault> {
        let answer = watchdog_answer(question(dog.services));
        dog.on_service(at(us), at(us), answer)
    }

    /// T-CHIP-6: service in the window with the right answer keeps the system running.
    #[test]
    fn good_service_is_no_fault() {
        let mut dog = Watchdog::new(START);
        for n in 1..100 {
            assert_eq!(dog.check(at(n * 10_000 - 1)), Ok(()));
            assert_eq!(serve(&mut dog, n * 10_000), Ok(()));
        }
    }

    /// T-CHIP-6: the first service has a limit of its own.
    #[test]
    fn first_service_may_be_late_and_not_too_late() {
        let mut dog = Watchdog::new(START);
        assert_eq!(dog.check(at(u64::from(FIRST_SERVICE_US))), Ok(()));
        assert_eq!(
            dog.check(at(u64::from(FIRST_SERVICE_US) + 1)),
            Err(WatchdogFault::Late)
        );
        assert_eq!(serve(&mut dog, u64::from(FIRST_SERVICE_US)), Ok(()));
    }

    /// T-CHIP-6: a missed service is a fault.
    #[test]
    fn late_is_a_fault() {
        let mut dog = Watchdog::new(START);
        assert_eq!(serve(&mut dog, 0), Ok(()));
        assert_eq!(dog.check(at(u64::from(WINDOW_CLOSES_US))), Ok(()));
        assert_eq!(
            dog.check(at(u64::from(WINDOW_CLOSES_US) + 1)),
            Err(WatchdogFault::Late)
        );
    }

    /// T-CHIP-6: a service before the window opens is a fault; the first one has no window.
    #[test]
    fn early_is_a_fault() {
        let mut dog = Watchdog::new(START);
        assert_eq!(serve(&mut dog, 1), Ok(()));
        assert_eq!(
            serve(&mut dog, u64::from(WINDOW_OPENS_US)),
            Err(WatchdogFault::Early)
        );
        assert_eq!(serve(&mut dog, u64::from(WINDOW_OPENS_US) + 1), Ok(()));
    }

    /// T-CHIP-6: for each of the questions exactly one answer is right.
    #[test]
    fn wrong_answers_are_faults() {
        for services in 0..16 {
            for answer in 0..=u8::MAX {
                let mut dog = Watchdog::new(START);
                dog.services = services;
                let right = answer == watchdog_answer(question(services));
                let result = dog.on_service(at(1), at(1), answer);
                assert_eq!(result.is_ok(), right, "{services} {answer}");
            }
        }
    }

    #[test]
    fn all_questions_come() {
        let mut seen = [false; 16];
        for services in 0..16 {
            seen[usize::from(question(services))] = true;
        }
        assert_eq!(seen, [true; 16]);
    }

    #[test]
    fn a_supply_that_was_held_up_blames_nobody() {
        let mut dog = Watchdog::new(START);
        assert_eq!(serve(&mut dog, 0), Ok(()));
        dog.excuse(Duration::from_us(1_000_000));
        let closes = u64::from(WINDOW_CLOSES_US) + 1_000_000;
        assert_eq!(dog.check(at(closes)), Ok(()));
        assert_eq!(dog.check(at(closes + 1)), Err(WatchdogFault::Late));
        // With the next service all is as before.
        assert_eq!(serve(&mut dog, closes), Ok(()));
        let closes = closes + u64::from(WINDOW_CLOSES_US);
        assert_eq!(dog.check(at(closes + 1)), Err(WatchdogFault::Late));
    }

    #[test]
    fn a_time_ahead_buys_nothing() {
        let mut dog = Watchdog::new(START);
        let answer = watchdog_answer(question(0));
        assert_eq!(dog.on_service(at(10), at(900_000), answer), Ok(()));
        assert_eq!(
            dog.check(at(10 + u64::from(WINDOW_CLOSES_US) + 1)),
            Err(WatchdogFault::Late)
        );
    }
}
