//! Window and functional watchdog of a supply, in virtual time. T-CHIP-6

use tandem_board::watchdog_answer;

pub(crate) const OPENS_US: u32 = 5_000;
pub(crate) const CLOSES_US: u32 = 20_000;
pub(crate) const FIRST_SERVICE_US: u32 = 100_000;

/// What a service did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub(crate) enum Service {
    Accepted,
    /// Early, late or with a wrong answer: the system is reset.
    Refused,
}

/// The watchdogs of one system.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Watchdog {
    question: u8,
    opens_ns: u64,
    closes_ns: u64,
}

impl Watchdog {
    /// Armed at the start of a system.
    pub(crate) fn start(now_ns: u64) -> Self {
        let closes_ns = now_ns + u64::from(FIRST_SERVICE_US) * 1_000;
        Self {
            question: 3,
            opens_ns: now_ns,
            closes_ns,
        }
    }

    pub(crate) fn question(&self) -> u8 {
        self.question
    }

    /// A defect: the question of `before` again.
    pub(crate) fn ask_again(&mut self, before: &Self) {
        self.question = before.question;
    }

    /// A defect: accepts the next service at any time.
    pub(crate) fn open(&mut self) {
        self.opens_ns = 0;
    }

    /// The last instant at which a service is in time.
    pub(crate) fn closes_ns(&self) -> u64 {
        self.closes_ns
    }

    pub(crate) fn service(&mut self, answer: u8, now_ns: u64) -> Service {
        let in_window = (self.opens_ns..=self.closes_ns).contains(&now_ns);
        if !in_window || answer != watchdog_answer(self.question) {
            return Service::Refused;
        }
        // A full-period generator over 0..=15: each question differs from the one before.
        self.question = (self.question.wrapping_mul(5) + 3) & 0xF;
        self.opens_ns = now_ns + u64::from(OPENS_US) * 1_000;
        self.closes_ns = now_ns + u64::from(CLOSES_US) * 1_000;
        Service::Accepted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: u64 = 1_000;

    #[test]
    fn the_window_is_closed_on_both_sides() {
        let opens = u64::from(OPENS_US) * US;
        let closes = u64::from(CLOSES_US) * US;
        for (at, expected) in [
            (opens - 1, Service::Refused),
            (opens, Service::Accepted),
            (closes, Service::Accepted),
            (closes + 1, Service::Refused),
        ] {
            let mut dog = Watchdog::start(0);
            assert_eq!(
                dog.service(watchdog_answer(dog.question()), 0),
                Service::Accepted
            );
            assert_eq!(
                dog.service(watchdog_answer(dog.question()), at),
                expected,
                "{at} ns"
            );
        }
    }

    #[test]
    fn only_the_right_answer_counts_and_every_question_is_asked() {
        let mut dog = Watchdog::start(0);
        let mut asked = [false; 16];
        for round in 0..16 {
            let now = round * 10_000 * US;
            let right = watchdog_answer(dog.question());
            for wrong in (0..=255).filter(|answer| *answer != right) {
                assert_eq!(dog.clone().service(wrong, now), Service::Refused);
            }
            asked[usize::from(dog.question())] = true;
            assert_eq!(dog.service(right, now), Service::Accepted);
        }
        assert_eq!(asked, [true; 16]);
    }
}
