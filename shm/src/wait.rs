//! The waiting policy: spin, spin and then sleep, or sleep.
//!
//! A core with its own CPU can spin: it waits only for a cache line. On a shared CPU it must sleep,
//! so that the core that it waits for can run. The policy decides when to poll and when to sleep;
//! the caller's [`Awaited`] defines what to poll and how to sleep.

use crate::sync::spin;

/// The event that a core waits for, and how the core sleeps.
pub trait Awaited {
    /// The result of the wait.
    type Output;

    /// Polls once, without blocking. `Some` ends the wait; an event with a deadline also returns
    /// `Some` when the deadline has passed.
    fn check(&mut self) -> Option<Self::Output>;

    /// Announces to the cores that may wake this one that it is going to sleep (see
    /// [`Receiver::prepare_sleep`](crate::mailbox::Receiver::prepare_sleep)). If something has just
    /// arrived, withdraws the announcement and returns `false`.
    fn prepare_sleep(&mut self) -> bool;

    /// Sleeps until another core wakes this one or the deadline has passed; may return early.
    fn sleep(&mut self);

    /// Announces that this core is awake.
    fn awake(&mut self);
}

/// How a core waits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WaitPolicy {
    /// Poll continuously; never sleep. Only for a core with its own CPU.
    Spin,
    /// Poll a number of times, then sleep.
    SpinThenSleep {
        /// Polls before each sleep.
        spins: u32,
    },
    /// Sleep after each poll that finds nothing.
    #[default]
    Sleep,
}

impl WaitPolicy {
    /// Waits until [`Awaited::check`] returns something. Task context; blocks.
    #[inline]
    pub fn wait<E: Awaited>(self, event: &mut E) -> E::Output {
        loop {
            let mut spins = match self {
                Self::Spin => u32::MAX,
                Self::SpinThenSleep { spins } => spins,
                Self::Sleep => 0,
            };
            loop {
                if let Some(output) = event.check() {
                    return output;
                }
                if spins == 0 {
                    break;
                }
                spins -= u32::from(self != Self::Spin);
                spin(1);
            }
            if event.prepare_sleep() {
                event.sleep();
                event.awake();
            }
        }
    }
}

#[cfg(not(loom))]
#[cfg(test)]
mod tests {
    use super::*;

    /// An event whose `check` returns the number of sleeps after `after` polls without a result.
    struct Script {
        after: u32,
        polls: u32,
        refused: bool,
        sleeps: u32,
        announced: bool,
    }

    impl Awaited for Script {
        type Output = u32;

        fn check(&mut self) -> Option<u32> {
            assert!(
                !self.announced,
                "polls only after it has announced that it is awake"
            );
            self.polls += 1;
            (self.polls > self.after).then_some(self.sleeps)
        }

        fn prepare_sleep(&mut self) -> bool {
            // The first attempt is refused, as if a signal had just arrived.
            let first = !core::mem::replace(&mut self.refused, true);
            self.announced = !first;
            !first
        }

        fn sleep(&mut self) {
            assert!(self.announced);
            self.sleeps += 1;
        }

        fn awake(&mut self) {
            self.announced = false;
        }
    }

    fn wait(policy: WaitPolicy, after: u32) -> u32 {
        policy.wait(&mut Script {
            after,
            polls: 0,
            refused: false,
            sleeps: 0,
            announced: false,
        })
    }

    #[test]
    fn each_policy_polls_and_sleeps_as_documented() {
        assert_eq!(wait(WaitPolicy::Spin, 1000), 0);
        // The first poll, then a refused sleep, then a sleep before each poll.
        assert_eq!(wait(WaitPolicy::Sleep, 0), 0);
        assert_eq!(wait(WaitPolicy::Sleep, 1), 0);
        assert_eq!(wait(WaitPolicy::Sleep, 5), 4);
        assert_eq!(wait(WaitPolicy::SpinThenSleep { spins: 9 }, 9), 0);
        assert_eq!(wait(WaitPolicy::SpinThenSleep { spins: 9 }, 19), 0);
        assert_eq!(wait(WaitPolicy::SpinThenSleep { spins: 9 }, 20), 1);
    }
}
