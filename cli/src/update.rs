//! The programming host of a vehicle. It updates both systems one after the other, each while the
//! other system drives. If one does not take its update, the host gives up. U-3, U-5

use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tandem_board::{CanFrame, Duration, Instant, RoleLamp, SystemId};
use tandem_boot_host::{FileSender, ToDo};

use crate::run_config::UpdateFiles;

/// How long the roles must be stable before an update begins. By then a system that was just
/// updated has approved its image: on the host within a second after it has a role, under the
/// emulator after a second with a role. Dual operation resumes only after two seconds.
const SETTLED: Duration = Duration::from_ms(1_000);
/// Frames of a download per millisecond on a bus of 500 kbit/s.
const FRAMES_PER_MS: usize = 3;
/// Largest number of unacknowledged records.
const WINDOW: u8 = 8;

/// The updates of both systems.
pub(crate) struct Update {
    /// The file for the results.
    ended: PathBuf,
    /// The records for each system. They are removed from here when its update begins.
    lines: [Option<Vec<String>>; 2],
    under_way: Option<(SystemId, FileSender)>,
    /// The time since which each system has been ready for an update.
    ready_since: [Option<Instant>; 2],
}

impl Update {
    /// Reads the updates from these files.
    ///
    /// # Errors
    /// If a file cannot be read.
    pub(crate) fn read(files: &UpdateFiles) -> anyhow::Result<Self> {
        let read = |path: &PathBuf| {
            let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
            anyhow::Ok(Some(
                text.split_inclusive('\n').map(str::to_owned).collect(),
            ))
        };
        let [a, b] = &files.lines;
        Ok(Self {
            ended: files.ended.clone(),
            lines: [read(a)?, read(b)?],
            under_way: None,
            ready_since: [None; 2],
        })
    }

    /// Processes a frame from the bus.
    pub(crate) fn on_frame(&mut self, now: Instant, frame: &CanFrame) {
        if let Some((_, sender)) = &mut self.under_way {
            sender.on_frame(now, frame);
        }
    }

    /// Sends the frames of this millisecond. `roles` are the roles that the systems display.
    pub(crate) fn poll(
        &mut self,
        now: Instant,
        roles: [RoleLamp; 2],
        send: &mut dyn FnMut(&CanFrame),
    ) {
        if self.under_way.is_none() {
            self.begin(now, roles);
        }
        let Some((system, sender)) = &mut self.under_way else {
            return;
        };
        for _ in 0..FRAMES_PER_MS {
            match sender.next(now) {
                ToDo::Send(frame) => send(&frame),
                ToDo::Wait(_) => return,
                end => {
                    let line = match end {
                        ToDo::Done => taken(*system),
                        ToDo::Refused(why) => format!(
                            "{system} has not taken the update: the bootloader refuses it: {why:?} \
                             (docs/boot.md, table of codes)\n"
                        ),
                        _ => format!("{system} has not taken the update: no bootloader answers\n"),
                    };
                    note(&self.ended, &line);
                    if !matches!(end, ToDo::Done) {
                        // Two systems with the same release are better than two releases.
                        self.lines = [None, None];
                    }
                    self.under_way = None;
                    return;
                }
            }
        }
    }

    /// Begins an update if one is due: first that of the standby, then that of the master, after
    /// dual operation has resumed. The master hands over when it receives the request.
    fn begin(&mut self, now: Instant, roles: [RoleLamp; 2]) {
        for system in SystemId::ALL {
            let peer = system.peer();
            let is_ready = match (roles[system.index()], roles[peer.index()]) {
                (RoleLamp::Standby, RoleLamp::Master | RoleLamp::DegradedMaster) => true,
                (RoleLamp::Master, RoleLamp::Standby) => self.lines[peer.index()].is_none(),
                _ => false,
            };
            let since = &mut self.ready_since[system.index()];
            if !is_ready {
                *since = None;
                continue;
            }
            let settled = now.since(*since.get_or_insert(now)) >= SETTLED;
            if settled && let Some(lines) = self.lines[system.index()].take() {
                self.under_way = Some((system, FileSender::new(lines, Some(system), WINDOW)));
                return;
            }
        }
    }
}

/// Returns the line about a system that has taken its update.
fn taken(system: SystemId) -> String {
    format!("{system} has taken the update\n")
}

/// Returns what the results of the updates, one line each, say against the run.
pub(crate) fn objections(results: &str) -> Vec<String> {
    let has_taken = |system: &SystemId| results.contains(&taken(*system));
    let mut objections: Vec<String> = SystemId::ALL
        .iter()
        .filter(|system| !has_taken(system))
        .map(|system| {
            let told = results
                .lines()
                .find(|line| line.starts_with(&format!("{system} has not taken")));
            told.map_or_else(|| format!("{system} keeps its release"), str::to_owned)
        })
        .collect();
    if let [_] = objections[..] {
        objections.push("the systems have different releases".to_owned());
    }
    objections
}

/// Appends a line to the results. If that fails, the end of the run reports the missing update.
fn note(path: &Path, line: &str) {
    let file = File::options().create(true).append(true).open(path);
    let _ = file.and_then(|mut file| file.write_all(line.as_bytes()));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// U-5: an update is good only if both systems have taken it.
    #[test]
    fn an_update_of_one_system_is_an_objection() {
        let refused = "A has not taken the update: the bootloader refuses it: Downgrade";
        for (results, expected) in [
            (taken(SystemId::B) + &taken(SystemId::A), vec![]),
            (
                taken(SystemId::B) + refused,
                vec![refused, "the systems have different releases"],
            ),
            (refused.to_owned(), vec![refused, "B keeps its release"]),
            (
                String::new(),
                vec!["A keeps its release", "B keeps its release"],
            ),
        ] {
            assert_eq!(objections(&results), expected);
        }
    }
}
