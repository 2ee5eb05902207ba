//! A connection between two processes of this machine that carries CAN frames, each as a message in
//! the form of [`UdpBus`](crate::UdpBus). It has a name in the kernel, and leaves no file behind.

use std::io::{self, Read as _};
use std::os::fd::{AsFd, BorrowedFd};

use socket2::{Domain, SockAddr, Socket, Type};
use tandem_board::CanFrame;

use crate::udp_bus::{decode, encode};

/// No message is longer.
const MESSAGE_MAX: usize = 2048;

/// The end that waits for the other one.
#[derive(Debug)]
pub struct BusPipeListener(Socket);

impl BusPipeListener {
    /// Makes the name known: [`BusPipe::connect`] finds it from now on.
    ///
    /// # Errors
    /// An error of the operating system, such as a name that is in use.
    pub fn bind(name: &str) -> io::Result<Self> {
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        socket.bind(&address(name)?)?;
        socket.listen(1)?;
        Ok(Self(socket))
    }

    /// Waits for another end. Each user of this machine can be there: ask the kernel who it is.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn accept(&self) -> io::Result<BusPipe> {
        self.0.accept().map(|(socket, _)| BusPipe(socket))
    }
}

/// One end of the connection.
#[derive(Debug)]
pub struct BusPipe(Socket);

impl AsFd for BusPipe {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl BusPipe {
    /// Connects to the end that waits under this name. [`BusPipe::poll`] and [`BusPipe::send`]
    /// then never block; do not call [`BusPipe::receive`].
    ///
    /// # Errors
    /// An error of the operating system, such as an unknown name.
    pub fn connect(name: &str) -> io::Result<Self> {
        let socket = Socket::new(Domain::UNIX, Type::SEQPACKET, None)?;
        socket.connect(&address(name)?)?;
        socket.set_nonblocking(true)?;
        Ok(Self(socket))
    }

    /// Returns a second handle of this end, for another thread.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn try_clone(&self) -> io::Result<Self> {
        self.0.try_clone().map(Self)
    }

    /// Sends a frame.
    ///
    /// # Errors
    /// An error of the operating system, such as a full buffer or an end that has closed.
    pub fn send(&self, frame: &CanFrame) -> io::Result<()> {
        self.0.send(&encode(frame)?).map(drop)
    }

    /// Waits for the next frame; `None` if the other end has closed.
    ///
    /// # Errors
    /// An error of the operating system.
    pub fn receive(&self) -> io::Result<Option<CanFrame>> {
        let mut bytes = [0; MESSAGE_MAX];
        loop {
            match (&self.0).read(&mut bytes) {
                Ok(0) => return Ok(None),
                Ok(length) => {
                    if let Some(frame) = decode(&bytes[..length]) {
                        return Ok(Some(frame));
                    }
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Returns the next frame that has arrived; `None` also if the other end has closed.
    #[must_use]
    pub fn poll(&self) -> Option<CanFrame> {
        self.receive().ok().flatten()
    }
}

/// Returns an address of the abstract namespace, which a NUL begins.
fn address(name: &str) -> io::Result<SockAddr> {
    SockAddr::unix(format!("\0{name}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::CanId;

    /// Frames of each kind pass in both directions, in order. The end of one side is the end of
    /// the other, and its name is no longer known.
    #[test]
    fn frames_pass_in_both_directions() {
        let name = format!("tandem-test-{}", std::process::id());
        let frames = [
            CanFrame::new(CanId::Standard(0x7FF), false, &[]),
            CanFrame::new(CanId::Extended(0x7FF), false, &[1, 2, 3]),
            CanFrame::new(CanId::Standard(1), true, &[9; 64]),
        ]
        .map(Result::unwrap);
        let listener = BusPipeListener::bind(&name).unwrap();
        assert!(BusPipeListener::bind(&name).is_err());
        let vehicle = BusPipe::connect(&name).unwrap();
        assert_eq!(vehicle.poll(), None);
        let bridge = listener.accept().unwrap();
        drop(listener);
        for frame in &frames {
            vehicle.send(frame).unwrap();
            bridge.try_clone().unwrap().send(frame).unwrap();
        }
        for frame in frames {
            assert_eq!(bridge.receive().unwrap(), Some(frame));
            assert_eq!(vehicle.poll(), Some(frame));
        }
        drop(vehicle);
        assert_eq!(bridge.receive().unwrap(), None);
        assert!(BusPipe::connect(&name).is_err());
    }
}
