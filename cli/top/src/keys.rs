//! The keys of `tandem top`. They inject and end faults by commands of `tandem` and by signals.

use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use tandem_board::{CoreId, SystemId};
use tandem_board_host::RunName;
use tandem_board_host::process_list::{self, ProcessKind};

/// The keys and their effect on the selected system.
pub(super) const KEYS: &str =
    "Tab system p/o power off/on 0-2 kill core h hang c CAN b beats l link m mend q";
/// Duration of a hang.
const HANG: Duration = Duration::from_millis(100);
const WIRES: [&str; 6] = [
    "heartbeat-1",
    "heartbeat-2",
    "start",
    "level",
    "link",
    "can",
];

/// Executes the commands of the keys that the user presses.
pub(super) struct Keys {
    run: RunName,
    /// Commands that still run.
    commands: Vec<Child>,
    said: String,
}

impl Keys {
    pub(super) const fn on(run: RunName) -> Self {
        Self {
            run,
            commands: vec![],
            said: String::new(),
        }
    }

    /// Returns a description of the last action.
    pub(super) fn said(&mut self) -> String {
        self.commands
            .retain_mut(|command| matches!(command.try_wait(), Ok(None)));
        self.said.clone()
    }

    /// Executes the action of the key on this system.
    pub(super) fn press(&mut self, key: char, system: SystemId) {
        let name = system.to_string();
        match key {
            'p' => self.command(&["power", "off", &name]),
            'o' => self.command(&["power", "on", &name]),
            'c' => self.command(&["cut", "can", "--from", &name]),
            'l' => self.command(&["cut", "link", "--from", &name]),
            'b' => {
                self.command(&["cut", "heartbeat-1", "--from", &name]);
                self.command(&["cut", "heartbeat-2", "--from", &name]);
            }
            'm' => {
                for wire in WIRES {
                    self.command(&["mend", wire]);
                }
                self.said = "mend all wires".to_owned();
            }
            '0'..='2' => {
                let core = CoreId::new(key as u8 - b'0');
                self.signal(system, core, Signal::KILL);
                self.said = format!("kill core {key} of {name}");
            }
            'h' => {
                let Some(pid) = self.signal(system, Some(CoreId::CONTROL), Signal::STOP) else {
                    return;
                };
                self.said = format!("core 0 of {name} hangs for 100 ms");
                std::thread::spawn(move || {
                    std::thread::sleep(HANG);
                    // This call fails if the watchdog has reset the core.
                    let _ = kill_process(pid, Signal::CONT);
                });
            }
            _ => self.said = format!("{key} is no key"),
        }
    }

    /// Starts `tandem` with these arguments on this run, which only a new process can enter.
    fn command(&mut self, words: &[&str]) {
        let this = std::env::current_exe().unwrap_or_default();
        let started = Command::new(this.with_file_name("tandem"))
            .args(words)
            .args(["--run", self.run.as_str()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        self.said = format!("tandem {}", words.join(" "));
        match started {
            Ok(child) => self.commands.push(child),
            Err(error) => self.said = format!("{}: {error}", self.said),
        }
    }

    fn signal(&mut self, system: SystemId, core: Option<CoreId>, signal: Signal) -> Option<Pid> {
        let is_it = |process: &process_list::Process| {
            let of = match process.kind {
                ProcessKind::Core(of, _) => Some(of),
                ProcessKind::Supply | ProcessKind::Vehicle => None,
            };
            process.system == Some(system) && of.is_some() && of == core
        };
        let found = process_list::of_run(&self.run).into_iter().find(is_it);
        let pid = found.and_then(|it| Pid::from_raw(i32::try_from(it.pid).ok()?));
        if pid.is_none_or(|pid| kill_process(pid, signal).is_err()) {
            self.said = format!("{system} has no such core");
            return None;
        }
        pid
    }
}
