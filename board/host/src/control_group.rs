//! Control groups, where the machine grants them.

use std::fs::{self, File};
use std::io;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

/// Where version 2 is mounted: alone, or beside version 1.
const MOUNTS: [&str; 2] = ["/sys/fs/cgroup", "/sys/fs/cgroup/unified"];

/// A group of version 2 around a launcher and all that it starts: nothing that a process starts can
/// leave it unseen, and one write kills all.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ControlGroup {
    path: PathBuf,
}

impl ControlGroup {
    /// Makes a group of this name below the caller's, and kills what a launcher that was killed has
    /// left in it. `None` if the machine does not grant one.
    #[must_use]
    pub fn make(name: &str) -> Option<Self> {
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
    #[must_use]
    pub fn leave(name: &str) -> Option<Self> {
        let path = Self::named("")?.path;
        let inside = path.file_name().is_some_and(|it| it == name);
        let group = Self { path };
        let above = group.path.parent()?.join("cgroup.procs");
        (inside && fs::write(above, "0").is_ok()).then_some(group)
    }

    /// Moves all of these processes into the group, and what they start at the same time. Returns
    /// whether the machine grants it.
    pub fn take(&self, all: impl Fn() -> Vec<u32>) -> bool {
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

    /// Kills all processes of the group.
    pub fn kill(&self) {
        // A kernel before 5.14 does not have it.
        let _ = fs::write(self.path.join("cgroup.kill"), "1");
    }

    /// Removes the group, when no process is left.
    pub fn remove(&self) {
        remove(&self.path);
    }
}

/// Removes a group. Its last processes may still be about to end.
fn remove(path: &Path) {
    for _ in 0..500 {
        match fs::remove_dir(path) {
            Err(error) if error.kind() == io::ErrorKind::ResourceBusy => {
                std::thread::sleep(std::time::Duration::from_millis(2));
            }
            _ => return,
        }
    }
}

/// Groups of version 1 that limit the memory of a process. Version 2 does so only in a group whose
/// parent holds no process, and such a tree is not the launcher's to make.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemoryGroups {
    root: PathBuf,
}

impl MemoryGroups {
    /// Returns the groups below this name; makes none. `None` if the machine has no version 1.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        let own = fs::read_to_string("/proc/self/cgroup").ok()?;
        let own = own.lines().find_map(|line| line.split_once(":memory:/"))?.1;
        let root = Path::new("/sys/fs/cgroup/memory").join(own).join(name);
        Some(Self { root })
    }

    /// Makes a group for a process with this limit, and returns what it writes to, to join.
    ///
    /// # Errors
    /// If the machine does not grant it.
    pub fn make(&self, process: &str, bytes: u64) -> io::Result<OwnedFd> {
        let path = self.root.join(process);
        fs::create_dir_all(&path)?;
        fs::write(path.join("memory.limit_in_bytes"), bytes.to_string())?;
        let procs = File::options()
            .write(true)
            .open(path.join("cgroup.procs"))?;
        Ok(procs.into())
    }

    /// Removes all groups, when no process is left.
    pub fn remove(&self) {
        let groups = fs::read_dir(&self.root).into_iter().flatten().flatten();
        let groups = groups.filter(|it| it.file_type().is_ok_and(|kind| kind.is_dir()));
        groups.for_each(|group| remove(&group.path()));
        remove(&self.root);
    }
}
