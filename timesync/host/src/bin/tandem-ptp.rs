//! Follows a master of PTP, or is one, and prints lines of JSON. It never sets a clock.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a program")]

use std::error::Error;
use std::io::Write;

use tandem_board::{Duration, Instant};
use tandem_timesync::gptp::{
    Claims, DelayMechanism, Master, MasterSettings, PtpProfile, Slave, SlaveSettings, SlaveStatus,
};
use tandem_timesync::{Arbitrary, GlobalTime, Sample};
use tandem_timesync_host::{TimePort, Transport, follow, lead, now};

const USAGE: &str = "\
tandem-ptp slave|master INTERFACE [options]
  --gptp | --peer | --end-to-end   802.1AS (default); IEEE 1588 with either delay mechanism
  --udp                            UDP over IPv4 instead of Ethernet
  --seconds N                      ends after this time; default 60
  --max-delay-us N                 slave: a longer delay is refused; default 1000
  --rate-ppb N                     master: its time runs faster than the machine's clock by this
  --leap-ms N                      master: its time leaps by this after half of the run";

struct Options {
    role: String,
    interface: String,
    profile: PtpProfile,
    transport: Transport,
    seconds: u32,
    max_delay_us: u64,
    rate_ppb: i64,
    leap_ms: i64,
}

fn options() -> Result<Options, Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let mut options = Options {
        role: args.next().ok_or(USAGE)?,
        interface: args.next().ok_or(USAGE)?,
        profile: PtpProfile::GPTP,
        transport: Transport::Ethernet,
        seconds: 60,
        max_delay_us: 1_000,
        rate_ppb: 0,
        leap_ms: 0,
    };
    while let Some(arg) = args.next() {
        let mut value = || {
            args.next()
                .ok_or_else(|| format!("{arg} needs a value\n{USAGE}"))
        };
        match arg.as_str() {
            "--gptp" => options.profile = PtpProfile::GPTP,
            "--end-to-end" => options.profile = PtpProfile::END_TO_END,
            "--peer" => {
                options.profile = PtpProfile::END_TO_END;
                options.profile.delay = DelayMechanism::Peer;
            }
            "--udp" => options.transport = Transport::Udp,
            "--seconds" => options.seconds = value()?.parse()?,
            "--max-delay-us" => options.max_delay_us = value()?.parse()?,
            "--rate-ppb" => options.rate_ppb = value()?.parse()?,
            "--leap-ms" => options.leap_ms = value()?.parse()?,
            _ => return Err(format!("unknown option {arg}\n{USAGE}").into()),
        }
    }
    Ok(options)
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = options()?;
    let mut port = TimePort::open(&options.interface, options.profile, options.transport)?;
    match options.role.as_str() {
        "slave" => slave(&options, &mut port)?,
        "master" => master(&options, &mut port)?,
        role => return Err(format!("no role {role}\n{USAGE}").into()),
    }
    Ok(())
}

fn slave(options: &Options, port: &mut TimePort) -> std::io::Result<()> {
    let end = now() + Duration::from_ms(1_000).times(options.seconds);
    let settings = SlaveSettings {
        max_delay: Duration::from_us(options.max_delay_us),
        ..SlaveSettings::new(port.identity(), options.profile)
    };
    let mut slave = Slave::<Arbitrary>::new(settings);
    let mut told: Option<SlaveStatus> = None;
    let mut out = std::io::stdout();
    follow(port, &mut slave, end, |slave, sample| {
        let status = slave.status();
        let is_news = told.is_none_or(|told| {
            (told.why, told.followed, told.counts.leaps)
                != (status.why, status.followed, status.counts.leaps)
        });
        if is_news {
            told = Some(status);
            // A closed pipe ends the program at its next line.
            let _ = writeln!(out, "{}", status_line(&status));
        }
        if let Some(sample) = sample {
            let _ = writeln!(out, "{}", sample_line(&status, &sample));
        }
    })?;
    writeln!(out, "{}", status_line(&slave.status()))
}

fn status_line(status: &SlaveStatus) -> String {
    let why = status
        .why
        .map_or("null".into(), |why| format!("\"{why:?}\""));
    let followed = status.followed.map_or("null".into(), |it| {
        let clock = it.port.clock.0.map(|byte| format!("{byte:02x}")).concat();
        let class = it.claims.class;
        format!("{{\"clock\":\"{clock}\",\"class\":{class}}}")
    });
    let counts = status.counts;
    format!(
        "{{\"why\":{why},\"followed\":{followed},\"samples\":{},\"others\":{},\"chosen\":{},\
         \"leaps\":{},\"refused_delays\":{},\"malformed\":{}}}",
        counts.samples,
        counts.others,
        counts.chosen,
        counts.leaps,
        counts.refused_delays,
        counts.malformed,
    )
}

/// The offset is the master's time minus that of this machine's clock.
fn sample_line(status: &SlaveStatus, sample: &Sample<Arbitrary>) -> String {
    let offset = sample
        .global
        .after(GlobalTime::from_ns(sample.local.as_ns()));
    let delay = status.delay.map_or(0, Duration::as_ns);
    let (error, rate) = (sample.error.as_ns(), status.rate_ppb);
    format!(
        "{{\"offset_ns\":{offset},\"delay_ns\":{delay},\"error_ns\":{error},\"rate_ppb\":{rate}}}"
    )
}

fn master(options: &Options, port: &mut TimePort) -> std::io::Result<()> {
    let begin = now();
    let run = Duration::from_ms(1_000).times(options.seconds);
    let mut master = Master::<Arbitrary>::new(MasterSettings {
        identity: port.identity(),
        profile: options.profile,
        claims: Claims::default(),
        sync_exponent: -3,
    });
    let global = |at: Instant| {
        let since = at.since(begin);
        let gained = i128::from(since.as_ns()) * i128::from(options.rate_ppb) / 1_000_000_000;
        let has_leapt = since.as_ns() >= run.as_ns() / 2;
        let leap = if has_leapt {
            options.leap_ms * 1_000_000
        } else {
            0
        };
        Some(GlobalTime::from_ns(at.as_ns()).moved(gained as i64 + leap))
    };
    lead(port, &mut master, begin + run, global)?;
    println!(
        "{{\"unsent\":{},\"others\":{}}}",
        port.unsent, master.others
    );
    Ok(())
}
