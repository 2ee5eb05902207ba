//! One drive of a campaign with real processes. A separate process runs the drive, and reports the
//! outcome of each fault.

use anyhow::Context as _;
use rustix::process::{Signal, set_parent_process_death_signal};
use tandem_board::{CanId, Duration, Instant, RoleLamp, SystemId};
use tandem_board_host::injection::{Injection, Target};
use tandem_board_host::{Backplane, BusTap, clock};
use tandem_bus::Control;

use super::Source;
use super::inject::Injector;
use super::pipe::{Line, report};
use super::recording_judge;
use super::round::{
    HEALED_WITHIN, Injected, SETTLED_MS, SUSPENDED_FOR, arguments, driver, settled,
};
use tandem::run;
use tandem_processes::files::RunFiles;

const POLL_PERIOD: Duration = Duration::from_ms(10);
/// Injects the faults with these numbers in one run.
///
/// # Errors
/// If the run does not start or leaves no recording.
pub(super) fn run(source: &Source, numbers: &[u64]) -> anyhow::Result<()> {
    // If the campaign is killed, its run ends as after Ctrl-C.
    set_parent_process_death_signal(Some(Signal::TERM))?;
    let folder = tempfile::tempdir().context("a folder")?;
    let args = arguments(numbers, &folder.path().join("report"), &[])?;
    let recorded = run::recorded(&args, |injection, files| {
        let done = inject_all(source, numbers, &injection, files);
        injection.backplane().request_stop();
        done
    })?;
    let (outcomes, wrong) = recording_judge::judge(source, &recorded)?;
    report(&Line::Ended(outcomes, wrong))
}

fn inject_all(
    source: &Source,
    numbers: &[u64],
    injection: &Injection,
    files: &RunFiles,
) -> anyhow::Result<Vec<Injected>> {
    let hold = |ms| report(&Line::Hold(ms));
    let flash = SystemId::ALL.map(|system| files.flash(system));
    let mut injector = Injector::new(injection, flash, &hold);
    let backplane = injection.backplane();
    let mut done: Vec<Injected> = Vec::new();
    let mut begun = Injected::new(0, SystemId::A, Instant::ORIGIN);
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
        let mut injected = Injected::new(*number, driver, clock::now());
        injector.suffer(&sequence.faults, sequence.span, driver)?;
        let healed = heal(injection, &mut injected);
        if backplane.stop_requested() {
            break;
        }
        done.push(injected);
        report(&Line::Done(index as u64 + 1))?;
        if healed.is_none() {
            break;
        }
    }
    // Wait, so that the recording contains the consequences of the last fault.
    clock::sleep_until(clock::now() + Duration::from_ms(SETTLED_MS));
    Ok(done)
}

fn roles(backplane: Backplane) -> [RoleLamp; 2] {
    SystemId::ALL.map(|system| backplane.role(system))
}

/// Waits until one system is master and the other its standby, and returns the master. Switches on
/// a system without power, and switches a suspended system off and on.
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
        clock::sleep_until(clock::now() + POLL_PERIOD);
    }
    None
}

/// Waits until `phase` after a control frame of the driver.
fn wait_for_phase(backplane: Backplane, driver: SystemId, phase: Duration) -> anyhow::Result<()> {
    let mut tap = BusTap::new(backplane)
        .map_err(|error| anyhow::anyhow!("the bus cannot be read: {error:?}"))?;
    let id = CanId::Standard(Control::IDS[driver.index()]);
    // If the driver sends no frame within 100 ms, accept any phase.
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
