//! Sockets by which processes of this machine talk: requests of one line, and datagrams. Their
//! names are in the abstract namespace: no file is left behind.

use std::io::{self, BufRead as _, BufReader, IoSliceMut, Read as _, Write as _};
use std::os::fd::{AsFd, AsRawFd as _, BorrowedFd};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram, UnixListener, UnixStream};

use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, UnixCredentials, getsockopt, recvmsg, setsockopt, sockopt,
};

/// The longest request, bytes.
const LONGEST_REQUEST: usize = 256;
/// The longest datagram, bytes; a longer one is cut.
const LONGEST_DATAGRAM: usize = 4096;
/// The most connections of a [`RequestSocket`] at a time; a further one waits.
const MOST_CONNECTIONS: usize = 16;

/// A connection that carries lines, and never blocks.
#[derive(Debug)]
pub struct LineStream {
    stream: BufReader<UnixStream>,
    heard: Vec<u8>,
}

impl LineStream {
    /// Makes the connection one that does not block.
    ///
    /// # Errors
    /// If the system does not permit it.
    pub fn new(stream: UnixStream) -> io::Result<Self> {
        stream.set_nonblocking(true)?;
        Ok(Self {
            stream: BufReader::new(stream),
            heard: vec![],
        })
    }

    /// Returns the next line, without its end.
    ///
    /// # Errors
    /// `WouldBlock` if it has not arrived. Any other error says that there is none: the other end
    /// is closed, or the line is longer than `longest` bytes.
    pub fn line(&mut self, longest: usize) -> io::Result<String> {
        let room = longest.saturating_sub(self.heard.len()) as u64;
        let mut stream = (&mut self.stream).take(room);
        stream.read_until(b'\n', &mut self.heard)?;
        let line = self.heard.strip_suffix(b"\n");
        let line = String::from_utf8_lossy(line.ok_or(io::ErrorKind::InvalidData)?).into_owned();
        self.heard.clear();
        Ok(line)
    }
}

/// Returns the process and the user at the other end of a connection.
fn peer(connection: &impl AsFd) -> Option<(u32, u32)> {
    let peer = getsockopt(connection, sockopt::PeerCredentials).ok()?;
    Some((u32::try_from(peer.pid()).ok()?, peer.uid()))
}

/// Whether the process at the other end of a connection is of the same user, or of root. Names in
/// the abstract namespace are open to every user of the machine.
#[must_use]
pub fn is_trusted(connection: &impl AsFd) -> bool {
    let own = rustix::process::geteuid().as_raw();
    peer(connection).is_some_and(|(_, uid)| uid == own || uid == 0)
}

impl AsFd for LineStream {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.stream.get_ref().as_fd()
    }
}

/// Takes requests of one line from processes of the same user and of root. A connection carries one
/// request and its answer.
#[derive(Debug)]
pub struct RequestSocket {
    listener: UnixListener,
    connections: Vec<LineStream>,
}

/// A request that waits for its answer.
#[derive(Debug)]
pub struct LineRequest {
    /// Its line.
    pub text: String,
    /// The process that asks; 0 if it is not known.
    pub from: u32,
    stream: LineStream,
}

impl LineRequest {
    /// Answers by one line. Never blocks.
    pub fn answer(mut self, line: &str) {
        // A caller that left needs no answer. One that does not read loses it: never wait for one.
        let stream = self.stream.stream.get_mut();
        let _ = stream.write_all(format!("{line}\n").as_bytes());
    }
}

impl RequestSocket {
    /// Opens the socket of this name.
    ///
    /// # Errors
    /// `AddrInUse` if another process has it.
    pub fn open(name: &str) -> io::Result<Self> {
        let listener = UnixListener::bind_addr(&SocketAddr::from_abstract_name(name)?)?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            listener,
            connections: vec![],
        })
    }

    /// Returns the descriptors that are readable when something arrives.
    pub fn fds(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        let has_room = self.connections.len() < MOST_CONNECTIONS;
        let listener = has_room.then(|| self.listener.as_fd());
        let connections = self.connections.iter().map(AsFd::as_fd);
        listener.into_iter().chain(connections)
    }

    /// Returns the requests that have arrived. Never blocks.
    ///
    /// # Errors
    /// If the system does not give a descriptor for a connection.
    pub fn take(&mut self) -> io::Result<Vec<LineRequest>> {
        // As many as there may be, also if each is refused: a flood of them must not hold it up.
        for _ in self.connections.len()..MOST_CONNECTIONS {
            match self.listener.accept() {
                Ok((stream, _)) => {
                    let stream = LineStream::new(stream)?;
                    if is_trusted(&stream) {
                        self.connections.push(stream);
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => {}
                Err(error) => return Err(error),
            }
        }
        let mut requests = vec![];
        for mut stream in std::mem::take(&mut self.connections) {
            match stream.line(LONGEST_REQUEST) {
                Ok(text) => requests.push(LineRequest {
                    text,
                    from: peer(&stream).map_or(0, |(pid, _)| pid),
                    stream,
                }),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.connections.push(stream);
                }
                Err(_) => {}
            }
        }
        Ok(requests)
    }
}

/// Sends a request to the [`RequestSocket`] of this name, and waits for the answer.
///
/// # Errors
/// If no process has the socket, or it ends before it answers.
pub fn ask(name: &str, request: &str) -> io::Result<String> {
    let mut stream = UnixStream::connect_addr(&SocketAddr::from_abstract_name(name)?)?;
    stream.write_all(format!("{request}\n").as_bytes())?;
    let mut answer = String::new();
    BufReader::new(stream).read_line(&mut answer)?;
    if answer.is_empty() {
        return Err(io::Error::other("the other end closed before it answered"));
    }
    Ok(answer.trim_end().to_owned())
}

/// Takes datagrams. The kernel says which process has sent each.
#[derive(Debug)]
pub struct DatagramSocket(UnixDatagram);

impl DatagramSocket {
    /// Opens the socket of this name.
    ///
    /// # Errors
    /// `AddrInUse` if another process has it.
    pub fn open(name: &str) -> io::Result<Self> {
        let socket = UnixDatagram::bind_addr(&SocketAddr::from_abstract_name(name)?)?;
        setsockopt(&socket, sockopt::PassCred, &true)?;
        Ok(Self(socket))
    }

    /// Returns the process that has sent the next datagram, and its bytes. Never blocks. The
    /// process is 0 if it is of another namespace.
    #[must_use]
    pub fn receive(&self) -> Option<(u32, Vec<u8>)> {
        let mut bytes = vec![0; LONGEST_DATAGRAM];
        let mut parts = [IoSliceMut::new(&mut bytes)];
        let mut space = nix::cmsg_space!(UnixCredentials);
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_CMSG_CLOEXEC;
        let fd = self.0.as_raw_fd();
        let received = recvmsg::<()>(fd, &mut parts, Some(&mut space), flags).ok()?;
        let sender = received.cmsgs().ok()?.find_map(|message| match message {
            ControlMessageOwned::ScmCredentials(sender) => u32::try_from(sender.pid()).ok(),
            _ => None,
        });
        let length = received.bytes;
        bytes.truncate(length);
        Some((sender.unwrap_or(0), bytes))
    }
}

impl AsFd for DatagramSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
