//! Counts the system calls of a piece of code, by Linux's Syscall User Dispatch.
//!
//! While a selector byte in our memory requests it, the kernel turns every system call of this
//! thread into a signal (SIGSYS). The handler counts, makes the call itself, and returns the result
//! to the counted code. Nothing is estimated. See
//! Documentation/admin-guide/syscall-user-dispatch.rst in the Linux sources.

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
pub use dispatch::count;

/// Runs `code`; system calls cannot be counted here.
#[cfg(not(all(target_os = "linux", target_arch = "x86_64")))]
pub fn count(code: impl FnOnce()) -> Option<u32> {
    code();
    None
}

#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
mod dispatch {
    use std::arch::{asm, naked_asm};
    use std::ptr;
    use std::sync::atomic::{AtomicU8, AtomicU32, Ordering};

    const PR_SET_SYSCALL_USER_DISPATCH: libc::c_int = 59;
    const OFF: libc::c_ulong = 0;
    const ON: libc::c_ulong = 1;
    const ALLOW: u8 = 0;
    const BLOCK: u8 = 1;
    const SA_RESTORER: u64 = 0x0400_0000;

    /// Selector that the kernel reads at each system call: let it pass, or signal us.
    static SELECTOR: AtomicU8 = AtomicU8::new(ALLOW);
    static COUNT: AtomicU32 = AtomicU32::new(0);

    /// The kernel's signal action; the C library's has no field for a restorer.
    #[repr(C)]
    struct Action {
        handler: extern "C" fn(libc::c_int, *mut libc::siginfo_t, *mut libc::c_void),
        flags: u64,
        restorer: unsafe extern "C" fn(),
        mask: u64,
    }

    /// Returns from the signal handler: `rt_sigreturn`, the one call that always passes.
    #[unsafe(naked)]
    unsafe extern "C" fn restore() {
        naked_asm!("mov eax, 15", "syscall", "ud2", ".balign 16");
    }
    /// Bytes of [`restore`], including its `syscall`.
    const RESTORE_BYTES: libc::c_ulong = 8;

    extern "C" fn on_call(
        _signal: libc::c_int,
        _info: *mut libc::siginfo_t,
        context: *mut libc::c_void,
    ) {
        SELECTOR.store(ALLOW, Ordering::Relaxed);
        COUNT.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the kernel passes the context of the interrupted code; no other code uses it now.
        let registers = unsafe { &mut (*context.cast::<libc::ucontext_t>()).uc_mcontext.gregs };
        let register = |name: libc::c_int| registers[name as usize];
        let result: i64;
        // SAFETY: makes the same call as the counted code, with the same arguments.
        unsafe {
            asm!(
                "syscall",
                inlateout("rax") register(libc::REG_RAX) => result,
                in("rdi") register(libc::REG_RDI),
                in("rsi") register(libc::REG_RSI),
                in("rdx") register(libc::REG_RDX),
                in("r10") register(libc::REG_R10),
                in("r8") register(libc::REG_R8),
                in("r9") register(libc::REG_R9),
                lateout("rcx") _,
                lateout("r11") _,
            );
        }
        registers[libc::REG_RAX as usize] = result;
        SELECTOR.store(BLOCK, Ordering::Relaxed);
    }

    /// Runs `code` and returns how many system calls it makes; `None` if this kernel cannot count
    /// them. Only for processes of one thread: there is one counter. `code` must not start threads
    /// or processes.
    pub fn count(code: impl FnOnce()) -> Option<u32> {
        let action = Action {
            handler: on_call,
            flags: libc::SA_SIGINFO as u64 | SA_RESTORER,
            restorer: restore,
            mask: 0,
        };
        let size = size_of_val(&action.mask);
        let old = ptr::null_mut::<Action>();
        // SAFETY: `action` has the layout of the kernel's structure, and its handler and restorer
        // stay where they are. The selector is a static.
        let refused = unsafe {
            libc::syscall(libc::SYS_rt_sigaction, libc::SIGSYS, &action, old, size) != 0
                || libc::prctl(
                    PR_SET_SYSCALL_USER_DISPATCH,
                    ON,
                    restore as unsafe extern "C" fn() as usize,
                    RESTORE_BYTES,
                    SELECTOR.as_ptr(),
                ) != 0
        };
        COUNT.store(0, Ordering::Relaxed);
        SELECTOR.store(if refused { ALLOW } else { BLOCK }, Ordering::SeqCst);
        code();
        SELECTOR.store(ALLOW, Ordering::SeqCst);
        let zero: libc::c_ulong = 0;
        // SAFETY: this call passes no pointer.
        unsafe { libc::prctl(PR_SET_SYSCALL_USER_DISPATCH, OFF, zero, zero, zero) };
        (!refused).then(|| COUNT.load(Ordering::Relaxed))
    }
}
