//! io_uring's messages between two rings: the kernel puts a completion into the other's queue.

use crate::harness::{Batch, End, Plan, between_processes};
use crate::shared::Shared;
use io_uring::{IoUring, opcode, squeue, types};
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::sync::atomic::Ordering::Relaxed;

struct Ring {
    own: IoUring,
    peer: OwnedFd,
}

impl Ring {
    /// Tells where the own ring is, and takes a descriptor of the other's.
    fn open(shared: &Shared, [own_at, peer_at]: [usize; 2]) -> io::Result<Self> {
        let own = IoUring::new(8)?;
        let here = shared.line(2 * own_at);
        here.store(own.as_raw_fd() as u32, Relaxed);
        shared
            .line(2 * own_at + 1)
            .store(std::process::id(), Relaxed);
        // Orders the words before and after it.
        shared.meet(2);
        let [fd, pid] = [2 * peer_at, 2 * peer_at + 1].map(|at| shared.line(at).load(Relaxed));
        // SAFETY: takes numbers only; the result is a new descriptor or negative.
        let process = unsafe { libc::syscall(libc::SYS_pidfd_open, pid, 0) };
        let process = owned(process)?;
        // SAFETY: as above.
        let peer = unsafe { libc::syscall(libc::SYS_pidfd_getfd, process.as_raw_fd(), fd, 0) };
        Ok(Self {
            own,
            peer: owned(peer)?,
        })
    }

    fn deliver(&mut self, stamp: u32) -> io::Result<()> {
        let to = types::Fd(self.peer.as_raw_fd());
        let message = opcode::MsgRingData::new(to, stamp as i32, 0, None).build();
        let message = message.flags(squeue::Flags::SKIP_SUCCESS);
        // SAFETY: the message refers to no memory, and the descriptor outlives it.
        unsafe { self.own.submission().push(&message) }.map_err(io::Error::other)?;
        self.own.submit().map(drop)
    }
}

fn owned(fd: libc::c_long) -> io::Result<OwnedFd> {
    match i32::try_from(fd) {
        // SAFETY: the kernel has just made it, and nothing else owns it.
        Ok(fd) if fd >= 0 => Ok(unsafe { OwnedFd::from_raw_fd(fd) }),
        _ => Err(io::Error::last_os_error()),
    }
}

impl End for Ring {
    fn send(&mut self, stamp: u32) {
        self.deliver(stamp).expect("a message to the other ring");
    }

    fn receive(&mut self) -> u32 {
        loop {
            if let Some(entry) = self.own.completion().next() {
                return entry.result() as u32;
            }
            match self.own.submit_and_wait(1) {
                Err(error) if error.kind() != io::ErrorKind::Interrupted => {
                    panic!("io_uring cannot wait: {error}")
                }
                _ => {}
            }
        }
    }
}

/// 4 bytes in a message from ring to ring; the receiver sleeps in the kernel.
///
/// # Errors
/// As [`between_processes`], and if the kernel forbids io_uring.
pub fn io_uring(plan: &Plan) -> io::Result<Batch> {
    // Forbidden by a sysctl or a filter: says so before any process starts.
    IoUring::new(8).map_err(|error| io::Error::other(format!("io_uring is forbidden: {error}")))?;
    let end = |ways| {
        move |shared: &Shared| {
            Ring::open(shared, ways).unwrap_or_else(|error| panic!("io_uring: {error}"))
        }
    };
    between_processes(plan, 0, end([0, 2]), end([2, 0]))
}
