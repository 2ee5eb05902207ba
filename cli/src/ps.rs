//! `tandem ps`: lists the processes of all runs.

use serde::Serialize;
use tandem_board::SystemId;
use tandem_board_host::process_list::{self, Process, ProcessKind};

use crate::args::PsArgs;
use crate::failure::Failure;

/// A process in the output of `--json`.
#[derive(Debug, Serialize)]
struct Row {
    pid: u32,
    run: String,
    kind: String,
    system: Option<String>,
    core: Option<usize>,
    role: Option<String>,
    cpu: Option<u32>,
}

/// The board's name for the role of a master without a standby.
const DEGRADED: &str = "degraded";

fn row(process: &Process) -> Row {
    let role = process.role.as_deref();
    Row {
        pid: process.pid,
        run: process.run.to_string(),
        kind: process.kind.to_string(),
        system: process.system.map(|system: SystemId| system.to_string()),
        core: match process.kind {
            ProcessKind::Core(core, _) => Some(core.index()),
            ProcessKind::Supply | ProcessKind::Vehicle => None,
        },
        // Degraded is a mode of the master.
        role: role.map(|role| if role == DEGRADED { "master" } else { role }.to_owned()),
        cpu: process.cpu,
    }
}

/// Prints the processes.
///
/// # Errors
/// If stdout or the file cannot be written.
pub fn run(args: &PsArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let processes = process_list::list();
    let rows: Vec<Row> = processes.iter().map(row).collect();
    Ok(crate::print(&json_to.write(&rows, || table(&processes))?)?)
}

fn table(processes: &[Process]) -> String {
    if processes.is_empty() {
        return "no run is active; `tandem run` starts one\n".to_owned();
    }
    let mut text = format!(
        "{:>8}  {:8}  {:6}  {:4}  {:17}  {:>3}  {}\n",
        "PID", "KIND", "SYSTEM", "CORE", "ROLE", "CPU", "RUN"
    );
    for process in processes {
        let row = row(process);
        let dash = || "-".to_owned();
        let mode = if process.role.as_deref() == Some(DEGRADED) {
            " (degraded)"
        } else {
            ""
        };
        text += &format!(
            "{:>8}  {:8}  {:6}  {:4}  {:17}  {:>3}  {}\n",
            row.pid,
            row.kind,
            row.system.unwrap_or_else(dash),
            row.core.map_or_else(dash, |core| core.to_string()),
            row.role.map_or_else(dash, |role| role + mode),
            row.cpu.map_or_else(dash, |cpu| cpu.to_string()),
            process.run,
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::{CoreId, Generation};

    fn core() -> Process {
        Process {
            pid: 17,
            run: "tandem-1-a".parse().unwrap(),
            kind: ProcessKind::Core(CoreId::PLANNING, Generation(1)),
            system: Some(SystemId::B),
            role: Some(DEGRADED.to_owned()),
            cpu: Some(1),
        }
    }

    #[test]
    fn scripts_find_exactly_the_names_that_they_rely_on() {
        let json = serde_json::to_string(&row(&core())).unwrap();
        let expected = concat!(
            r#"{"pid":17,"run":"tandem-1-a","kind":"core","system":"B","core":2,"#,
            r#""role":"master","cpu":1}"#
        );
        assert_eq!(json, expected);
    }

    #[test]
    fn people_see_that_a_master_is_degraded() {
        assert!(table(&[core()]).contains("master (degraded)"));
    }
}
