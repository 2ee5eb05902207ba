//! `tandem run`: checks the arguments, runs both systems and the vehicle, and writes the report.

use std::fs;
use std::net::UdpSocket;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, bail};
use tandem_board::{CoreAddress, Duration, SystemId};
use tandem_board_host::injection::Injection;
use tandem_board_host::realtime::{Claim, Grant, claim};
use tandem_board_host::{
    CoreArgs, Ended, LaunchPlan, Launcher, Leftovers, Pinning, ProcessArgs, RunName, Schedule,
};
use tandem_page::json::JsonOutput;
use tandem_processes::boot::{self, ProgramFlashes};
use tandem_processes::files::RunFiles;
use tandem_processes::open_bus::{OpenBus, OpenBusPlace};
use tandem_processes::run_config::{LastReport, LimitProfile, RunConfig, UpdateFiles};
use tandem_processes::update::objections;
use tandem_processes::{core_process, vehicle};
use tandem_record::RunLog;
use tandem_record::gap::Bounds;
use tandem_record::verdict::{Beside, Watch};
use tandem_redundancy::Budget;
use tandem_vehicle::Scenario;

use crate::args::{CanBus, CpuList, RunArgs, SocArgs, Timing};
use crate::board_kind::BoardKind;
use crate::can_bridge::CanBridge;
use crate::collected::{Collected, read};
use crate::failure::Failure;
use crate::grandmaster::{GrandmasterEnd, GrandmasterProcess};
use crate::live::Progress;
use crate::metrics::{Metrics, Surroundings};
use crate::output::{self, ReportFolder};
use crate::publish::Publishing;
use crate::soc::{SocEnd, SocProcess};
use crate::stall_watch::{self, Seen, StallWatch};
use crate::{summary, topics};

/// Duration for which `--timing auto` measures the stalls of the machine.
const MEASURED_FOR: Duration = Duration::from_ms(500);
/// Upper bound of the delay of the processes' timers.
const TIMERS_LATE: Duration = Duration::from_ms(2);

/// Drives the scenario and writes the report.
///
/// # Errors
/// Returns the [`Failure`] whose exit status the command documents.
pub fn run(args: &RunArgs) -> Result<(), Failure> {
    let checked = Checked::new(args).map_err(Failure::Usage)?;
    // Observers must see what publishing uses in `/dev/shm`, so it starts before the launcher.
    let bridge = CanBridge::start(args)?;
    let publishing = Publishing::prepare(args)?;
    let mut launcher = Launcher::prepare()?;
    let (profile, granted) = grant(args, &checked, &launcher).map_err(Failure::Usage)?;
    let longest = (args.timing == Timing::Auto)
        .then(|| stall_watch::longest(&checked.places, profile == LimitProfile::Rt, MEASURED_FOR));
    let config = RunConfig {
        stall_us: longest.map(|it| u32::try_from(it.as_us()).unwrap_or(u32::MAX)),
        ..config_with(args, profile, bridge.as_ref())
    };
    if !args.quiet {
        eprintln!("{granted}\n{}", limits(&config.budget(), longest));
    }
    let files = RunFiles::of(launcher.isolation().run());
    let config = with_flash(args, &files, config)?;
    let watch = StallWatch::start(&checked.places, profile == LimitProfile::Rt);
    let config = RunConfig {
        cpus: checked.cores(),
        stall_timers: watch.timers(),
        report: Some(LastReport {
            out: checked.out.path().to_owned(),
            granted: granted.clone(),
        }),
        ..config
    };
    let driven = drive(args, &checked, &config, &files, &mut launcher, publishing);
    let machine = watch.end();
    drop(bridge);
    let Driven {
        ended,
        soc,
        grandmaster,
    } = driven?;
    let because = || match ended.vehicle {
        Some(status) => format!("the vehicle's process ended with {status}"),
        None => "the vehicle's process ended".to_owned(),
    };
    let updates = updates(args, &files);
    let collected = Collected::new(&checked.out, &files, &because);
    let around = surroundings(&config, granted)
        .after(machine, &launcher.finish())
        .with_soc(soc);
    let around = Surroundings {
        grandmaster,
        ..around
    };
    conclude(
        args,
        checked,
        collected,
        &around,
        ended.interrupted,
        updates,
    )
}

/// Returns the configuration that the command line describes, without program flashes and without
/// a CAN interface.
pub fn config_of(args: &RunArgs, profile: LimitProfile) -> RunConfig {
    RunConfig {
        scenario: args.scenario.clone(),
        problem: args.problem,
        seed: args.seed,
        duration_s: args.duration,
        profile,
        reintegrate: args.reintegrate,
        overrides_s: args.overrides,
        answers_after_s: args.answers,
        parks_from_s: args.parks_from_s(),
        sensor_faults: args.sensor_fault.clone(),
        sensor_timing: args.sensor_time.clone(),
        can: multicast(args),
        ..RunConfig::default()
    }
}

/// Returns the same with the bridge to a CAN interface, if the run has one.
fn config_with(args: &RunArgs, profile: LimitProfile, bridge: Option<&CanBridge>) -> RunConfig {
    let config = config_of(args, profile);
    let can = bridge.map(CanBridge::place).or(config.can.clone());
    RunConfig { can, ..config }
}

/// Returns where other programs hear the bus over UDP, if they do.
fn multicast(args: &RunArgs) -> Option<OpenBusPlace> {
    (args.can == Some(CanBus::Udp)).then_some(OpenBusPlace::Udp {
        group: args.can_group,
        port: args.can_port,
    })
}

/// The result of [`recorded`].
pub struct Recorded<T> {
    /// The recording.
    pub log: RunLog,
    /// Facts about the run that the recording does not contain.
    pub around: Surroundings,
    /// The return value of `inject`.
    pub done: T,
}

/// Runs the same drive as [`run`] while a separate thread calls `inject`. Writes no report.
///
/// # Errors
/// If the run does not start, `inject` fails, or the run leaves no recording.
pub fn recorded<T: Send>(
    args: &RunArgs,
    inject: impl FnOnce(Injection, &RunFiles) -> anyhow::Result<T> + Send,
) -> anyhow::Result<Recorded<T>> {
    let checked = Checked::new(args)?;
    let publishing = match Publishing::prepare(args) {
        Ok(publishing) => publishing,
        Err(Failure::Usage(error)) => return Err(error),
        Err(_) => None,
    };
    let mut launcher = Launcher::prepare()?;
    let (profile, granted) = grant(args, &checked, &launcher)?;
    let files = RunFiles::of(launcher.isolation().run());
    let config = with_flash(args, &files, config_of(args, profile))?;
    let injection = launcher.injection();
    let watch = StallWatch::start(&checked.places, profile == LimitProfile::Rt);
    let config = RunConfig {
        cpus: checked.cores(),
        stall_timers: watch.timers(),
        ..config
    };
    let (driven, done) = std::thread::scope(|scope| {
        let injected = scope.spawn(|| inject(injection, &files));
        let driven = drive(args, &checked, &config, &files, &mut launcher, publishing);
        (driven, injected.join())
    });
    let machine = watch.end();
    let Driven { soc, .. } = driven?;
    let done = done.map_err(|_| anyhow::anyhow!("the injection panicked"))?;
    let folder = tempfile::tempdir().context("a folder for the log")?;
    let log = read(&files.recording(), &folder.path().join(output::CANDUMP));
    let left = launcher.finish();
    Ok(Recorded {
        log: log?,
        around: surroundings(&config, granted)
            .after(machine, &left)
            .with_soc(soc),
        done: done?,
    })
}

/// A drive on another board.
#[derive(Debug)]
pub struct DrivenElsewhere {
    /// A line about its time.
    pub summary: String,
    /// How it ended.
    pub ended: vehicle::DriveEnd,
    /// How its SoC ended, if it had one.
    pub soc: Option<SocEnd>,
}

/// Like [`run`], with a controller on another board. `drive` runs the controller. Its time is
/// virtual, so timers are never late.
///
/// # Errors
/// Returns the [`Failure`] whose exit status the command documents.
pub fn run_elsewhere(
    args: &RunArgs,
    drive: impl FnOnce(&RunConfig, &RunFiles) -> Result<DrivenElsewhere, Failure>,
) -> Result<(), Failure> {
    let checked = Checked::new(args).map_err(Failure::Usage)?;
    let bridge = CanBridge::start(args)?;
    let config = config_with(args, LimitProfile::Rt, bridge.as_ref());
    let folder = tempfile::tempdir().context("a folder for the run's logs")?;
    let files = RunFiles::within(folder.path());
    let mut publishing = Publishing::prepare(args)?;
    if let Some(publishing) = &mut publishing {
        let run = RunName::unique();
        publishing.begin(&run, &config, true);
        publishing.follow(&files);
        if !args.quiet {
            eprintln!("observers find it as {run}");
        }
    }
    let driven = drive(&config, &files);
    if let Some(publishing) = publishing {
        publishing.end();
    }
    let DrivenElsewhere {
        summary,
        ended,
        soc,
    } = driven?;
    let updates = updates(args, &files);
    if !args.quiet {
        eprintln!("{summary}");
    }
    let collected = Collected::new(&checked.out, &files, &|| "the emulator ended".to_owned());
    let interrupted = ended == vehicle::DriveEnd::Stopped;
    let around = surroundings(&config, summary).with_soc(soc);
    conclude(args, checked, collected, &around, interrupted, updates)
}

/// Prints the results of the updates. Returns what they say against the run.
fn updates(args: &RunArgs, files: &RunFiles) -> Vec<String> {
    let Some(release) = args.update else {
        return Vec::new();
    };
    let results = UpdateFiles::results(files);
    if !args.quiet {
        eprint!("{results}");
    }
    objections(&results, release)
}

/// Adds the program flashes and the update to the configuration of a run.
fn with_flash(args: &RunArgs, files: &RunFiles, run: RunConfig) -> anyhow::Result<RunConfig> {
    if args.no_bootloader {
        return Ok(run);
    }
    let (key, tester, paths) = match &args.program_flash {
        Some(folder) => {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
            (
                boot::key_in(&folder.join("key.der"))?,
                folder.join("tester.der"),
                SystemId::ALL.map(|system| folder.join(format!("{system}.pflash"))),
            )
        }
        None => (
            boot::new_key()?,
            files.tester(),
            SystemId::ALL.map(|system| files.program_flash(system)),
        ),
    };
    let flash = ProgramFlashes::of(paths, &key, &boot::key_in(&tester)?)?;
    let update = match args.update {
        Some(release) => {
            let [a, b] = SystemId::ALL.map(|system| flash.update(system, release, &key));
            Some(UpdateFiles::write(files, [&a?, &b?], release, tester)?)
        }
        None => None,
    };
    Ok(RunConfig {
        program_flash: Some(flash),
        update,
        ..run
    })
}

/// Returns the facts about a run that are known before the drive and that its recording lacks.
#[must_use]
pub fn surroundings(config: &RunConfig, granted: String) -> Surroundings {
    let product = core_process::config(config).redundancy;
    // A disturbed bus moves frames once a millisecond. The last frame before a gap and the first
    // one after it may each be late by another half millisecond, which is not yet a stall.
    let on_bus = Duration::from_ms(1) + stall_watch::LATE.times(2);
    Surroundings {
        granted,
        timing: config.profile.name().to_owned(),
        detection_bound_ms: Some(product.takeover_bound().as_ms_f64()),
        beside: Beside {
            bounds: Bounds::new(config.required(), on_bus, TIMERS_LATE),
            product: Some(product),
            ..Beside::default()
        },
        watched_by: String::new(),
        soc: None,
        grandmaster: None,
    }
}

impl Surroundings {
    /// Adds the facts that are known only after a run of processes.
    fn after(self, machine: Seen, left: &Leftovers) -> Self {
        Self {
            beside: Beside {
                watch: machine.watch,
                stalls: machine.stalls,
                leftovers: leftovers(left),
                ..self.beside
            },
            watched_by: machine.watched_by,
            ..self
        }
    }

    /// The same after a run whose launcher has died. It alone had seen which stalls there were.
    pub(crate) fn after_launcher(self) -> Self {
        let beside = Beside {
            watch: Watch::Ordinary,
            ..self.beside
        };
        Self { beside, ..self }
    }

    /// Adds how the SoC of the run has ended, if there was one.
    #[must_use]
    pub fn with_soc(self, soc: Option<SocEnd>) -> Self {
        Self {
            beside: Beside {
                not_parked: soc.as_ref().and_then(SocEnd::not_parked),
                ..self.beside
            },
            soc,
            ..self
        }
    }
}

/// Writes the report, prints its summary, and judges the run. If the user ended the run, the
/// report covers the drive up to that time, if any.
fn conclude(
    args: &RunArgs,
    checked: Checked,
    collected: anyhow::Result<Collected>,
    around: &Surroundings,
    interrupted: bool,
    updates: Vec<String>,
) -> Result<(), Failure> {
    let driven = |collected: &Collected| collected.log.driven_s() > 0.0;
    if interrupted && !collected.as_ref().is_ok_and(driven) {
        return Err(Failure::Interrupted);
    }
    let metrics = collected.and_then(|c| c.write(&checked.out, around))?;
    print_summary(args, checked.json_to, &checked.out, &metrics, &updates)?;
    if interrupted {
        return Err(Failure::DrivenUntil(metrics.duration_s));
    }
    let objections = [metrics.verdict.objections(), updates].concat();
    match objections.is_empty() {
        true => Ok(()),
        false => Err(Failure::Objections(objections)),
    }
}

/// The checked arguments and the properties of the machine, before anything is started.
struct Checked {
    out: ReportFolder,
    json_to: JsonOutput,
    pinning: Pinning,
    cpus: Vec<usize>,
    /// The same CPUs, each with its index among those that this process may use.
    places: Vec<(usize, usize)>,
    dflash: Option<PathBuf>,
    /// The claim on the run's domain, held until the run has ended.
    _domain: Option<UdpSocket>,
}

impl Checked {
    /// Returns the CPU of each core, in the order A0, A1, … B2.
    fn cores(&self) -> Vec<usize> {
        let cpus = self.cpus.iter().cycle();
        cpus.take(CoreAddress::ALL.len()).copied().collect()
    }

    fn new(args: &RunArgs) -> anyhow::Result<Self> {
        check_board(args)?;
        check_scenario(args)?;
        let can = multicast(args);
        can.as_ref().map(OpenBus::join).transpose()?;
        let domain = args.network().map(topics::claim).transpose()?;
        let out = ReportFolder::check(&args.out)?;
        outside_shared_memory("--out", out.path())?;
        let available = available_cpus()?;
        let (pinning, cpus, places) = match &args.cpus {
            None => {
                let places = (0..available.len()).collect();
                (Pinning::Auto, available, places)
            }
            Some(CpuList(asked)) => {
                let places = indices(asked, &available)?;
                (Pinning::Cpus(places.clone()), asked.clone(), places)
            }
        };
        let places = cpus.iter().copied().zip(places).collect();
        let dflash = args.dflash.as_deref().map(check_dflash).transpose()?;
        Ok(Self {
            out,
            json_to: args.json.check()?,
            pinning,
            cpus,
            places,
            dflash,
            _domain: domain,
        })
    }
}

/// Rejects options that only apply to the board of processes.
///
/// # Errors
/// If such an option is given for another board.
pub fn check_board(args: &RunArgs) -> anyhow::Result<()> {
    let of_host = [
        ("--cpus", args.cpus.is_some()),
        ("--dflash", args.dflash.is_some()),
        ("--timing", args.timing != Timing::Auto),
        ("--stagger", args.stagger.is_some()),
        ("--grandmaster", args.grandmaster.is_some()),
    ];
    match of_host.iter().find(|(_, given)| *given) {
        Some((option, _)) if args.board != BoardKind::Host => {
            bail!("{option}: only processes of this machine have it; leave out --board or {option}")
        }
        _ => Ok(()),
    }
}

/// Checks that the vehicle's process can read the scenario.
fn check_scenario(args: &RunArgs) -> anyhow::Result<()> {
    let scenario = &*args.scenario;
    let path = Path::new(scenario);
    // A pipe can only be read once, and only by this process.
    let is_special = fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir());
    if is_special && !Scenario::names().any(|name| name == scenario) {
        bail!("--scenario {scenario}: it is no regular file; save it as one first");
    }
    let loaded = Scenario::load_problem(scenario, args.problem.into())?;
    if let Some(reason) = loaded.outside_domain() {
        bail!(
            "--scenario {scenario}: outside the operational design domain: {reason}; \
             docs/domain.md says what it is"
        );
    }
    for warning in loaded.warnings() {
        eprintln!("warning: {warning}");
    }
    if args.problem.is_some() && !args.quiet {
        eprintln!("{scenario}: {} is driven", loaded.planning_problem());
    }
    fs::canonicalize(path).map_or(Ok(()), |path| outside_shared_memory("--scenario", &path))
}

/// Rejects a path in the machine's `/dev/shm`, because a run has its own `/dev/shm`.
fn outside_shared_memory(option: &str, path: &Path) -> anyhow::Result<()> {
    if path.starts_with("/dev/shm") {
        bail!(
            "{option} {}: a run cannot reach this place, as it has a /dev/shm of its own; \
             name another one",
            path.display()
        );
    }
    Ok(())
}

fn available_cpus() -> anyhow::Result<Vec<usize>> {
    let ids = core_affinity::get_core_ids().context("cannot tell which CPUs there are")?;
    Ok(ids.into_iter().map(|id| id.id).collect())
}

/// Returns the index of each requested CPU among the available ones.
fn indices(asked: &[usize], available: &[usize]) -> anyhow::Result<Vec<usize>> {
    asked
        .iter()
        .map(|cpu| {
            available
                .iter()
                .position(|there| there == cpu)
                .with_context(|| {
                    format!("--cpus: there is no CPU {cpu}; this process may use {available:?}")
                })
        })
        .collect()
}

fn check_dflash(folder: &Path) -> anyhow::Result<PathBuf> {
    let shown = folder.display();
    let folder = fs::canonicalize(folder)
        .with_context(|| format!("--dflash {shown}: create this folder first"))?;
    if !folder.is_dir() {
        bail!("--dflash {shown}: it is a file; name a folder");
    }
    outside_shared_memory("--dflash", &folder)?;
    tempfile::tempfile_in(&folder)
        .with_context(|| format!("--dflash {shown}: cannot write in this folder"))?;
    Ok(folder)
}

/// Returns the time limits of this run, in one line.
fn limits(budget: &Budget, longest: Option<Duration>) -> String {
    let config = budget.config();
    let ms = |time: Duration| format!("{} ms", time.as_ms_f64());
    let measured = longest.map_or_else(String::new, |longest| {
        format!(
            "longest stall in {}: {:.1} ms; ",
            ms(MEASURED_FOR),
            longest.as_ms_f64()
        )
    });
    format!(
        "{measured}limits: line silent {}, third witness {}; without control for at most {} at a \
         takeover, while stalls stay below {}",
        ms(config.silent_limit()),
        ms(config.witness_limit()),
        ms(config.gap_bound().max(config.gap_bound_mute())),
        ms(budget.tolerated_stall()),
    )
}

/// Determines which permissions the machine grants. Also returns a line that reports them.
fn grant(
    args: &RunArgs,
    checked: &Checked,
    launcher: &Launcher,
) -> anyhow::Result<(LimitProfile, String)> {
    let granted = if args.timing == Timing::Desktop {
        Grant::default()
    } else {
        // Use a separate thread, because a claim changes the thread that makes it.
        let probe = || {
            claim(Claim {
                priority: Some(1),
                cpu: None,
                lock_memory: true,
            })
        };
        std::thread::scope(|scope| scope.spawn(probe).join())
            .map_err(|_| anyhow::anyhow!("asking for real time has panicked"))?
    };
    if args.timing == Timing::Rt && !granted.is_realtime() {
        bail!(
            "--timing rt: SCHED_FIFO was refused; raise RLIMIT_RTPRIO to 80 (`ulimit -r 80`, or \
             rtprio in /etc/security/limits.conf), run as root, or use --timing auto"
        );
    }
    let profile = if granted.is_realtime() {
        LimitProfile::Rt
    } else {
        LimitProfile::Desktop
    };
    let cpus: Vec<String> = checked.cpus.iter().map(ToString::to_string).collect();
    let line = format!(
        "{} timing: {}, {}, cores pinned to CPU {}; {}",
        profile.name(),
        if granted.is_realtime() {
            "SCHED_FIFO"
        } else {
            "no real-time priority"
        },
        if granted.memory_locked {
            "memory locked"
        } else {
            "memory not locked"
        },
        cpus.join(","),
        launcher.isolation(),
    );
    Ok((profile, line))
}

/// What [`drive`] returns.
struct Driven {
    ended: Ended,
    /// How the SoC ended, if the run had one.
    soc: Option<SocEnd>,
    /// How the grandmaster ended, if the run had one.
    grandmaster: Option<GrandmasterEnd>,
}

/// Starts all processes and waits for the end of the run.
fn drive(
    args: &RunArgs,
    checked: &Checked,
    config: &RunConfig,
    files: &RunFiles,
    launcher: &mut Launcher,
    mut publishing: Option<Publishing>,
) -> anyhow::Result<Driven> {
    if let Some(publishing) = &mut publishing {
        publishing.begin(launcher.isolation().run(), config, false);
    }
    let flash = SystemId::ALL.map(|system| match &checked.dflash {
        Some(folder) => folder.join(format!("{system}.dflash")),
        None => files.flash(system),
    });
    let schedule = Schedule {
        realtime: config.profile == LimitProfile::Rt,
        pinning: checked.pinning.clone(),
    };
    let errors = fs::File::create(files.errors()).context("creating the log of errors")?;
    if let Some(stagger_s) = args.stagger {
        launcher.stagger(SystemId::A, Duration::from_us((stagger_s * 1e6) as u64));
    }
    let plan = LaunchPlan {
        schedule,
        flash,
        network: args.network(),
        extra: config.to_extra()?,
    };
    let command = |args: &ProcessArgs| {
        let mut command = this_program(args);
        match errors.try_clone() {
            Ok(errors) => command.stderr(errors),
            Err(_) => command.stderr(Stdio::null()),
        };
        command
    };
    let grandmaster = start_grandmaster(args, config, files)?;
    let soc = start_soc(args, config, files)?;
    launcher.start(&plan, &command)?;
    let publishing = publishing.map(|mut publishing| {
        publishing.follow(files);
        publishing
    });
    let progress = (!args.quiet).then(|| Progress::show(files.live(), config.duration_s));
    let ended = launcher.wait_and_switch(&plan, &command);
    // At once: that the bus is silent now is no matter of the SoC's.
    let soc = soc.map(SocProcess::end);
    let grandmaster = grandmaster.map(GrandmasterProcess::end);
    if let Some(progress) = progress {
        progress.end();
    }
    if let Some(publishing) = publishing {
        publishing.end();
    }
    Ok(Driven {
        ended,
        soc,
        grandmaster,
    })
}

/// Starts the grandmaster's process, if the run has one.
fn start_grandmaster(
    args: &RunArgs,
    config: &RunConfig,
    files: &RunFiles,
) -> anyhow::Result<Option<GrandmasterProcess>> {
    let (Some(scale), Some(place)) = (args.grandmaster, args.network()) else {
        return Ok(None);
    };
    let realtime = config.profile == LimitProfile::Rt;
    let started = GrandmasterProcess::start(scale, place, files.grandmaster(), realtime)?;
    let (grandmaster, pid) = started;
    if !args.quiet {
        eprintln!("grandmaster: process {pid}, at {place}, gives {scale}");
    }
    Ok(Some(grandmaster))
}

/// Starts the SoC's process, if the run has one.
fn start_soc(
    args: &RunArgs,
    config: &RunConfig,
    files: &RunFiles,
) -> anyhow::Result<Option<SocProcess>> {
    let (Some(way), Some(place)) = (args.soc, args.network()) else {
        return Ok(None);
    };
    let (soc, pid) = SocProcess::start(SocArgs {
        park: way,
        place,
        leaves: files.soc(),
        times: files.soc_time(),
        realtime: config.profile == LimitProfile::Rt,
    })?;
    if !args.quiet {
        eprintln!("SoC: process {pid}, at {place}, parks after {way} m");
    }
    Ok(Some(soc))
}

/// Returns the command that starts this program again, even if its file has been replaced.
pub fn this_program(args: &ProcessArgs) -> Command {
    let mut command = tandem_board_host::this_program();
    command.arg0("tandem").args(args.to_argv());
    // No process of a run may keep the caller's pipes open after `tandem run` has ended.
    command.stdin(Stdio::null()).stdout(Stdio::null());
    command
}

/// Returns the command with which a supply starts a core.
pub fn core_command(args: &CoreArgs) -> Command {
    this_program(&ProcessArgs::Core(args.clone()))
}

fn leftovers(found: &Leftovers) -> Vec<String> {
    let processes = found
        .processes
        .iter()
        .map(|p| format!("process {} ({})", p.pid, p.kind));
    processes.chain(found.files.iter().cloned()).collect()
}

/// Prints the summary of the run on the terminal.
fn print_summary(
    args: &RunArgs,
    json_to: JsonOutput,
    out: &ReportFolder,
    metrics: &Metrics,
    besides: &[String],
) -> anyhow::Result<()> {
    let report = out.path().join(output::REPORT);
    let text = || match args.quiet {
        true => String::new(),
        false => summary::table(metrics, besides, &report),
    };
    crate::print(&json_to.write(metrics, text)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// T-RED-8: the limits are printed with the stall that they follow from. On a machine with
    /// short stalls the limits are shorter. On others the requirement bounds them.
    #[test]
    fn limits_are_printed_with_the_stall_that_they_follow_from() {
        let line = |us| {
            let longest = Duration::from_us(us);
            limits(&Budget::RT.measured(longest), Some(longest))
        };
        assert_eq!(
            line(500),
            "longest stall in 500 ms: 0.5 ms; limits: line silent 6 ms, third witness 14 ms; \
             without control for at most 17 ms at a takeover, while stalls stay below 3 ms"
        );
        assert_eq!(
            line(9_000),
            "longest stall in 500 ms: 9.0 ms; limits: line silent 8 ms, third witness 17 ms; \
             without control for at most 19 ms at a takeover, while stalls stay below 5 ms"
        );
        assert!(limits(&Budget::RT, None).starts_with("limits: line silent 8 ms"));
    }

    #[test]
    fn cpus_are_named_by_their_numbers() {
        assert_eq!(indices(&[5, 2], &[2, 3, 5]).unwrap(), [2, 0]);
        let error = indices(&[7], &[2, 3]).unwrap_err().to_string();
        assert!(
            error.contains("no CPU 7") && error.contains("[2, 3]"),
            "{error}"
        );
    }
}
