//! Software timers of the kernel.

use super::{Life, ffi};
use crate::InUse;
use crate::context::{Context, TimerContext};
use crate::time::Ticks;
use core::cell::UnsafeCell;
use core::ffi::c_void;

/// What a timer calls.
pub(crate) type Callback = dyn FnMut(&TimerContext) + Send;

/// The kernel's control block and the callback. Lives for ever: commands about a timer are on their
/// way to the service task when the call that gave them has returned.
pub(crate) struct Block {
    block: UnsafeCell<[usize; ffi::TIMER_WORDS]>,
    callback: UnsafeCell<Option<&'static mut Callback>>,
    life: Life,
}

// SAFETY: the block is the kernel's, which is called from the core's thread only; the callback is
// written when the timer is new, called by the service task alone, and `Send`.
unsafe impl Sync for Block {}

/// Commands of the service task, as `tmrCOMMAND_…`; in interrupts others that mean the same.
#[derive(Clone, Copy)]
pub(crate) enum Command {
    Start,
    Stop,
    ChangePeriod(Ticks),
}

impl Block {
    pub(crate) const fn new() -> Self {
        Self {
            block: UnsafeCell::new([0; ffi::TIMER_WORDS]),
            callback: UnsafeCell::new(None),
            life: Life::none(),
        }
    }

    pub(crate) fn make(
        &'static self,
        period: Ticks,
        reload: bool,
        callback: &'static mut Callback,
    ) -> Result<(), InUse> {
        assert!(period.0 > 0, "a period of zero ticks");
        self.life.claim()?;
        let id = core::ptr::from_ref(self).cast_mut().cast();
        let block = self.block.get().cast();
        // SAFETY: the block is ours and lives for ever, and no service task knows it yet.
        unsafe {
            *self.callback.get() = Some(callback);
            let name = c"timer".as_ptr();
            ffi::xTimerCreateStatic(name, period.0, usize::from(reload), id, expired, block);
        }
        Ok(())
    }

    fn handle(&self) -> *mut c_void {
        self.life.assert_current();
        self.block.get().cast()
    }

    /// Gives a command to the service task. Whether there was room for it.
    pub(crate) fn command<C: Context>(&self, ctx: &C, command: Command) -> bool {
        let timer = self.handle();
        let now = super::task::now(C::IN_INTERRUPT).0;
        let (number, value) = match command {
            Command::Start => (1, now),
            Command::Stop => (3, 0),
            Command::ChangePeriod(period) => (4, period.0),
        };
        let mut woken = 0;
        // SAFETY: a timer of this life that lives for ever; commands of interrupts are 5 above
        // those of tasks; without waiting.
        let sent = unsafe {
            if C::IN_INTERRUPT {
                ffi::xTimerGenericCommandFromISR(timer, number + 5, value, &mut woken, 0)
            } else {
                ffi::xTimerGenericCommandFromTask(timer, number, value, core::ptr::null_mut(), 0)
            }
        };
        ctx.woken(woken != 0);
        sent == ffi::PASS
    }

    pub(crate) fn is_active(&self) -> bool {
        // SAFETY: a timer of this life.
        unsafe { ffi::xTimerIsTimerActive(self.handle()) != 0 }
    }
}

/// The service task found that a timer has expired.
extern "C" fn expired(timer: *mut c_void) {
    // SAFETY: `make` gave the block as the timer's id.
    let block = unsafe { &*ffi::pvTimerGetTimerID(timer).cast::<Block>() };
    // SAFETY: only the service task calls it, one timer after the other.
    if let Some(callback) = unsafe { (*block.callback.get()).as_mut() } {
        callback(&TimerContext::new());
    }
}
