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
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use rustix::process::getppid;
use serde::{Deserialize, Serialize};
use tandem_board::{CanId, CoreAddress, SystemId};
use tandem_board_host::RunName;
use tandem_bus::{Message, RoleCode};
use tandem_cores::trace;
use tandem_observers::{ChainedClock, Event, Frame, Publisher, Roles, Vehicle, VehicleClocks};
use tandem_processes::files::RunFiles;
use tandem_processes::observed;
use tandem_processes::run_config::{LimitProfile, RunConfig};
use tandem_record::clocks::{ChainClock, TimeLog};
use tandem_record::happenings::Obeyed;
use tandem_record::log::{Sample, VehicleRecord};
use tandem_record::roles::RoleState;
use tandem_record::{Entry, description, file};
use tandem_shm::topic::Publish as _;
use tandem_vehicle::LoggedFrame;

use crate::args::RunArgs;
use crate::beside::Attendant;
use crate::failure::Failure;
use crate::viewer;

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
/// Interval at which the vehicle's time is published, ns.
const TIME_NS: u64 = 100_000_000;
/// The time is published from what was recorded in this span, ns.
const TIME_SPAN_NS: u64 = 5_000_000_000;
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
    viewers: Vec<Attendant>,
}

impl Publishing {
    /// Starts the publisher before the run gets its own `/dev/shm`, and the programs that show the
    /// run; `None` if the publisher does not start.
    ///
    /// # Errors
    /// [`Failure::Usage`] if the arguments ask for a view of the run that cannot be shown.
    pub(crate) fn prepare(args: &RunArgs) -> Result<Option<Self>, Failure> {
        let viewers = viewer::start(args)?;
        match Self::start() {
            Some(publishing) => Ok(Some(Self {
                viewers,
                ..publishing
            })),
            None if !viewers.is_empty() => {
                let reason = anyhow!(
                    "the publisher, which --web, --foxglove and --mcap need, does not start"
                );
                Err(Failure::Usage(reason))
            }
            None => Ok(None),
        }
    }

    fn start() -> Option<Self> {
        let (to, from) = UnixDatagram::pair().ok()?;
        to.set_nonblocking(true).ok()?;
        let process = tandem_board_host::this_program()
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
            viewers: Vec::new(),
        })
    }

    /// Creates the services of this run, before its processes start: so an observer can subscribe
    /// before the first sample. `is_virtual`: the run's time is not that of this machine.
    pub(crate) fn begin(&mut self, run: &RunName, config: &RunConfig, is_virtual: bool) {
        let realtime = config.profile == LimitProfile::Rt && !is_virtual;
        let begin = Begin {
            run: run.to_string(),
            duration_s: config.duration_s,
            realtime,
        };
        if let Ok(begin) = serde_json::to_vec(&begin) {
            // If the publisher has ended, nothing is published.
            let _ = self.to.send(&begin);
        }
        for viewer in &mut self.viewers {
            viewer::begin(viewer, run, realtime, is_virtual);
        }
    }

    /// Starts publishing what the run records in these files.
    pub(crate) fn follow(&mut self, files: &RunFiles) {
        let (to, over) = (Arc::clone(&self.to), Arc::clone(&self.over));
        let recordings = [files.recording(), files.soc_time()].map(Growing::new);
        let named = std::thread::Builder::new().name("publish".to_owned());
        self.thread = named.spawn(move || hand_over(recordings, &to, &over)).ok();
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
        for viewer in self.viewers {
            viewer.end();
        }
    }
}

/// A recording that grows.
struct Growing {
    path: PathBuf,
    file: Option<File>,
    /// The part of an entry at the end.
    left: Vec<u8>,
    /// What is not sent yet.
    unsent: Vec<u8>,
}

impl Growing {
    const fn new(path: PathBuf) -> Self {
        Self {
            path,
            file: None,
            left: Vec::new(),
            unsent: Vec::new(),
        }
    }

    /// Reads what was added, and sends what observers need of it to the publisher, in whole
    /// entries. Returns how much was added.
    fn hand_over(&mut self, to: &UnixDatagram) -> usize {
        if self.file.is_none() {
            self.file = File::open(&self.path).ok();
        }
        let Some(file) = &mut self.file else { return 0 };
        let more = file.take(READ_MAX as u64).read_to_end(&mut self.left);
        observed::select(&mut self.left, &mut self.unsent);
        while let Some(end) = file::whole_entries(&self.unsent, MESSAGE_MAX) {
            if end <= MESSAGE_MAX {
                // A publisher that is too slow loses these entries. If it has ended, the error is
                // harmless.
                let _ = to.send(&self.unsent[..end]);
            }
            self.unsent.drain(..end);
        }
        more.unwrap_or(0)
    }
}

/// Reads the recordings as they grow, and sends whole entries to the publisher.
fn hand_over([mut recording, mut beside]: [Growing; 2], to: &UnixDatagram, over: &AtomicBool) {
    loop {
        // Read once more after the end: the recording is complete then.
        let is_over = over.load(Ordering::Relaxed);
        let more = recording.hand_over(to);
        beside.hand_over(to);
        if is_over && more < READ_MAX {
            return;
        }
        if more < READ_MAX {
            let found = more > 0 && recording.left.is_empty();
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
        observed::read(&entries, &mut |entry| news.take(&entry, &mut publisher))?;
        // What cannot be published is lost for observers only; so are the values below.
        let _ = publisher.roles.publish(&news.roles());
        if let Some(time) = news.time(publisher.time.is_observed()) {
            let _ = publisher.time.publish(&time);
        }
    }
    Ok(())
}

/// Publishes an event of the vehicle about this system.
fn tell(publisher: &mut Publisher, at_ns: u64, system: u8, what: &str) {
    let event = Event::new(at_ns, system, Event::VEHICLE, what);
    let _ = publisher.trace.publish(&event);
}

/// Converts the entries of a recording to messages for observers.
struct News {
    roles: Roles,
    obeyed: Obeyed,
    /// Time, ns, and system of the last accepted control frame.
    last: Option<(u64, SystemId)>,
    /// Time of the last trace record of each core, ns.
    seen_ns: [u64; CoreAddress::COUNT],
    start_ns: Option<u64>,
    time: TimeLog,
    /// When the time was last published, ns.
    time_ns: u64,
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
            obeyed: Obeyed::default(),
            last: None,
            seen_ns: [0; CoreAddress::COUNT],
            start_ns: None,
            time: TimeLog::default(),
            time_ns: 0,
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

    /// Returns the vehicle's time if it is to be published, and is observed.
    fn time(&mut self, is_observed: bool) -> Option<VehicleClocks> {
        let at_ns = self.roles.at_ns;
        if at_ns < self.time_ns + TIME_NS {
            return None;
        }
        self.time_ns = at_ns;
        let from_ns = at_ns.saturating_sub(TIME_SPAN_NS);
        self.time.forget(from_ns);
        is_observed.then(|| of_time(&self.time, at_ns, from_ns))
    }

    fn take(&mut self, entry: &Entry, publisher: &mut Publisher) {
        self.time.push(entry);
        match entry {
            Entry::Trace(traced) => {
                let of = CoreAddress::new(traced.system, traced.core);
                let seen_ns = &mut self.seen_ns[of.index()];
                *seen_ns = traced.at.as_ns().max(*seen_ns);
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
                for what in self.judge(frame) {
                    let (at_ns, obeyed) = (frame.at.as_ns(), self.roles.obeyed);
                    tell(publisher, at_ns, obeyed, &format!("the vehicle {what}"));
                }
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
                VehicleRecord::Hand {
                    at_ns,
                    system,
                    what,
                    cuts,
                } => {
                    if let Some(of) = self.roles.cuts.get_mut(usize::from(*system)) {
                        *of = *cuts;
                    }
                    tell(publisher, *at_ns, *system, what);
                }
                VehicleRecord::Collision { at_ns } => {
                    let obeyed = self.roles.obeyed;
                    tell(publisher, *at_ns, obeyed, "the vehicle has a collision");
                }
                _ => {}
            },
        }
    }

    /// Returns what has changed for the vehicle, in words.
    fn judge(&mut self, frame: &LoggedFrame) -> Vec<&'static str> {
        let at_ns = frame.at.as_ns();
        self.roles.at_ns = self.roles.at_ns.max(at_ns);
        match (frame.ruling, frame.message()) {
            (Some(tandem_vehicle::Ruling::Accepted), Some(Message::Control { control, .. })) => {
                let Some(system) = frame.controller() else {
                    return vec![];
                };
                let (mode, asks) = (control.mode, control.takeover_request);
                let changes = self.obeyed.change(mode, asks).collect();
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
                return changes;
            }
            (None, Some(Message::Status { system, status })) => {
                let Some(system) = SystemId::from_index(system.into()) else {
                    return vec![];
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
        vec![]
    }
}

fn of_time(log: &TimeLog, at_ns: u64, from_ns: u64) -> VehicleClocks {
    let clock = |of| {
        let log = log.clock(of);
        let state = log.states.last().copied().unwrap_or_default();
        let sample = log.samples.last().copied().unwrap_or_default();
        ChainedClock {
            at_ns: state.at_ns,
            heard_ns: sample.at_ns,
            offset_ns: sample.offset_ns,
            delay_ns: sample.delay_ns,
            error_ns: sample.error_ns,
            rate_ppb: state.rate_ppb,
            leaps: log.leaps.len() as u32,
            source: state.source,
            status: state.status,
            why: log.grandmaster.last().map_or(u8::MAX, |(_, why)| *why),
            reserved: 0,
        }
    };
    // Sorted: a histogram of such spans is 4 MB, ten times a second.
    let mut skews: Vec<u64> = log.skews().iter().map(|it| it.1.unsigned_abs()).collect();
    skews.sort_unstable();
    let skew_ns = |percent: usize| {
        let rank = (skews.len() * percent).div_ceil(100);
        skews.get(rank.saturating_sub(1)).map_or(0, |ns| *ns as u32)
    };
    VehicleClocks {
        at_ns,
        clocks: ChainClock::ALL.map(clock),
        apart_ns: log.apart().last().map_or(i32::MIN, |(_, by_ns)| *by_ns),
        cycles: skews.len() as u32,
        skew_p50_ns: skew_ns(50),
        skew_p99_ns: skew_ns(99),
        sensors: log
            .sensors(from_ns)
            .map(|it| it.map_or(u8::MAX, |it| it as u8)),
        reserved: [0; 2],
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
