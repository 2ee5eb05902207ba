//! `ddsperf` of Eclipse Cyclone DDS over loopback, as its help shows: `ddsperf ping`, `ddsperf
//! pong`.
//!
//! It prints half the round trip as percentiles, once a second. The samples here are rebuilt from
//! those: as many as it counted, at the percentiles that it names, so that the median and the 90th
//! and 99th percentile are its own and everything above is its maximum.

use crate::harness::{Batch, Plan};
use crate::worker::LIMIT;
use std::io::{self, Read};
use std::os::fd::AsRawFd;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Instant;

/// Debian's package that has it.
const PACKAGE: &str = "cyclonedds-tools";
/// Loopback only; without an interface of its own choice it would take the first one.
const CONFIG: &str = "<CycloneDDS><Domain><General><Interfaces>\
    <NetworkInterface name=\"lo\"/></Interfaces></General>\
    <Tracing><Verbosity>none</Verbosity></Tracing></Domain></CycloneDDS>";
/// The topic "OU": a sequence number of 4 bytes and nothing else.
const TOPIC: &str = "-TOU";

/// A process of it; killed when this is dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A ping-pong between two processes, for as many seconds as the plan has rounds.
///
/// # Errors
/// If it is not installed, or does not measure.
pub fn ddsperf(plan: &Plan) -> io::Result<Batch> {
    let start = |cpu: usize, seconds: usize, mode: &str| {
        let mut command = Command::new("taskset");
        command.args(["-c", &cpu.to_string(), "ddsperf", TOPIC, "-D"]);
        command.args([&seconds.to_string(), mode]);
        command.env("CYCLONEDDS_URI", CONFIG);
        command.stdin(Stdio::null()).stderr(Stdio::null());
        // It ends by itself, but not with us.
        crate::worker::die_with_parent(&mut command);
        command.stdout(Stdio::piped()).spawn()
    };
    if Command::new("ddsperf").arg("help").output().is_err() {
        let text = format!("ddsperf is not installed (Debian package {PACKAGE})");
        return Err(io::Error::new(io::ErrorKind::NotFound, text));
    }
    let _pong = Running(start(plan.cpus[1], plan.rounds + 2, "pong")?);
    // The first second is discovery and warm-up.
    let mut ping = Running(start(plan.cpus[0], plan.rounds + 1, "ping")?);
    let output = ping.0.stdout.take();
    let text = output.map_or(Ok(String::new()), read_within_limit)?;
    let reports: Vec<Report> = text.lines().filter_map(Report::parse).collect();
    if reports.is_empty() {
        return Err(io::Error::other("ddsperf did not measure anything"));
    }
    Ok(Batch {
        samples_ps: reports.iter().flat_map(Report::samples).collect(),
        payload_bytes: 4,
        ..Batch::default()
    })
}

/// All that comes until its end, but not for longer than a batch may take.
fn read_within_limit(mut output: ChildStdout) -> io::Result<String> {
    let until = Instant::now() + LIMIT;
    let mut bytes = vec![];
    loop {
        let mut ready = libc::pollfd {
            fd: output.as_raw_fd(),
            events: libc::POLLIN,
            revents: 0,
        };
        let left_ms = until.saturating_duration_since(Instant::now()).as_millis() as i32;
        // SAFETY: `ready` is one valid entry.
        if left_ms == 0 || unsafe { libc::poll(&mut ready, 1, left_ms) } == 0 {
            return Err(io::Error::new(
                io::ErrorKind::TimedOut,
                "ddsperf did not end",
            ));
        }
        let mut some = [0; 4096];
        match output.read(&mut some) {
            Ok(0) => return Ok(String::from_utf8_lossy(&bytes).into_owned()),
            Ok(count) => bytes.extend_from_slice(&some[..count]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

/// One line of its output, in microseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Report {
    p50: f64,
    p90: f64,
    p99: f64,
    max: f64,
    count: usize,
}

impl Report {
    /// Reads a line such as `[9] 2.000  vm:8 size 4 mean 69.0us min 16.3us 50% 22.5us 90% 27.5us
    /// 99% 1830.3us max 5256.2us cnt 7228`.
    fn parse(line: &str) -> Option<Self> {
        let words: Vec<&str> = line.split_whitespace().collect();
        let after = |name: &str| {
            let at = words.iter().position(|word| *word == name)?;
            words
                .get(at + 1)?
                .trim_end_matches("us")
                .parse::<f64>()
                .ok()
        };
        Some(Self {
            p50: after("50%")?,
            p90: after("90%")?,
            p99: after("99%")?,
            max: after("max")?,
            count: after("cnt")? as usize,
        })
    }

    /// As many samples as it counted, in picoseconds.
    fn samples(&self) -> impl Iterator<Item = u64> + use<> {
        let steps = [(0.5, self.p50), (0.9, self.p90), (0.99, self.p99)];
        let (count, max) = (self.count, self.max);
        (1..=count).map(move |n| {
            let quantile = n as f64 / count as f64;
            let step = steps.iter().find(|(up_to, _)| quantile <= *up_to);
            (step.map_or(max, |(_, us)| *us) * 1e6) as u64
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_is_read_and_other_lines_are_not() {
        let line = "[10452] 2.000  vm:10451 size 4 mean 69.075us min 16.384us 50% 22.598us \
                    90% 27.505us 99% 1830.330us max 5256.264us cnt 7228";
        let report = Report {
            p50: 22.598,
            p90: 27.505,
            p99: 1830.33,
            max: 5256.264,
            count: 7228,
        };
        assert_eq!(Report::parse(line), Some(report));
        assert_eq!(Report::parse("[10452] participant vm:10451: new"), None);
        let rss = "[10452] 2.000  rss:7.5MB vcsw:7247 ivcsw:27 recvUC:3%+20%";
        assert_eq!(Report::parse(rss), None);
        assert_eq!(Report::parse("50% 1us 90% 2us 99% x max 3us cnt 4"), None);
    }

    #[test]
    fn rebuilt_samples_have_the_percentiles_that_were_printed() {
        let report = Report {
            p50: 1.0,
            p90: 2.0,
            p99: 3.0,
            max: 4.0,
            count: 1000,
        };
        let samples: Vec<u64> = report.samples().collect();
        assert_eq!(samples.len(), 1000);
        let at = |n: usize| samples[n - 1];
        assert_eq!(
            [at(500), at(501), at(900), at(990), at(991), at(1000)],
            [
                1_000_000, 2_000_000, 2_000_000, 3_000_000, 4_000_000, 4_000_000
            ]
        );
    }
}
