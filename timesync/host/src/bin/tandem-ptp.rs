//! Follows a master of PTP, or is one, and prints lines of JSON. It never sets a clock.
//!
//! `ptp slave|master INTERFACE gptp|peer|end-to-end ethernet|udp SECONDS`
#![allow(clippy::print_stdout, reason = "a program")]

use std::error::Error;

use tandem_board::Duration;
use tandem_timesync::gptp::{
    Claims, DelayMechanism, Master, MasterSettings, PtpProfile, Slave, SlaveSettings, Why,
};
use tandem_timesync::{Arbitrary, GlobalTime};
use tandem_timesync_host::{TimePort, Transport, follow, lead, now};

const USAGE: &str =
    "ptp slave|master INTERFACE gptp|peer|end-to-end ethernet|udp SECONDS (of the run)";

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [role, interface, profile, transport, seconds] = &args[..] else {
        return Err(USAGE.into());
    };
    let profile = match profile.as_str() {
        "gptp" => PtpProfile::GPTP,
        "peer" => PtpProfile {
            delay: DelayMechanism::Peer,
            ..PtpProfile::END_TO_END
        },
        "end-to-end" => PtpProfile::END_TO_END,
        _ => return Err(USAGE.into()),
    };
    let transport = match transport.as_str() {
        "ethernet" => Transport::Ethernet,
        "udp" => Transport::Udp,
        _ => return Err(USAGE.into()),
    };
    let end = now() + Duration::from_ms(1_000).times(seconds.parse()?);
    let mut port = TimePort::open(interface, profile, transport)?;
    let identity = port.identity();
    match role.as_str() {
        "slave" => {
            let mut slave = Slave::<Arbitrary>::new(SlaveSettings::new(identity, profile));
            let mut told: Option<Option<Why>> = None;
            follow(&mut port, &mut slave, end, |slave, sample| {
                let status = slave.status();
                if told != Some(status.why) {
                    told = Some(status.why);
                    let why = status
                        .why
                        .map_or("null".into(), |why| format!("\"{why:?}\""));
                    println!("{{\"why\":{why}}}");
                }
                if let Some(sample) = sample {
                    println!(
                        "{{\"offset_ns\":{},\"delay_ns\":{},\"error_ns\":{},\"rate_ppb\":{}}}",
                        sample
                            .global
                            .after(GlobalTime::from_ns(sample.local.as_ns())),
                        status.delay.map_or(0, Duration::as_ns),
                        sample.error.as_ns(),
                        status.rate_ppb
                    );
                }
            })?;
            println!("{{\"counts\":\"{:?}\"}}", slave.status().counts);
        }
        "master" => {
            let mut master = Master::<Arbitrary>::new(MasterSettings {
                identity,
                profile,
                claims: Claims::default(),
                sync_exponent: -3,
            });
            let global = |at: tandem_board::Instant| Some(GlobalTime::from_ns(at.as_ns()));
            lead(&mut port, &mut master, end, global)?;
            println!(
                "{{\"unsent\":{},\"others\":{}}}",
                port.unsent, master.others
            );
        }
        _ => return Err(USAGE.into()),
    }
    Ok(())
}
