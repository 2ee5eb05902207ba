//! The configuration of a run, as its processes receive it.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use serde::{Deserialize, Serialize};
use tandem_board::Duration;
use tandem_board::SystemId;
use tandem_board_host::Alarm;
use tandem_record::verdict::Limits;
use tandem_redundancy::Budget;
use tandem_vehicle::{Scenario, ScenarioError};

use crate::boot::ProgramFlashes;
use crate::files::RunFiles;
use crate::open_bus::OpenBusPlace;

/// The profile of the cores' time limits.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LimitProfile {
    /// Tight limits, for a machine that granted real-time priority.
    Rt,
    /// Limits that a desktop's scheduler can keep, for a machine without real-time priority.
    #[default]
    Desktop,
}

impl LimitProfile {
    /// Returns its name on the command line and in `metrics.json`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Rt => "rt",
            Self::Desktop => "desktop",
        }
    }
}

/// The configuration of all processes of a run. It is passed as one argument.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RunConfig {
    /// Name or path of the scenario.
    pub scenario: String,
    /// Id of its planning problem; `None` selects the first one.
    pub problem: Option<i64>,
    /// Seed of the sensors' noise.
    pub seed: u64,
    /// Scenario time to drive, s.
    pub duration_s: f64,
    /// The profile of time limits.
    pub profile: LimitProfile,
    /// The longest measured stall, µs; `None` selects the profile's own value.
    pub stall_us: Option<u32>,
    /// Whether a restarted system may rejoin as standby.
    pub reintegrate: bool,
    /// The driver overrides the function between these scenario times, s.
    pub overrides_s: Option<(f64, f64)>,
    /// The driver answers a takeover request after this time, s.
    pub answers_after_s: Option<f64>,
    /// The driver wants the vehicle parked from this scenario time on, s.
    pub parks_from_s: Option<f64>,
    /// Failures of sensors, in the form of the command line.
    pub sensor_faults: Vec<String>,
    /// Clocks and delays of sensors, in the form of the command line.
    pub sensor_timing: Vec<String>,
    /// The program flashes that the systems boot from; `None` on a board with its own flashes.
    pub program_flash: Option<ProgramFlashes>,
    /// The update that each system receives while the other system drives.
    pub update: Option<UpdateFiles>,
    /// Where other programs are on the bus, if they may.
    pub can: Option<OpenBusPlace>,
    /// For `tandem boot-demo`: the file with the records to send, and the file for the result.
    pub demo: Option<[PathBuf; 2]>,
    /// What the vehicle's process needs to write the report if the process that started the run
    /// dies; `None` if that process writes none either.
    pub report: Option<LastReport>,
    /// The CPU of each core, in the order A0, A1, … B2; empty if the cores are not processes.
    pub cpus: Vec<usize>,
    /// Timers of the threads that watch for stalls. Each core 0 postpones the timer of its CPU.
    pub stall_timers: Vec<StallTimer>,
}

/// Where and how the vehicle's process writes the report of a run whose launcher has died.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastReport {
    /// The folder of the report, an absolute path.
    pub out: PathBuf,
    /// The permissions that the machine granted, in one line.
    pub granted: String,
}

/// An [`Alarm`] that the processes inherit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StallTimer {
    /// The watched CPU.
    pub cpu: usize,
    /// Number of the file descriptor.
    pub descriptor: i32,
}

/// The files of the updates in a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UpdateFiles {
    /// The records for each system.
    pub lines: [PathBuf; 2],
    /// The file for the results of the updates, one line each.
    pub ended: PathBuf,
    /// The release that the systems receive.
    pub release: u32,
    /// The private key of the tester that updates them.
    pub tester: PathBuf,
}

impl UpdateFiles {
    /// Writes the records for each system to the files that the vehicle reads.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(
        files: &RunFiles,
        lines: [&[String]; 2],
        release: u32,
        tester: PathBuf,
    ) -> anyhow::Result<Self> {
        let places = SystemId::ALL.map(|system| files.update(system));
        for (path, lines) in places.iter().zip(lines) {
            write_lines(path, lines)?;
        }
        Ok(Self {
            lines: places,
            ended: files.updated(),
            release,
            tester,
        })
    }

    /// Returns the results of the updates, to print.
    pub fn results(files: &RunFiles) -> String {
        let ended = fs::read_to_string(files.updated()).unwrap_or_default();
        if ended.is_empty() {
            return "no system was updated\n".to_owned();
        }
        ended
    }
}

/// Writes the records of a download to a file.
///
/// # Errors
/// If the file cannot be written.
pub fn write_lines(path: &Path, lines: &[String]) -> anyhow::Result<()> {
    fs::write(path, lines.concat()).with_context(|| path.display().to_string())
}

impl RunConfig {
    /// Loads the scenario with its planning problem.
    ///
    /// # Errors
    /// If there is no such scenario or problem, or it cannot be understood.
    pub fn load_scenario(&self) -> Result<Scenario, ScenarioError> {
        Scenario::load_problem(&self.scenario, self.problem.into())
    }

    /// Returns the budget from which the time limits follow.
    pub fn budget(&self) -> Budget {
        let budget = match self.profile {
            LimitProfile::Rt => Budget::RT,
            LimitProfile::Desktop => Budget::DESKTOP,
        };
        match self.stall_us {
            Some(us) => budget.measured(Duration::from_us(us.into())),
            None => budget,
        }
    }

    /// Returns the limits that the requirement sets for a run with this profile on this machine.
    pub fn required(&self) -> Limits {
        let limits = match self.profile {
            LimitProfile::Rt => Limits::RT,
            LimitProfile::Desktop => Limits::DESKTOP,
        };
        limits.with_stall(self.budget().stall)
    }

    /// Returns the timer that a core 0 pinned to this CPU postpones. The thread that waits for the
    /// timer has priority over core 0, so core 0 cannot hide a stall from it. Without a timer the
    /// thread wakes more often.
    pub(crate) fn stall_alarm(&self, cpu: Option<usize>) -> Option<Alarm> {
        let mut timers = self.stall_timers.iter();
        let own = timers.find(|timer| Some(timer.cpu) == cpu)?;
        Alarm::inherited(own.descriptor).ok()
    }

    // JSON is inlined into the command, which is not optimised: a first build takes less time.

    /// Encodes the configuration as a process's argument.
    ///
    /// # Errors
    /// Never in practice: JSON can represent the whole configuration.
    #[inline]
    pub fn to_extra(&self) -> anyhow::Result<Vec<OsString>> {
        Ok(vec![
            serde_json::to_string(self)
                .context("the configuration of the run")?
                .into(),
        ])
    }

    /// Decodes the configuration from a process's argument.
    ///
    /// # Errors
    /// If the argument is missing or was not made by [`RunConfig::to_extra`].
    #[inline]
    pub fn from_extra(extra: &[OsString]) -> anyhow::Result<Self> {
        let text = extra
            .first()
            .and_then(|text| text.to_str())
            .context("the configuration of the run is missing")?;
        serde_json::from_str(text)
            .context("the configuration of the run (made by this program itself)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_configuration_survives_the_command_line() {
        let config = RunConfig {
            scenario: "/tmp/a \"b\".xml".into(),
            problem: Some(-7),
            seed: u64::MAX,
            duration_s: 0.5,
            profile: LimitProfile::Desktop,
            stall_us: Some(1_500),
            reintegrate: true,
            overrides_s: Some((1.0, 2.5)),
            answers_after_s: None,
            parks_from_s: Some(0.0),
            sensor_faults: vec!["camera-front:lost:1-2".into()],
            sensor_timing: vec!["all:delay:20ms".into()],
            program_flash: None,
            update: Some(UpdateFiles {
                lines: ["/tmp/a.update".into(), "/tmp/b.update".into()],
                ended: "/tmp/updated".into(),
                release: 2,
                tester: "/tmp/tester.der".into(),
            }),
            can: Some(OpenBusPlace::Udp {
                group: std::net::Ipv4Addr::LOCALHOST,
                port: 7,
            }),
            demo: None,
            report: Some(LastReport {
                out: PathBuf::from("/tmp/report"),
                granted: "rt".to_owned(),
            }),
            cpus: vec![0, 1, 0, 1, 0, 1],
            stall_timers: vec![StallTimer {
                cpu: 1,
                descriptor: 9,
            }],
        };
        assert_eq!(
            RunConfig::from_extra(&config.to_extra().unwrap()).unwrap(),
            config
        );
        assert!(RunConfig::from_extra(&[]).is_err());
    }
}
