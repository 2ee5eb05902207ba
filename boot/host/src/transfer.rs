//! Both ends of a download over a [`UdpBus`](crate::UdpBus), in real time.

use crate::{FileSender, ToDo, UdpBus};
use embedded_storage::nor_flash::NorFlash;
use std::io;
use std::time::Instant as Clock;
use tandem_board::{Duration, Instant};
use tandem_boot::{Loader, Next, Refusal};

/// Why a file was not transferred.
#[derive(Debug, thiserror::Error)]
pub enum TransferError {
    /// The bus fails.
    #[error("the CAN bus over UDP fails: {0}; is there a route for multicast?")]
    Wire(#[from] io::Error),
    /// No loader answers.
    #[error("no bootloader answers within {0} s; reset the controller, or check the bus")]
    NoAnswer(u64),
    /// The bootloader refuses the file.
    #[error("the bootloader refuses the file: {0:?} (docs/boot.md, table of codes)")]
    Refused(Refusal),
    /// A wrong tester's key was used before.
    #[error("the bootloader takes no tester's key for {0} s (65535: before its next start)")]
    Locked(u16),
}

fn since(start: Clock) -> Instant {
    Instant::from_ns(start.elapsed().as_nanos() as u64)
}

fn left(now: Instant, until: Instant) -> std::time::Duration {
    // Limit the wait, so that the caller reads the clock regularly.
    let left = until.since(now).as_ns().clamp(1_000, 100_000_000);
    std::time::Duration::from_nanos(left)
}

/// Sends a file. Calls `progress` with the number of accepted records and of all records.
///
/// # Errors
/// [`TransferError`] if the loader did not put the file on trial.
pub fn send_file(
    wire: &UdpBus,
    mut host: FileSender,
    connect_within: Duration,
    mut progress: impl FnMut(u32, u32),
) -> Result<(), TransferError> {
    let start = Clock::now();
    let mut limit = Instant::ORIGIN + connect_within;
    loop {
        let now = since(start);
        if host.is_connected() {
            limit = now + connect_within;
        }
        match host.next(now) {
            ToDo::Send(frame) => {
                wire.send(&frame)?;
                if host.is_connected() || now < limit {
                    continue;
                }
                return Err(TransferError::NoAnswer(
                    connect_within.as_ns() / 1_000_000_000,
                ));
            }
            ToDo::Wait(until) => {
                if let Some(frame) = wire.receive(left(now, until))? {
                    host.on_frame(since(start), &frame);
                    let (done, all) = host.progress();
                    progress(done, all);
                }
            }
            ToDo::Done => return Ok(()),
            ToDo::Refused(refusal) => return Err(TransferError::Refused(refusal)),
            ToDo::Locked(seconds) => return Err(TransferError::Locked(seconds)),
            ToDo::Silent => {
                return Err(TransferError::NoAnswer(
                    crate::ANSWER_WITHIN.as_ns() / 1_000_000_000,
                ));
            }
        }
    }
}

/// Runs a bootloader until its next action is neither to wait nor to send.
///
/// # Errors
/// [`TransferError`] if the bus fails.
pub fn serve<F: NorFlash>(
    wire: &UdpBus,
    start: Clock,
    loader: &mut Loader<'_, F>,
) -> Result<Next, TransferError> {
    loop {
        let now = since(start);
        match loader.next(now) {
            Next::Send(frame) => wire.send(&frame)?,
            Next::Wait(until) => {
                if let Some(frame) = wire.receive(left(now, until))? {
                    loader.on_frame(since(start), &frame);
                }
            }
            next => return Ok(next),
        }
    }
}
