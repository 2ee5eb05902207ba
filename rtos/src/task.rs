//! The options of a task: name, priority, stack.

/// How urgent a task is; a higher number is more urgent. Tasks of equal priority alternate at each
/// tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Priority(u8);

impl Priority {
    /// One above the idle task.
    pub const LOWEST: Self = Self(1);
    /// One below the service task of the software timers.
    pub const HIGHEST: Self = Self(30);

    /// Returns the priority `level`, 1 to 30.
    ///
    /// # Panics
    /// If `level` is 0 (the idle task's) or above 30; in a constant, this is a compile error.
    #[must_use]
    pub const fn new(level: u8) -> Self {
        assert!(
            level >= Self::LOWEST.0 && level <= Self::HIGHEST.0,
            "priorities go from 1 to 30"
        );
        Self(level)
    }

    /// Returns the number.
    #[must_use]
    pub const fn level(self) -> u8 {
        self.0
    }
}

/// The options of a task.
#[derive(Clone, Copy, Debug)]
pub struct TaskOptions<'a> {
    /// 1 to 23 bytes, for messages and traces.
    pub name: &'a str,
    /// How urgent it is.
    pub priority: Priority,
    /// Bytes of the stack: at least the port's smallest, and whole pages on the host.
    pub stack_bytes: usize,
}

impl<'a> TaskOptions<'a> {
    /// Returns the options of a task with the usual stack: 64 KiB on the host, 4 KiB on the target.
    #[must_use]
    pub const fn new(name: &'a str, priority: Priority) -> Self {
        let stack_bytes = if cfg!(target_os = "linux") {
            64 << 10
        } else {
            4 << 10
        };
        Self {
            name,
            priority,
            stack_bytes,
        }
    }

    /// Sets the number of bytes of the stack.
    #[must_use]
    pub const fn stack_bytes(self, stack_bytes: usize) -> Self {
        Self {
            stack_bytes,
            ..self
        }
    }
}

/// Why a task could not be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SpawnError {
    /// The name is empty, longer than 23 bytes, or contains a zero byte.
    #[error("a task's name has 1 to 23 bytes, none of them zero")]
    BadName,
    /// There is no memory for the stack.
    #[error("no memory for the stack")]
    NoMemory,
}
