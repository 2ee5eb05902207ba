//! The hands of the live views. They inject and end faults by commands of `tandem` and by signals.

use std::fmt;
use std::process::{Child, Command, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use tandem_board::{CoreId, SystemId};
use tandem_board_host::process_list::{self, ProcessKind};
use tandem_board_host::{RunName, Wire};

/// What a hand does to a system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hand {
    /// Switches the system off.
    PowerOff,
    /// Switches the system on.
    PowerOn,
    /// Kills the process of the supply: the system is without power until it is switched on.
    KillSupply,
    /// Kills a core.
    KillCore(CoreId),
    /// Stops core 0 for 100 ms.
    Hang,
    /// Cuts the system's connection to the bus.
    CutCan,
    /// Cuts the link from the system.
    CutLink,
    /// Cuts both heartbeat lines from the system.
    CutHeartbeats,
    /// Restores all wires of both systems.
    Mend,
}

impl Hand {
    /// All hands.
    pub const ALL: [Self; 11] = [
        Self::PowerOff,
        Self::PowerOn,
        Self::KillSupply,
        Self::KillCore(CoreId::ALL[0]),
        Self::KillCore(CoreId::ALL[1]),
        Self::KillCore(CoreId::ALL[2]),
        Self::Hang,
        Self::CutCan,
        Self::CutLink,
        Self::CutHeartbeats,
        Self::Mend,
    ];

    /// Returns the key of `tandem top`; `None` if it has none.
    #[must_use]
    pub fn key(self) -> Option<char> {
        Some(match self {
            Self::PowerOff => 'p',
            Self::PowerOn => 'o',
            Self::KillSupply => return None,
            Self::KillCore(core) => char::from(b'0' + core.index() as u8),
            Self::Hang => 'h',
            Self::CutCan => 'c',
            Self::CutLink => 'l',
            Self::CutHeartbeats => 'b',
            Self::Mend => 'm',
        })
    }

    /// Returns the hand with this key of `tandem top`.
    #[must_use]
    pub fn of_key(key: char) -> Option<Self> {
        Self::ALL.into_iter().find(|hand| hand.key() == Some(key))
    }

    /// Returns the hand with this name, as its `Display` writes it.
    #[must_use]
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|hand| hand.to_string() == name)
    }
}

impl fmt::Display for Hand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::PowerOff => "power-off",
            Self::PowerOn => "power-on",
            Self::KillSupply => "kill-supply",
            Self::KillCore(core) => return write!(f, "kill-core-{}", core.index()),
            Self::Hang => "hang",
            Self::CutCan => "cut-can",
            Self::CutLink => "cut-link",
            Self::CutHeartbeats => "cut-heartbeats",
            Self::Mend => "mend",
        })
    }
}

/// A hand could not do its work. The text says why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refused(pub String);

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Injects and ends faults in one run.
#[derive(Debug)]
pub struct Hands {
    run: RunName,
    /// Commands that still run.
    commands: Vec<Child>,
}

impl Hands {
    /// Returns the hands on this run.
    #[must_use]
    pub const fn on(run: RunName) -> Self {
        Self {
            run,
            commands: vec![],
        }
    }

    /// Does the work of a hand on this system. Returns what it has begun, in words. It does not
    /// wait for the commands of `tandem` that it starts.
    ///
    /// # Errors
    /// [`Refused`] if there is no such process, or a command does not start.
    pub fn lay(&mut self, hand: Hand, system: SystemId) -> Result<String, Refused> {
        // Reap the commands that have ended.
        self.commands
            .retain_mut(|command| matches!(command.try_wait(), Ok(None)));
        if process_list::of_run(&self.run).is_empty() {
            // The run has ended, or its systems are emulated machines.
            let why = "the run has no processes on this machine that a hand could reach";
            return Err(Refused(why.to_owned()));
        }
        let name = system.to_string();
        match hand {
            Hand::PowerOff => self.command(&["power", "off", &name]),
            Hand::PowerOn => self.command(&["power", "on", &name]),
            Hand::CutCan => self.command(&["cut", "can", "--from", &name]),
            Hand::CutLink => self.command(&["cut", "link", "--from", &name]),
            Hand::CutHeartbeats => {
                self.command(&["cut", "heartbeat-1", "--from", &name])?;
                self.command(&["cut", "heartbeat-2", "--from", &name])
            }
            Hand::Mend => {
                for wire in Wire::ALL {
                    self.command(&["mend", wire.name()])?;
                }
                Ok("mend all wires".to_owned())
            }
            Hand::KillSupply => {
                self.signal(system, None, Signal::KILL)?;
                Ok(format!("kill the supply of {name}"))
            }
            Hand::KillCore(core) => {
                self.signal(system, Some(core), Signal::KILL)?;
                Ok(format!("kill core {} of {name}", core.index()))
            }
            Hand::Hang => {
                // Only a command can enter the run. Refuse here if there is no such core.
                self.signal(system, Some(CoreId::CONTROL), Signal::CONT)?;
                self.command(&["fault", "hang", &name])?;
                Ok(format!("core 0 of {name} hangs for 100 ms"))
            }
        }
    }

    /// Starts `tandem` with these arguments on this run, which only a new process can enter.
    fn command(&mut self, words: &[&str]) -> Result<String, Refused> {
        let this = std::env::current_exe().unwrap_or_default();
        let started = Command::new(this.with_file_name("tandem"))
            .args(words)
            .args(["--run", self.run.as_str()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn();
        let said = format!("tandem {}", words.join(" "));
        match started {
            Ok(child) => {
                self.commands.push(child);
                Ok(said)
            }
            Err(error) => Err(Refused(format!("{said}: {error}"))),
        }
    }

    /// Sends a signal to a core of the system, or to its supply. Returns the process.
    fn signal(
        &self,
        system: SystemId,
        core: Option<CoreId>,
        signal: Signal,
    ) -> Result<(), Refused> {
        let is_it = |process: &process_list::Process| {
            let of = match process.kind {
                ProcessKind::Core(of, _) => Some(of),
                ProcessKind::Supply => None,
                ProcessKind::Vehicle => return false,
            };
            process.system == Some(system) && of == core
        };
        let found = process_list::of_run(&self.run).into_iter().find(is_it);
        let pid = found.and_then(|it| Pid::from_raw(i32::try_from(it.pid).ok()?));
        let reached = pid.filter(|pid| kill_process(*pid, signal).is_ok());
        reached.map(drop).ok_or_else(|| match core {
            Some(_) => Refused(format!("{system} has no such core")),
            None => Refused(format!("{system} has no supply")),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_hand_has_one_name_and_one_key() {
        for hand in Hand::ALL {
            assert_eq!(Hand::named(&hand.to_string()), Some(hand));
            if let Some(key) = hand.key() {
                assert_eq!(Hand::of_key(key), Some(hand));
            }
        }
        assert_eq!(Hand::of_key('3'), None);
        assert_eq!(Hand::named("kill-core-3"), None);
    }
}
