//! What the kernel offers to pass bytes or a wake-up. The receiver sleeps.

use crate::harness::{Batch, Plan, between_processes};
use crate::shared::Shared;
use crate::stream::{self, Stream};
use io_uring::{IoUring, opcode, squeue, types};
use std::cell::RefCell;
use std::io;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};

fn write<const N: usize>(to: &OwnedFd, bytes: [u8; N]) -> bool {
    // SAFETY: N bytes from a valid buffer.
    unsafe { libc::write(to.as_raw_fd(), bytes.as_ptr().cast(), N) == N as isize }
}

/// Pipes and packet sockets do not tear so few bytes: pipe(7).
fn read<const N: usize>(from: &OwnedFd) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    // SAFETY: up to N bytes into a valid buffer.
    let read = unsafe { libc::read(from.as_raw_fd(), bytes.as_mut_ptr().cast(), N) };
    (read == N as isize).then_some(bytes)
}

fn owned(fd: libc::c_long) -> io::Result<OwnedFd> {
    match i32::try_from(fd) {
        // SAFETY: the kernel has just made it, and nothing else owns it.
        Ok(fd) if fd >= 0 => Ok(unsafe { OwnedFd::from_raw_fd(fd) }),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Two descriptors that the kernel puts into a place for them.
fn two(made: impl FnOnce(*mut i32) -> i32) -> io::Result<[OwnedFd; 2]> {
    let mut fds = [-1; 2];
    if made(fds.as_mut_ptr()) != 0 {
        return Err(io::Error::last_os_error());
    }
    let [one, other] = fds.map(|fd| owned(fd.into()));
    Ok([one?, other?])
}

/// The reading and the writing end.
fn new_pipe() -> io::Result<[OwnedFd; 2]> {
    // SAFETY: a valid place for two descriptors.
    two(|fds| unsafe { libc::pipe2(fds, libc::O_CLOEXEC) })
}

/// 4 bytes by `write` and `read`. Each way has the descriptors to read from and to write to.
fn by_bytes(plan: &Plan, ways: [[&OwnedFd; 2]; 2]) -> io::Result<Batch> {
    between_processes(plan, |_, [out, inward]| {
        let (to, from) = (ways[out][1], ways[inward][0]);
        let send = |stamp: u32| {
            write(to, stamp.to_ne_bytes());
        };
        (send, || read(from).map_or(0, u32::from_ne_bytes))
    })
}

/// Two pipes.
pub(crate) fn pipe(plan: &Plan) -> io::Result<Batch> {
    let [there, back] = [new_pipe()?, new_pipe()?];
    by_bytes(plan, [there.each_ref(), back.each_ref()])
}

/// A pair of Unix sockets that keep the boundaries of messages.
pub(crate) fn unix_socket(plan: &Plan) -> io::Result<Batch> {
    let kind = libc::SOCK_SEQPACKET | libc::SOCK_CLOEXEC;
    // SAFETY: a valid place for two descriptors.
    let [near, far] = two(|fds| unsafe { libc::socketpair(libc::AF_UNIX, kind, 0, fds) })?;
    by_bytes(plan, [[&far, &near], [&near, &far]])
}

/// A stream of 8 bytes each through a pipe, a system call at each end of each.
pub(crate) fn pipe_stream(plan: &Plan) -> io::Result<Batch> {
    let [inward, out] = new_pipe()?;
    let stream = Stream {
        chunk: 1024,
        payload_bytes: 8,
    };
    let sender = |_| |k: u32| write(&out, u64::from(k).to_ne_bytes());
    let receiver = |_| || read(&inward).map(|bytes| u64::from_ne_bytes(bytes) as u32);
    stream::from_processes::<_, _, 1>(plan, &Shared::new()?, stream, sender, receiver)
}

/// A wake-up by eventfd, with the stamp in shared memory beside it.
pub(crate) fn eventfd(plan: &Plan) -> io::Result<Batch> {
    // SAFETY: takes no pointer.
    let [there, back] =
        [0, 0].map(|_| owned(unsafe { libc::eventfd(0, libc::EFD_CLOEXEC) }.into()));
    let ways = [there?, back?];
    between_processes(plan, |shared, [out, inward]| {
        let (stamp_out, stamp_in) = (shared.line(2 * out), shared.line(2 * inward));
        let (to, from) = (&ways[out], &ways[inward]);
        let send = move |stamp| {
            stamp_out.store(stamp, Release);
            write(to, 1u64.to_ne_bytes());
        };
        let receive = move || {
            read::<8>(from);
            stamp_in.load(Acquire)
        };
        (send, receive)
    })
}

/// The peer's ring: tells where the own one is, and takes a descriptor of the other's.
fn peers_ring(own: &IoUring, shared: &Shared, [out, inward]: [usize; 2]) -> io::Result<OwnedFd> {
    shared.line(2 * out).store(own.as_raw_fd() as u32, Relaxed);
    shared.line(2 * out + 1).store(std::process::id(), Relaxed);
    // Orders the words before and after it.
    shared.meet(2);
    let [fd, pid] = [0, 1].map(|word| shared.line(2 * inward + word).load(Relaxed));
    // SAFETY: takes numbers only; the result is a new descriptor or negative.
    let process = owned(unsafe { libc::syscall(libc::SYS_pidfd_open, pid, 0) })?;
    // SAFETY: as above.
    owned(unsafe { libc::syscall(libc::SYS_pidfd_getfd, process.as_raw_fd(), fd, 0) })
}

/// 4 bytes in a message from ring to ring: the kernel puts a completion into the other's queue.
pub(crate) fn io_uring(plan: &Plan) -> io::Result<Batch> {
    // Forbidden by a sysctl or a filter: says so before any process starts.
    IoUring::new(8).map_err(|error| io::Error::other(format!("io_uring is forbidden: {error}")))?;
    between_processes(plan, |shared, ways| {
        let own = IoUring::new(8).expect("there was one");
        let peer = peers_ring(&own, shared, ways).expect("the peer's ring");
        let ring = std::rc::Rc::new(RefCell::new(own));
        let sending = ring.clone();
        let send = move |stamp: u32| {
            let to = types::Fd(peer.as_raw_fd());
            let message = opcode::MsgRingData::new(to, stamp as i32, 0, None).build();
            let message = message.flags(squeue::Flags::SKIP_SUCCESS);
            let mut own = sending.borrow_mut();
            // SAFETY: the message refers to no memory, and the descriptor outlives it.
            unsafe { own.submission().push(&message) }.expect("there is room");
            own.submit().expect("a message to the other ring");
        };
        let receive = move || {
            let mut own = ring.borrow_mut();
            loop {
                if let Some(entry) = own.completion().next() {
                    return entry.result() as u32;
                }
                match own.submit_and_wait(1) {
                    Err(error) if error.kind() != io::ErrorKind::Interrupted => {
                        panic!("io_uring cannot wait: {error}")
                    }
                    _ => {}
                }
            }
        };
        (send, receive)
    })
}
