//! The whole controller: the three cores of each system, and the carrier, which exchanges with a
//! vehicle on the host.
//!
//! Strap `First`: which systems are in this machine, 1 A, 2 B, 3 both. Strap `Second`: bit 0 lets a
//! system that comes back become the standby of the running one; bit 1 has core 0 work as a task of
//! FreeRTOS. Cores 1 and 2 are always bare. There is one kernel in the image, with statics of its
//! own, so it is for a machine with one system; and it cannot be started again, so after a reset
//! without loss of power core 0 goes on bare.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use tandem_board::{Board, CoreId};
use tandem_board_riscv32_virt::board::{VirtBoard, run};
use tandem_board_riscv32_virt::carrier::Carrier;
use tandem_board_riscv32_virt::memory::{Strap, strap};
use tandem_board_riscv32_virt::{doorbell, entry, log, trap};
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::core2::Core2;
use tandem_cores::{Config, Core};
use tandem_rtos::{Clock, Interrupt, InterruptPriority, Kernel, Priority, TaskOptions, Ticks};

entry!(main);

/// Bits of strap `Second`.
const REINTEGRATE: u32 = 1;
const WITH_RTOS: u32 = 2;
/// Stack of core 0's task; bare, core 0 takes 21 KiB.
const STACK_BYTES: usize = 40 << 10;
/// Period of the kernel's tick.
const TICK_US: u64 = 1_000;
/// The task looks at least once a second.
const LONGEST_TICKS: u32 = 1_000;
/// Turns of 50 us: the emulator runs one hart at a time, and none must wait long for another.
const SLICE_TICKS: u32 = 500;

fn main(hart: usize) -> ! {
    run(hart, SLICE_TICKS, core, outside)
}

/// One life of one core.
fn core(board: &VirtBoard) {
    match board.identity().core {
        CoreId::CONTROL => {
            if strap(Strap::Second) & WITH_RTOS != 0
                && let Ok(kernel) = Kernel::take()
            {
                under_rtos(kernel, board);
            }
            go(board, Core0::new(board, config()))
        }
        CoreId::PERCEPTION => go(board, Core1::new(board)),
        _ => go(board, Core2::new(board)),
    }
}

fn config() -> Config {
    let mut config = Config::rt();
    config.redundancy.reintegrate = strap(Strap::Second) & REINTEGRATE != 0;
    config
}

/// Core 0 as a task of FreeRTOS: its doorbell notifies the task, which else sleeps until the tick
/// after its deadline.
fn under_rtos(kernel: Kernel, board: &VirtBoard) {
    log!(
        "core 0 of {} is a task of FreeRTOS",
        board.identity().system
    );
    tandem_rtos::riscv32::on_fatal(|message| panic!("{message}"));
    // The kernel has the timer.
    doorbell::set_slice(0);
    let board = board.clone();
    let options = TaskOptions::new("control", Priority::new(5)).stack_bytes(STACK_BYTES);
    let control = kernel.spawn(&options, move |ctx| {
        let mut core = Core0::new(&board, config());
        loop {
            let deadline = core.poll();
            let left = deadline.since(board.now());
            let ticks = left.as_us().div_ceil(TICK_US).min(u64::from(LONGEST_TICKS));
            if ticks > 0 {
                ctx.take_notifications(Ticks(ticks as u32));
            }
        }
    });
    let Ok(control) = control else {
        panic!("the heap has no room for the task of core 0")
    };
    let attached = kernel.attach(Interrupt::DOORBELL, InterruptPriority::LOWEST, move |ctx| {
        trap::end_if_held();
        // It never ends.
        let _ = control.notify(ctx);
    });
    assert!(attached.is_ok(), "the doorbell has no other handler");
    let _ = kernel.start(Clock::Wall);
    panic!("the kernel does not start")
}

fn go(board: &VirtBoard, mut core: impl Core) -> ! {
    loop {
        let deadline = core.poll();
        board.wait(deadline);
    }
}

fn outside(carrier: &mut Carrier) -> ! {
    let systems = strap(Strap::First);
    carrier.connect([systems & 1 != 0, systems & 2 != 0]);
    carrier.set_watchdogs(true);
    for system in carrier.systems() {
        carrier.power_off(system);
        carrier.new_flash(system);
    }
    loop {
        // The world connects the battery, and ends the machine.
        carrier.step(u64::MAX);
    }
}
