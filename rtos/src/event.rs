//! Event groups: bits that tasks wait for, one, several or all of them.

use crate::InUse;
use crate::context::{Context, InterruptContext, TaskContext, TaskLevel};
use crate::sys::event::Group;
use crate::time::Ticks;
use core::fmt;
use core::ops::{BitAnd, BitOr};

/// A set of events: bits 0 to 23.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Events(u32);

impl Events {
    /// No event.
    pub const NONE: Self = Self(0);

    /// Events by their bits.
    ///
    /// # Panics
    /// If a bit above 23 is set, which are the kernel's; in a constant that is an error of the
    /// compiler.
    #[must_use]
    pub const fn new(bits: u32) -> Self {
        assert!(bits >> 24 == 0, "events are bits 0 to 23");
        Self(bits)
    }

    /// The bits.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }

    /// Whether all of `others` are among these.
    #[must_use]
    pub const fn contains(self, others: Self) -> bool {
        self.0 & others.0 == others.0
    }

    fn of_kernel(bits: u32) -> Self {
        Self(bits & 0x00FF_FFFF)
    }
}

impl BitOr for Events {
    type Output = Self;

    fn bitor(self, others: Self) -> Self {
        Self(self.0 | others.0)
    }
}

impl BitAnd for Events {
    type Output = Self;

    fn bitand(self, others: Self) -> Self {
        Self(self.0 & others.0)
    }
}

/// The service task has no room for another call of an interrupt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EventsFull;

impl fmt::Display for EventsFull {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("the service task has no room for another call")
    }
}

impl core::error::Error for EventsFull {}

/// Memory for an event group in a static.
pub struct EventGroupMemory(Group);

impl EventGroupMemory {
    /// Memory for one group.
    #[must_use]
    #[allow(
        clippy::new_without_default,
        reason = "for statics, where a default is of no use"
    )]
    pub const fn new() -> Self {
        Self(Group::new())
    }
}

/// An event group. Copied handles are the same one. Lives as long as the program.
#[derive(Clone, Copy)]
pub struct EventGroup {
    group: &'static Group,
}

impl fmt::Debug for EventGroup {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("EventGroup")
    }
}

impl EventGroup {
    /// A group from the heap, which is never given back.
    #[cfg(feature = "alloc")]
    #[must_use]
    pub fn new(at: &impl TaskLevel) -> Self {
        let memory = alloc::boxed::Box::leak(alloc::boxed::Box::new(EventGroupMemory::new()));
        let made = Self::new_static(at, memory);
        debug_assert!(made.is_ok(), "new memory is unused");
        Self { group: &memory.0 }
    }

    /// A group in a static.
    ///
    /// # Errors
    /// [`InUse`]
    pub fn new_static(
        _at: &impl TaskLevel,
        memory: &'static EventGroupMemory,
    ) -> Result<Self, InUse> {
        memory.0.make()?;
        Ok(Self { group: &memory.0 })
    }

    /// Sets events and wakes who waits for them. Returns what is set afterwards: a task that was
    /// woken may have cleared them.
    pub fn set(&self, _ctx: &TaskContext, events: Events) -> Events {
        Events::of_kernel(self.group.set(events.0))
    }

    /// Has the service task set events as soon as the interrupts have ended.
    ///
    /// # Errors
    /// [`EventsFull`]
    pub fn set_from_interrupt(
        &self,
        ctx: &InterruptContext,
        events: Events,
    ) -> Result<(), EventsFull> {
        if self.group.set_from_interrupt(ctx, events.0) {
            Ok(())
        } else {
            Err(EventsFull)
        }
    }

    /// Clears events. Returns what was set before.
    pub fn clear(&self, _ctx: &TaskContext, events: Events) -> Events {
        Events::of_kernel(self.group.clear(events.0))
    }

    /// What is set.
    pub fn get(&self, _ctx: &impl Context) -> Events {
        Events::of_kernel(self.group.get())
    }

    /// Waits for one of several events. Returns what was set when it ended: none of them if the
    /// time was over. `clear` clears the awaited ones.
    ///
    /// # Panics
    /// If no event is named; in a critical section or with pre-emption deferred.
    pub fn wait_any(
        &self,
        _ctx: &TaskContext,
        events: Events,
        clear: bool,
        timeout: impl Into<Ticks>,
    ) -> Events {
        assert!(events != Events::NONE, "waits for no event");
        Events::of_kernel(self.group.wait(events.0, false, clear, timeout.into()))
    }

    /// Waits for all of several events. Returns what was set when it ended: not all of them if the
    /// time was over. `clear` clears them if all came.
    ///
    /// # Panics
    /// If no event is named; in a critical section or with pre-emption deferred.
    pub fn wait_all(
        &self,
        _ctx: &TaskContext,
        events: Events,
        clear: bool,
        timeout: impl Into<Ticks>,
    ) -> Events {
        assert!(events != Events::NONE, "waits for no event");
        Events::of_kernel(self.group.wait(events.0, true, clear, timeout.into()))
    }

    /// A rendezvous: sets `own` and waits until all of `all` are set, which clears them. Returns
    /// what was set when it ended.
    ///
    /// # Panics
    /// As [`EventGroup::wait_all`].
    pub fn meet(
        &self,
        _ctx: &TaskContext,
        own: Events,
        all: Events,
        timeout: impl Into<Ticks>,
    ) -> Events {
        assert!(all != Events::NONE, "waits for no event");
        Events::of_kernel(self.group.meet(own.0, all.0, timeout.into()))
    }
}
