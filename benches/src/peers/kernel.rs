//! Mechanisms of the kernel that pass bytes or a wake-up. The receiver sleeps.

use crate::harness::{Batch, BatchPlan, between_processes};
use crate::shared::SharedPage;
use crate::stream::{Stream, from_processes};
use io_uring::{IoUring, opcode, squeue, types};
use rustix::event::{EventfdFlags, eventfd as new_eventfd};
use rustix::process::{Pid, PidfdFlags, PidfdGetfdFlags, pidfd_getfd, pidfd_open};
use std::cell::RefCell;
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::sync::atomic::Ordering::{Acquire, Relaxed, Release};

/// Pipes and packet sockets do not split messages this short: pipe(7).
fn read<const N: usize>(mut from: impl Read) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    (from.read(&mut bytes).ok()? == N).then_some(bytes)
}

/// 4 bytes by `write` and `read`. Each way has a writer and a reader.
fn by_bytes<R, W>(plan: &BatchPlan, ways: [(R, W); 2]) -> io::Result<Batch>
where
    for<'a> &'a R: Read,
    for<'a> &'a W: Write,
{
    between_processes(plan, |_, [out, inward]| {
        let (mut to, from) = (&ways[out].1, &ways[inward].0);
        let send = move |stamp: u32| drop(to.write(&stamp.to_ne_bytes()));
        (send, move || read(from).map_or(0, u32::from_ne_bytes))
    })
}

/// Two pipes.
pub(crate) fn pipe(plan: &BatchPlan) -> io::Result<Batch> {
    by_bytes(plan, [io::pipe()?, io::pipe()?])
}

/// A pair of Unix sockets that keep the boundaries of messages.
pub(crate) fn unix_socket(plan: &BatchPlan) -> io::Result<Batch> {
    let kind = libc::SOCK_SEQPACKET | libc::SOCK_CLOEXEC;
    let mut fds = [-1; 2];
    // SAFETY: a valid place for two descriptors.
    if unsafe { libc::socketpair(libc::AF_UNIX, kind, 0, fds.as_mut_ptr()) } != 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: the kernel has just made them, and nothing else owns them.
    let [near, far] = fds.map(|fd| unsafe { File::from_raw_fd(fd) });
    let back = (near.try_clone()?, far.try_clone()?);
    by_bytes(plan, [(far, near), back])
}

/// A stream of messages of 8 bytes through a pipe, with one system call per message at each end.
pub(crate) fn pipe_stream(plan: &BatchPlan) -> io::Result<Batch> {
    let (inward, out) = io::pipe()?;
    let stream = Stream {
        chunk: 1024,
        payload_bytes: 8,
    };
    let sender = |_| |k: u32| (&out).write(&u64::from(k).to_ne_bytes()).is_ok();
    let receiver = |_| || read(&inward).map(|bytes| u64::from_ne_bytes(bytes) as u32);
    from_processes::<_, _, 1>(plan, &SharedPage::new()?, stream, sender, receiver)
}

/// A wake-up by eventfd, with the stamp in shared memory beside it.
pub(crate) fn eventfd(plan: &BatchPlan) -> io::Result<Batch> {
    let new = || new_eventfd(0, EventfdFlags::CLOEXEC).map(File::from);
    let ways = [new()?, new()?];
    between_processes(plan, |shared, [out, inward]| {
        let (stamp_out, stamp_in) = (shared.line(2 * out), shared.line(2 * inward));
        let (mut to, from) = (&ways[out], &ways[inward]);
        let send = move |stamp| {
            stamp_out.store(stamp, Release);
            drop(to.write(&1u64.to_ne_bytes()));
        };
        let receive = move || {
            read::<8>(from);
            stamp_in.load(Acquire)
        };
        (send, receive)
    })
}

/// Publishes the ring of this end, and returns a descriptor of the peer's ring.
fn peers_ring(
    own: &IoUring,
    shared: &SharedPage,
    [out, inward]: [usize; 2],
) -> io::Result<OwnedFd> {
    shared.line(2 * out).store(own.as_raw_fd() as u32, Relaxed);
    shared.line(2 * out + 1).store(std::process::id(), Relaxed);
    // Orders the stores above before the peer's loads below.
    shared.meet(2);
    let [fd, pid] = [0, 1].map(|word| shared.line(2 * inward + word).load(Relaxed) as i32);
    let peer = Pid::from_raw(pid).expect("a process");
    let peer = pidfd_open(peer, PidfdFlags::empty())?;
    Ok(pidfd_getfd(peer, fd, PidfdGetfdFlags::empty())?)
}

/// 4 bytes in a message from ring to ring: the kernel adds a completion to the receiver's queue.
pub(crate) fn io_uring(plan: &BatchPlan) -> io::Result<Batch> {
    // If a sysctl or a filter forbids io_uring, report it before any process starts.
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
