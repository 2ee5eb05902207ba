//! The socket for requests: `ps` and `target NAME`. One request a connection, one line each way.

use std::io::{self, Read as _, Write as _};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};

use nix::sys::socket::{getsockopt, sockopt};

/// The longest request.
const LONGEST: usize = 256;
/// The most connections at a time; a further one waits.
const MOST: usize = 16;

#[derive(Debug)]
pub(super) struct ControlSocket {
    listener: UnixListener,
    connections: Vec<Connection>,
}

#[derive(Debug)]
struct Connection {
    stream: UnixStream,
    heard: Vec<u8>,
}

/// A request that waits for its answer.
#[derive(Debug)]
pub(super) struct Request {
    pub(super) text: String,
    pub(super) from: u32,
    stream: UnixStream,
}

impl Request {
    /// Answers by one line.
    pub(super) fn answer(mut self, line: &str) {
        // A caller that left needs no answer. One that does not read loses it: never wait for one.
        let _ = self.stream.write_all(format!("{line}\n").as_bytes());
    }
}

impl ControlSocket {
    /// Opens the socket of this abstract name.
    ///
    /// # Errors
    /// `AddrInUse` if another launcher has it.
    pub(super) fn open(name: &str) -> io::Result<Self> {
        let address = SocketAddr::from_abstract_name(name.as_bytes())?;
        let listener = UnixListener::bind_addr(&address)?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            listener,
            connections: vec![],
        })
    }

    /// Returns the descriptors to wait for.
    pub(super) fn fds(&self) -> Vec<BorrowedFd<'_>> {
        let listener = (self.connections.len() < MOST).then(|| self.listener.as_fd());
        let connections = self.connections.iter().map(|it| it.stream.as_fd());
        listener.into_iter().chain(connections).collect()
    }

    /// Returns the requests that have arrived. Never blocks.
    ///
    /// # Errors
    /// If the system does not give a descriptor for a connection.
    pub(super) fn take(&mut self) -> io::Result<Vec<Request>> {
        while self.connections.len() < MOST {
            match self.listener.accept() {
                Ok((stream, _)) if is_permitted(&stream) => {
                    stream.set_nonblocking(true)?;
                    self.connections.push(Connection {
                        stream,
                        heard: vec![],
                    });
                }
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                Err(error) => return Err(error),
            }
        }
        let mut requests = vec![];
        self.connections.retain_mut(|connection| {
            let (is_open, request) = connection.read();
            requests.extend(request);
            is_open
        });
        Ok(requests)
    }
}

impl Connection {
    /// Returns whether it is still to be read, and its request.
    fn read(&mut self) -> (bool, Option<Request>) {
        let mut bytes = [0; LONGEST];
        loop {
            match self.stream.read(&mut bytes) {
                Ok(0) => return (false, None),
                Ok(count) => self.heard.extend(bytes.iter().take(count)),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return (true, None),
                Err(_) => return (false, None),
            }
            if let Some(end) = self.heard.iter().position(|byte| *byte == b'\n') {
                let text = self.heard.get(..end).unwrap_or_default();
                let request = self.stream.try_clone().ok().map(|stream| Request {
                    text: String::from_utf8_lossy(text).into_owned(),
                    from: peer(&self.stream).map_or(0, |(pid, _)| pid),
                    stream,
                });
                return (false, request);
            }
            if self.heard.len() >= LONGEST {
                return (false, None);
            }
        }
    }
}

/// Returns the process and the user at the other end.
fn peer(stream: &UnixStream) -> Option<(u32, u32)> {
    let peer = getsockopt(stream, sockopt::PeerCredentials).ok()?;
    Some((u32::try_from(peer.pid()).ok()?, peer.uid()))
}

/// Only the launcher's own user and root may ask.
fn is_permitted(stream: &UnixStream) -> bool {
    let own = rustix::process::geteuid().as_raw();
    peer(stream).is_some_and(|(_, uid)| uid == own || uid == 0)
}
