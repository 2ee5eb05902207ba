//! A slave or a master on a port of the host, until a time.

use std::io;

use crate::port::{PtpArrival, TimePort, now};
use tandem_board::Instant;
use tandem_timesync::gptp::{Master, Slave};
use tandem_timesync::{GlobalTime, Sample, Scale};

/// Runs a slave until `end`; `hear` is called after each arrival, with the sample that it made.
///
/// # Errors
/// If the port fails.
pub fn follow<S: Scale>(
    port: &mut TimePort,
    slave: &mut Slave<S>,
    end: Instant,
    mut hear: impl FnMut(&Slave<S>, Option<Sample<S>>),
) -> io::Result<()> {
    loop {
        let at = now();
        if at >= end {
            return Ok(());
        }
        let due = slave.poll(at, port).min(end);
        let sample = match port.wait(due.since(now()))? {
            Some(PtpArrival::Message(bytes, at)) => slave.on_message(at, &bytes, port),
            Some(PtpArrival::Sent(event, at)) => {
                slave.on_sent(event, at, port);
                None
            }
            None => None,
        };
        hear(slave, sample);
    }
}

/// Runs a master until `end`; `global` is its time.
///
/// # Errors
/// If the port fails.
pub fn lead<S: Scale>(
    port: &mut TimePort,
    master: &mut Master<S>,
    end: Instant,
    global: impl Fn(Instant) -> Option<GlobalTime<S>>,
) -> io::Result<()> {
    loop {
        let at = now();
        if at >= end {
            return Ok(());
        }
        let due = master.poll(at, &global, port).min(end);
        match port.wait(due.since(now()))? {
            Some(PtpArrival::Message(bytes, at)) => master.on_message(at, &bytes, &global, port),
            Some(PtpArrival::Sent(event, at)) => master.on_sent(event, at, &global, port),
            None => {}
        }
    }
}
