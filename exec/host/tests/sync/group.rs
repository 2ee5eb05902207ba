//! A group of redundant processes, and what each of them told.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration as Time;

use rustix::process::{Pid, Signal, kill_process};
use tandem_board::Duration;
use tandem_board_host::{Isolation, isolation};
use tandem_exec::master::Config;
use tandem_exec_client::sync::SyncPlace;

use crate::roles::{ROLE, text};

/// A line that is not there after this time will not come. Only a failing test waits for so long.
const WATCHDOG: Time = Time::from_secs(60);

/// Three clients, two are enough. Times that a loaded machine keeps: it never decides without a
/// client that runs.
pub(crate) const CONFIG: Config = Config {
    clients: 3,
    quorum: 2,
    candidates: 2,
    period: Duration::from_ms(2),
    lead: Duration::from_us(400),
    wait: Duration::from_ms(15_000),
    patience: Duration::from_ms(30_000),
    takeover: Duration::from_ms(100),
};

/// The same for clients that are dead: the others wait shortly for them.
pub(crate) const SHORT: Config = Config {
    wait: Duration::from_ms(150),
    ..CONFIG
};

pub(crate) struct Process {
    child: Child,
    lines: Receiver<String>,
    pub(crate) told: Vec<String>,
}

impl Process {
    /// Returns the first line that `is_wanted`, after those that were returned before.
    pub(crate) fn until(&mut self, what: &str, is_wanted: impl Fn(&str) -> bool) -> String {
        loop {
            match self.lines.recv_timeout(WATCHDOG) {
                Ok(line) => {
                    self.told.push(line.clone());
                    if is_wanted(&line) {
                        return line;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => {
                    panic!("ended without {what}: {}", self.tail())
                }
                Err(RecvTimeoutError::Timeout) => panic!("no {what} in time: {}", self.tail()),
            }
        }
    }

    pub(crate) fn until_has(&mut self, part: &str) -> String {
        self.until(part, |line| line.contains(part))
    }

    /// Waits until the process ends, and takes all its lines.
    pub(crate) fn finish(&mut self) {
        loop {
            match self.lines.recv_timeout(WATCHDOG) {
                Ok(line) => self.told.push(line),
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => panic!("does not end: {}", self.tail()),
            }
        }
        self.child.wait().unwrap();
    }

    /// Takes the lines that are there now, and waits until `count` further activations.
    pub(crate) fn skip(&mut self, count: usize) {
        while let Ok(line) = self.lines.try_recv() {
            self.told.push(line);
        }
        for _ in 0..count {
            self.until("an activation", |line| line.starts_with("A "));
        }
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    pub(crate) fn kill(mut self) -> Vec<String> {
        self.child.kill().unwrap();
        self.finish();
        std::mem::take(&mut self.told)
    }

    /// Returns whether the process runs, or ended without a panic or a signal.
    pub(crate) fn is_sound(&mut self) -> bool {
        self.child
            .try_wait()
            .unwrap()
            .is_none_or(|status| status.success())
    }

    fn tail(&self) -> String {
        self.told[self.told.len().saturating_sub(12)..].join("\n")
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Ended or not, after this it is gone.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

pub(crate) struct Group {
    isolation: Isolation,
    config: Config,
    pub(crate) place: SyncPlace,
    pub(crate) folder: tempfile::TempDir,
}

impl Group {
    pub(crate) fn new(config: Config) -> Self {
        let isolation = isolation::enter_shared().unwrap();
        let place = SyncPlace::create(isolation.run(), "sync").unwrap();
        let folder = tempfile::tempdir().unwrap();
        Self {
            isolation,
            config,
            place,
            folder,
        }
    }

    fn start(&self, kind: &str, id: usize, rest: &[&str]) -> Process {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args([
                ROLE,
                kind,
                self.isolation.run().as_str(),
                "sync",
                &id.to_string(),
            ])
            .args(rest)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = channel();
        let out = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            for line in out.lines().map_while(Result::ok) {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        let mut process = Process {
            child,
            lines,
            told: vec![],
        };
        process.until_has("ready");
        process
    }

    pub(crate) fn master(&self, id: usize) -> Process {
        self.start("master", id, &[&text(&self.config)])
    }

    pub(crate) fn client(&self, id: usize, script: &str) -> Process {
        self.start("client", id, &[script])
    }

    pub(crate) fn clients(&self, scripts: [&str; 3]) -> [Process; 3] {
        [0, 1, 2].map(|id| self.client(id, scripts[id]))
    }

    pub(crate) fn liar(&self, id: usize) -> Process {
        self.start("liar", id, &[])
    }

    pub(crate) fn driver(&self, id: usize, recording: &str, flip: &str) -> Process {
        self.start("driver", id, &[recording, flip])
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // Declared before the processes in each test, so it is dropped after them.
        self.isolation.wipe();
    }
}

/// One activation that a client told.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Told {
    pub(crate) cycle: u64,
    pub(crate) code: String,
    pub(crate) at: u64,
    pub(crate) random: u64,
    pub(crate) standing: String,
    pub(crate) missed: u64,
    pub(crate) agreed: u64,
}

pub(crate) fn activations(told: &[String]) -> Vec<Told> {
    let of = |line: &String| {
        let words: Vec<&str> = line.strip_prefix("A ")?.split(' ').collect();
        let number = |at: usize| words[at].parse().unwrap();
        Some(Told {
            cycle: number(0),
            code: words[1].to_owned(),
            at: number(2),
            random: number(3),
            standing: words[4].to_owned(),
            missed: number(5),
            agreed: number(8),
        })
    };
    told.iter().filter_map(of).collect()
}

/// Checks what must hold whatever was killed: each client's cycles and times increase, and all
/// clients that took a cycle took the same time, the same random number, and, as members, the same
/// code. Returns the number of cycles that at least two clients took.
pub(crate) fn check_all<'a>(told: impl IntoIterator<Item = &'a Vec<String>>) -> usize {
    let mut cycles = BTreeMap::<u64, Vec<Told>>::new();
    for told in told {
        let own = activations(told);
        for pair in own
            .windows(2)
            .filter(|pair| pair[1].code != "RegisterServices")
        {
            assert!(
                pair[0].cycle < pair[1].cycle && pair[0].at < pair[1].at,
                "{pair:?}"
            );
        }
        own.into_iter()
            .for_each(|one| cycles.entry(one.cycle).or_default().push(one));
    }
    for taken in cycles.values() {
        let members = taken.iter().filter(|one| one.standing == "Member");
        let codes: Vec<_> = members.map(|one| &one.code).collect();
        assert!(codes.windows(2).all(|pair| pair[0] == pair[1]), "{taken:?}");
        let same = |one: &Told| (one.at, one.random, one.agreed);
        assert!(
            taken.iter().all(|one| same(one) == same(&taken[0])),
            "{taken:?}"
        );
    }
    cycles.values().filter(|taken| taken.len() > 1).count()
}
