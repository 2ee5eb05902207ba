//! What a process says to the launcher of its platform, and how state management asks it for a run
//! target.
//!
//! The protocol is systemd's `sd_notify`, with a number for checkpoints. A process without
//! `NOTIFY_SOCKET` has no launcher, or one that does not listen: its reports go nowhere.

use std::io;
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::net::{SocketAddr, UnixDatagram};

use crate::{clock, socket};

/// Environment variable with the socket for reports.
pub const NOTIFY_SOCKET: &str = "NOTIFY_SOCKET";
/// Environment variable with the socket for requests; only state management has it.
pub const CONTROL_SOCKET: &str = "TANDEM_CONTROL_SOCKET";

/// Says that the process is ready.
///
/// # Errors
/// If there is a launcher, and it cannot be reached.
pub fn ready() -> io::Result<()> {
    say("READY=1")
}

/// Says that the process is alive.
///
/// # Errors
/// As [`ready`].
pub fn alive() -> io::Result<()> {
    say("WATCHDOG=1")
}

/// Says that the process is about to end.
///
/// # Errors
/// As [`ready`].
pub fn stopping() -> io::Result<()> {
    say("STOPPING=1")
}

/// Says that the process has reached a checkpoint now.
///
/// # Errors
/// As [`ready`].
pub fn checkpoint(number: u32) -> io::Result<()> {
    let now_us = clock::now().as_ns() / 1_000;
    say(&format!(
        "X_TANDEM_CHECKPOINT={number}\nMONOTONIC_USEC={now_us}"
    ))
}

/// Sends lines of the protocol. Opens no descriptor that stays open.
///
/// # Errors
/// As [`ready`].
pub fn say(lines: &str) -> io::Result<()> {
    let Some(name) = std::env::var_os(NOTIFY_SOCKET) else {
        return Ok(());
    };
    let bytes = name.as_bytes();
    let address = match bytes.strip_prefix(b"@") {
        Some(name) => SocketAddr::from_abstract_name(name)?,
        None => SocketAddr::from_pathname(&name)?,
    };
    UnixDatagram::unbound()?.send_to_addr(lines.as_bytes(), &address)?;
    Ok(())
}

/// Asks the launcher for a run target, and waits until all of it is ready. For state management.
///
/// # Errors
/// If there is no launcher, or the target was not reached; the text says why.
pub fn switch_target(name: &str) -> io::Result<()> {
    let socket = std::env::var(CONTROL_SOCKET).map_err(io::Error::other)?;
    let socket = socket.strip_prefix('@').unwrap_or(&socket);
    match socket::ask(socket, &format!("target {name}"))?.as_str() {
        "ok" => Ok(()),
        why => Err(io::Error::other(why.to_owned())),
    }
}
