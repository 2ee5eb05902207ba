//! Cyclone DDS as a peer: a process with Python, which answers each line that it reads with one.

use crate::peer::{Reader, Writer};
use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use tandem_topics::{Durability, Qos, Reliability};

const SCRIPT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/matrix/cyclone.py");

/// Returns the interpreter that has Cyclone DDS: the one in `TANDEM_PYTHON`, or `python3`.
fn python() -> Command {
    Command::new(std::env::var_os("TANDEM_PYTHON").unwrap_or_else(|| "python3".into()))
}

/// Returns what this machine lacks.
pub(crate) fn missing() -> Option<String> {
    let output = python().args(["-c", "import cyclonedds"]).output();
    let has = output.is_ok_and(|output| output.status.success());
    (!has).then(|| "no Python with cyclonedds (TANDEM_PYTHON names another one)".to_owned())
}

/// A process with a writer or a reader. It ends when its input does.
pub(crate) struct Cyclone {
    process: Child,
    /// `None` when it shall end.
    to: Option<ChildStdin>,
    from: BufReader<ChildStdout>,
}

impl Cyclone {
    pub(crate) fn start(role: &str, domain: u16, qos: Qos) -> Self {
        let reliability = match qos.reliability {
            Reliability::Reliable => "reliable",
            Reliability::BestEffort => "best-effort",
        };
        let durability = match qos.durability {
            Durability::TransientLocal => "transient-local",
            Durability::Volatile => "volatile",
        };
        let mut process = python()
            .arg(SCRIPT)
            .args([role, &domain.to_string(), reliability, durability])
            .arg(qos.depth.to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let to = process.stdin.take();
        let from = BufReader::new(process.stdout.take().unwrap());
        let mut cyclone = Self { process, to, from };
        assert_eq!(cyclone.line(), "ready");
        cyclone
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.from.read_line(&mut line).unwrap();
        assert!(line.ends_with('\n'), "Cyclone's process has ended");
        line.trim_end().to_owned()
    }

    fn ask(&mut self, question: &str) -> Vec<u32> {
        writeln!(self.to.as_mut().unwrap(), "{question}").unwrap();
        let line = self.line();
        let numbers = line
            .split_whitespace()
            .map(|number| number.parse().unwrap());
        numbers.collect()
    }
}

impl Drop for Cyclone {
    fn drop(&mut self) {
        self.to = None;
        let _status = self.process.wait();
    }
}

impl Writer for Cyclone {
    fn write(&mut self, number: u32) -> bool {
        self.ask(&format!("write {number}")).is_empty()
    }

    fn incompatible(&mut self) -> u32 {
        self.ask("incompatible")[0]
    }
}

impl Reader for Cyclone {
    fn take(&mut self) -> Vec<u32> {
        self.ask("take")
    }

    fn incompatible(&mut self) -> u32 {
        self.ask("incompatible")[0]
    }
}
