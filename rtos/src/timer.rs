//! Software timers: callbacks in the service task, once or again and again.

use crate::InUse;
use crate::context::{Context, TaskLevel, TimerContext};
use crate::sys::timer::{Block, Command};
use crate::time::Ticks;
use core::fmt;

/// The service task has no room for another command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CommandsFull;

impl fmt::Display for CommandsFull {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the service task has no room for another command")
    }
}

impl core::error::Error for CommandsFull {}

/// Memory for a timer in a static.
pub struct TimerMemory(Block);

impl TimerMemory {
    /// Memory for one timer.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        Self(Block::new())
    }
}

/// A timer. Copied handles are the same one. Lives as long as the program.
///
/// Its callback runs in the service task, which is more urgent than all others: keep it short.
#[derive(Clone, Copy)]
pub struct Timer {
    block: &'static Block,
}

impl fmt::Debug for Timer {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Timer")
    }
}

impl Timer {
    /// A timer from the heap, which is never given back. It stands still until it is started.
    /// `reload` starts it again each time, without drift.
    ///
    /// # Panics
    /// If the period is zero.
    #[cfg(feature = "alloc")]
    pub fn new(
        at: &impl TaskLevel,
        period: impl Into<Ticks>,
        reload: bool,
        callback: impl FnMut(&TimerContext) + Send + 'static,
    ) -> Self {
        use alloc::boxed::Box;
        let memory = Box::leak(Box::new(TimerMemory::new()));
        let callback = Box::leak(Box::new(callback));
        let made = Self::new_static(at, memory, period, reload, callback);
        debug_assert!(made.is_ok(), "new memory is unused");
        Self { block: &memory.0 }
    }

    /// A timer in a static. It stands still until it is started.
    ///
    /// # Errors
    /// [`InUse`]
    ///
    /// # Panics
    /// If the period is zero.
    pub fn new_static(
        _at: &impl TaskLevel,
        memory: &'static TimerMemory,
        period: impl Into<Ticks>,
        reload: bool,
        callback: &'static mut (dyn FnMut(&TimerContext) + Send),
    ) -> Result<Self, InUse> {
        memory.0.make(period.into(), reload, callback)?;
        Ok(Self { block: &memory.0 })
    }

    /// Starts it, or starts it anew: it expires one period from now.
    ///
    /// # Errors
    /// [`CommandsFull`]
    pub fn start(&self, ctx: &impl Context) -> Result<(), CommandsFull> {
        self.command(ctx, Command::Start)
    }

    /// Stops it.
    ///
    /// # Errors
    /// [`CommandsFull`]
    pub fn stop(&self, ctx: &impl Context) -> Result<(), CommandsFull> {
        self.command(ctx, Command::Stop)
    }

    /// Gives it another period and starts it.
    ///
    /// # Errors
    /// [`CommandsFull`]
    ///
    /// # Panics
    /// If the period is zero.
    pub fn change_period(
        &self,
        ctx: &impl Context,
        period: impl Into<Ticks>,
    ) -> Result<(), CommandsFull> {
        let period = period.into();
        assert!(period.0 > 0, "a period of zero ticks");
        self.command(ctx, Command::ChangePeriod(period))
    }

    /// Whether it runs.
    pub fn is_active(&self, _ctx: &impl TaskLevel) -> bool {
        self.block.is_active()
    }

    fn command(&self, ctx: &impl Context, command: Command) -> Result<(), CommandsFull> {
        if self.block.command(ctx, command) {
            Ok(())
        } else {
            Err(CommandsFull)
        }
    }
}
