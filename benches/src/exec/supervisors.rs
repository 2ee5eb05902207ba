//! Supervisors that start ten processes, each set up as its documentation advises.
//!
//! | supervisor | how a process reports | who says that all are ready |
//! |---|---|---|
//! | `tandem exec run` | `READY=1` to `NOTIFY_SOCKET` | the launcher, by its event `reached` |
//! | s6 | a newline to descriptor 3 | `s6-svwait -U` |
//! | runit | not at all | the processes themselves |
//! | `systemd --user` | `READY=1` to `NOTIFY_SOCKET` | the manager, by `STATUS=Ready.` |

use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};
use std::fs::{self, Permissions};
use std::io;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Processes that a supervisor starts.
pub(crate) const PROCESSES: usize = 10;
/// Where version 2 of control groups is mounted: alone, or beside version 1.
const CGROUPS: [&str; 2] = ["/sys/fs/cgroup/unified", "/sys/fs/cgroup"];
const SYSTEMD: &str = "/lib/systemd/systemd";
/// How long a supervisor may take to stop.
const STOP_WITHIN: Duration = Duration::from_secs(10);

/// Gives systemd what it demands: a folder that says that the machine was booted by systemd, and a
/// tree of control groups and process ids of its own. Without the latter it would move all
/// processes of the machine's root group. The group's path is `$1`. A newline tells that all is
/// made.
const IN_NAMESPACES: &str = "echo $$ > $1/cgroup.procs && exec unshare --mount --cgroup --pid \
    --fork --kill-child --mount-proc --propagation private sh -c '\
    mount -t cgroup2 none /sys/fs/cgroup && mount -t tmpfs none /run && \
    mkdir -p /run/systemd/system && echo && \
    /lib/systemd/systemd --user --unit=ten.target; exit $?'";

/// A program that starts and restarts processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Supervisor {
    Tandem,
    S6,
    Runit,
    Systemd,
}

impl Supervisor {
    /// The protocol by which a process reports, as `ready.c` names it.
    fn protocol(self) -> &'static str {
        match self {
            Self::Tandem | Self::Systemd => "notify",
            Self::S6 => "fd3",
            Self::Runit => "none",
        }
    }

    /// Returns its program.
    fn program(self) -> io::Result<PathBuf> {
        let missing = |what: &str, package: &str| {
            io::Error::other(format!("{what} is not installed ({package})"))
        };
        let (name, package) = match self {
            Self::Tandem => return tandem().ok_or_else(|| missing("tandem", "cargo build")),
            Self::S6 => ("s6-svscan", "s6"),
            Self::Runit => ("runsvdir", "runit"),
            Self::Systemd => (SYSTEMD, "systemd"),
        };
        let path = std::env::var_os("PATH").unwrap_or_default();
        let found = std::env::split_paths(&path).map(|folder| folder.join(name));
        let mut found = found.filter(|path| path.exists());
        found.next().ok_or_else(|| missing(name, package))
    }

    /// Writes its description of ten processes that run `program` to this folder.
    pub(crate) fn describe(self, folder: &Path, program: &Path, witness: &Path) -> io::Result<()> {
        let names: Vec<String> = (0..PROCESSES).map(|index| format!("p{index}")).collect();
        let (program, witness) = (program.display(), witness.display());
        let protocol = self.protocol();
        let line = |index: usize| format!("{program} {protocol} {index} {witness}");
        let units = folder.join("systemd/user");
        match self {
            Self::Tandem => return fs::write(manifest(folder), tandem_manifest(&names, &line)),
            Self::Systemd => {
                fs::create_dir_all(&units)?;
                let names = names.join(".service ") + ".service";
                let target = format!("[Unit]\nWants={names}\nAfter={names}\n");
                fs::write(units.join("ten.target"), target)?;
            }
            Self::S6 | Self::Runit => {}
        }
        for (index, name) in names.iter().enumerate() {
            let line = line(index);
            if self == Self::Systemd {
                let unit = format!(
                    "[Service]\nType=notify\nExecStart={line}\nRestart=always\nRestartSec=0\n"
                );
                fs::write(units.join(format!("{name}.service")), unit)?;
                continue;
            }
            let service = folder.join(name);
            fs::create_dir(&service)?;
            let run = service.join("run");
            let shell = match self {
                Self::S6 => "/usr/bin/execlineb -P\n",
                _ => "/bin/sh\nexec ",
            };
            fs::write(&run, format!("#!{shell}{line}\n"))?;
            fs::set_permissions(run, Permissions::from_mode(0o755))?;
            if self == Self::S6 {
                fs::write(service.join("notification-fd"), "3\n")?;
            }
        }
        Ok(())
    }

    /// Starts it over the processes that this folder describes. It and all that it starts hold
    /// `leash` as their stdout.
    pub(crate) fn start(self, folder: &Path, leash: Stdio, notify: &Path) -> io::Result<Running> {
        let program = self.program()?;
        let group = match self {
            Self::Systemd => Some(Group::new()?),
            _ => None,
        };
        let mut command = Command::new(program);
        let end = match self {
            Self::Runit => Signal::HUP,
            Self::Systemd => Signal::KILL,
            Self::Tandem | Self::S6 => Signal::TERM,
        };
        match &group {
            None if self == Self::Tandem => {
                command
                    .args(["exec", "run", "--json"])
                    .arg(manifest(folder));
            }
            None => {
                command.arg(folder);
            }
            Some(group) => {
                command = Command::new("/bin/sh");
                command.args(["-c", IN_NAMESPACES, "sh"]).arg(&group.0);
                command.env("XDG_RUNTIME_DIR", "/run").env("HOME", folder);
                command.env("XDG_CONFIG_HOME", folder);
                command.env_remove("DBUS_SESSION_BUS_ADDRESS");
            }
        }
        command.env("NOTIFY_SOCKET", notify).process_group(0);
        command
            .stdin(Stdio::null())
            .stdout(leash)
            .stderr(Stdio::null());
        // SAFETY: between fork and exec it makes one system call.
        unsafe {
            command.pre_exec(move || Ok(set_parent_process_death_signal(Some(end))?));
        }
        let child = command.spawn()?;
        Ok(Running { child, end, group })
    }
}

/// Returns the `tandem` beside this program; a test's program lies one folder below.
fn tandem() -> Option<PathBuf> {
    let this = std::env::current_exe().ok()?;
    let beside = this
        .ancestors()
        .skip(1)
        .take(2)
        .map(|folder| folder.join("tandem"));
    beside.into_iter().find(|path| path.is_file())
}

fn manifest(folder: &Path) -> PathBuf {
    folder.join("manifest.toml")
}

fn tandem_manifest(names: &[String], line: &dyn Fn(usize) -> String) -> String {
    let mut text = "version = 1\ninitial = \"ten\"\n".to_owned();
    for (index, name) in names.iter().enumerate() {
        let line = line(index);
        let mut words = line.split(' ');
        let program = words.next().unwrap_or_default();
        let arguments: Vec<&str> = words.collect();
        text += &format!(
            "\n[[process]]\nname = \"{name}\"\nprogram = {program:?}\narguments = {arguments:?}\n\
             ready = \"report\"\nrestart = {{ times = 1000, pause = \"0ms\" }}\n"
        );
    }
    text + &format!("\n[[target]]\nname = \"ten\"\nprocesses = {names:?}\n")
}

/// A control group of version 2 for systemd, so that it sees no other.
struct Group(PathBuf);

impl Group {
    fn new() -> io::Result<Self> {
        let root = CGROUPS
            .map(Path::new)
            .into_iter()
            .find(|root| root.join("cgroup.procs").exists());
        let root = root.ok_or_else(|| io::Error::other("systemd cannot run here: no cgroup v2"))?;
        let path = root.join(format!("tandem-bench-{}", crate::harness::next_run()));
        fs::create_dir(&path).map_err(|error| {
            io::Error::other(format!(
                "systemd cannot run here: {}: {error}",
                path.display()
            ))
        })?;
        Ok(Self(path))
    }
}

impl Drop for Group {
    /// Kills what is left, and removes the group with those that systemd has made below it.
    fn drop(&mut self) {
        let _ = fs::write(self.0.join("cgroup.kill"), "1");
        let begin = Instant::now();
        while remove_groups(&self.0).is_err() && begin.elapsed() < STOP_WITHIN {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn remove_groups(group: &Path) -> io::Result<()> {
    for entry in fs::read_dir(group)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            remove_groups(&entry.path())?;
        }
    }
    fs::remove_dir(group)
}

/// A supervisor that runs. Dropping it stops it and waits for it.
pub(crate) struct Running {
    child: Child,
    end: Signal,
    group: Option<Group>,
}

impl Running {
    /// Returns whether it has ended, and how.
    pub(crate) fn has_ended(&mut self) -> Option<String> {
        let status = self.child.try_wait().ok().flatten()?;
        Some(format!("the supervisor ended with {status}"))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            let _ = kill_process(pid, self.end);
        }
        let begin = Instant::now();
        while self.has_ended().is_none() {
            if begin.elapsed() > STOP_WITHIN {
                let _ = self.child.kill();
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        drop(self.group.take());
    }
}
