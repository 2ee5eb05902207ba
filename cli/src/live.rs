//! How a run stands: written by the vehicle some times a second, shown by `tandem run`.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};
use serde::{Deserialize, Serialize};

const REFRESH: Duration = Duration::from_millis(100);

/// How a run stands.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Live {
    /// Scenario time, s.
    pub(crate) time_s: f64,
    /// m/s
    pub(crate) speed: f64,
    /// Roles of A and B as they show them.
    pub(crate) roles: [String; 2],
    /// Longest time between two accepted control frames so far, ms.
    pub(crate) gap_max_ms: f64,
    /// How often the accepted system has changed.
    pub(crate) takeovers: u32,
}

impl Live {
    /// Writes it so that a reader sees the old or the new one, never a part.
    ///
    /// # Errors
    /// If the file system refuses.
    pub(crate) fn write(&self, path: &Path) -> std::io::Result<()> {
        let next = path.with_extension("next");
        fs::write(&next, serde_json::to_vec(self)?)?;
        fs::rename(&next, path)
    }

    fn read(path: &Path) -> Option<Self> {
        serde_json::from_slice(&fs::read(path).ok()?).ok()
    }
}

/// A bar on the terminal that follows the run; nothing if there is no terminal.
pub(crate) struct Progress {
    over: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Progress {
    /// Shows the run whose state is at `path`.
    pub(crate) fn show(path: PathBuf, duration_s: f64) -> Self {
        let bar = ProgressBar::new((duration_s * 10.0).ceil() as u64);
        let over = Arc::new(AtomicBool::new(false));
        let thread = (!bar.is_hidden()).then(|| {
            let style = ProgressStyle::with_template("{bar:24.cyan/dim} {msg}");
            bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.set_message("starting");
            let over = Arc::clone(&over);
            std::thread::spawn(move || follow(&bar, &path, duration_s, &over))
        });
        Self { over, thread }
    }

    /// Clears the bar.
    pub(crate) fn end(mut self) {
        self.over.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // It only shows; if it has panicked, the run is not affected.
            let _ = thread.join();
        }
    }
}

fn follow(bar: &ProgressBar, path: &Path, duration_s: f64, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        if let Some(live) = Live::read(path) {
            bar.set_position((live.time_s * 10.0) as u64);
            let [a, b] = &live.roles;
            bar.set_message(format!(
                "{:5.1} / {duration_s:.0} s  {:4.1} m/s  A {a}  B {b}  largest gap {:.1} ms{}",
                live.time_s,
                live.speed,
                live.gap_max_ms,
                match live.takeovers {
                    0 => String::new(),
                    1 => "  1 takeover".to_owned(),
                    n => format!("  {n} takeovers"),
                }
            ));
        }
        std::thread::sleep(REFRESH);
    }
    bar.finish_and_clear();
}
