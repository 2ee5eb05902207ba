//! Software timers: callbacks in the kernel's service task, one-shot or periodic.

use super::Life;
use crate::context::{Context, TaskLevel, TimerContext};
use crate::ffi;
use crate::time::Ticks;
use alloc::boxed::Box;
use core::cell::UnsafeCell;
use core::ffi::c_void;
use core::fmt;

/// The service task has no room for another command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the service task has no room for another command")]
pub struct CommandsFull;

type Callback = Box<dyn FnMut(&TimerContext) + Send>;

/// The kernel's control block and the callback. It is never freed, because the service task may
/// still have a command for it.
struct Block {
    block: UnsafeCell<[usize; ffi::TIMER_WORDS]>,
    callback: UnsafeCell<Callback>,
    life: Life,
}

// SAFETY: the block is the kernel's, which is called only on the core's thread; only the service
// task calls the callback, which is `Send`.
unsafe impl Sync for Block {}

/// Commands of the service task, as `tmrCOMMAND_…`; interrupts use other numbers for the same
/// commands.
const START: ffi::Base = 1;
const STOP: ffi::Base = 3;
/// The difference between the commands of interrupts and those of tasks.
const FROM_INTERRUPT: ffi::Base = 5;

/// A timer. Copied handles refer to the same timer. It exists until the program ends.
///
/// Its callback runs in the service task, which is more urgent than all others, and must be short.
#[derive(Clone, Copy)]
pub struct Timer(&'static Block);

impl fmt::Debug for Timer {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Timer")
    }
}

impl Timer {
    /// Makes a timer that has not started. Its memory is never freed. With `reload` it restarts at
    /// each expiry, without drift.
    ///
    /// # Panics
    /// If the period is zero.
    pub fn new(
        _at: &impl TaskLevel,
        period: impl Into<Ticks>,
        reload: bool,
        callback: impl FnMut(&TimerContext) + Send + 'static,
    ) -> Self {
        let period = period.into();
        assert!(period.0 > 0, "a period of zero ticks");
        let timer: &'static Block = Box::leak(Box::new(Block {
            block: UnsafeCell::new([0; ffi::TIMER_WORDS]),
            callback: UnsafeCell::new(Box::new(callback)),
            life: Life::current(),
        }));
        let id = core::ptr::from_ref(timer).cast_mut().cast();
        let (name, block) = (c"timer".as_ptr(), timer.block.get().cast());
        // SAFETY: the block is ours and is never freed.
        unsafe {
            ffi::xTimerCreateStatic(name, period.0, usize::from(reload), id, expired, block);
        }
        Self(timer)
    }

    /// Starts or restarts the timer: it expires one period from now.
    ///
    /// # Errors
    /// [`CommandsFull`]
    pub fn start<C: Context>(&self, ctx: &C) -> Result<(), CommandsFull> {
        self.command(ctx, START, super::task::now(C::IN_INTERRUPT).0)
    }

    /// Stops the timer.
    ///
    /// # Errors
    /// [`CommandsFull`]
    pub fn stop(&self, ctx: &impl Context) -> Result<(), CommandsFull> {
        self.command(ctx, STOP, 0)
    }

    fn command<C: Context>(
        &self,
        ctx: &C,
        command: ffi::Base,
        value: ffi::Tick,
    ) -> Result<(), CommandsFull> {
        self.0.life.assert_current();
        let timer = self.0.block.get().cast();
        let mut woken = 0;
        // SAFETY: a timer of this life that is never freed; does not wait.
        let sent = unsafe {
            if C::IN_INTERRUPT {
                let command = command + FROM_INTERRUPT;
                ffi::xTimerGenericCommandFromISR(timer, command, value, &mut woken, 0)
            } else {
                ffi::xTimerGenericCommandFromTask(timer, command, value, core::ptr::null_mut(), 0)
            }
        };
        ctx.woken(woken != 0);
        if sent == ffi::PASS {
            Ok(())
        } else {
            Err(CommandsFull)
        }
    }
}

/// Calls the callback. The service task calls this function when the timer has expired.
extern "C" fn expired(timer: *mut c_void) {
    // SAFETY: `new` set the block as the timer's id.
    let block = unsafe { &*ffi::pvTimerGetTimerID(timer).cast::<Block>() };
    // SAFETY: only the service task calls it, one timer after another.
    let callback = unsafe { &mut *block.callback.get() };
    callback(&TimerContext::new());
}
