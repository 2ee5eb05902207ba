//! A control group (cgroup v2) around the launcher and all that it starts, where the machine grants
//! one: nothing that a process starts can leave it unseen, and one write kills all.

use std::fs;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Where version 2 is mounted: alone, or beside version 1.
const MOUNTS: [&str; 2] = ["/sys/fs/cgroup", "/sys/fs/cgroup/unified"];

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ControlGroup {
    path: PathBuf,
}

impl ControlGroup {
    /// Moves the caller into a group of this name below its own, and kills what a launcher that was
    /// killed has left in it. `None` if the machine does not grant one.
    pub(super) fn join(name: &str) -> Option<Self> {
        let own = fs::read_to_string("/proc/self/cgroup").ok()?;
        let own = own.lines().find_map(|line| line.strip_prefix("0::/"))?;
        let mut mounts = MOUNTS.into_iter().map(PathBuf::from);
        let mount = mounts.find(|mount| mount.join("cgroup.procs").exists())?;
        let group = Self {
            path: mount.join(own).join(name),
        };
        if group.path.exists() {
            group.kill();
        } else {
            fs::create_dir(&group.path).ok()?;
        }
        let joined = fs::write(group.path.join("cgroup.procs"), "0");
        joined.is_ok().then_some(group)
    }

    pub(super) fn kill(&self) {
        // A kernel before 5.14 does not have it.
        let _ = fs::write(self.path.join("cgroup.kill"), "1");
    }

    /// Removes the group. Its last processes may still be about to end.
    pub(super) fn remove(&self) {
        for _ in 0..500 {
            match fs::remove_dir(&self.path) {
                Err(error) if error.kind() == std::io::ErrorKind::ResourceBusy => {
                    std::thread::sleep(std::time::Duration::from_millis(2));
                }
                _ => return,
            }
        }
    }
}
