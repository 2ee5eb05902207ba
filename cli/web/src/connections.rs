//! Limits what clients can take from the server: how many connections there are at a time, and how
//! long one may stay without progress.
//!
//! So idle clients, clients that do not read, and floods of connections cost a bounded number of
//! sockets, tasks and buffers. They can keep others from the page, but not from the run.

use std::future::Future as _;
use std::io::{self, ErrorKind};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, Sleep, sleep};

/// A listener that accepts a limited number of connections at a time. Further ones wait in the
/// queue of the kernel.
pub(crate) struct Limited {
    listener: TcpListener,
    free: Arc<Semaphore>,
    idle: Duration,
}

impl Limited {
    /// Accepts `most` connections at a time, and closes one that makes no progress for `idle`.
    pub(crate) fn new(listener: TcpListener, most: usize, idle: Duration) -> Self {
        Self {
            listener,
            free: Arc::new(Semaphore::new(most)),
            idle,
        }
    }
}

impl Listener for Limited {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        // Fails only if the semaphore is closed, which nothing does.
        let permit = Arc::clone(&self.free).acquire_owned().await.ok();
        let (stream, from) = Listener::accept(&mut self.listener).await;
        let connection = Connection {
            stream,
            idle: self.idle,
            ends: Box::pin(sleep(self.idle)),
            _permit: permit,
        };
        (connection, from)
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// A connection that fails when it has made no progress for some time.
pub(crate) struct Connection {
    stream: TcpStream,
    idle: Duration,
    ends: Pin<Box<Sleep>>,
    _permit: Option<OwnedSemaphorePermit>,
}

impl Connection {
    /// Passes on a result: progress moves the end, and no progress until then is an error.
    fn checked<T>(
        &mut self,
        result: Poll<io::Result<T>>,
        context: &mut Context<'_>,
    ) -> Poll<io::Result<T>> {
        if result.is_ready() {
            self.ends.as_mut().reset(Instant::now() + self.idle);
            return result;
        }
        ready!(self.ends.as_mut().poll(context));
        Poll::Ready(Err(ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let result = Pin::new(&mut self.stream).poll_read(context, buffer);
        self.checked(result, context)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let result = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.checked(result, context)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read as _, Write as _};
    use std::net::{Ipv4Addr, TcpStream as Client};

    const ASK: &[u8] = b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n";

    /// Serves one page with these limits, until the program ends. Returns the server's port.
    fn serve(most: usize, idle: Duration) -> u16 {
        let listener = std::net::TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        listener.set_nonblocking(true).unwrap();
        let port = listener.local_addr().unwrap().port();
        std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread()
                .enable_all()
                .build();
            runtime.unwrap().block_on(async {
                let listener = TcpListener::from_std(listener).unwrap();
                let page = axum::routing::get(|| async { "page" });
                let router = axum::Router::new().route("/", page);
                axum::serve(Limited::new(listener, most, idle), router).await
            })
        });
        port
    }

    fn connect(port: u16) -> Client {
        Client::connect((Ipv4Addr::LOCALHOST, port)).unwrap()
    }

    fn read(mut client: Client) -> String {
        let mut text = String::new();
        client.read_to_string(&mut text).unwrap();
        text
    }

    #[test]
    fn a_client_that_says_nothing_is_disconnected() {
        let client = connect(serve(8, Duration::from_millis(100)));
        assert_eq!(read(client), "");
    }

    /// One client holds the only connection. The next one is served when the first has gone.
    #[test]
    fn clients_beyond_the_limit_wait() {
        let port = serve(1, Duration::from_secs(3600));
        let mut first = connect(port);
        // An answer to this client shows that the server has accepted it.
        first
            .write_all(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
            .unwrap();
        first.read_exact(&mut [0; 16]).unwrap();
        let mut second = connect(port);
        second.write_all(ASK).unwrap();
        second
            .set_read_timeout(Some(Duration::from_millis(300)))
            .unwrap();
        let early = second.read(&mut [0; 16]).map_err(|error| error.kind());
        assert_eq!(early, Err(ErrorKind::WouldBlock));
        drop(first);
        second.set_read_timeout(None).unwrap();
        assert!(read(second).ends_with("page"));
    }
}
