//! One run of a campaign: a process of its own, which tells the campaign what became of each fault.

use std::io::Write as _;
use std::path::Path;

use anyhow::Context as _;
use clap::Parser as _;
use rustix::process::{Signal, set_parent_process_death_signal};
use serde::{Deserialize, Serialize};
use tandem_board::{CanId, Duration, RoleLamp, SystemId};
use tandem_board_host::injection::{Injection, Target};
use tandem_board_host::{Backplane, BusTap, clock};
use tandem_bus::Control;

use super::Source;
use super::inject::Injector;
use super::judge::{self, Outcome};
use crate::args::{Cli, Command};
use tandem::args::RunArgs;
use tandem::files::RunFiles;
use tandem::run;

/// After the last fault was mended, the systems must be master and standby again within this time.
pub(super) const HEALED_WITHIN: Duration = Duration::from_ms(60_000);
/// A system that has suspended itself for this long is switched off and on.
pub(super) const SUSPENDED_FOR: Duration = Duration::from_ms(3_000);
const LOOK_AGAIN: Duration = Duration::from_ms(10);
/// The systems have been master and standby for at least this long before a fault, ms.
const SETTLED_MS: u64 = 300;
/// A fault lasts and is mended within this time; the run is made long enough for all.
const LONGEST_FAULT_S: f64 = 12.0;

/// A line that a leg tells its campaign.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Line {
    /// The number of faults that are done.
    Done(u64),
    /// Let this process stand still for this number of milliseconds.
    Hold(u16),
    /// The run has ended: what became of each fault, and what was wrong with the run as a whole.
    Ended(Vec<Outcome>, Vec<String>),
}

/// One sequence of faults that was injected.
#[derive(Clone, Debug)]
pub(super) struct Injected {
    pub(super) number: u64,
    /// The system that drove.
    pub(super) driver: SystemId,
    /// When, ns.
    pub(super) at_ns: u64,
    /// When the systems were master and standby again, ns.
    pub(super) healed_ns: Option<u64>,
    /// How often a system that had suspended itself was switched off and on.
    pub(super) power_cycles: u32,
    /// The roles when the wait was over, for a message.
    pub(super) roles: [RoleLamp; 2],
}

pub(super) fn tell(line: &Line) -> anyhow::Result<()> {
    let text = serde_json::to_string(line).context("a line")?;
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{text}").context("stdout")?;
    stdout.flush().context("stdout")
}

/// The arguments of a run that is long enough for these faults.
pub(super) fn arguments(numbers: &[u64], out: &Path, further: &[&str]) -> anyhow::Result<RunArgs> {
    let duration_s = (numbers.len() as f64 * LONGEST_FAULT_S + 60.0).min(3_600.0);
    let line =
        format!("tandem run --scenario free-lane --duration {duration_s}s --reintegrate --quiet");
    let words = line
        .split(' ')
        .chain(further.iter().copied())
        .chain(["--out"]);
    let words = words.map(Into::into).chain([out.into()]);
    match Cli::try_parse_from::<_, std::ffi::OsString>(words)?.command {
        Command::Run(args) => Ok(args),
        _ => anyhow::bail!("`{line}` is no run"),
    }
}

/// Injects the faults of these numbers in one run.
///
/// # Errors
/// If the run does not start or leaves no recording.
pub(super) fn run(source: &Source<'_>, numbers: &[u64]) -> anyhow::Result<()> {
    // The campaign may be killed: its run then ends as by Ctrl-C.
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let folder = tempfile::tempdir().context("a folder")?;
    let args = arguments(numbers, &folder.path().join("report"), &[])?;
    let recorded = run::recorded(&args, |injection, files| {
        let done = inject_all(source, numbers, &injection, files);
        injection.backplane().request_stop();
        done
    })?;
    let (outcomes, wrong) = judge::judge(source, &recorded)?;
    tell(&Line::Ended(outcomes, wrong))
}

fn inject_all(
    source: &Source<'_>,
    numbers: &[u64],
    injection: &Injection,
    files: &RunFiles,
) -> anyhow::Result<Vec<Injected>> {
    let hold = |ms| tell(&Line::Hold(ms));
    let flash = SystemId::ALL.map(|system| files.flash(system));
    let mut injector = Injector::new(injection, flash, &hold);
    let backplane = injection.backplane();
    let mut done: Vec<Injected> = Vec::new();
    let mut begun = Injected {
        number: 0,
        driver: SystemId::A,
        at_ns: 0,
        healed_ns: None,
        power_cycles: 0,
        roles: [RoleLamp::Starting; 2],
    };
    heal(injection, &mut begun);
    for (index, number) in numbers.iter().enumerate() {
        let (sequence, phase) = source.sequence(*number)?;
        clock::sleep_until(clock::now() + settled(*number));
        // A stall of the machine may have changed the roles again.
        let Some(driver) = driver(roles(backplane)).or_else(|| heal(injection, &mut begun)) else {
            break;
        };
        if let Some(phase) = phase {
            wait_for_phase(backplane, driver, phase)?;
        }
        let mut injected = Injected {
            number: *number,
            driver,
            at_ns: clock::now().as_ns(),
            ..begun.clone()
        };
        injected.power_cycles = 0;
        injector.suffer(&sequence.faults, sequence.span, driver)?;
        let healed = heal(injection, &mut injected);
        if backplane.stop_requested() {
            break;
        }
        done.push(injected);
        tell(&Line::Done(index as u64 + 1))?;
        if healed.is_none() {
            break;
        }
    }
    // The recording has the consequences of the last fault.
    clock::sleep_until(clock::now() + Duration::from_ms(SETTLED_MS));
    Ok(done)
}

/// How long the systems have been master and standby before a fault: another time for each, so that
/// the faults meet the control cycle everywhere.
pub(super) fn settled(number: u64) -> Duration {
    Duration::from_ms(SETTLED_MS + number.wrapping_mul(7_919) % 311)
}

/// The system that drives, if the other is its standby. By the roles of A and B.
pub(super) fn driver(roles: [RoleLamp; 2]) -> Option<SystemId> {
    SystemId::ALL.into_iter().find(|system| {
        let of = |system: SystemId| roles[system.index()];
        of(*system) == RoleLamp::Master && of(system.peer()) == RoleLamp::Standby
    })
}

fn roles(backplane: Backplane) -> [RoleLamp; 2] {
    SystemId::ALL.map(|system| backplane.role(system))
}

/// Waits until one system is master and the other its standby; the master. A system that has no
/// power is switched on, one that has suspended itself off and on.
fn heal(injection: &Injection, injected: &mut Injected) -> Option<SystemId> {
    let backplane = injection.backplane();
    let begin = clock::now();
    let mut suspended = [begin; 2];
    while clock::now().since(begin) < HEALED_WITHIN && !backplane.stop_requested() {
        injected.roles = roles(backplane);
        if let Some(driver) = driver(injected.roles) {
            injected.healed_ns = Some(clock::now().as_ns());
            return Some(driver);
        }
        for system in SystemId::ALL {
            let since = &mut suspended[system.index()];
            if injected.roles[system.index()] != RoleLamp::Suspended {
                *since = clock::now();
            } else if clock::now().since(*since) > SUSPENDED_FOR {
                *since = clock::now();
                injected.power_cycles += 1;
                injection.signal(Target::Supply(system), Signal::KILL);
            }
            injection.request_power(system);
        }
        clock::sleep_until(clock::now() + LOOK_AGAIN);
    }
    None
}

/// Waits until this time after a control frame of the driver.
fn wait_for_phase(backplane: Backplane, driver: SystemId, phase: Duration) -> anyhow::Result<()> {
    let mut tap = BusTap::new(backplane)
        .map_err(|error| anyhow::anyhow!("the bus cannot be read: {error:?}"))?;
    let id = CanId::Standard(Control::IDS[driver.index()]);
    // Without a frame of the driver within 100 ms any phase is as good.
    let until = clock::now() + Duration::from_ms(100);
    while clock::now() < until {
        while let Some((_, received)) = tap.try_next() {
            if received.frame.id() == id {
                clock::sleep_until(received.at + phase);
                return Ok(());
            }
        }
        clock::sleep_until(clock::now() + Duration::from_us(200));
    }
    Ok(())
}
