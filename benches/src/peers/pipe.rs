//! What the kernel offers to pass bytes: pipe, Unix socket. The receiver sleeps.

use crate::harness::{Batch, End, Plan, between_processes};
use crate::shared::Shared;
use crate::stream::{self, Sink, Source, Stream};
use std::io;

/// Two descriptors that pass 4 bytes by `read` and `write`.
struct Descriptors {
    out: i32,
    inward: i32,
}

impl End for Descriptors {
    fn send(&mut self, stamp: u32) {
        let bytes = stamp.to_ne_bytes();
        // SAFETY: sends 4 bytes from a valid buffer to a descriptor that both processes hold.
        unsafe { libc::write(self.out, bytes.as_ptr().cast(), bytes.len()) };
    }

    fn receive(&mut self) -> u32 {
        let mut bytes = [0u8; 4];
        // SAFETY: receives up to 4 bytes into a valid buffer from a descriptor that both processes
        // hold.
        unsafe { libc::read(self.inward, bytes.as_mut_ptr().cast(), bytes.len()) };
        u32::from_ne_bytes(bytes)
    }
}

fn run(plan: &Plan, near: [i32; 2], far: [i32; 2]) -> io::Result<Batch> {
    let end = |[out, inward]: [i32; 2]| move |_: &Shared| Descriptors { out, inward };
    let samples = between_processes(plan, 0, end(near), end(far));
    let mut all = [near, far].concat();
    all.sort_unstable();
    all.dedup();
    close(all);
    samples
}

fn close(descriptors: impl IntoIterator<Item = i32>) {
    for descriptor in descriptors {
        // SAFETY: the descriptor is ours and not used after this.
        unsafe { libc::close(descriptor) };
    }
}

/// The reading and the writing end of a new pipe.
fn new_pipe() -> io::Result<[i32; 2]> {
    let mut pipe = [0i32; 2];
    // SAFETY: `pipe` is a valid place for two descriptors.
    if unsafe { libc::pipe2(pipe.as_mut_ptr(), libc::O_CLOEXEC) } != 0 {
        return Err(io::Error::last_os_error());
    }
    Ok(pipe)
}

/// Two pipes.
///
/// # Errors
/// As [`between_processes`], and if no pipe can be had.
pub fn pipe(plan: &Plan) -> io::Result<Batch> {
    let [read_there, write_there] = new_pipe()?;
    let [read_back, write_back] = new_pipe()?;
    run(plan, [write_there, read_back], [write_back, read_there])
}

/// A pair of Unix sockets that keep the boundaries of messages.
///
/// # Errors
/// As [`between_processes`], and if no socket can be had.
pub fn unix_socket(plan: &Plan) -> io::Result<Batch> {
    let mut pair = [0i32; 2];
    let kind = libc::SOCK_SEQPACKET | libc::SOCK_CLOEXEC;
    // SAFETY: `pair` is a valid place for two descriptors.
    if unsafe { libc::socketpair(libc::AF_UNIX, kind, 0, pair.as_mut_ptr()) } != 0 {
        return Err(io::Error::last_os_error());
    }
    run(plan, [pair[0]; 2], [pair[1]; 2])
}

/// One end of a pipe.
struct OneWay(i32);

impl Source for OneWay {
    fn send(&mut self, k: u32) -> bool {
        let bytes = u64::from(k).to_ne_bytes();
        // SAFETY: sends 8 bytes from a valid buffer to a descriptor that this process holds.
        unsafe { libc::write(self.0, bytes.as_ptr().cast(), bytes.len()) == 8 }
    }
}

impl Sink for OneWay {
    fn receive(&mut self) -> Option<u32> {
        let mut bytes = [0u8; 8];
        // SAFETY: receives up to 8 bytes into a valid buffer from a descriptor that this process
        // holds. Writes of 8 bytes are not torn: pipe(7).
        let read = unsafe { libc::read(self.0, bytes.as_mut_ptr().cast(), bytes.len()) };
        (read == 8).then(|| u64::from_ne_bytes(bytes) as u32)
    }
}

/// A stream of 8 bytes each through a pipe, a system call at each end of each.
///
/// # Errors
/// As [`stream::from_processes`], and if no pipe can be had.
pub fn pipe_stream(plan: &Plan) -> io::Result<Batch> {
    let [inward, out] = new_pipe()?;
    let stream = Stream {
        chunk: 1024,
        payload_bytes: 8,
        own_bytes: 0,
    };
    let (source, sink) = (|_| OneWay(out), |_| OneWay(inward));
    let shared = Shared::new()?;
    let batch = stream::from_processes::<_, _, 1>(plan, &shared, stream, source, sink);
    close([inward, out]);
    batch
}
