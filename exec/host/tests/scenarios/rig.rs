//! A platform under test: a folder, a manifest, a guardian with its launcher.

use std::fs;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process, test_kill_process};
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::low_level::pipe;
use tandem_exec_host::launcher::{
    self, GuardEnd, GuardPlan, NOTHING_STARTED, ProcessLauncher, Told,
};

/// A test that takes longer hangs: on a loaded machine the longest takes a tenth of it.
const WATCHDOG: Duration = Duration::from_secs(60);

/// A platform. Dropping it ends it.
pub(crate) struct Rig {
    folder: tempfile::TempDir,
    guardian: Option<Child>,
}

/// Returns the lines of a process whose program does these steps.
pub(crate) fn process(name: &str, steps: &[&str], more: &str) -> String {
    let program = std::env::current_exe().unwrap();
    let quoted: Vec<String> = ["actor"]
        .iter()
        .chain(steps)
        .map(|it| format!("{it:?}"))
        .collect();
    let steps = quoted.join(", ");
    format!(
        "[[process]]\nname = {name:?}\nprogram = {program:?}\narguments = [{steps}]\n\
         ready-within = \"50s\"\n{more}\n"
    )
}

/// Returns the lines of a process that manages the state by these steps.
pub(crate) fn driver(steps: &[&str]) -> String {
    let steps = [&["ready"], steps, &["append:driver-done", "to:off"]].concat();
    process("driver", &steps, "state-management = true")
}

/// Returns the lines of a run target.
pub(crate) fn target(name: &str, processes: &[&str]) -> String {
    format!("[[target]]\nname = {name:?}\nprocesses = {processes:?}\n")
}

impl Rig {
    /// Makes a platform with this manifest, which begins with `version`, and starts it.
    pub(crate) fn start(manifest: &[String]) -> Self {
        let mut rig = Self::prepare(manifest);
        rig.launch(&[]);
        rig
    }

    pub(crate) fn prepare(manifest: &[String]) -> Self {
        let folder = tempfile::Builder::new()
            .prefix("tandem-exec-")
            .tempdir()
            .unwrap();
        fs::write(folder.path().join("manifest.toml"), manifest.concat()).unwrap();
        // A process may have another user.
        let all = std::os::unix::fs::PermissionsExt::from_mode(0o777);
        fs::set_permissions(folder.path(), all).unwrap();
        let guardian = None;
        Self { folder, guardian }
    }

    /// Starts the guardian, with these arguments after the manifest.
    pub(crate) fn launch(&mut self, more: &[&str]) {
        let mut command = Command::new(std::env::current_exe().unwrap());
        self.launch_by(command.arg("guardian").arg(self.manifest()).args(more));
    }

    pub(crate) fn launch_by(&mut self, command: &mut Command) {
        self.launch_by_spawn(command, Command::spawn);
    }

    pub(crate) fn launch_by_spawn(
        &mut self,
        command: &mut Command,
        spawn: impl FnOnce(&mut Command) -> std::io::Result<Child>,
    ) {
        let events = fs::File::create(self.path("events")).unwrap();
        command.current_dir(self.folder.path()).stdout(events);
        let errors = fs::File::create(self.path("errors")).unwrap();
        self.guardian = Some(spawn(command.stderr(errors)).unwrap());
    }

    pub(crate) fn manifest(&self) -> PathBuf {
        self.path("manifest.toml")
    }

    pub(crate) fn path(&self, file: &str) -> PathBuf {
        self.folder.path().join(file)
    }

    pub(crate) fn has(&self, file: &str) -> bool {
        self.path(file).exists()
    }

    pub(crate) fn text(&self, file: &str) -> String {
        fs::read_to_string(self.path(file)).unwrap_or_default()
    }

    /// Returns the process ids that were appended to a file.
    pub(crate) fn pids(&self, file: &str) -> Vec<i32> {
        self.text(file)
            .lines()
            .map(|line| line.parse().unwrap())
            .collect()
    }

    /// Returns the numbers of lines of events that hold all of these words.
    pub(crate) fn events(&self, words: &[&str]) -> Vec<usize> {
        let text = self.text("events");
        let lines = text.lines().enumerate();
        let found = lines.filter(|(_, line)| words.iter().all(|word| line.contains(word)));
        found.map(|(number, _)| number).collect()
    }

    pub(crate) fn guardian_pid(&self) -> i32 {
        self.guardian.as_ref().unwrap().id() as i32
    }

    /// Returns the launcher's process id.
    pub(crate) fn launcher_pid(&self) -> i32 {
        let guardian = self.guardian_pid().to_string();
        let children = || {
            let entries = fs::read_dir("/proc").unwrap().flatten();
            entries.filter_map(|it| it.file_name().to_str()?.parse::<i32>().ok())
        };
        let is_child = |pid: &i32| {
            let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
            let after = stat.rsplit_once(')').map_or("", |it| it.1);
            after.split_whitespace().nth(1) == Some(&guardian)
        };
        children().find(is_child).expect("a launcher")
    }

    /// Waits until this is so.
    pub(crate) fn wait_until(&self, what: &str, mut is: impl FnMut(&Self) -> bool) {
        let begin = Instant::now();
        while !is(self) {
            assert!(begin.elapsed() < WATCHDOG, "{what}: {}", self.story());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    pub(crate) fn wait_for(&self, file: &str) {
        self.wait_until(file, |rig| rig.has(file));
    }

    /// Waits for the end of the guardian.
    pub(crate) fn end(&mut self) -> ExitStatus {
        let mut guardian = self.guardian.take().unwrap();
        let begin = Instant::now();
        loop {
            if let Some(status) = guardian.try_wait().unwrap() {
                return status;
            }
            if begin.elapsed() > WATCHDOG {
                self.guardian = Some(guardian);
                panic!("it does not end: {}", self.story());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits for the end: the driver has done all its steps, and no process has failed in one.
    pub(crate) fn end_well(&mut self) {
        let status = self.end();
        assert!(status.success(), "{status}: {}", self.story());
        assert!(!self.has("error"), "{}", self.story());
        assert!(self.has("driver-done"), "{}", self.story());
    }

    pub(crate) fn stop(&self) {
        let pid = Pid::from_raw(self.guardian_pid()).unwrap();
        kill_process(pid, Signal::TERM).unwrap();
    }

    pub(crate) fn ask(&self, request: &str) -> String {
        launcher::ask(&self.manifest(), request).unwrap_or_else(|error| error.to_string())
    }

    /// What happened, for the message of a failed test.
    pub(crate) fn story(&self) -> String {
        let files = ["error", "events", "errors", "log"];
        files
            .map(|file| format!("{file}:\n{}", self.text(file)))
            .concat()
    }
}

impl Drop for Rig {
    fn drop(&mut self) {
        if let Some(mut guardian) = self.guardian.take() {
            // The launcher cleans up when the guardian is gone.
            guardian.kill().unwrap();
            guardian.wait().unwrap();
            let begin = Instant::now();
            while launcher::ask(&self.manifest(), "ps").is_ok() && begin.elapsed() < WATCHDOG {
                std::thread::sleep(Duration::from_millis(10));
            }
        }
    }
}

pub(crate) fn is_alive(pid: i32) -> bool {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let is_zombie = stat
        .rsplit_once(')')
        .is_some_and(|it| it.1.trim().starts_with('Z'));
    test_kill_process(Pid::from_raw(pid).unwrap()).is_ok() && !is_zombie
}

pub(crate) fn signal(pid: i32, signal: Signal) {
    kill_process(Pid::from_raw(pid).unwrap(), signal).unwrap();
}

fn stops() -> UnixStream {
    let (read, write) = UnixStream::pair().unwrap();
    for signal in [SIGINT, SIGTERM] {
        pipe::register(signal, write.try_clone().unwrap()).unwrap();
    }
    read
}

/// In the guardian: arguments are the manifest, and the commands of the clean-up.
pub(crate) fn guardian(words: &[String]) -> ExitCode {
    let mut command = Command::new("/proc/self/exe");
    command
        .arg("launcher")
        .arg(&words[0])
        .stdout(Stdio::inherit());
    let hook = |at: usize| {
        words
            .get(at)
            .map(|it| it.split(' ').map(str::to_owned).collect())
    };
    let plan = GuardPlan {
        manifest: PathBuf::from(&words[0]),
        anchor: None,
        before: hook(1).unwrap_or_default(),
        after: hook(2).unwrap_or_default(),
    };
    match launcher::guard(command, &plan, &stops(), &mut |_| {}).unwrap() {
        GuardEnd::Done => ExitCode::SUCCESS,
        GuardEnd::NothingStarted => ExitCode::from(2),
        GuardEnd::CleanedUp(why, failed) => {
            eprintln!("clean-up: {why}; {failed:?}");
            ExitCode::from(1)
        }
    }
}

/// In the launcher.
pub(crate) fn launcher(words: &[String]) -> ExitCode {
    let launcher = match ProcessLauncher::open(Path::new(&words[0]), None) {
        Ok(launcher) => launcher,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(NOTHING_STARTED);
        }
    };
    match launcher.run(stops(), true, &mut |told: &Told| println!("{told}")) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(launcher::give_up(&error))
        }
    }
}
