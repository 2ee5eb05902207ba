//! Counts the system calls and the allocator requests of one thread of this process, by ptrace.
//!
//! A child process traces its parent and stops it at each system call. The parent marks the window
//! and each allocator request by system calls with numbers that Linux does not have. So the tracer
//! sees all calls in order, with the thread that made each.

use std::alloc::{GlobalAlloc, Layout, System};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

const BEGIN: i64 = 0x7A_0001;
const END: i64 = 0x7A_0002;
const ALLOCATOR: i64 = 0x7A_0003;
/// The number under which allocator requests are counted, beside those of system calls.
pub(crate) const ALLOCATOR_REQUESTS: i64 = -1;
/// Name of the thread whose calls are counted.
const THREAD: &str = "kernel\n";

/// Whether allocator requests are marked.
static TRACED: AtomicBool = AtomicBool::new(false);

/// Makes a system call that Linux rejects, and restores `errno`.
fn mark(number: i64) {
    // SAFETY: Linux has no such system call; `errno` belongs to this thread.
    unsafe {
        let errno = libc::__errno_location();
        let before = *errno;
        libc::syscall(number);
        *errno = before;
    }
}

/// Marks the beginning of the window in which calls are counted. `mark_end` marks its end.
pub(crate) fn mark_begin() {
    mark(BEGIN);
}

pub(crate) fn mark_end() {
    mark(END);
}

/// The system's allocator, with a mark for each request while this process is traced.
pub(crate) struct Marked;

fn mark_request() {
    if TRACED.load(Relaxed) {
        mark(ALLOCATOR);
    }
}

// SAFETY: passes every request to the system's allocator unchanged.
unsafe impl GlobalAlloc for Marked {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        mark_request();
        // SAFETY: the caller's contract is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        mark_request();
        // SAFETY: the caller's contract is passed on.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        mark_request();
        // SAFETY: the caller's contract is passed on.
        unsafe { System.realloc(at, layout, size) }
    }
}

/// Starts a child that traces this process from now on. When the window ends, the child writes the
/// counts to the file `into`: a line with number and count for each system call.
pub(crate) fn start(into: &Path) {
    let threads = fs::read_dir("/proc/self/task").expect("threads").count();
    assert_eq!(threads, 1, "only a process with one thread is forked");
    let mut ready = [0; 2];
    // SAFETY: this process has one thread, so the child is a complete copy of it. The pipe is open
    // in both, and `ready` has room for its two descriptors.
    unsafe {
        libc::prctl(libc::PR_SET_PTRACER, libc::PR_SET_PTRACER_ANY, 0, 0, 0);
        assert_eq!(libc::pipe(ready.as_mut_ptr()), 0);
        let traced = libc::getpid();
        let child = libc::fork();
        assert!(child >= 0, "fork");
        if child == 0 {
            libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL);
            let done = std::panic::catch_unwind(|| trace(traced, ready[1], into));
            libc::_exit(i32::from(done.is_err()));
        }
        libc::close(ready[1]);
        let mut byte = 0_u8;
        let got = libc::read(ready[0], (&raw mut byte).cast(), 1);
        assert_eq!(got, 1, "this system does not permit tracing");
        libc::close(ready[0]);
    }
    TRACED.store(true, Relaxed);
}

unsafe fn ptrace(request: libc::c_uint, thread: libc::pid_t, at: usize, data: usize) -> i64 {
    // SAFETY: the caller ensures that `data` fits the request.
    unsafe { libc::ptrace(request, thread, at, data) }
}

/// Higher than core 0's, because signals pile up on core 0's stack while it waits for the tracer.
const PRIORITY: i32 = 80;

/// Runs the tracer until its parent has ended.
fn trace(process: libc::pid_t, ready: i32, into: &Path) {
    let urgent = libc::sched_param {
        sched_priority: PRIORITY,
    };
    // This fails without the permission for real-time priorities, which core 0 then lacks too.
    // SAFETY: the parameter is read during the call.
    unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO, &urgent) };
    let options = libc::PTRACE_O_TRACESYSGOOD | libc::PTRACE_O_TRACECLONE;
    // SAFETY: seizes the parent and stops it once; this process owns the end of the pipe.
    unsafe {
        let seized = ptrace(libc::PTRACE_SEIZE, process, 0, options as usize);
        assert_eq!(seized, 0, "{}", std::io::Error::last_os_error());
        ptrace(libc::PTRACE_INTERRUPT, process, 0, 0);
    }
    let mut counts: BTreeMap<i64, u32> = BTreeMap::new();
    let mut counting = None;
    let mut reported = false;
    loop {
        let mut status = 0;
        // SAFETY: `status` is valid for writing.
        let thread = unsafe { libc::waitpid(-1, &mut status, libc::__WALL) };
        if thread < 0 {
            return;
        }
        if !libc::WIFSTOPPED(status) {
            continue;
        }
        let (signal, event) = (libc::WSTOPSIG(status), status >> 16);
        let is_call = signal == libc::SIGTRAP | 0x80;
        if is_call && let Some(number) = entered(thread) {
            match number {
                BEGIN => counting = kernel_thread(process),
                END if counting.take().is_some() => {
                    let lines: Vec<String> = counts
                        .iter()
                        .map(|(number, count)| format!("{number} {count}\n"))
                        .collect();
                    // Rename a complete file, so that a reader never sees a partly written one.
                    let draft = into.with_extension("draft");
                    fs::write(&draft, lines.concat()).expect("the file of the counts");
                    fs::rename(draft, into).expect("the file of the counts");
                }
                _ if counting == Some(thread) => {
                    let number = match number {
                        ALLOCATOR => ALLOCATOR_REQUESTS,
                        _ => number,
                    };
                    *counts.entry(number).or_default() += 1;
                }
                _ => {}
            }
        }
        // After a stop for an event or a system call there is no signal to deliver.
        let deliver = if is_call || event != 0 { 0 } else { signal };
        // SAFETY: resumes a stopped thread; if the thread has ended, the call fails.
        unsafe { ptrace(libc::PTRACE_SYSCALL, thread, 0, deliver as usize) };
        if !reported {
            reported = true;
            // SAFETY: the buffer has one valid byte; this process owns the descriptor.
            unsafe { libc::write(ready, [1_u8].as_ptr().cast(), 1) };
        }
    }
}

/// Returns the system call that the thread is about to make; `None` if it returns from one.
fn entered(thread: libc::pid_t) -> Option<i64> {
    // SAFETY: all-zero bytes are a valid value; Linux writes at most `size` bytes.
    let info = unsafe {
        let mut info: libc::ptrace_syscall_info = core::mem::zeroed();
        let size = size_of_val(&info);
        ptrace(
            libc::PTRACE_GET_SYSCALL_INFO,
            thread,
            size,
            &raw mut info as usize,
        );
        info
    };
    if info.op != libc::PTRACE_SYSCALL_INFO_ENTRY {
        return None;
    }
    // SAFETY: the stop is an entry, so this member of the union is valid.
    let number = unsafe { info.u.entry.nr };
    i64::try_from(number).ok()
}

fn kernel_thread(process: libc::pid_t) -> Option<libc::pid_t> {
    let tasks = fs::read_dir(format!("/proc/{process}/task")).ok()?;
    let mut named = tasks.flatten().filter(|task| {
        let comm = fs::read_to_string(task.path().join("comm"));
        comm.is_ok_and(|comm| comm == THREAD)
    });
    named.next()?.file_name().to_str()?.parse().ok()
}
