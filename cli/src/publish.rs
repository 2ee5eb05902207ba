//! Publishes a run. A thread of `tandem run` reads the recording as it grows, and a separate
//! process publishes the entries.
//!
//! The run does not depend on the thread or the process. The thread never waits: entries that do
//! not fit into the socket are lost. The process shares `/dev/shm` with observers, so it starts
//! before the run gets a `/dev/shm` of its own.

use std::fs::File;
use std::io::Read as _;
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::net::UnixDatagram;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use rustix::process::getppid;
use serde::{Deserialize, Serialize};
use tandem_board::{CanId, CoreAddress, SystemId};
use tandem_board_host::RunName;
use tandem_board_host::services::{Event, Frame, Publisher, Roles, Vehicle};
use tandem_bus::{Message, RoleCode};
use tandem_cores::trace;
use tandem_record::log::{Sample, VehicleRecord};
use tandem_record::roles::RoleState;
use tandem_record::{Entry, description, file};
use tandem_shm::topic::Publish as _;
use tandem_vehicle::LoggedFrame;

use crate::run_config::{LimitProfile, RunConfig};

/// Delay of the next read after a read that found nothing, or only part of an entry.
const RETRY_INTERVAL: Duration = Duration::from_millis(10);
/// Delay of the next read after a read that found entries. The vehicle writes every 100 ms; with a
/// slightly shorter interval each read follows closely after a write.
const READ_INTERVAL: Duration = Duration::from_millis(99);
/// The largest message to the publisher, bytes. A longer entry is dropped.
const MESSAGE_MAX: usize = 48 << 10;
/// The largest read, bytes.
const READ_MAX: usize = 4 << 20;
/// Time within which the publisher must end.
const ENDS_WITHIN: Duration = Duration::from_secs(1);
/// Interval at which the publisher checks whether `tandem run` still exists.
const CHECK_INTERVAL: Duration = Duration::from_millis(200);
/// After this many checks without a message, the publisher assumes that `tandem run` has died.
const SILENT_CHECKS: u32 = 300;
/// A core that has written no trace record for this long is shown as dead, ns.
const ALIVE_NS: u64 = 300_000_000;

/// The first message to the publisher.
#[derive(Debug, Serialize, Deserialize)]
struct Begin {
    run: String,
    duration_s: f64,
    /// The run's processes have a real-time priority.
    realtime: bool,
}

/// The connection of `tandem run` to the publisher's process.
pub(crate) struct Publishing {
    to: Arc<UnixDatagram>,
    process: Child,
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Publishing {
    /// Starts the publisher before the run gets its own `/dev/shm`; `None` if it does not start.
    pub(crate) fn prepare() -> Option<Self> {
        let (to, from) = UnixDatagram::pair().ok()?;
        to.set_nonblocking(true).ok()?;
        let process = Command::new("/proc/self/exe")
            .arg0("tandem")
            .arg("publish")
            .stdin(Stdio::from(OwnedFd::from(from)))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            // Ctrl-C in the terminal must not reach the publisher, because the run ends it.
            .process_group(0)
            .spawn()
            .ok()?;
        Some(Self {
            to: Arc::new(to),
            process,
            over: Arc::default(),
            thread: None,
        })
    }

    /// Starts publishing this run.
    pub(crate) fn follow(&mut self, run: &RunName, recording: PathBuf, config: &RunConfig) {
        let begin = Begin {
            run: run.to_string(),
            duration_s: config.duration_s,
            realtime: config.profile == LimitProfile::Rt,
        };
        let Ok(begin) = serde_json::to_vec(&begin) else {
            return;
        };
        if self.to.send(&begin).is_err() {
            return;
        }
        let (to, over) = (Arc::clone(&self.to), Arc::clone(&self.over));
        let named = std::thread::Builder::new().name("publish".to_owned());
        self.thread = named.spawn(move || hand_over(&recording, &to, &over)).ok();
    }

    /// Ends the thread and the process. Kills the process if it does not end.
    pub(crate) fn end(mut self) {
        self.over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A panic in the thread does not affect the run.
            let _ = thread.join();
        }
        let begin = Instant::now();
        while matches!(self.process.try_wait(), Ok(None)) {
            // An empty message ends the publisher. It cannot be sent if the socket is full.
            let _ = self.to.send(&[]);
            if begin.elapsed() > ENDS_WITHIN {
                let _ = self.process.kill();
                let _ = self.process.wait();
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

/// Reads the recording as it grows, and sends whole entries to the publisher.
fn hand_over(recording: &Path, to: &UnixDatagram, over: &AtomicBool) {
    let (mut from, mut left) = (None, Vec::new());
    while !over.load(Ordering::Relaxed) {
        from = from.or_else(|| File::open(recording).ok());
        let more = from
            .as_mut()
            .and_then(|from: &mut File| from.take(READ_MAX as u64).read_to_end(&mut left).ok());
        while let Some(end) = file::whole_entries(&left, MESSAGE_MAX) {
            if end <= MESSAGE_MAX {
                // A publisher that is too slow loses these entries. If it has ended, the error is
                // harmless.
                let _ = to.send(&left[..end]);
            }
            left.drain(..end);
        }
        let more = more.unwrap_or(0);
        if more < READ_MAX {
            let found = more > 0 && left.is_empty();
            std::thread::sleep(if found { READ_INTERVAL } else { RETRY_INTERVAL });
        }
    }
}

/// Runs the publisher's process: publishes the entries from `tandem run` until the run ends.
///
/// # Errors
/// If `tandem run` did not start this process, or iceoryx2 fails.
pub fn run() -> anyhow::Result<()> {
    let parent = getppid();
    let stdin = std::io::stdin().as_fd().try_clone_to_owned();
    let from = UnixDatagram::from(stdin.context("stdin")?);
    from.set_read_timeout(Some(CHECK_INTERVAL))
        .context("stdin: only `tandem run` starts this command")?;
    let mut buffer = vec![0; 2 * MESSAGE_MAX];
    let mut next = move || {
        for _ in 0..SILENT_CHECKS {
            match from.recv(&mut buffer) {
                Ok(0) => return None,
                Ok(length) => return Some(buffer[..length].to_vec()),
                Err(_) if getppid() != parent => return None,
                Err(error) => match error.kind() {
                    std::io::ErrorKind::WouldBlock | std::io::ErrorKind::Interrupted => {}
                    _ => return None,
                },
            }
        }
        None
    };
    let Some(begin) = next() else {
        return Ok(());
    };
    let begin: Begin = serde_json::from_slice(&begin).context("the first message")?;
    if !begin.realtime {
        // All other processes of the run have precedence.
        let _ = rustix::process::nice(10);
    }
    let mut publisher = Publisher::create(&begin.run.parse()?)?;
    let mut news = News::new(begin.duration_s);
    while let Some(entries) = next() {
        file::parse(&entries, |entry| news.take(&entry, &mut publisher))?;
        // What cannot be published is lost for observers only; so are the values below.
        let _ = publisher.roles.publish(&news.roles());
    }
    Ok(())
}

/// Converts the entries of a recording to messages for observers.
struct News {
    roles: Roles,
    /// Time, ns, and system of the last accepted control frame.
    last: Option<(u64, SystemId)>,
    /// Time of the last trace record of each core, ns.
    seen_ns: [u64; CoreAddress::COUNT],
    start_ns: Option<u64>,
}

impl News {
    fn new(duration_s: f64) -> Self {
        let roles = Roles {
            duration_s,
            obeyed: u8::MAX,
            ..Roles::default()
        };
        Self {
            roles,
            last: None,
            seen_ns: [0; CoreAddress::COUNT],
            start_ns: None,
        }
    }

    fn roles(&self) -> Roles {
        let at_ns = self.roles.at_ns;
        let since = |start_ns| at_ns.saturating_sub(start_ns);
        Roles {
            time_s: self
                .start_ns
                .map_or(0.0, |start| since(start) as f64 * 1e-9),
            alive: self
                .seen_ns
                .map(|seen| u8::from(seen > 0 && since(seen) < ALIVE_NS)),
            ..self.roles
        }
    }

    fn take(&mut self, entry: &Entry, publisher: &mut Publisher) {
        match entry {
            Entry::Trace(traced) => {
                let of = CoreAddress::new(traced.system, traced.core);
                self.seen_ns[of.index()] = traced.at.as_ns();
                let event = trace::Event::decode(traced.record);
                if let Some(text) = event.and_then(description::core_event) {
                    let (system, core) = (traced.system.index() as u8, traced.core.index() as u8);
                    let event = Event::new(traced.at.as_ns(), system, core, &text);
                    let _ = publisher.trace.publish(&event);
                }
            }
            Entry::Supply(at, system, event) => {
                let text = description::supply_event(*event);
                let system = system.index() as u8;
                let event = Event::new(at.as_ns(), system, u8::MAX, &text);
                let _ = publisher.trace.publish(&event);
            }
            Entry::Frame(frame) => {
                self.judge(frame);
                let _ = publisher.can.publish(&of_frame(frame));
            }
            Entry::Vehicle(record) => match &**record {
                VehicleRecord::Sample(sample) => {
                    let _ = publisher.vehicle.publish(&of_sample(sample));
                }
                VehicleRecord::Start { at_ns } => self.start_ns = Some(*at_ns),
                VehicleRecord::Power { system, on, .. } => {
                    if let Some(state) = self.roles.state.get_mut(usize::from(*system)) {
                        *state = u8::from(*on);
                    }
                }
                _ => {}
            },
        }
    }

    fn judge(&mut self, frame: &LoggedFrame) {
        let at_ns = frame.at.as_ns();
        self.roles.at_ns = self.roles.at_ns.max(at_ns);
        match (frame.ruling, frame.message()) {
            (Some(tandem_vehicle::Ruling::Accepted), Some(Message::Control { control, .. })) => {
                let Some(system) = frame.controller() else {
                    return;
                };
                self.roles.term = control.term;
                self.roles.obeyed = system.index() as u8;
                // A status frame has the mode of the redundancy: it does not say what is driven.
                // The enum lists the states in the order of their published numbers.
                let state = RoleState::of(RoleCode::Master, control.mode);
                self.roles.state[system.index()] = state as u8;
                if let Some((last_ns, last)) = self.last.replace((at_ns, system)) {
                    let gap_ms = at_ns.saturating_sub(last_ns) as f64 * 1e-6;
                    self.roles.gap_max_ms = self.roles.gap_max_ms.max(gap_ms);
                    if last != system {
                        self.roles.takeovers += 1;
                        self.roles.takeover_gap_ms = gap_ms;
                    }
                }
            }
            (None, Some(Message::Status { system, status })) => {
                let Some(system) = SystemId::from_index(system.into()) else {
                    return;
                };
                let is_obeyed = usize::from(self.roles.obeyed) == system.index();
                if status.role != RoleCode::Master || !is_obeyed {
                    let state = RoleState::of(status.role, status.mode);
                    self.roles.state[system.index()] = state as u8;
                }
                // A system reports the heartbeat lines that it receives, which its peer drives.
                let heard =
                    [status.line1_silent, status.line2_silent].map(|silent| u8::from(!silent));
                self.roles.beats[system.peer().index()] = heard[0] | heard[1] << 1;
            }
            _ => {}
        }
    }
}

fn of_frame(logged: &LoggedFrame) -> Frame {
    let frame = &logged.frame;
    let (id, extended) = match frame.id() {
        CanId::Standard(id) => (u32::from(id), 0),
        CanId::Extended(id) => (id, 1),
    };
    let flags = extended | if frame.is_fd() { 2 } else { 0 };
    let ruling = file::ruling_code(logged.ruling);
    Frame::new(logged.at.as_ns(), id, flags, ruling, frame.data())
}

fn of_sample(sample: &Sample) -> Vehicle {
    Vehicle {
        at_ns: sample.at_ns,
        x: sample.x,
        y: sample.y,
        heading: sample.heading,
        speed: sample.speed,
        accel: sample.accel,
        lat_accel: sample.lat_accel,
        lateral_error: sample.lateral_error,
        lead_gap: sample.lead_gap.unwrap_or(f64::NAN),
        lane: sample.lane as i64,
    }
}
