//! Event groups of the kernel.

use super::{Life, ffi};
use crate::InUse;
use crate::context::Context;
use crate::port;
use crate::time::Ticks;
use core::cell::UnsafeCell;
use core::ffi::c_void;

/// The kernel's control block. Lives for ever: a set of bits from an interrupt is on its way to the
/// kernel's service task when the interrupt has ended.
pub(crate) struct Group {
    block: UnsafeCell<[usize; ffi::EVENTS_WORDS]>,
    life: Life,
}

// SAFETY: the block is the kernel's, which is called from the core's thread only.
unsafe impl Sync for Group {}

impl Group {
    pub(crate) const fn new() -> Self {
        Self {
            block: UnsafeCell::new([0; ffi::EVENTS_WORDS]),
            life: Life::none(),
        }
    }

    pub(crate) fn make(&'static self) -> Result<(), InUse> {
        self.life.claim()?;
        // SAFETY: the block is ours and stays.
        unsafe { ffi::xEventGroupCreateStatic(self.block.get().cast()) };
        Ok(())
    }

    fn handle(&self) -> *mut c_void {
        self.life.assert_current();
        self.block.get().cast()
    }

    pub(crate) fn set(&self, bits: u32) -> u32 {
        // SAFETY: a group of this life, called by a task.
        unsafe { ffi::xEventGroupSetBits(self.handle(), bits) }
    }

    /// Whether the service task will do it.
    pub(crate) fn set_from_interrupt<C: Context>(&self, ctx: &C, bits: u32) -> bool {
        let mut woken = 0;
        // SAFETY: a group of this life that lives for ever, called by an interrupt.
        let sent = unsafe { ffi::xEventGroupSetBitsFromISR(self.handle(), bits, &mut woken) };
        ctx.woken(woken != 0);
        sent == ffi::PASS
    }

    pub(crate) fn clear(&self, bits: u32) -> u32 {
        // SAFETY: a group of this life, called by a task.
        unsafe { ffi::xEventGroupClearBits(self.handle(), bits) }
    }

    pub(crate) fn get(&self) -> u32 {
        // SAFETY: a group of this life; this call reads with interrupts masked, from everywhere.
        unsafe { ffi::xEventGroupGetBitsFromISR(self.handle()) }
    }

    pub(crate) fn wait(&self, bits: u32, all: bool, clear: bool, timeout: Ticks) -> u32 {
        port::assert_may_block();
        let (clear, all) = (ffi::Base::from(clear), ffi::Base::from(all));
        // SAFETY: a group of this life, called by a task that may block.
        unsafe { ffi::xEventGroupWaitBits(self.handle(), bits, clear, all, timeout.0) }
    }

    pub(crate) fn meet(&self, set: u32, wait: u32, timeout: Ticks) -> u32 {
        port::assert_may_block();
        // SAFETY: as above.
        unsafe { ffi::xEventGroupSync(self.handle(), set, wait, timeout.0) }
    }
}
