//! Finds and ends what processes have started: a process must not escape by a fork.

use std::fs;

use rustix::process::{Signal, WaitOptions, waitpid};

use crate::process_list::{Stat, pids};
use crate::spawn;

fn all() -> impl Iterator<Item = (u32, Stat)> {
    pids().filter_map(|pid| Some((pid, Stat::read(pid)?)))
}

/// Returns all descendants of this process that have not ended. Waits for the children among them
/// that have ended, except those in `known`.
#[must_use]
pub fn living(known: &[u32]) -> Vec<u32> {
    let all: Vec<_> = all().collect();
    let own = std::process::id();
    let (mut found, mut parents) = (vec![], vec![own]);
    while let Some(parent) = parents.pop() {
        for (pid, stat) in all.iter().filter(|(_, stat)| stat.parent == parent) {
            parents.push(*pid);
            if !stat.has_ended {
                found.push(*pid);
            } else if parent == own && !known.contains(pid) {
                reap(*pid);
            }
        }
    }
    found
}

/// Sends a signal to all descendants of this process. Returns their number.
pub fn signal_all(signal: Signal) -> usize {
    let found = living(&[]);
    found.iter().for_each(|pid| spawn::signal(*pid, signal));
    found.len()
}

/// Kills the children of this process with this variable (`NAME=value`) in their environment, and
/// waits for all children that have ended; both except those in `known`. A subreaper thus ends what
/// a process has left that it started with the variable.
pub fn kill_orphans(mark: &str, known: &[u32]) {
    let own = std::process::id();
    for (pid, stat) in all() {
        if stat.parent != own || known.contains(&pid) {
            continue;
        }
        let environment = || fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
        if stat.has_ended {
            reap(pid);
        } else if environment()
            .split(|it| *it == 0)
            .any(|it| it == mark.as_bytes())
        {
            spawn::signal(pid, Signal::KILL);
        }
    }
}

/// Waits for a child that has ended. No effect if it was waited for since.
fn reap(pid: u32) {
    let _ = waitpid(spawn::pid(pid), WaitOptions::NOHANG);
}
