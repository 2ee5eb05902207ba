//! Runs one `tandem` command under test, with all processes and files that it creates.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// No run of these tests takes longer than this, even on a busy machine.
const WATCHDOG: Duration = Duration::from_secs(120);
const LOOK_AGAIN: Duration = Duration::from_millis(20);
/// Checks that the command rejects these arguments with a message that contains all of `words`.
pub(crate) fn refuses(fixture: &Fixture, args: &[&str], words: &[&str]) {
    let before = fixture.names();
    let output = fixture.output(args);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
    for word in words {
        assert!(
            said.contains(word),
            "{args:?} does not say {word:?}: {said}"
        );
    }
    assert!(output.stdout.is_empty(), "{args:?}");
    assert_eq!(fixture.names(), before, "{args:?} has left something");
}

/// A temporary folder, and a lock for the machine's CPUs.
pub(crate) struct Fixture {
    folder: TempDir,
    _turn: File,
}

impl Fixture {
    /// Creates a fixture that may run at the same time as other tests.
    pub(crate) fn new() -> Self {
        let turn = turn();
        turn.lock_shared().unwrap();
        Self::with(turn)
    }

    /// Waits until no other test has a run. For tests that block a CPU or check times.
    pub(crate) fn alone() -> Self {
        let turn = turn();
        turn.lock().unwrap();
        Self::with(turn)
    }

    fn with(turn: File) -> Self {
        Self {
            folder: tempfile::tempdir().unwrap(),
            _turn: turn,
        }
    }

    pub(crate) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Returns the command with these arguments, in the fixture's folder.
    pub(crate) fn command(&self, args: &[&str]) -> Command {
        let mut command = Command::new(crate::PROGRAM);
        command
            .args(args)
            .current_dir(self.folder())
            .stdin(Stdio::null());
        command
    }

    /// Runs the command to its end.
    pub(crate) fn output(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    /// Starts `tandem run --json` with additional arguments.
    pub(crate) fn run(&self, args: &[&str]) -> Run {
        self.run_by(self.command(&[]), args)
    }

    /// Starts `tandem run --json` by a command that starts `tandem`.
    pub(crate) fn run_by(&self, mut command: Command, args: &[&str]) -> Run {
        let number = fs::read_dir(self.folder()).unwrap().count();
        let stdout = self.folder().join(format!("{number}.stdout"));
        let stderr = self.folder().join(format!("{number}.stderr"));
        command.args(["run", "--json"]).args(args);
        command
            .stdout(File::create(&stdout).unwrap())
            .stderr(File::create(&stderr).unwrap());
        let launcher = command.spawn().unwrap();
        let name = format!("tandem-{}-", launcher.id());
        Run {
            launcher,
            name,
            stdout,
            stderr,
            since: Instant::now(),
        }
    }

    /// Returns the names in the fixture's folder, without the output of runs.
    pub(crate) fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.folder()).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.filter(|name| !name.contains(".std")).collect();
        names.sort();
        names
    }
}

fn turn() -> File {
    File::create(Path::new(env!("CARGO_TARGET_TMPDIR")).join("turn.lock")).unwrap()
}

/// Checks the properties of a run that no stall of the machine may break.
pub(crate) fn sound(metrics: &Value) {
    assert_eq!(metrics["collisions"], 0, "{metrics:#}");
    assert_eq!(metrics["false_takeovers"], 0, "{metrics:#}");
    assert_eq!(metrics["two_masters_ms"], 0.0, "{metrics:#}");
    let ms = |name: &str| metrics[name].as_f64().unwrap();
    let both_ms = ms("both_transmitted_ms");
    assert!(both_ms <= ms("hand_over_ms"), "{metrics:#}");
    let left = metrics["leftovers"].as_array().map(Vec::len);
    assert_eq!(left, Some(0), "{metrics:#}");
}

/// Returns the takeovers of a run, except those from a master that the machine had held up. A busy
/// machine adds such takeovers to any run.
pub(crate) fn takeovers(metrics: &Value) -> Vec<&Value> {
    let takeovers = metrics["takeovers"].as_array().unwrap().iter();
    takeovers.filter(|it| it["held_up"] != true).collect()
}

/// A running `tandem run`. Dropping it kills all its processes.
pub(crate) struct Run {
    launcher: Child,
    /// Prefix of the run's name.
    name: String,
    stdout: PathBuf,
    stderr: PathBuf,
    since: Instant,
}

/// One line of `tandem ps --json`.
#[derive(Clone, Debug)]
pub(crate) struct Process {
    pub(crate) pid: i32,
    pub(crate) kind: String,
    pub(crate) system: Option<String>,
    pub(crate) core: Option<u64>,
    pub(crate) role: Option<String>,
}

impl Run {
    /// Returns the processes of the run that `tandem ps` lists.
    pub(crate) fn processes(&self) -> Vec<Process> {
        let output = Command::new(crate::PROGRAM)
            .args(["ps", "--json"])
            .output()
            .unwrap();
        let all: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
        let text = |value: &Value| value.as_str().map(str::to_owned);
        let processes = all.iter().map(|process| Process {
            pid: process["pid"].as_i64().unwrap() as i32,
            kind: text(&process["kind"]).unwrap(),
            system: text(&process["system"]),
            core: process["core"].as_u64(),
            role: text(&process["role"]),
        });
        // Ignore other runs on this machine.
        processes
            .filter(|process| self.is_mine(process.pid))
            .collect()
    }

    fn is_mine(&self, pid: i32) -> bool {
        let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split(|byte| *byte == 0)
            .any(|word| word.starts_with(self.name.as_bytes()))
    }

    /// Waits until `found` returns a value for the list of processes.
    pub(crate) fn until<T>(&self, what: &str, mut found: impl FnMut(&[Process]) -> Option<T>) -> T {
        loop {
            let processes = self.processes();
            if let Some(it) = found(&processes) {
                return it;
            }
            assert!(
                self.since.elapsed() < WATCHDOG,
                "{what} never came: {processes:?}\n{}",
                self.said()
            );
            std::thread::sleep(LOOK_AGAIN);
        }
    }

    /// Waits until one system drives and the other system stands by.
    pub(crate) fn until_dual(&self) {
        self.until("dual operation", |processes| {
            let roles = |role: &str| {
                let with_role =
                    |p: &&Process| p.kind == "supply" && p.role.as_deref() == Some(role);
                processes.iter().filter(with_role).count()
            };
            (roles("master") == 1 && roles("standby") == 1).then_some(())
        });
    }

    /// Waits for the supply of the system that drives, and returns it.
    pub(crate) fn master_supply(&self) -> Process {
        self.until("a master", |processes| {
            let is_it = |p: &&Process| p.kind == "supply" && p.role.as_deref() == Some("master");
            processes.iter().find(is_it).cloned()
        })
    }

    /// Waits for the process of a core, and returns its id.
    pub(crate) fn core(&self, system: &str, core: u64) -> i32 {
        let is_it = |p: &&Process| p.core == Some(core) && p.system.as_deref() == Some(system);
        self.until("the core", |processes| {
            processes.iter().find(is_it).map(|process| process.pid)
        })
    }

    /// Returns the process id of `tandem run` itself.
    pub(crate) fn launcher_pid(&self) -> i32 {
        self.launcher.id() as i32
    }

    /// Waits for the end of `tandem run`.
    pub(crate) fn end(&mut self) -> ExitStatus {
        loop {
            if let Some(status) = self.launcher.try_wait().unwrap() {
                return status;
            }
            assert!(
                self.since.elapsed() < WATCHDOG,
                "the run does not end:\n{}",
                self.said()
            );
            std::thread::sleep(LOOK_AGAIN);
        }
    }

    /// Waits until a run has ended by itself. Returns its figures, after checking them with
    /// [`sound`]. The exit status may be 1, because the machine may break time bounds.
    pub(crate) fn metrics(&mut self) -> Value {
        let status = self.end();
        assert!(
            matches!(status.code(), Some(0 | 1)),
            "{status}\n{}",
            self.said()
        );
        self.figures()
    }

    /// Sends Ctrl-C to the run, and waits for its end. Returns the figures of the drive up to that
    /// time, after checking them with [`sound`].
    pub(crate) fn interrupt(&mut self) -> Value {
        send(self.launcher_pid(), Signal::INT);
        let status = self.end();
        assert_eq!(status.code(), Some(130), "{}", self.said());
        self.figures()
    }

    /// Returns the figures that an ended run printed, after checking them with [`sound`].
    fn figures(&self) -> Value {
        let figures = self.printed();
        sound(&figures);
        assert!(!self.said().contains("panicked"), "{}", self.said());
        figures
    }

    /// Returns the figures that an ended run printed on stdout.
    pub(crate) fn printed(&self) -> Value {
        let text = fs::read_to_string(&self.stdout).unwrap();
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {}", self.said()))
    }

    /// Waits until the run has no process.
    pub(crate) fn until_vanished(&self) {
        self.until("the end of all processes", |processes| {
            processes.is_empty().then_some(())
        });
    }

    /// Returns its output on stderr.
    pub(crate) fn said(&self) -> String {
        fs::read_to_string(&self.stderr).unwrap()
    }

    /// Checks that no file of this run remains on the machine.
    pub(crate) fn left_nothing(&self) {
        let files = self.files();
        assert!(files.is_empty(), "{files:?}");
    }

    /// Returns the files of this run on the machine.
    fn files(&self) -> Vec<PathBuf> {
        ["/dev/shm", "/tmp"]
            .iter()
            .flat_map(|folder| fs::read_dir(folder).unwrap())
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.to_string_lossy().contains(&self.name))
            .collect()
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.launcher.kill();
        let _ = self.launcher.wait();
        for process in self.processes() {
            kill(process.pid);
        }
    }
}

/// Kills a process. The process may have ended already.
pub(crate) fn kill(pid: i32) {
    send(pid, Signal::KILL);
}

/// Sends a signal. The process may have ended already.
pub(crate) fn send(pid: i32, signal: Signal) {
    let _ = kill_process(Pid::from_raw(pid).unwrap(), signal);
}
