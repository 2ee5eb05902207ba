//! Finds and kills what processes have started: a process must not escape by a fork.

use std::fs;
use std::os::unix::ffi::OsStrExt as _;

use rustix::process::{Pid, Signal, WaitOptions, kill_process, waitpid};
use tandem_board_host::spawn;

/// Environment variable that names the process of the manifest; descendants inherit it.
pub(super) const MARK: &str = "TANDEM_EXEC_PROCESS";

#[derive(Clone, Copy, Debug)]
struct Entry {
    pid: u32,
    parent: u32,
    is_zombie: bool,
}

/// Returns all processes of the machine that `/proc` shows.
fn all() -> Vec<Entry> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = entries.filter_map(|entry| {
        let name = entry.file_name();
        std::str::from_utf8(name.as_bytes()).ok()?.parse().ok()
    });
    pids.filter_map(|pid: u32| {
        let stat = fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
        // Field 2, the name, may hold any character: count from its closing bracket. proc(5)
        let mut fields = stat.rsplit_once(')')?.1.split_whitespace();
        let is_zombie = matches!(fields.next()?, "Z" | "X");
        let parent = fields.next()?.parse().ok()?;
        Some(Entry {
            pid,
            parent,
            is_zombie,
        })
    })
    .collect()
}

/// Returns all descendants of this process that have not ended. Waits for the children among them
/// that have ended, but for those in `known`.
pub(super) fn living(known: &[u32]) -> Vec<u32> {
    let all = all();
    let own = std::process::id();
    let mut found = vec![];
    let mut parents = vec![own];
    while let Some(parent) = parents.pop() {
        for entry in all.iter().filter(|entry| entry.parent == parent) {
            parents.push(entry.pid);
            if !entry.is_zombie {
                found.push(entry.pid);
            } else if parent == own && !known.contains(&entry.pid) {
                reap(entry.pid);
            }
        }
    }
    found
}

/// Kills the orphans that this process of the manifest has left: they are children of the launcher
/// now. Waits for those that have ended, whoever left them. `known` are the manifest's processes.
pub(super) fn kill_orphans_of(name: &str, known: &[u32]) {
    let own = std::process::id();
    for entry in all() {
        if entry.parent != own || known.contains(&entry.pid) {
            continue;
        }
        if entry.is_zombie {
            reap(entry.pid);
        } else if is_marked(entry.pid, name) {
            signal(entry.pid, Signal::KILL);
        }
    }
}

fn is_marked(pid: u32, name: &str) -> bool {
    let mark = format!("{MARK}={name}");
    let environment = fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
    environment
        .split(|byte| *byte == 0)
        .any(|variable| variable == mark.as_bytes())
}

/// Waits for a child that has ended.
fn reap(pid: u32) {
    // Fails if it was waited for since.
    let _ = waitpid(spawn::pid(pid), WaitOptions::NOHANG);
}

fn signal(pid: u32, signal: Signal) {
    // Fails if it has ended since.
    let _ = spawn::pid(pid).map(|pid: Pid| kill_process(pid, signal));
}

/// Sends a signal to all descendants. Returns their number.
pub(super) fn signal_all(of: Signal) -> usize {
    let found = living(&[]);
    found.iter().for_each(|pid| signal(*pid, of));
    found.len()
}
