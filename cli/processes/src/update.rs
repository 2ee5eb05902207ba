//! The programming host of a vehicle. It updates both systems one after the other, each while the
//! other system drives. Both approve the release, or none: if one does not take it, the host has
//! the other one go back. U-3, U-5

use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use tandem_board::{CanFrame, Duration, Instant, RoleLamp, SystemId};
use tandem_boot::{Answer, ReleaseStage};
use tandem_boot_host::{FileSender, SigningKey, ToDo};

use crate::boot;
use crate::run_config::UpdateFiles;

/// How long the roles must be stable before an update begins. Dual operation resumes only after two
/// seconds.
const SETTLED: Duration = Duration::from_ms(1_000);
/// Frames of a download per millisecond on a bus of 500 kbit/s.
const FRAMES_PER_MS: usize = 3;
/// Largest number of unacknowledged records.
const WINDOW: u8 = 8;

/// A release that a system runs, and how far it is with it.
type Told = (ReleaseStage, u32);

/// The updates of both systems.
pub(crate) struct Update {
    /// The file for the results.
    ended: PathBuf,
    release: u32,
    tester: SigningKey,
    /// The records for each system. They are removed from here when its update begins.
    lines: [Option<Vec<String>>; 2],
    /// What the host sends now, and to which system.
    under_way: Option<(SystemId, FileSender, Errand)>,
    /// The time since which each system has been ready for an update.
    ready_since: [Option<Instant>; 2],
    /// What each system told last.
    told: [Option<Told>; 2],
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Errand {
    Download,
    RollBack,
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
            release: files.release,
            tester: boot::key_in(&files.tester)?,
            lines: [read(a)?, read(b)?],
            under_way: None,
            ready_since: [None; 2],
            told: [None; 2],
        })
    }

    /// Processes a frame from the bus.
    pub(crate) fn on_frame(&mut self, now: Instant, frame: &CanFrame) {
        if let Some((_, sender, _)) = &mut self.under_way {
            sender.on_frame(now, frame);
        }
        if frame.id() == tandem_boot::RELEASES
            && let Some(Answer::Release {
                system,
                stage,
                version,
            }) = Answer::decode(frame.data())
        {
            self.on_release(system, (stage, version));
        }
    }

    /// Called when a system tells its release.
    fn on_release(&mut self, system: SystemId, told: Told) {
        if self.told[system.index()].replace(told) != Some(told) {
            note(&self.ended, &runs(system, told));
        }
        let is_old = told.0 == ReleaseStage::Approved && told.1 != self.release;
        let goes_back = |(to, _, errand): &(SystemId, FileSender, Errand)| {
            *to == system && *errand == Errand::RollBack
        };
        if is_old && self.under_way.as_ref().is_some_and(goes_back) {
            self.under_way = None;
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
        let Some((system, sender, errand)) = &mut self.under_way else {
            return;
        };
        for _ in 0..FRAMES_PER_MS {
            match sender.next(now) {
                ToDo::Send(frame) => send(&frame),
                ToDo::Wait(_) => return,
                end => {
                    let (system, errand) = (*system, *errand);
                    self.under_way = None;
                    return self.on_end(system, errand, end);
                }
            }
        }
    }

    fn on_end(&mut self, system: SystemId, errand: Errand, end: ToDo) {
        let why = match end {
            ToDo::Done => return note(&self.ended, &taken(system)),
            ToDo::Refused(why) => {
                format!("the bootloader refuses it: {why:?} (docs/boot.md, table of codes)")
            }
            ToDo::Locked(seconds) => format!("no tester may try for {seconds} s"),
            _ => "no bootloader answers".to_owned(),
        };
        let what = match errand {
            Errand::Download => "has not taken the update",
            Errand::RollBack => "has not gone back",
        };
        note(&self.ended, &format!("{system} {what}: {why}\n"));
        self.lines = [None, None];
        let peer = system.peer();
        let goes_back = |told: &Told| told.1 == self.release && told.0 < ReleaseStage::Ready;
        if errand == Errand::Download && self.told[peer.index()].as_ref().is_some_and(goes_back) {
            // Two systems with the same release are better than two releases. A system that is
            // ready does not go back alone.
            let sender = FileSender::rolling_back(peer).proving(peer, self.tester);
            self.under_way = Some((peer, sender, Errand::RollBack));
        }
    }

    /// Begins an update if one is due: first that of the standby, then that of the master, after
    /// the new release has worked on the other system and dual operation has resumed. The master
    /// hands over when it receives the request.
    fn begin(&mut self, now: Instant, roles: [RoleLamp; 2]) {
        for system in SystemId::ALL {
            let peer = system.peer();
            let works = self.told[peer.index()].is_some_and(|(stage, version)| {
                version == self.release && stage > ReleaseStage::Trial
            });
            let is_ready = match (roles[system.index()], roles[peer.index()]) {
                (RoleLamp::Standby, RoleLamp::Master | RoleLamp::DegradedMaster) => {
                    works || self.lines[peer.index()].is_some()
                }
                (RoleLamp::Master, RoleLamp::Standby) => works,
                _ => false,
            };
            let since = &mut self.ready_since[system.index()];
            if !is_ready {
                *since = None;
                continue;
            }
            let settled = now.since(*since.get_or_insert(now)) >= SETTLED;
            if settled && let Some(lines) = self.lines[system.index()].take() {
                let sender = FileSender::new(lines, Some(system), WINDOW);
                let sender = sender.proving(system, self.tester);
                self.under_way = Some((system, sender, Errand::Download));
                return;
            }
        }
    }
}

/// Returns the line about a system that has taken its update.
fn taken(system: SystemId) -> String {
    format!("{system} has taken the update\n")
}

/// Returns the line about what a system runs.
fn runs(system: SystemId, (stage, version): Told) -> String {
    let stage = match stage {
        ReleaseStage::Trial => "on trial",
        ReleaseStage::Works => "on trial, works",
        ReleaseStage::Ready => "on trial, ready",
        ReleaseStage::Approved => "approved",
    };
    format!("{system} runs release {version}, {stage}\n")
}

/// Returns what the results of the updates to a release, one line each, say against the run.
pub fn objections(results: &str, release: u32) -> Vec<String> {
    let last = |system: SystemId| {
        let about = format!("{system} runs release ");
        results.lines().rfind(|line| line.starts_with(&about))
    };
    let approved = |system: SystemId| runs(system, (ReleaseStage::Approved, release));
    let is_good = |system: &SystemId| last(*system) == Some(approved(*system).trim_end());
    let mut objections: Vec<String> = SystemId::ALL
        .into_iter()
        .filter(|system| !is_good(system))
        .map(|system| {
            let refused = |line: &&str| line.starts_with(&format!("{system} has not"));
            let told = results.lines().find(refused).or_else(|| last(system));
            told.map_or_else(|| format!("{system} keeps its release"), str::to_owned)
        })
        .collect();
    let version = |system| last(system).and_then(|line| line.split([' ', ',']).nth(3));
    let versions = SystemId::ALL.map(version);
    if versions[0] != versions[1] {
        let [a, b] = versions.map(|version| version.unwrap_or("unknown"));
        objections.push(format!("the systems have different releases: A {a}, B {b}"));
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

    /// U-5: an update is good only if both systems have approved it.
    #[test]
    fn an_update_of_one_system_is_an_objection() {
        let refused = "A has not taken the update: the bootloader refuses it: Downgrade";
        let [old, works, new] = [
            (ReleaseStage::Approved, 1),
            (ReleaseStage::Works, 2),
            (ReleaseStage::Approved, 2),
        ];
        let [a, b] = SystemId::ALL.map(|system| move |told| runs(system, told));
        let mixed = "the systems have different releases: A 1, B 2";
        for (results, expected) in [
            (taken(SystemId::B) + &b(works) + &a(new) + &b(new), vec![]),
            (
                a(old) + &b(works) + refused,
                vec![refused, "B runs release 2, on trial, works", mixed],
            ),
            (
                a(old) + &b(works) + refused + "\n" + &b(old),
                vec![refused, "B runs release 1, approved"],
            ),
            (a(old) + &b(new), vec!["A runs release 1, approved", mixed]),
            (
                String::new(),
                vec!["A keeps its release", "B keeps its release"],
            ),
        ] {
            assert_eq!(objections(&results, 2), expected);
        }
    }
}
