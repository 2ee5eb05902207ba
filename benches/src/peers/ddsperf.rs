//! `ddsperf`, the measurement that comes with Eclipse Cyclone DDS: ping and pong on the loopback
//! interface, reliable, with a listener that runs in the receiving thread (its defaults).

use crate::harness::{Batch, BatchPlan};
use crate::shared::{SharedPage, draw};
use crate::worker::{BatchPart, perform};
use rustix::fs::{MemfdFlags, memfd_create};
use std::fs::File;
use std::io::{self, Read, Seek, Write};
use std::os::fd::AsRawFd;
use std::process::{Command, Stdio};
use tandem_topics::{CanFrame, TopicType};

const PROGRAM: &str = "ddsperf";
/// What hands its samples on, built by the build script.
const SAMPLES: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/ddsperf-samples.so"));
/// How long it runs: it ends by itself. It sends the first ping after a second, and sorts the
/// samples of the second after that.
const SECONDS: &str = "2.2";
const CONFIG: &str = "\
<CycloneDDS><Domain Id=\"any\">\
<General><Interfaces><NetworkInterface name=\"lo\"/></Interfaces>\
<AllowMulticast>false</AllowMulticast></General>\
<Discovery><ParticipantIndex>auto</ParticipantIndex>\
<Peers><Peer address=\"127.0.0.1\"/></Peers></Discovery>\
</Domain></CycloneDDS>";

/// Returns a domain that is not the default, at random: another benchmark may run beside this one.
pub(crate) fn domain() -> u16 {
    30 + draw(200) as u16
}

/// Half of a round trip of a payload of the same length, as ddsperf counts it.
pub(crate) fn ping_pong(plan: &BatchPlan) -> io::Result<Batch> {
    let mut help = Command::new(PROGRAM);
    let is_there = help.arg("help").stdout(Stdio::null()).status();
    is_there.map_err(|error| {
        io::Error::other(format!(
            "{PROGRAM} is not installed (cyclonedds-tools): {error}"
        ))
    })?;
    // Inherited by the programs.
    let memory = |name| memfd_create(name, MemfdFlags::empty()).map(File::from);
    let (mut library, mut samples) = (memory("ddsperf-samples")?, memory("samples")?);
    library.write_all(SAMPLES)?;
    let domain = domain().to_string();
    let size = CanFrame::PAYLOAD_LEN.to_string();
    let part = |cpu: usize, mode: &'static [&str]| {
        let mut command = Command::new(PROGRAM);
        command.args(["-i", &domain, "-D", SECONDS, "-T", "KS"]);
        command.args(mode);
        command.env("CYCLONEDDS_URI", CONFIG);
        if mode == ["ping"] {
            command.args(["size", &size]);
            command.env(
                "LD_PRELOAD",
                format!("/proc/self/fd/{}", library.as_raw_fd()),
            );
            command.env("TANDEM_SAMPLES", samples.as_raw_fd().to_string());
        }
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        // The process waits for the program with the program's priority. A process of a higher one
        // that waits for a program with threads can stop the kernel: it frees what the last thread
        // is just freeing, and keeps that thread from its CPU.
        BatchPart::on(plan.cpus[cpu], move |_| {
            let status = command.status()?;
            let failed = || io::Error::other(format!("{PROGRAM} ended with {status}"));
            status.success().then_some(()).ok_or_else(failed)
        })
    };
    perform(
        &SharedPage::new()?,
        vec![part(1, &["pong"]), part(0, &["ping"])],
    )?;
    let mut bytes = vec![];
    samples.rewind()?;
    samples.read_to_end(&mut bytes)?;
    let all = bytes.as_chunks().0;
    let in_ps = |ns: &[u8; 8]| u64::from_ne_bytes(*ns) * 1000;
    // As in all batches, a tenth warms up.
    let samples_ps: Vec<u64> = all.iter().skip(all.len() / 10).map(in_ps).collect();
    if samples_ps.is_empty() {
        return Err(io::Error::other("ddsperf measured nothing"));
    }
    Ok(Batch {
        samples_ps,
        ..Batch::default()
    }
    .carrying(CanFrame::PAYLOAD_LEN as u64))
}
