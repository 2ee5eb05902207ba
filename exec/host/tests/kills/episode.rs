//! One life of a platform: it starts, its processes are killed at random, it ends in one of several
//! ways, and nothing of it may be left.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::os::fd::OwnedFd;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use tandem_board_host::RunName;

use crate::check::check;
use crate::platform::{self, CANDIDATES, CLIENTS, Record};

/// Ways in which a platform ends.
pub(crate) const ENDS: u64 = 5;
/// Kills in one life of a platform, at most.
const LONGEST: u64 = 40;
/// How long something may take that must happen: far more than on a busy machine.
const WITHIN: Duration = Duration::from_secs(20);
/// The modes of the platform's processes, which may be killed.
const PROCESSES: [&str; 4] = ["client", "master", "tree", "leaf"];

/// SplitMix64, so that a seed repeats the choices of a campaign.
pub(crate) struct Dice(u64);

impl Dice {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// Returns a number below `count`.
    fn below(&mut self, count: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % count
    }
}

/// What an episode has shown.
pub(crate) struct Outcome {
    pub(crate) kills: u64,
    /// Cycles that at least two clients have run together.
    pub(crate) cycles: usize,
    /// Two clients were lost at once, so all of them ended. Then nothing more is killed.
    pub(crate) is_safe_state: bool,
    /// Signal and victim of each kill.
    pub(crate) victims: Vec<String>,
    pub(crate) wrong: Vec<String>,
    /// What helps to understand what is wrong.
    pub(crate) story: String,
}

/// A process of the platform.
struct Found {
    /// Not a process id: that may be another process's by the time of the signal.
    process: OwnedFd,
    mode: String,
}

impl Found {
    fn signal(&self, signal: Signal) {
        // It may have ended.
        let _ = pidfd_send_signal(&self.process, signal);
    }
}

/// Returns the living processes that have the run's name among their arguments.
fn processes_of(run: &str) -> Vec<Found> {
    let mut found = vec![];
    for entry in std::fs::read_dir("/proc").unwrap() {
        let name = entry.unwrap().file_name().into_string().unwrap_or_default();
        let Some(pid) = name.parse().ok().and_then(Pid::from_raw) else {
            continue;
        };
        // Opened before its arguments are read, so that they are this process's.
        let Ok(process) = pidfd_open(pid, PidfdFlags::empty()) else {
            continue;
        };
        // A process that has just ended has no arguments any more.
        let line = std::fs::read(format!("/proc/{name}/cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).into_owned();
        let words: Vec<&str> = line.split('\0').collect();
        if words.contains(&run) {
            let mode = words.get(1).copied().unwrap_or_default().to_owned();
            found.push(Found { process, mode });
        }
    }
    found
}

/// Returns the files and control groups with the run's name in theirs.
fn files_of(run: &str) -> Vec<String> {
    let mut found = vec![];
    let mut folders = vec![
        "/sys/fs/cgroup".into(),
        "/dev/shm".into(),
        "/tmp/iceoryx2".into(),
    ];
    while let Some(folder) = folders.pop() {
        let folder: std::path::PathBuf = folder;
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if entry.file_name().to_string_lossy().contains(run) {
                found.push(path.display().to_string());
            } else if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                folders.push(path);
            }
        }
    }
    found
}

fn manifest(run: &str, folder: &Path) -> String {
    let program = std::env::current_exe().unwrap();
    let program = program.display();
    let mut text = format!(
        "version = 1\ninitial = \"all\"\n[safe-state]\nafter = [\"{program}\", \"clean\", \"{run}\"]\n"
    );
    let mut names = vec![];
    let mut process = |name: String, arguments: &str, after: &str| {
        write!(
            text,
            "\n[[process]]\nname = \"{name}\"\nprogram = \"{program}\"\narguments = [{arguments}]\n\
             after = [{after}]\nready-within = \"20s\"\n\
             restart = {{ times = 1000000, pause = \"0ms\" }}\n"
        )
        .unwrap();
        names.push(name);
    };
    for id in 0..CANDIDATES {
        process(
            format!("master-{id}"),
            &format!("\"master\", \"{run}\", \"{id}\""),
            "",
        );
    }
    for id in 0..CLIENTS {
        let log = folder.join(format!("log-{id}"));
        let arguments = format!("\"client\", \"{run}\", \"{id}\", \"{}\"", log.display());
        process(format!("client-{id}"), &arguments, "\"master-0\"");
    }
    process("tree".to_owned(), &format!("\"tree\", \"{run}\""), "");
    write!(
        text,
        "\n[[target]]\nname = \"all\"\nprocesses = {names:?}\n"
    )
    .unwrap();
    text
}

/// Waits until this holds; `false` if it does not within [`WITHIN`].
fn eventually(mut holds: impl FnMut() -> bool) -> bool {
    let begin = Instant::now();
    while !holds() {
        if begin.elapsed() > WITHIN {
            return false;
        }
        sleep(Duration::from_millis(4));
    }
    true
}

/// A platform that runs, with the guardian as our child.
struct Life {
    run: RunName,
    folder: tempfile::TempDir,
    guardian: Child,
}

impl Life {
    fn start() -> Self {
        let run = RunName::unique();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("platform.toml");
        std::fs::write(&path, manifest(run.as_str(), folder.path())).unwrap();
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["guardian", run.as_str()]).arg(&path);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        let guardian = command.process_group(0).spawn().unwrap();
        Self {
            run,
            folder,
            guardian,
        }
    }

    fn logs(&self) -> Vec<Vec<Record>> {
        let log = |id| {
            let bytes = std::fs::read(self.folder.path().join(format!("log-{id}")));
            Record::read_all(&bytes.unwrap_or_default())
        };
        (0..CLIENTS).map(log).collect()
    }

    fn last_record(&self, id: usize) -> Option<Record> {
        let mut log = File::open(self.folder.path().join(format!("log-{id}"))).ok()?;
        log.seek(SeekFrom::End(-(Record::BYTES as i64))).ok()?;
        let mut bytes = vec![];
        log.read_to_end(&mut bytes).ok()?;
        Record::read_all(&bytes).first().copied()
    }

    /// Returns the last cycle that all clients have run as members; `None` if one is not in step.
    fn cycle_in_step(&self) -> Option<u64> {
        let in_step = |record: &Record| record.code == 4 && record.standing == 1;
        let cycle = |id| Some(self.last_record(id).filter(in_step)?.cycle);
        (0..CLIENTS)
            .map(cycle)
            .try_fold(u64::MAX, |least, cycle| Some(least.min(cycle?)))
    }

    fn is_safe_state(&self) -> bool {
        let is_safe = |id| {
            self.last_record(id)
                .is_some_and(|record| record.safe_state == 1)
        };
        (0..CLIENTS).any(is_safe)
    }

    /// Returns what helps to understand a violation: the last kills, the last records.
    fn story(&self, victims: &[String]) -> String {
        let last = |log: &Vec<Record>| format!("{:#?}", &log[log.len().saturating_sub(4)..]);
        let records: Vec<String> = self.logs().iter().map(last).collect();
        let kills = &victims[victims.len().saturating_sub(8)..];
        format!(
            "last kills: {kills:?}; last records: {}",
            records.join("\n")
        )
    }

    /// Waits until all clients have run a cycle that begins from now on. Returns `false` if they do
    /// not, which is a violation except in the safe state.
    fn is_in_step_again(&self, outcome: &mut Outcome) -> bool {
        let mut newest = None;
        let is_over = eventually(|| {
            outcome.is_safe_state = self.is_safe_state();
            let cycle = self.cycle_in_step();
            // A process that was just killed may have logged its last cycle a moment before.
            let since = *newest.get_or_insert(cycle.unwrap_or(0) + 2);
            outcome.is_safe_state || cycle.is_some_and(|cycle| cycle > since)
        });
        if !is_over {
            outcome
                .wrong
                .push("the clients do not run in step again".to_owned());
        }
        is_over && !outcome.is_safe_state
    }
}

impl Drop for Life {
    /// Also after a failed check nothing of the test stays.
    fn drop(&mut self) {
        eventually(|| {
            let left = processes_of(self.run.as_str());
            for process in &left {
                process.signal(Signal::KILL);
            }
            let _ = self.guardian.try_wait();
            left.is_empty()
        });
        let _ = platform::clean(self.run.as_str());
    }
}

/// Runs the episode of this number, of at most `most` kills.
pub(crate) fn run(dice: &mut Dice, number: u64, most: u64) -> Outcome {
    let mut life = Life::start();
    let mut outcome = Outcome {
        kills: 0,
        cycles: 0,
        is_safe_state: false,
        victims: vec![],
        wrong: vec![],
        story: String::new(),
    };
    life.is_in_step_again(&mut outcome);
    // The last kill of an episode is the end of the platform.
    let kills = 1 + dice.below(LONGEST.min(most));
    while outcome.kills + 1 < kills && kill_one(&life, dice, &mut outcome) {}
    if !outcome.is_safe_state && life.is_in_step_again(&mut outcome) {
        count_processes(&life, &mut outcome);
    }
    end(&mut life, number % ENDS, dice, &mut outcome);
    let (wrong, cycles) = check(&life.logs());
    outcome.wrong.extend(wrong);
    outcome.cycles = cycles;
    if !outcome.wrong.is_empty() {
        outcome.story = life.story(&outcome.victims);
    }
    outcome
}

/// After all kills each process runs once: also what a killed one had started.
fn count_processes(life: &Life, outcome: &mut Outcome) {
    let counts = || {
        let found = processes_of(life.run.as_str());
        PROCESSES.map(|mode| found.iter().filter(|it| it.mode == mode).count())
    };
    if !eventually(|| counts() == [CLIENTS, CANDIDATES, 1, 1]) {
        outcome
            .wrong
            .push(format!("{PROCESSES:?} run {:?} times", counts()));
    }
}

/// Kills one of the processes. Returns `false` if the episode is to end.
fn kill_one(life: &Life, dice: &mut Dice, outcome: &mut Outcome) -> bool {
    let mut found = processes_of(life.run.as_str());
    found.retain(|it| PROCESSES.contains(&it.mode.as_str()));
    if found.is_empty() {
        return eventually(|| !processes_of(life.run.as_str()).is_empty());
    }
    let victim = found.swap_remove(dice.below(found.len() as u64) as usize);
    // Without two members of three the safe state would be right.
    if victim.mode == "client" && !life.is_in_step_again(outcome) {
        return false;
    }
    let name = match dice.below(10) {
        0..=5 => {
            victim.signal(Signal::KILL);
            "KILL"
        }
        6..=7 => {
            victim.signal(Signal::TERM);
            "TERM"
        }
        _ => {
            victim.signal(Signal::STOP);
            sleep(Duration::from_millis(dice.below(40)));
            victim.signal(Signal::CONT);
            "STOP"
        }
    };
    outcome.kills += 1;
    outcome.victims.push(format!(
        "{name} {} at {:?}",
        victim.mode,
        tandem_board_host::clock::now()
    ));
    sleep(Duration::from_millis(dice.below(25)));
    true
}

/// Ends the platform in one of several ways, and checks that nothing is left.
fn end(life: &mut Life, way: u64, dice: &mut Dice, outcome: &mut Outcome) {
    let run = life.run.as_str().to_owned();
    let (mode, signal) = match way {
        0 => ("guardian", Signal::KILL),
        1 => ("launcher", Signal::KILL),
        2 => ("launcher", Signal::TERM),
        3 => ("guardian", Signal::TERM),
        // A frozen guardian is no reason to end; the platform is then told to.
        _ => ("guardian", Signal::STOP),
    };
    let victim = processes_of(&run).into_iter().find(|it| it.mode == mode);
    let Some(victim) = victim else {
        outcome
            .wrong
            .push(format!("the {mode} has ended by itself"));
        return;
    };
    victim.signal(signal);
    outcome.kills += 1;
    let name = match signal {
        Signal::KILL => "KILL",
        Signal::TERM => "TERM",
        _ => "STOP",
    };
    outcome.victims.push(format!("{name} {mode}"));
    if signal == Signal::STOP {
        sleep(Duration::from_millis(dice.below(40)));
        victim.signal(Signal::CONT);
        victim.signal(Signal::TERM);
    }
    let is_over = eventually(|| {
        let _ = life.guardian.try_wait();
        processes_of(&run).is_empty() && files_of(&run).is_empty()
    });
    if !is_over {
        let left = processes_of(&run).into_iter();
        let left: Vec<String> = left.map(|it| it.mode).collect();
        let files = files_of(&run);
        outcome.wrong.push(format!(
            "left after {name} of the {mode}: {left:?}, {files:?}"
        ));
    }
}
