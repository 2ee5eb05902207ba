//! Ends the process with a task's name after a stack overflow or a panic.

use super::process::{errno, fatal};
use super::stack::page;
use super::state;
use crate::ffi;
use core::mem::MaybeUninit;
use core::ptr;
use std::boxed::Box;
use std::sync::Once;

/// Size of the fault handler's own stack: a task's stack that overflowed has no room for it.
const HANDLER_BYTES: usize = 64 << 10;
/// If the stack pointer is closer to the stack's end than this, a signal's frame did not fit.
const FRAME_BYTES: usize = 16 << 10;

/// The previous state of this thread.
pub(super) struct Before {
    stack: libc::stack_t,
    actions: [(i32, libc::sigaction); 2],
    memory: *mut libc::c_void,
}

static mut PREVIOUS: [MaybeUninit<libc::sigaction>; 2] = [const { MaybeUninit::uninit() }; 2];

/// Sets the handler of faults for this thread's tasks.
pub(super) fn begin() -> Result<Before, i32> {
    let handler: extern "C" fn(i32, *mut libc::siginfo_t, *mut libc::c_void) = on_fault;
    let flags = libc::MAP_PRIVATE | libc::MAP_ANONYMOUS | libc::MAP_STACK;
    let access = libc::PROT_READ | libc::PROT_WRITE;
    // SAFETY: a fresh mapping becomes the alternate stack; all pointers are valid. The handler only
    // reads, writes and ends the process.
    unsafe {
        let memory = libc::mmap(ptr::null_mut(), HANDLER_BYTES, access, flags, -1, 0);
        if memory == libc::MAP_FAILED {
            return Err(errno());
        }
        let stack = libc::stack_t {
            ss_sp: memory,
            ss_flags: 0,
            ss_size: HANDLER_BYTES,
        };
        let mut before: libc::stack_t = core::mem::zeroed();
        libc::sigaltstack(&stack, &mut before);
        let mut action: libc::sigaction = core::mem::zeroed();
        action.sa_sigaction = handler as *const () as usize;
        action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
        // Block all other signals: tasks must not be switched on the alternate stack.
        libc::sigfillset(&mut action.sa_mask);
        let actions = [libc::SIGSEGV, libc::SIGBUS].map(|signal| {
            let mut old: libc::sigaction = core::mem::zeroed();
            libc::sigaction(signal, &action, &mut old);
            (signal, old)
        });
        for (place, (_, old)) in (0..).zip(actions) {
            (&raw mut PREVIOUS[place]).write(MaybeUninit::new(old));
        }
        Ok(Before {
            stack: before,
            actions,
            memory,
        })
    }
}

/// Restores the previous state.
pub(super) fn end(before: &Before) {
    // SAFETY: these are the values that `begin` read; the alternate stack is not in use.
    unsafe {
        for (signal, action) in &before.actions {
            libc::sigaction(*signal, action, ptr::null_mut());
        }
        libc::sigaltstack(&before.stack, ptr::null_mut());
        libc::munmap(before.memory, HANDLER_BYTES);
    }
}

extern "C" fn on_fault(signal: i32, info: *mut libc::siginfo_t, context: *mut libc::c_void) {
    if state::on_core()
        && let Some(low) = current_stack()
    {
        // SAFETY: for SA_SIGINFO the operating system passes valid pointers to a handler.
        let (address, pointer) =
            unsafe { ((*info).si_addr() as usize, stack_pointer(context.cast())) };
        let guard = low - page()..low;
        // Either the task touched the guard, or a signal found no room for its frame.
        let no_room =
            (low - page()..low + FRAME_BYTES).contains(&pointer) && !on_stack(address, low);
        if guard.contains(&address) || no_room {
            let name = ffi::current_name();
            fatal(format_args!("task '{name}' has overflowed its stack"));
        }
    }
    // This is not a task's fault: restore the previous handler. The instruction then faults again;
    // a signal that another process sent is lost.
    let place = usize::from(signal == libc::SIGBUS);
    // SAFETY: `begin` wrote this element when it installed this handler.
    unsafe { libc::sigaction(signal, (&raw const PREVIOUS[place]).cast(), ptr::null_mut()) };
}

/// Returns the lowest address of the running task's stack.
fn current_stack() -> Option<usize> {
    let task = ffi::current_tcb();
    if task.is_null() {
        return None;
    }
    let (mut low, mut tcb) = (ptr::null_mut(), ptr::null_mut());
    // SAFETY: the running task lives; the call writes its stack and control block to our variables.
    let known = unsafe { ffi::xTaskGetStaticBuffers(task, &mut low, &mut tcb) } == ffi::PASS;
    known.then_some(low as usize)
}

/// Returns whether an address is in the accessible part of the stack; if so, this is no overflow.
fn on_stack(address: usize, low: usize) -> bool {
    (low..low + FRAME_BYTES).contains(&address)
}

/// Returns the stack pointer of interrupted code.
///
/// # Safety
/// `context` is the argument of a signal handler.
pub(super) unsafe fn stack_pointer(context: *const libc::ucontext_t) -> usize {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: the caller's promise.
    return unsafe { (*context).uc_mcontext.gregs[libc::REG_RSP as usize] as usize };
    #[cfg(target_arch = "aarch64")]
    // SAFETY: the caller's promise.
    return unsafe { (*context).uc_mcontext.sp as usize };
}

/// Makes a panic in a task end the process. The task's name follows the usual message, which is
/// repeated because a test may have captured it.
pub(super) fn name_panics() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let usual = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if !state::on_core() {
                return usual(panic);
            }
            state::mask_for_good();
            usual(panic);
            let place = if state::in_interrupt() {
                "a handler during task"
            } else {
                "task"
            };
            fatal(format_args!("{place} '{}' {panic}", ffi::current_name()));
        }));
    });
}
