//! The tables of tasks in the documentation, from the task table in the code.

use crate::{read, write};
use anyhow::{Context, Result, bail};
use std::fmt::Write as _;
use std::path::Path;
use tandem_board::CoreId;
use tandem_cores::task_table::{self, CORE_0, INTERRUPTS, ReleasedBy, SharedPart, TaskInfo};

/// A page, the name of its two marks, and the table between them.
type Place = (&'static str, &'static str, fn() -> String);

const PAGES: [Place; 3] = [
    ("docs/rtos-tasks.md", "task table", priorities),
    ("docs/rtos-tasks.md", "locks", locks),
    ("docs/tracing.md", "task table", codes),
];

/// Writes the tables, or reports with `check` whether one is stale.
pub(crate) fn run(root: &Path, check: bool) -> Result<()> {
    for (page, name, table) in PAGES {
        let path = root.join(page);
        let before = read(&path)?;
        let after = placed(&before, name, &table()).context(page)?;
        if check && before != after {
            bail!("{page}: the {name} is stale; run `cargo xtask task-tables`");
        }
        if before != after {
            write(&path, &after)?;
        }
    }
    Ok(())
}

/// Returns the page with the table between the marks of this name replaced.
pub(crate) fn placed(page: &str, name: &str, table: &str) -> Result<String> {
    let begin = format!("<!-- generated, {name}: begin -->");
    let end = format!("<!-- generated, {name}: end -->");
    let parts = page.split_once(&begin).and_then(|(before, rest)| {
        let (_, after) = rest.split_once(&end)?;
        Some((before, after))
    });
    let Some((before, after)) = parts else {
        bail!("the page has no lines {begin} and {end}")
    };
    Ok(format!("{before}{begin}\n\n{table}\n{end}{after}"))
}

fn name_of(by: &ReleasedBy) -> &'static str {
    match by {
        ReleasedBy::Period => "its period",
        ReleasedBy::OwnDeadline => "its own deadline",
        ReleasedBy::Doorbell => "doorbell",
        ReleasedBy::Task(code) => code.name().unwrap_or("?"),
    }
}

fn priorities() -> String {
    let mut out =
        "| task | released by | period = deadline | priority | what it does |\n".to_owned();
    out += "|---|---|---:|---:|---|\n";
    for info in &CORE_0 {
        let by: Vec<_> = info.released_by.iter().map(name_of).collect();
        let _ = writeln!(
            out,
            "| {} | {} | {} ms | {} | {} |",
            info.name,
            by.join(", "),
            info.period.as_us() / 1000,
            info.priority,
            info.purpose,
        );
    }
    out
}

fn locks() -> String {
    let users = |part: SharedPart| {
        let users = CORE_0.iter().filter(|info| info.uses.contains(&part));
        users.map(|info| info.name).collect::<Vec<_>>().join(", ")
    };
    let mut out = "| lock | what | tasks |\n|---|---|---|\n".to_owned();
    for (name, what, part) in [
        (
            "shared",
            "redundancy, CAN, link, flash, outputs",
            SharedPart::Shared,
        ),
        (
            "drive",
            "scene, trajectory, state of the controllers",
            SharedPart::Drive,
        ),
    ] {
        let _ = writeln!(out, "| {name} | {what} | {} |", users(part));
    }
    out
}

fn codes() -> String {
    let mut out = "| core | tasks |\n|---|---|\n".to_owned();
    for core in CoreId::ALL {
        let mut tasks: Vec<&TaskInfo> = task_table::tasks(core).iter().collect();
        tasks.sort_by_key(|info| info.code);
        let named = tasks
            .iter()
            .map(|info| format!("{} {}", info.code.0, info.name));
        let _ = writeln!(
            out,
            "| {} | {} |",
            core.index(),
            named.collect::<Vec<_>>().join(", ")
        );
    }
    let mut interrupts = INTERRUPTS;
    interrupts.sort_by_key(|info| info.code);
    let named = interrupts.map(|info| format!("{} {}", info.code.0, info.name));
    out + "\nInterrupts: " + &named.join(", ") + ".\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The tables in the documentation agree with the task table in the code.
    #[test]
    fn the_tables_of_the_documentation_are_those_of_the_code() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        run(&root, true).unwrap();
    }

    #[test]
    fn a_table_takes_the_place_of_what_is_between_its_marks() {
        let (begin, end) = ("<!-- generated, x: begin -->", "<!-- generated, x: end -->");
        let page = format!("a {begin}old{end} b");
        assert_eq!(
            placed(&page, "x", "new").unwrap(),
            format!("a {begin}\n\nnew\n{end} b")
        );
        assert!(placed(&page, "y", "new").is_err());
    }
}
