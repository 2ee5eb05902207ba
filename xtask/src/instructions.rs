//! Instructions of the primitives on the host, counted by valgrind and compared with a committed
//! table: an exact check that does not depend on the load of the machine.

use crate::{example, read_json, write_json};
use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;

const TABLE: &str = "benches/two-cores/instructions.json";
const PROGRAM: &str = "instructions";
/// The cases of `benches/two-cores/examples/instructions.rs`.
const CASES: [&str; 10] = [
    "mailbox",
    "mailbox-empty-poll",
    "channel-4B",
    "channel-scene",
    "fifo-4B",
    "fifo-scene",
    "broadcast-4B",
    "pool",
    "lock",
    "control-frame",
];
/// The repetitions in two runs of a case. Their difference excludes the program's start and end.
const TIMES: [u64; 2] = [1_000, 5_000];
/// The permitted difference, in percent, if the table is from another compiler. With the same
/// compiler a case takes the same number of instructions in each run.
const OTHER_COMPILER_PERCENT: f64 = 5.0;
/// Permitted difference in instructions per repetition: the environment affects the start of a run.
const NOISE: f64 = 0.3;

/// Counts the instructions of each case and compares them with the table; `save` writes a new one.
/// Without valgrind it says so and checks nothing.
pub(crate) fn run(root: &Path, save: bool) -> Result<()> {
    if Command::new("valgrind").arg("--version").output().is_err() {
        println!("skipped: no valgrind (apt-get install --no-install-recommends valgrind)");
        return Ok(());
    }
    let program = example(root, "release", PROGRAM)?;
    let program = Path::new(program.get_program());
    let mut counted = Vec::new();
    for case in CASES {
        let [few, many] = TIMES;
        let more = count(program, case, many)?.saturating_sub(count(program, case, few)?);
        counted.push((
            case,
            (more as f64 / (many - few) as f64 * 10.0).round() / 10.0,
        ));
    }
    let compiler = crate::firmware::version("rustc")?;
    let place = root.join(TABLE);
    if save {
        let rows = counted
            .iter()
            .map(|(name, count)| json!({ "name": name, "count": count }));
        let table = json!({
            "unit": "instructions of one operation and its answer, x86-64, callgrind",
            "compiler": compiler,
            "results": rows.collect::<Vec<_>>(),
        });
        write_json(&place, &table)?;
    }
    let table = read_json(&place)?;
    let known_compiler = table["compiler"].as_str().unwrap_or_default();
    let percent = if known_compiler == compiler {
        0.0
    } else {
        OTHER_COMPILER_PERCENT
    };
    println!("{compiler}; the table: {known_compiler}");
    let changed = changed(&counted, &table, percent)?;
    ensure!(
        changed.is_empty(),
        "not as in {TABLE}: {}; if it is meant to be so, `cargo xtask instructions --save`",
        changed.join(", ")
    );
    Ok(())
}

/// Prints each case beside the table, and names those that differ by more than this percentage.
fn changed(counted: &[(&str, f64)], table: &Value, percent: f64) -> Result<Vec<String>> {
    println!("{:<20} {:>9} {:>9}", "instructions", "now", "table");
    let mut changed = Vec::new();
    for (name, count) in counted {
        let rows = table["results"].as_array().into_iter().flatten();
        let mut known = rows.filter(|row| row["name"] == *name);
        let known = known.find_map(|row| row["count"].as_f64());
        let known = known.with_context(|| format!("{name} is not in the table: --save"))?;
        println!("{name:<20} {count:>9.1} {known:>9.1}");
        if (count - known).abs() > NOISE + known * percent / 100.0 {
            changed.push(format!("{name} {known:.1} -> {count:.1}"));
        }
    }
    Ok(changed)
}

/// Returns the instructions of the whole program that repeats a case `times` times.
fn count(program: &Path, case: &str, times: u64) -> Result<u64> {
    let output = Command::new("valgrind")
        .args(["--tool=callgrind", "--callgrind-out-file=/dev/null"])
        .arg(program)
        .args([case, &times.to_string()])
        .output()?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "{case} under valgrind: {said}");
    let collected = said.split("Collected :").nth(1);
    let count = collected.and_then(|text| text.split_whitespace().next()?.parse().ok());
    count.with_context(|| format!("callgrind counted nothing: {said}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_instruction_more_or_less_is_a_change() {
        let table = json!({ "results": [{ "name": "lock", "count": 40.0 }] });
        for (count, percent, expected) in [
            (40.0, 0.0, &[][..]),
            (41.0, 0.0, &["lock 40.0 -> 41.0"]),
            (39.0, 0.0, &["lock 40.0 -> 39.0"]),
            // The table is from another compiler.
            (42.0, 5.0, &[]),
            (43.0, 5.0, &["lock 40.0 -> 43.0"]),
        ] {
            let found = changed(&[("lock", count)], &table, percent).unwrap();
            assert_eq!(found, expected, "{count}");
        }
        assert!(changed(&[("pool", 1.0)], &table, 0.0).is_err());
    }
}
