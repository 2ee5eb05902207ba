//! The current state of a run. The vehicle writes it every 100 ms, and `tandem run` shows it.

use std::fs;
use std::io::{IsTerminal as _, stderr};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::termios::tcgetwinsize;
use serde::{Deserialize, Serialize};

const REFRESH: Duration = Duration::from_millis(100);

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

    /// Returns one line of fixed columns: time, speed, distance to the vehicle ahead, roles, the
    /// largest gap, and the number of takeovers.
    fn line(&self, duration_s: f64) -> String {
        let ahead = match self.lead_gap {
            Some(gap) if gap < 999.5 => format!("{gap:3.0} m"),
            _ => "free ".to_owned(),
        };
        let [a, b] = &self.roles;
        format!(
            "{:5.1}/{duration_s:.0} s {:3.0} km/h ahead {ahead} A {a:<9} B {b:<9} gap {:.0} ms, {} taken",
            self.time_s,
            self.speed * 3.6,
            self.gap_max_ms,
            self.takeovers,
        )
    }

    fn read(path: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(path).ok()?).ok()
    }
}

/// Shows the state of a run in one line of the terminal. Shows nothing without a terminal.
pub struct Progress {
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Progress {
    /// Starts to show the run whose state is in the file `path`.
    pub fn show(path: PathBuf, duration_s: f64) -> Self {
        let over = Arc::new(AtomicBool::new(false));
        let thread = stderr().is_terminal().then(|| {
            let over = Arc::clone(&over);
            std::thread::spawn(move || follow(&path, duration_s, &over))
        });
        Self { over, thread }
    }

    /// Clears the line.
    pub fn end(mut self) {
        self.over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The thread only displays, so a panic in it does not affect the run.
            let _ = thread.join();
        }
    }
}

/// Moves to the first column of the terminal and clears the line.
const CLEAR: &str = "\r\x1b[2K";

/// Returns the width of a terminal, characters; 80 if it does not tell one.
pub(crate) fn columns(terminal: impl AsFd) -> usize {
    let told = tcgetwinsize(terminal).map_or(0, |size| usize::from(size.ws_col));
    if told == 0 { 80 } else { told }
}

fn follow(path: &Path, duration_s: f64, over: &AtomicBool) {
    eprint!("starting");
    while !over.load(Ordering::Relaxed) {
        if let Some(live) = Live::read(path) {
            // Cut the line at the terminal's width: a wrapped line could not be cleared.
            let columns = columns(stderr());
            eprint!("{CLEAR}{:.columns$}", live.line(duration_s));
        }
        std::thread::sleep(REFRESH);
    }
    eprint!("{CLEAR}");
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The columns stay in place while the values change, and the line fits on a terminal of 80
    /// columns.
    #[test]
    fn the_line_keeps_its_columns() {
        let line = |speed, lead_gap, role: &str| {
            let live = Live {
                time_s: 107.0,
                speed,
                lead_gap,
                roles: [role.to_owned(), "suspended".to_owned()],
                gap_max_ms: 1_011.3,
                takeovers: 12,
            };
            live.line(120.0)
        };
        let shown = [
            line(0.0, None, "off"),
            line(40.0, Some(7.2), "suspended"),
            line(9.0, Some(5_000.0), "master"),
        ];
        assert!(
            shown[1].contains("144 km/h ahead   7 m A suspended"),
            "{}",
            shown[1]
        );
        for line in &shown {
            assert_eq!(line.find(" B "), shown[0].find(" B "), "{line}");
            assert!(line.len() < 80, "{line}");
        }
    }
}
