//! The jump from this image to one in a slot of the program flash, and its registers. T-BOOT-7

use crate::board::VirtBoard;
use crate::{clint, doorbell, hart, peripherals, trap};
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board, CoreId, SystemId};

/// The carrier's registers for the boot of one system.
#[repr(C)]
pub(crate) struct BootRegisters {
    /// Start address of each core in the slot that booted; 0 for a core that does not start.
    pub(crate) entries: [AtomicU32; CoreId::COUNT],
    /// The bank of the bootloader that the boot ROM has started, from 1 on; 0 for none.
    pub(crate) bank: AtomicU32,
    /// The bank to start after the next reset, likewise.
    pub(crate) asked_bank: AtomicU32,
}

// The linker scripts place it at the same address in all images. `used`, because an image that only
// reads it would be compiled as if it stayed zero: another image writes it.
#[used]
#[unsafe(link_section = ".bss.carrier.boot")]
static BOOT: [BootRegisters; 2] = [const {
    BootRegisters {
        entries: [const { AtomicU32::new(0) }; CoreId::COUNT],
        bank: AtomicU32::new(0),
        asked_bank: AtomicU32::new(0),
    }
}; 2];

/// Returns the registers of a system.
pub(crate) fn boot_registers(system: SystemId) -> &'static BootRegisters {
    &BOOT[system.index()]
}

unsafe extern "C" {
    fn tandem_jump(hart: usize, entry: u32) -> !;
}

impl VirtBoard {
    /// Sets the start addresses of this system's cores; `None` for a core that does not start.
    pub fn set_entries(&self, entries: [Option<u32>; CoreId::COUNT]) {
        let registers = boot_registers(self.identity().system);
        for (register, entry) in registers.entries.iter().zip(entries) {
            register.store(entry.unwrap_or(0), Relaxed);
        }
    }

    /// Resets CAN module and interrupts, and jumps to this core's start address, if it has one.
    pub fn jump(&self) {
        let place = self.identity().address();
        let entry = boot_registers(place.system).entries[place.core.index()].load(Relaxed);
        if entry == 0 {
            return;
        }
        hart::interrupts_off();
        // The CAN module: discard unsent frames, and received frames, which are for the bootloader.
        let registers = peripherals::core(place);
        registers.wake_on_receive.store(false, Relaxed);
        registers.transmit.discard();
        while registers.receive.take().is_some() {}
        trap::forget_handler(place.index());
        clint::set_timer(place.index(), u64::MAX);
        doorbell::take();
        // SAFETY: the bootloader has checked the image at `entry`. No code uses this image's stack
        // afterwards, and it shares only atomics with other harts.
        unsafe { tandem_jump(place.index(), entry) }
    }
}
