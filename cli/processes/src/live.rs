//! The current state of a run. The vehicle writes it every 100 ms, and `tandem run` shows it.

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};

/// The current state of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Live {
    /// Scenario time, s.
    pub time_s: f64,
    /// Speed, m/s.
    pub speed: f64,
    /// Distance from bumper to bumper to the vehicle ahead in the lane, m.
    pub lead_gap: Option<f64>,
    /// Roles of A and B, as their role outputs show them.
    pub roles: [String; 2],
    /// Longest time between two accepted control frames so far, ms.
    pub gap_max_ms: f64,
    /// Number of changes of the system that the vehicle obeys.
    pub takeovers: u32,
}

impl Live {
    /// Replaces the file atomically, so that a reader never sees a partly written state.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> std::io::Result<()> {
        let next = path.with_extension("next");
        fs::write(&next, serde_json::to_vec(self)?)?;
        fs::rename(&next, path)
    }

    /// Reads the file; `None` if there is no state in it.
    #[must_use]
    #[inline] // as the JSON of a run's configuration is
    pub fn read(path: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(path).ok()?).ok()
    }
}
