//! The floors: what the hardware and the kernel alone need.

pub mod cas;
mod lines;

pub use lines::full_lines;

use crate::harness::{Batch, End, Plan, between_processes};
use crate::open_loop::at_fixed_rate;
use crate::shared::Shared;
use std::hint::spin_loop;
use std::io;
use std::sync::atomic::{AtomicU32, Ordering};

/// Bytes of two cache lines.
const LINES: u64 = 2 * 64;

/// Two cache lines, one in each direction; the receiver spins on the value itself.
struct Line {
    out: &'static AtomicU32,
    inward: &'static AtomicU32,
    last: u32,
}

impl End for Line {
    fn send(&mut self, stamp: u32) {
        // Zero means "nothing yet". Release pairs with the Acquire in `receive`.
        self.out.store(stamp | 1, Ordering::Release);
    }

    fn receive(&mut self) -> u32 {
        loop {
            let stamp = self.inward.load(Ordering::Acquire);
            if stamp != self.last {
                self.last = stamp;
                return stamp;
            }
            spin_loop();
        }
    }
}

/// One-way time of a cache line between two CPUs that spin.
///
/// # Errors
/// As [`between_processes`].
pub fn cache_line(plan: &Plan) -> io::Result<Batch> {
    let end = |out, inward| {
        move |shared: &Shared| Line {
            out: shared.line(out),
            inward: shared.line(inward),
            last: 0,
        }
    };
    between_processes(plan, LINES, end(0, 2), end(2, 0))
}

/// The same two lines; the receiver sleeps in the kernel until the word changes.
pub(crate) struct Futex(Line);

impl Futex {
    /// On two lines of the case: out and inward.
    pub(crate) fn between(shared: &Shared, [out, inward]: [usize; 2]) -> Self {
        Self(Line {
            out: shared.line(2 * out),
            inward: shared.line(2 * inward),
            last: 0,
        })
    }
}

impl End for Futex {
    fn send(&mut self, stamp: u32) {
        self.0.send(stamp);
        // SAFETY: FUTEX_WAKE on a word of the shared mapping; it reads no further argument.
        unsafe { libc::syscall(libc::SYS_futex, self.0.out.as_ptr(), libc::FUTEX_WAKE, 1) };
    }

    fn receive(&mut self) -> u32 {
        loop {
            let stamp = self.0.inward.load(Ordering::Acquire);
            if stamp != self.0.last {
                self.0.last = stamp;
                return stamp;
            }
            let word = self.0.inward.as_ptr();
            let forever = std::ptr::null::<libc::timespec>();
            // SAFETY: FUTEX_WAIT on a word of the shared mapping, without a time limit.
            unsafe { libc::syscall(libc::SYS_futex, word, libc::FUTEX_WAIT, stamp, forever) };
        }
    }
}

/// One-way time of a futex wake to a sleeping process.
///
/// # Errors
/// As [`between_processes`].
pub fn futex(plan: &Plan) -> io::Result<Batch> {
    let end = |ways| move |shared: &Shared| Futex::between(shared, ways);
    between_processes(plan, LINES, end([0, 1]), end([1, 0]))
}

/// The same at a fixed rate.
///
/// # Errors
/// As [`at_fixed_rate`].
pub fn futex_at_rate(plan: &Plan) -> io::Result<Batch> {
    let end = |ways| move |shared: &Shared| Futex::between(shared, ways);
    at_fixed_rate(plan, LINES, end([0, 1]), end([1, 0]))
}

/// A pair of file descriptors that carry a wake-up, with the stamp in shared memory beside it.
struct EventFd {
    out: i32,
    inward: i32,
    stamp_out: &'static AtomicU32,
    stamp_in: &'static AtomicU32,
}

impl End for EventFd {
    fn send(&mut self, stamp: u32) {
        self.stamp_out.store(stamp, Ordering::Release);
        let one = 1u64.to_ne_bytes();
        // SAFETY: writes 8 bytes from a valid buffer to a descriptor that both processes hold.
        unsafe { libc::write(self.out, one.as_ptr().cast(), one.len()) };
    }

    fn receive(&mut self) -> u32 {
        let mut count = [0u8; 8];
        // SAFETY: reads 8 bytes into a valid buffer from a descriptor that both processes hold.
        unsafe { libc::read(self.inward, count.as_mut_ptr().cast(), count.len()) };
        self.stamp_in.load(Ordering::Acquire)
    }
}

/// One-way time of an eventfd to a sleeping process.
///
/// # Errors
/// As [`between_processes`], and if no eventfd can be had.
pub fn eventfd(plan: &Plan) -> io::Result<Batch> {
    // SAFETY: takes no pointer.
    let [near, far] = [0, 0].map(|_| unsafe { libc::eventfd(0, libc::EFD_CLOEXEC) });
    if near < 0 || far < 0 {
        return Err(io::Error::last_os_error());
    }
    let end = |out, inward, word_out, word_in| {
        move |shared: &Shared| EventFd {
            out,
            inward,
            stamp_out: shared.line(word_out),
            stamp_in: shared.line(word_in),
        }
    };
    let samples = between_processes(plan, LINES, end(far, near, 0, 2), end(near, far, 2, 0));
    // SAFETY: both descriptors are ours and not used after this.
    unsafe {
        libc::close(near);
        libc::close(far);
    }
    samples
}
