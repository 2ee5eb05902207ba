//! The line in the terminal that shows the current state of a run.

use std::io::{IsTerminal as _, stderr};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::termios::tcgetwinsize;
use tandem_processes::live::Live;

const REFRESH: Duration = Duration::from_millis(100);

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

/// Returns one line of fixed columns: time, speed, distance to the vehicle ahead, roles, the
/// largest gap, and the number of takeovers.
fn line(live: &Live, duration_s: f64) -> String {
    let ahead = match live.lead_gap {
        Some(gap) if gap < 999.5 => format!("{gap:3.0} m"),
        _ => "free ".to_owned(),
    };
    let [a, b] = &live.roles;
    format!(
        "{:5.1}/{duration_s:.0} s {:3.0} km/h ahead {ahead} A {a:<9} B {b:<9} gap {:.0} ms, {} taken",
        live.time_s,
        live.speed * 3.6,
        live.gap_max_ms,
        live.takeovers,
    )
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
            eprint!("{CLEAR}{:.columns$}", line(&live, duration_s));
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
            super::line(&live, 120.0)
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
