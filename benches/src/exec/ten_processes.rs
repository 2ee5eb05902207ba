//! Ten processes from the start of their supervisor to all ready, and from a kill to ready again.
//!
//! Each process tells the benchmark when it was ready, so that all supervisors are measured at the
//! same point. Where the supervisor itself says that all are ready, that later time is the sample.

use super::supervisors::{PROCESSES, Running, Supervisor};
use crate::clock::monotonic_ns;
use crate::harness::{Batch, BatchPlan, median};
use rustix::event::{PollFd, PollFlags, poll};
use rustix::process::{Pid, Signal, kill_process};
use std::fs::{self, File, Permissions};
use std::io::{self, Read as _, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tempfile::TempDir;

/// The program that is started, built by the build script.
const PROGRAM: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/ready"));
/// The longest wait for a report.
const LIMIT: Duration = Duration::from_secs(20);
/// s6 and runit wait for a second before they restart a process that ran for less.
const RUNS_FOR: Duration = Duration::from_millis(1100);

/// What a supervisor needs: programs and descriptions in a folder, and where reports arrive.
struct Place {
    supervisor: Supervisor,
    folder: TempDir,
    /// What the processes tell the benchmark.
    witness: UnixDatagram,
    /// What the supervisor tells whoever started it.
    notify: UnixDatagram,
}

impl Place {
    fn new(supervisor: Supervisor) -> io::Result<Self> {
        // Not the default folder: systemd gets an empty /run, and the others must not be hidden.
        let folder = tempfile::Builder::new().prefix("tandem-bench-").tempdir()?;
        let path = |name| folder.path().join(name);
        let mut program = File::create(path("ready"))?;
        program.write_all(PROGRAM)?;
        program.set_permissions(Permissions::from_mode(0o755))?;
        drop(program);
        let socket = |name| {
            let socket = UnixDatagram::bind(path(name))?;
            socket.set_read_timeout(Some(LIMIT))?;
            Ok::<_, io::Error>(socket)
        };
        let (witness, notify) = (socket("witness")?, socket("notify")?);
        fs::create_dir(path("services"))?;
        supervisor.describe(&path("services"), &path("ready"), &path("witness"))?;
        Ok(Self {
            supervisor,
            folder,
            witness,
            notify,
        })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Returns index and time of the next process that tells that it is ready.
    fn next_report(&self) -> io::Result<(usize, u64)> {
        let mut text = [0; 64];
        let length = self.witness.recv(&mut text)?;
        let text = String::from_utf8_lossy(&text[..length]).into_owned();
        let both = text
            .split_once(' ')
            .and_then(|(index, ns)| Some((index.parse::<usize>().ok()?, ns.parse::<u64>().ok()?)));
        both.ok_or_else(|| io::Error::other(format!("a process reported {text:?}")))
    }

    /// Starts the supervisor, and waits until all are ready. Returns it with the pipe that ends
    /// with its last process; when the last process was ready; and when the supervisor said so.
    fn start(&self) -> io::Result<(Started, Times)> {
        let (mut leash, held) = io::pipe()?;
        let services = self.path("services");
        let mut begin_ns = monotonic_ns();
        let running = self
            .supervisor
            .start(&services, held.into(), &self.path("notify"))?;
        if self.supervisor == Supervisor::Systemd {
            // Its namespaces are made: the time to make them is not systemd's.
            leash.read_exact(&mut [0])?;
            begin_ns = monotonic_ns();
        }
        let mut started = Started {
            running: Some(running),
            leash,
        };
        let said_ns = self.wait_for_supervisor(&mut started)?;
        let mut is_ready = [false; PROCESSES];
        let mut last_ns = 0;
        while !is_ready.iter().all(|ready| *ready) {
            let (index, ns) = self.next_report()?;
            if let Some(one) = is_ready.get_mut(index) {
                *one = true;
            }
            last_ns = ns.max(last_ns);
        }
        let times = Times {
            reported_ns: last_ns - begin_ns,
            known_ns: said_ns.unwrap_or(last_ns) - begin_ns,
        };
        Ok((started, times))
    }

    /// Returns when the supervisor said that all are ready; `None` if it does not say.
    fn wait_for_supervisor(&self, started: &mut Started) -> io::Result<Option<u64>> {
        match self.supervisor {
            Supervisor::Tandem => started.wait_for_line("\"reached\"")?,
            Supervisor::Systemd => self.wait_for_notice("STATUS=Ready.")?,
            Supervisor::S6 => self.svwait()?,
            Supervisor::Runit => return Ok(None),
        }
        Ok(Some(monotonic_ns()))
    }

    fn wait_for_notice(&self, line: &str) -> io::Result<()> {
        loop {
            let mut text = [0; 4096];
            let length = self.notify.recv(&mut text)?;
            let text = String::from_utf8_lossy(&text[..length]);
            if text.lines().any(|it| it == line) {
                return Ok(());
            }
        }
    }

    /// Runs `s6-svwait -U` until it succeeds: it fails while s6-supervise has not yet made its
    /// folders.
    fn svwait(&self) -> io::Result<()> {
        let begin = Instant::now();
        while begin.elapsed() < LIMIT {
            let mut command = Command::new("s6-svwait");
            command.args(["-U", "-a", "-t", "20000"]);
            command.args((0..PROCESSES).map(|index| format!("p{index}")));
            command
                .current_dir(self.path("services"))
                .stderr(Stdio::null());
            if command.status()?.success() {
                return Ok(());
            }
        }
        Err(io::Error::other("s6-svwait: never ready"))
    }

    /// Returns the process with this index: the one whose last arguments are the index and the path
    /// of this place's witness.
    fn pid_of(&self, index: usize) -> io::Result<Pid> {
        let end = format!("\0{index}\0{}\0", self.path("witness").display());
        for entry in fs::read_dir("/proc")? {
            let name = entry?.file_name().into_string().unwrap_or_default();
            let Some(pid) = name.parse().ok().and_then(Pid::from_raw) else {
                continue;
            };
            let line = fs::read(format!("/proc/{name}/cmdline")).unwrap_or_default();
            if line.ends_with(end.as_bytes()) {
                return Ok(pid);
            }
        }
        Err(io::Error::other(format!("process {index} is gone")))
    }
}

/// A started supervisor. Dropping it waits until nothing of it is left.
struct Started {
    running: Option<Running>,
    leash: io::PipeReader,
}

impl Started {
    /// Reads the supervisor's output until a line that contains `word`.
    fn wait_for_line(&mut self, word: &str) -> io::Result<()> {
        let (begin, mut text) = (Instant::now(), vec![]);
        loop {
            let mut bytes = [0; 4096];
            let mut fds = [PollFd::new(&self.leash, PollFlags::IN)];
            let left = LIMIT.saturating_sub(begin.elapsed());
            let ready = poll(&mut fds, left.try_into().ok().as_ref())?;
            let length = if ready == 0 {
                0
            } else {
                self.leash.read(&mut bytes)?
            };
            if length == 0 {
                let ended = self.running.as_mut().and_then(Running::has_ended);
                let why = ended.unwrap_or_else(|| format!("no line with {word}"));
                return Err(io::Error::other(why));
            }
            text.extend_from_slice(&bytes[..length]);
            if String::from_utf8_lossy(&text)
                .lines()
                .any(|line| line.contains(word))
            {
                return Ok(());
            }
        }
    }
}

impl Drop for Started {
    fn drop(&mut self) {
        drop(self.running.take());
        // Ends when the last process has ended.
        let _ = io::copy(&mut self.leash, &mut io::sink());
    }
}

struct Times {
    reported_ns: u64,
    known_ns: u64,
}

/// From the start of the supervisor until it knows that ten processes are ready. What it needs is
/// on disk, from an earlier start.
pub(crate) fn ready_10(plan: &BatchPlan, supervisor: Supervisor) -> io::Result<Batch> {
    let place = Place::new(supervisor)?;
    let mut reported = vec![];
    let mut samples_ps = vec![];
    for round in 0..1 + plan.rounds {
        let (started, times) = place.start()?;
        drop(started);
        if round >= 1 {
            reported.push(times.reported_ns);
            samples_ps.push(times.known_ns * 1000);
        }
    }
    let batch = Batch {
        samples_ps,
        ..Batch::default()
    };
    let reported_ms = median(&mut reported) as f64 / 1e6;
    Ok(batch.with_fact("last process ready, ms", reported_ms))
}

/// From SIGKILL to one of ten processes until it is ready again, by its own report.
pub(crate) fn restart(plan: &BatchPlan, supervisor: Supervisor) -> io::Result<Batch> {
    let place = Place::new(supervisor)?;
    let (started, _) = place.start()?;
    std::thread::sleep(RUNS_FOR);
    let mut samples_ps = vec![];
    for index in 0..plan.rounds.min(PROCESSES) {
        let pid = place.pid_of(index)?;
        let begin_ns = monotonic_ns();
        kill_process(pid, Signal::KILL)?;
        loop {
            let (who, ns) = place.next_report()?;
            if who == index {
                samples_ps.push(ns.saturating_sub(begin_ns) * 1000);
                break;
            }
        }
    }
    drop(started);
    Ok(Batch {
        samples_ps,
        ..Batch::default()
    })
}
