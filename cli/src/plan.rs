//! What a run is to do, as its processes are told.

use std::ffi::OsString;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};

/// By which limits the cores are to judge time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Profile {
    /// Real-time priority was granted: tight limits.
    Rt,
    /// It was not: limits that a desktop's scheduler can keep.
    Desktop,
}

impl Profile {
    /// As the command line and `metrics.json` write it.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Rt => "rt",
            Self::Desktop => "desktop",
        }
    }
}

/// What all processes of a run are told, as one argument.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RunPlan {
    /// Name or path of the scenario.
    pub(crate) scenario: String,
    /// Seed of the sensors' noise.
    pub(crate) seed: u64,
    /// Seconds of scenario time.
    pub(crate) duration_s: f64,
    /// The limits of time.
    pub(crate) profile: Profile,
    /// Whether a system that comes back may become the standby of a running pair.
    pub(crate) reintegrate: bool,
}

impl RunPlan {
    /// The argument.
    ///
    /// # Errors
    /// Never in practice: the plan has no content that JSON cannot hold.
    pub(crate) fn to_extra(&self) -> anyhow::Result<Vec<OsString>> {
        Ok(vec![
            serde_json::to_string(self)
                .context("the plan of the run")?
                .into(),
        ])
    }

    /// The plan from a process's argument.
    ///
    /// # Errors
    /// If this program has not made it.
    pub(crate) fn from_extra(extra: &[OsString]) -> anyhow::Result<Self> {
        let text = extra
            .first()
            .and_then(|text| text.to_str())
            .context("the plan is missing")?;
        serde_json::from_str(text).context("the plan of the run (made by this program itself)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_survives_the_command_line() {
        let plan = RunPlan {
            scenario: "/tmp/a \"b\".xml".into(),
            seed: u64::MAX,
            duration_s: 0.5,
            profile: Profile::Desktop,
            reintegrate: true,
        };
        assert_eq!(
            RunPlan::from_extra(&plan.to_extra().unwrap()).unwrap(),
            plan
        );
        assert!(RunPlan::from_extra(&[]).is_err());
    }
}
