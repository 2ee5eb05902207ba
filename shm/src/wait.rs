//! The waiting policy: spin, spin and then sleep, or sleep.
//!
//! With a CPU of its own a core waits at the cost of a cache line when it spins; on a shared CPU it
//! must sleep, or it keeps the one that it waits for from running. The policy decides when to look
//! and when to sleep; what to look for and how to sleep is the caller's, as an [`Event`].

use crate::sync::spin;

/// What a core waits for, and how it sleeps.
pub trait Event {
    /// What has come.
    type Output;

    /// Looks once, without blocking. A caller with a deadline returns here that it has passed: this
    /// is what ends the waiting.
    fn check(&mut self) -> Option<Self::Output>;

    /// Tells those who may wake this core that it is going to sleep (see
    /// [`Receiver::prepare_sleep`](crate::mailbox::Receiver::prepare_sleep)). `false` if something
    /// came meanwhile; then all that was told is taken back.
    fn prepare_sleep(&mut self) -> bool;

    /// Sleeps until someone wakes this core or the deadline has passed; may end early.
    fn sleep(&mut self);

    /// Tells them that it is awake.
    fn awake(&mut self);
}

/// How to wait.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum WaitPolicy {
    /// Look again and again; never sleep. Only for a core with a CPU of its own.
    Spin,
    /// Look so many times, then sleep.
    SpinThenSleep {
        /// Looks before each sleep.
        spins: u32,
    },
    /// Sleep whenever nothing is there.
    #[default]
    Sleep,
}

impl WaitPolicy {
    /// Waits until [`Event::check`] has something. Task context; blocks.
    #[inline]
    pub fn wait<E: Event>(self, event: &mut E) -> E::Output {
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

#[cfg(test)]
#[cfg(not(loom))]
mod tests {
    use super::*;

    /// Has something at the look number `after`; the sleep brings it at once.
    struct Script {
        after: u32,
        looks: u32,
        refused: bool,
        sleeps: u32,
        told: bool,
    }

    impl Event for Script {
        type Output = u32;

        fn check(&mut self) -> Option<u32> {
            assert!(!self.told, "looks only after it has told that it is awake");
            self.looks += 1;
            (self.looks > self.after).then_some(self.sleeps)
        }

        fn prepare_sleep(&mut self) -> bool {
            // The first time something comes in between.
            let first = !core::mem::replace(&mut self.refused, true);
            self.told = !first;
            !first
        }

        fn sleep(&mut self) {
            assert!(self.told);
            self.sleeps += 1;
        }

        fn awake(&mut self) {
            self.told = false;
        }
    }

    fn wait(policy: WaitPolicy, after: u32) -> u32 {
        policy.wait(&mut Script {
            after,
            looks: 0,
            refused: false,
            sleeps: 0,
            told: false,
        })
    }

    #[test]
    fn each_policy_looks_and_sleeps_as_it_says() {
        assert_eq!(wait(WaitPolicy::Spin, 1000), 0);
        // The first look, then a refused sleep, then a sleep before each look.
        assert_eq!(wait(WaitPolicy::Sleep, 0), 0);
        assert_eq!(wait(WaitPolicy::Sleep, 1), 0);
        assert_eq!(wait(WaitPolicy::Sleep, 5), 4);
        assert_eq!(wait(WaitPolicy::SpinThenSleep { spins: 9 }, 9), 0);
        assert_eq!(wait(WaitPolicy::SpinThenSleep { spins: 9 }, 19), 0);
        assert_eq!(wait(WaitPolicy::SpinThenSleep { spins: 9 }, 20), 1);
    }
}
