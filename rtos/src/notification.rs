//! Notifications: a count and a set of bits that every task has, the cheapest way to wake it.

use crate::context::{Context, TaskContext};
use crate::sys::task::{self, TaskError, TaskHandle};
use crate::time::Ticks;

impl TaskHandle {
    /// Counts the task's notification up by one and wakes it if it waits for that.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn notify<C: Context>(&self, ctx: &C) -> Result<(), TaskError> {
        let woken = task::notify(self, task::Change::Increment, C::IN_INTERRUPT)?;
        ctx.woken(woken);
        Ok(())
    }

    /// Sets bits of the task's notification and wakes it if it waits for that.
    ///
    /// # Errors
    /// [`TaskError::Ended`]
    pub fn notify_bits<C: Context>(&self, ctx: &C, bits: u32) -> Result<(), TaskError> {
        let woken = task::notify(self, task::Change::SetBits(bits), C::IN_INTERRUPT)?;
        ctx.woken(woken);
        Ok(())
    }
}

impl TaskContext {
    /// Waits until this task's notification is not zero, and takes all of it.
    ///
    /// Returns the count, or zero if the time was over first.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn take_notifications(&self, timeout: impl Into<Ticks>) -> u32 {
        task::take_notification(true, timeout.into())
    }

    /// Waits until this task's notification is not zero, and counts it down by one.
    ///
    /// Returns whether there was one before the time was over.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn take_notification(&self, timeout: impl Into<Ticks>) -> bool {
        task::take_notification(false, timeout.into()) != 0
    }

    /// Waits until bits of this task's notification were set, and clears and returns them all.
    ///
    /// Returns `None` if the time was over first.
    ///
    /// # Panics
    /// In a critical section or with pre-emption deferred.
    pub fn wait_bits(&self, timeout: impl Into<Ticks>) -> Option<u32> {
        task::wait_bits(timeout.into())
    }
}
