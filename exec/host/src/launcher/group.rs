//! A control group (cgroup v2) around the launcher and all that it starts, where the machine grants
//! one: nothing that a process starts can leave it unseen, and one write kills all.

use std::fs;
use std::path::PathBuf;

/// Where version 2 is mounted: alone, or beside version 1.
const MOUNTS: [&str; 2] = ["/sys/fs/cgroup", "/sys/fs/cgroup/unified"];

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ControlGroup {
    path: PathBuf,
}

impl ControlGroup {
    /// Makes a group of this name below the caller's, and kills what a launcher that was killed has
    /// left in it. `None` if the machine does not grant one.
    pub(super) fn make(name: &str) -> Option<Self> {
        let group = Self::named(name)?;
        if group.path.exists() {
            group.kill();
        } else {
            fs::create_dir(&group.path).ok()?;
        }
        Some(group)
    }

    /// Returns the group of this name below the caller's, which may not exist.
    fn named(name: &str) -> Option<Self> {
        let own = fs::read_to_string("/proc/self/cgroup").ok()?;
        let own = own.lines().find_map(|line| line.strip_prefix("0::/"))?;
        let mut mounts = MOUNTS.into_iter().map(PathBuf::from);
        let mount = mounts.find(|mount| mount.join("cgroup.procs").exists())?;
        Some(Self {
            path: mount.join(own).join(name),
        })
    }

    /// Moves the caller out of the group of this name, and returns the group.
    pub(super) fn leave(name: &str) -> Option<Self> {
        let path = Self::named("")?.path;
        let inside = path.file_name().is_some_and(|it| it == name);
        let group = Self { path };
        let above = group.path.parent()?.join("cgroup.procs");
        (inside && fs::write(above, "0").is_ok()).then_some(group)
    }

    /// Moves all of these processes into the group, and what they start at the same time. Returns
    /// whether the machine grants it.
    pub(super) fn take(&self, all: impl Fn() -> Vec<u32>) -> bool {
        let procs = self.path.join("cgroup.procs");
        loop {
            let inside = fs::read_to_string(&procs).unwrap_or_default();
            let is_inside = |pid: &u32| inside.lines().any(|line| line.parse() == Ok(*pid));
            let outside: Vec<u32> = all().into_iter().filter(|pid| !is_inside(pid)).collect();
            // Fails for a process that has ended since. If all fail, it is not granted.
            let moves = |pid: &u32| fs::write(&procs, pid.to_string()).is_ok();
            if outside.is_empty() || outside.iter().filter(|pid| moves(pid)).count() == 0 {
                return outside.is_empty() || !inside.is_empty();
            }
        }
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
