//! The switch between two tasks. It saves the registers that a C function must preserve, and the
//! stack pointer.
//!
//! The remaining registers of a pre-empted task, including those of the vector unit, are in the
//! frame of a signal; the task continues when the handler returns. A task that yielded called a
//! function, which must preserve only the registers saved here. No data is below the stack pointer:
//! callers are functions, and the operating system preserves the red zone of interrupted code.

use core::ffi::c_void;

unsafe extern "C" {
    /// Saves the caller's context on its stack and the stack pointer at `save`. Then continues at
    /// the place where the context at `resume` was saved.
    pub(super) fn tandem_switch(save: *mut *mut usize, resume: *mut usize);
    fn tandem_first();
}

#[cfg(target_arch = "x86_64")]
core::arch::global_asm!(
    ".global tandem_switch",
    ".type tandem_switch, @function",
    "tandem_switch:",
    "push rbp",
    "push rbx",
    "push r12",
    "push r13",
    "push r14",
    "push r15",
    "sub rsp, 8",
    "stmxcsr dword ptr [rsp]",
    "fnstcw word ptr [rsp + 4]",
    "mov [rdi], rsp",
    "mov rsp, rsi",
    "ldmxcsr dword ptr [rsp]",
    "fldcw word ptr [rsp + 4]",
    "add rsp, 8",
    "pop r15",
    "pop r14",
    "pop r13",
    "pop r12",
    "pop rbx",
    "pop rbp",
    "ret",
    ".size tandem_switch, . - tandem_switch",
    // The outermost frame of a new task: its code is in r12, the argument in r13, the function that
    // calls the code in r14.
    ".global tandem_first",
    ".type tandem_first, @function",
    "tandem_first:",
    "xor ebp, ebp",
    "mov rdi, r12",
    "mov rsi, r13",
    "call r14",
    "ud2",
    ".size tandem_first, . - tandem_first",
);

#[cfg(target_arch = "aarch64")]
core::arch::global_asm!(
    ".global tandem_switch",
    ".type tandem_switch, %function",
    "tandem_switch:",
    "sub sp, sp, #176",
    "stp x19, x20, [sp, #0]",
    "stp x21, x22, [sp, #16]",
    "stp x23, x24, [sp, #32]",
    "stp x25, x26, [sp, #48]",
    "stp x27, x28, [sp, #64]",
    "stp x29, x30, [sp, #80]",
    "stp d8, d9, [sp, #96]",
    "stp d10, d11, [sp, #112]",
    "stp d12, d13, [sp, #128]",
    "stp d14, d15, [sp, #144]",
    "mrs x9, fpcr",
    "str x9, [sp, #160]",
    "mov x9, sp",
    "str x9, [x0]",
    "mov sp, x1",
    "ldp x19, x20, [sp, #0]",
    "ldp x21, x22, [sp, #16]",
    "ldp x23, x24, [sp, #32]",
    "ldp x25, x26, [sp, #48]",
    "ldp x27, x28, [sp, #64]",
    "ldp x29, x30, [sp, #80]",
    "ldp d8, d9, [sp, #96]",
    "ldp d10, d11, [sp, #112]",
    "ldp d12, d13, [sp, #128]",
    "ldp d14, d15, [sp, #144]",
    "ldr x9, [sp, #160]",
    "msr fpcr, x9",
    "add sp, sp, #176",
    "ret",
    ".size tandem_switch, . - tandem_switch",
    ".global tandem_first",
    ".type tandem_first, %function",
    "tandem_first:",
    "mov x29, xzr",
    "mov x30, xzr",
    "mov x0, x19",
    "mov x1, x20",
    "blr x21",
    "brk #1",
    ".size tandem_first, . - tandem_first",
);

/// Prepares the stack of a new task: [`tandem_switch`] to the result starts the task.
///
/// # Safety
/// `top` is the highest word of a stack that has room and is not in use.
pub(super) unsafe fn first_frame(
    top: *mut usize,
    begin: extern "C" fn(extern "C" fn(*mut c_void), *mut c_void) -> !,
    code: extern "C" fn(*mut c_void),
    argument: *mut c_void,
) -> *mut usize {
    let words = frame(begin as usize, code as usize, argument as usize);
    // SAFETY: `top` is in the stack by the caller's promise; all writes are below it. Two words
    // above the frame stay free: the return leaves the stack pointer at a multiple of 16, as before
    // a call.
    unsafe {
        let aligned = (top as usize & !15) as *mut usize;
        let bottom = aligned.sub(2 + words.len());
        core::ptr::copy_nonoverlapping(words.as_ptr(), bottom, words.len());
        bottom
    }
}

/// Returns the saved context of a new task, from the stack pointer up.
#[cfg(target_arch = "x86_64")]
fn frame(begin: usize, code: usize, argument: usize) -> [usize; 8] {
    // Default control words: all floating-point exceptions masked, round to nearest; the x87 unit
    // with extended precision.
    let control = 0x1F80 | (0x037F << 32);
    let first = tandem_first as *const () as usize;
    // mxcsr and x87 control word, r15, r14, r13, r12, rbx, rbp, return address.
    [control, 0, begin, argument, code, 0, 0, first]
}

/// Returns the saved context of a new task, from the stack pointer up.
#[cfg(target_arch = "aarch64")]
fn frame(begin: usize, code: usize, argument: usize) -> [usize; 22] {
    let mut words = [0; 22];
    // x19, x20 and x21; the floating-point control register is zero by default.
    words[..3].copy_from_slice(&[code, argument, begin]);
    // x30.
    words[11] = tandem_first as *const () as usize;
    words
}
