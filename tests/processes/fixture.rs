//! One `tandem` command under test, and everything that it started.

use std::cell::Cell;
use std::fs::{self, File};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::rc::Rc;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

/// No run of these tests takes longer than this, however busy the machine is.
const WATCHDOG: Duration = Duration::from_secs(120);
const LOOK_AGAIN: Duration = Duration::from_millis(20);
/// A longer stall of the machine makes a sound master fall silent: docs/redundancy.md, profile rt.
const TOLERATED_STALL_MS: f64 = 5.0;
/// How often a test is tried whose runs met longer stalls.
const ATTEMPTS: u32 = 5;

/// A test that says when which system drives. If it fails and a run of it met a stall that no
/// profile tolerates, it is tried again; what no stall may cause, such as two masters, fails it.
pub(crate) fn unless_stalled(test: impl Fn(&Fixture)) {
    for attempt in 1.. {
        let fixture = Fixture::new();
        let Err(failure) = catch_unwind(AssertUnwindSafe(|| test(&fixture))) else {
            return;
        };
        let stalled_ms = fixture.seen.stalled_ms.get();
        let is_excused = stalled_ms > TOLERATED_STALL_MS && !fixture.seen.harm.get();
        if attempt == ATTEMPTS || !is_excused {
            resume_unwind(failure);
        }
        eprintln!("tried again: the machine stood still for {stalled_ms} ms");
    }
}

/// What the runs of a failed test saw, by their own verdict.
#[derive(Default)]
struct Seen {
    /// The longest stall of the machine.
    stalled_ms: Cell<f64>,
    /// What must never happen, whatever the machine does.
    harm: Cell<bool>,
}

/// The command must refuse these arguments and say all of `words`.
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

/// A folder of its own, and the right to use the machine's CPUs: two runs at a time would only
/// measure each other.
pub(crate) struct Fixture {
    folder: TempDir,
    seen: Rc<Seen>,
    _turn: File,
}

impl Fixture {
    pub(crate) fn new() -> Self {
        let turn = File::create(Path::new(env!("CARGO_TARGET_TMPDIR")).join("turn.lock")).unwrap();
        turn.lock().unwrap();
        Self {
            folder: tempfile::tempdir().unwrap(),
            seen: Rc::default(),
            _turn: turn,
        }
    }

    pub(crate) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Notes the stalls that a campaign's report names.
    #[allow(dead_code, reason = "the tests of campaigns use it")]
    pub(crate) fn heard_of_stalls(&self, report: &str) {
        let told = report.split("gone for ").skip(1);
        let ms = told.filter_map(|rest| rest.split(' ').next()?.parse::<f64>().ok());
        let longest_ms = ms.fold(self.seen.stalled_ms.get(), f64::max);
        self.seen.stalled_ms.set(longest_ms);
        let harm = ["two masters", "touched another", "was sound"].iter();
        let harm = harm.copied().any(|word| report.contains(word));
        self.seen.harm.set(self.seen.harm.get() || harm);
    }

    /// The command with these arguments, in the fixture's folder.
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

    /// Starts `tandem run --json` with these further arguments.
    pub(crate) fn run(&self, args: &[&str]) -> Run {
        let number = fs::read_dir(self.folder()).unwrap().count();
        let stdout = self.folder().join(format!("{number}.stdout"));
        let stderr = self.folder().join(format!("{number}.stderr"));
        let mut command = self.command(&["run", "--json"]);
        command.args(args);
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
            seen: Rc::clone(&self.seen),
        }
    }

    /// What is in the fixture's folder but the output of runs.
    pub(crate) fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.folder()).unwrap();
        let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.filter(|name| !name.contains(".std")).collect();
        names.sort();
        names
    }
}

/// A run under way. Dropping it kills all of it.
pub(crate) struct Run {
    launcher: Child,
    /// What the name of the run begins with.
    name: String,
    stdout: PathBuf,
    stderr: PathBuf,
    since: Instant,
    seen: Rc<Seen>,
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
    /// Its processes as `tandem ps` lists them.
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
        // Other runs on this machine are none of this test's business.
        processes
            .filter(|process| self.is_mine(process.pid))
            .collect()
    }

    fn is_mine(&self, pid: i32) -> bool {
        let line = fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        line.split(|byte| *byte == 0)
            .any(|word| word.starts_with(self.name.as_bytes()))
    }

    /// Waits until `found` finds something among the processes.
    pub(crate) fn until<T>(&self, what: &str, found: impl Fn(&[Process]) -> Option<T>) -> T {
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

    /// Waits until one system drives and the other one stands by.
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

    /// The supply of the system that drives.
    pub(crate) fn master_supply(&self) -> Process {
        self.until("a master", |processes| {
            let is_it = |p: &&Process| p.kind == "supply" && p.role.as_deref() == Some("master");
            processes.iter().find(is_it).cloned()
        })
    }

    /// The process of `tandem run` itself.
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

    /// Waits for the end; the figures of a run that was not objected to.
    pub(crate) fn metrics(&mut self) -> Value {
        let status = self.end();
        assert!(status.success(), "{status}\n{}", self.said());
        self.told()
    }

    /// Ends the run as a person does, and waits; the figures of what was driven.
    pub(crate) fn interrupt(&mut self) -> Value {
        send(self.launcher_pid(), Signal::INT);
        let status = self.end();
        assert_eq!(status.code(), Some(130), "{}", self.said());
        self.told()
    }

    /// The figures on stdout of a run that has ended.
    pub(crate) fn told(&self) -> Value {
        serde_json::from_str(&fs::read_to_string(&self.stdout).unwrap()).unwrap()
    }

    /// Waits until no process of the run is left.
    pub(crate) fn until_vanished(&self) {
        self.until("the end of all processes", |processes| {
            processes.is_empty().then_some(())
        });
    }

    /// What it said on stderr.
    pub(crate) fn said(&self) -> String {
        fs::read_to_string(&self.stderr).unwrap()
    }

    /// Nothing of this run is left on the machine: no stall excuses that.
    pub(crate) fn left_nothing(&self) {
        let files = self.files();
        self.seen
            .harm
            .set(self.seen.harm.get() || !files.is_empty());
        assert!(files.is_empty(), "{files:?}");
    }

    /// Files of this run on the machine.
    fn files(&self) -> Vec<PathBuf> {
        ["/dev/shm", "/tmp"]
            .iter()
            .flat_map(|folder| fs::read_dir(folder).unwrap())
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.to_string_lossy().contains(&self.name))
            .collect()
    }
}

impl Run {
    /// Ends the run with its verdict, and keeps what may excuse a failed test.
    fn note_what_it_saw(&mut self) {
        // The number of one that has ended may be another process's.
        if matches!(self.launcher.try_wait(), Ok(None)) {
            send(self.launcher_pid(), Signal::INT);
        }
        let patience = Instant::now() + WATCHDOG;
        while matches!(self.launcher.try_wait(), Ok(None)) && Instant::now() < patience {
            std::thread::sleep(LOOK_AGAIN);
        }
        let told = fs::read_to_string(&self.stdout).unwrap_or_default();
        let told: Value = serde_json::from_str(&told).unwrap_or_default();
        let figure = |name: &str| told.pointer(name).and_then(Value::as_f64).unwrap_or(0.0);
        let longest_ms = figure("/stalls/longest_ms").max(self.seen.stalled_ms.get());
        self.seen.stalled_ms.set(longest_ms);
        let harm = ["/two_masters_ms", "/false_takeovers", "/collisions"]
            .iter()
            .any(|name| figure(name) > 0.0)
            || self.said().contains("panicked")
            || figure("/both_transmitted_ms") > figure("/hand_over_ms");
        self.seen.harm.set(self.seen.harm.get() || harm);
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.note_what_it_saw();
        }
        let _ = self.launcher.kill();
        let _ = self.launcher.wait();
        for process in self.processes() {
            kill(process.pid);
        }
    }
}

/// Kills a process; it may have ended already.
pub(crate) fn kill(pid: i32) {
    send(pid, Signal::KILL);
}

/// Sends a signal; the process may have ended already.
pub(crate) fn send(pid: i32, signal: Signal) {
    let _ = kill_process(Pid::from_raw(pid).unwrap(), signal);
}
