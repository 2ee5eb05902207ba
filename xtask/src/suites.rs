//! `cargo xtask suites`: runs the suites and tools of other projects, and writes the page on them.

use crate::task_tables::placed;
use crate::{cargo, output, read, write};
use anyhow::{Context, Result, bail, ensure};
use std::io::{BufRead as _, BufReader, Read};
use std::path::Path;
use std::process::{Command, Stdio};

const PAGE: &str = "docs/suites.md";
const MARK: &str = "suites";
/// What a test writes to stderr before a text about the amount that it compared.
const COMPARED: &str = "compared: ";
/// With these, a test fails if its oracle is not installed.
const REQUIRED: [&str; 4] = [
    "TANDEM_REQUIRE_ORACLES",
    "TANDEM_REQUIRE_BOOT_ORACLES",
    "TANDEM_REQUIRE_COMMONROAD",
    "TANDEM_REQUIRE_SOLUTION_CHECKER",
];

/// Names the folder of a release of FreeRTOS.
pub(crate) const FREERTOS: &str = "TANDEM_FREERTOS";

/// Where a suite is from.
enum Source {
    /// A crate of the lock file.
    Crate(&'static str),
    /// A package of Python that must be installed.
    Python(&'static str),
    /// A release in the folder that a variable names. Without the variable the suite does not run,
    /// and the page keeps its row.
    Folder(&'static str),
}

/// A suite of others.
struct Suite {
    source: Source,
    /// The tests of the workspace that run it.
    tests: &'static [&'static str],
    /// Parts of their names; all tests if empty.
    names: &'static [&'static str],
    /// What it is used for here.
    used_for: &'static str,
    /// Its parts that do not run, and why.
    left_out: &'static str,
}

const SUITES: [Suite; 7] = [
    Suite {
        source: Source::Crate("iceoryx2-cal-conformance-tests"),
        tests: &["iceoryx2"],
        names: &[],
        used_for: "iceoryx2's conformance tests of a dynamic storage, an event and a named \
                   concept, on the host board's storage and doorbell",
        left_out: "12 of 15 modules: the board implements none of their traits",
    },
    Suite {
        source: Source::Python("autosar-e2e"),
        tests: &["e2e", "outputs"],
        names: &["autosar_e2e", "agrees_with_an_independent", "others_decode"],
        used_for: "end-to-end protection by AUTOSAR's profile 5: 45 frames of all lengths, and \
                   each frame of a drive",
        left_out: "other profiles: no frame uses them; the counter: the package checks the CRC \
                   only",
    },
    Suite {
        source: Source::Python("cantools"),
        tests: &["cantools_oracle", "outputs"],
        names: &["cantools", "others_decode"],
        used_for: "decodes random frames and each frame of a drive to our values, and encodes \
                   random values to our bytes",
        left_out: "nothing",
    },
    Suite {
        source: Source::Python("python-can"),
        tests: &["outputs", "python_can"],
        names: &["python_can", "others_decode"],
        used_for: "reads a drive from candump, ASC and BLF; downloads an image over UDP multicast",
        left_out: "a CAN FD frame without data: it takes this for a remote frame, which CAN FD \
                   does not have",
    },
    Suite {
        source: Source::Python("commonroad-drivability-checker"),
        tests: &["outputs", "commonroad_oracle"],
        names: &["drivability"],
        used_for: "accepts each judged drive: start, goal, collisions, feasible by the vehicle \
                   model; overlaps of random rectangles",
        left_out: "the road's boundary: the check needs a package that is not free",
    },
    Suite {
        source: Source::Python("commonroad-io"),
        tests: &["commonroad_oracle"],
        names: &["commonroad_io"],
        used_for: "reads lanes, traffic and goals of scenarios as we do",
        left_out: "parts of the format that we do not read",
    },
    Suite {
        source: Source::Folder("FreeRTOS"),
        tests: &["standard_demos"],
        names: &["suite"],
        used_for: "28 suites of the standard demo tasks on the host port, each for 20 s of virtual \
                   time: its own check passes every 5 s; our kernel, with the options that they \
                   need beyond ours (dynamic memory, event groups, stream buffers, \
                   recursive mutexes, tick hook)",
        left_out: "comtest, comtest_strings: a serial port; flash, flash_timer: lamps, without a \
                   check; crflash, crhook: co-routines, which the kernel is built without",
    },
];

impl Suite {
    const fn name(&self) -> &'static str {
        match self.source {
            Source::Crate(name) | Source::Python(name) | Source::Folder(name) => name,
        }
    }

    /// Returns the version in use, or nothing if the suite is not installed.
    fn version(&self, root: &Path) -> Result<Option<String>> {
        match self.source {
            Source::Crate(name) => locked(root, name).map(Some),
            Source::Python(name) => {
                let script =
                    format!("from importlib import metadata as m; print(m.version('{name}'))");
                let mut python = Command::new("python3");
                let said = output(python.args(["-c", &script])).ok();
                Ok(said.map(|version| version.trim().to_owned()))
            }
            Source::Folder(_) => {
                let Some(folder) = std::env::var_os(FREERTOS) else {
                    return Ok(None);
                };
                let text = read(Path::new(&folder).join("FreeRTOS/Demo/Common/Minimal/BlockQ.c"))?;
                let version = text.lines().find_map(|line| line.split_once("FreeRTOS V"));
                let (_, version) =
                    version.with_context(|| format!("{FREERTOS} names no release of FreeRTOS"))?;
                Ok(Some(version.trim().to_owned()))
            }
        }
    }

    /// Returns the arguments of cargo that run it.
    fn arguments(&self) -> Vec<&'static str> {
        let tests = self.tests.iter().flat_map(|test| ["--test", test]);
        let mut arguments: Vec<&str> = ["test", "--workspace"].into_iter().chain(tests).collect();
        if !self.names.is_empty() {
            arguments.push("--");
            arguments.extend(self.names);
        }
        arguments
    }

    fn row(&self, version: &str, outcome: &Outcome) -> String {
        let compared = match &outcome.compared[..] {
            [] => String::new(),
            all => format!("; this run: {}", all.join("; ")),
        };
        format!(
            "| `{}` | {version} | {} | {} | {}{compared} | {} | `cargo {}` |",
            self.name(),
            outcome.passed,
            outcome.failed,
            self.used_for,
            self.left_out,
            self.arguments().join(" "),
        )
    }

    /// Returns its row of the page.
    fn row_of<'a>(&self, page: &'a str) -> Option<&'a str> {
        let begin = format!("| `{}` |", self.name());
        page.lines().find(|line| line.starts_with(&begin))
    }

    fn run(&self, root: &Path) -> Result<Outcome> {
        let mut command = cargo(root, &self.arguments());
        println!("$ {command:?}");
        // Only what ships is counted.
        command
            .env_remove("TANDEM_SCENARIOS")
            .env_remove("TANDEM_DRIVE");
        command.envs(REQUIRED.map(|name| (name, "1")));
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        let reader = std::thread::spawn(move || lines(stderr, COMPARED));
        let results = lines(stdout, "test result: ");
        let mut compared = reader.join().unwrap_or_default();
        compared.sort();
        let has_ended_well = child.wait()?.success();
        let sum = |what| results.iter().map(|result| count(result, what)).sum();
        let [passed, failed]: [usize; 2] = [" passed", " failed"].map(sum);
        ensure!(
            has_ended_well || failed > 0,
            "{}: its tests did not run",
            self.name()
        );
        Ok(Outcome {
            passed,
            failed,
            compared,
        })
    }
}

/// Copies the lines to the terminal as they arrive. Returns the rest of those that begin with this
/// word.
fn lines(from: Option<impl Read>, word: &str) -> Vec<String> {
    let lines = from
        .into_iter()
        .flat_map(|pipe| BufReader::new(pipe).lines());
    let seen = lines
        .map_while(Result::ok)
        .inspect(|line| println!("{line}"));
    let chosen = seen.filter_map(|line| line.strip_prefix(word).map(str::to_owned));
    chosen.collect()
}

/// Returns the number before this word in `ok. 3 passed; 0 failed; …`.
fn count(result: &str, word: &str) -> usize {
    let part = result.split(';').find_map(|part| part.strip_suffix(word));
    let number = part.and_then(|part| part.rsplit(' ').next());
    number.and_then(|number| number.parse().ok()).unwrap_or(0)
}

/// What became of a suite.
struct Outcome {
    passed: usize,
    failed: usize,
    compared: Vec<String>,
}

/// Returns the version of a crate in the lock file.
fn locked(root: &Path, name: &str) -> Result<String> {
    let lock: toml::Table = read(root.join("Cargo.lock"))?.parse()?;
    let packages = lock["package"].as_array().context("Cargo.lock")?;
    let version = packages
        .iter()
        .find(|package| package["name"].as_str() == Some(name))
        .and_then(|package| package["version"].as_str());
    Ok(version
        .with_context(|| format!("Cargo.lock has no {name}"))?
        .to_owned())
}

/// Runs all suites and prints the table. With `save` it writes the table to the page; with `check`
/// it runs none, and reports only whether the page fits them.
pub(crate) fn run(root: &Path, save: bool, check: bool) -> Result<()> {
    let page = read(root.join(PAGE))?;
    if check {
        return SUITES.iter().try_for_each(|suite| {
            let said = || {
                format!(
                    "{PAGE} is stale for {}; run `cargo xtask suites --save`",
                    suite.name()
                )
            };
            fits(root, suite, &page).with_context(said)
        });
    }
    let mut rows = String::from(
        "| suite | version | passed | failed | what it does here | left out, why | command |\n\
         |---|---|---:|---:|---|---|---|\n",
    );
    let (mut missing, mut failed) = (Vec::new(), Vec::new());
    for suite in &SUITES {
        let Some(version) = suite.version(root)? else {
            if let Source::Folder(name) = suite.source {
                println!("SKIPPED: {name}: {FREERTOS}=FOLDER is not set");
                fits(root, suite, &page)
                    .with_context(|| format!("{name}: its row cannot be kept; set {FREERTOS}"))?;
                rows.extend(suite.row_of(&page).map(|row| format!("{row}\n")));
            } else {
                println!("SKIPPED: {0}: pip install {0}", suite.name());
                missing.push(suite.name());
            }
            continue;
        };
        let outcome = suite.run(root)?;
        ensure!(
            outcome.passed + outcome.failed > 0,
            "{}: no test ran",
            suite.name()
        );
        if outcome.failed > 0 {
            failed.push(suite.name());
        }
        rows += &(suite.row(&version, &outcome) + "\n");
    }
    print!("\n{rows}");
    ensure!(failed.is_empty(), "failed: {}", failed.join(", "));
    ensure!(missing.is_empty(), "did not run: {}", missing.join(", "));
    if save {
        write(root.join(PAGE), &placed(&page, MARK, &rows)?)?;
    }
    Ok(())
}

/// Checks the page's row of this suite: what it says beside the figures, that all tests passed, and
/// for a crate the version.
fn fits(root: &Path, suite: &Suite, page: &str) -> Result<()> {
    let row = suite.row_of(page).context("it has no row")?;
    let row: Vec<&str> = row.split('|').map(str::trim).collect();
    let [
        _,
        _,
        version,
        passed,
        failed,
        used_for,
        left_out,
        command,
        _,
    ] = row[..]
    else {
        bail!("its row has other columns")
    };
    ensure!(
        passed.parse::<usize>().is_ok_and(|it| it > 0) && failed == "0",
        "not all passed"
    );
    ensure!(
        used_for.starts_with(suite.used_for) && left_out == suite.left_out,
        "other words"
    );
    ensure!(
        command == format!("`cargo {}`", suite.arguments().join(" ")),
        "another command"
    );
    if let Source::Crate(_) = suite.source {
        ensure!(
            suite.version(root)?.as_deref() == Some(version),
            "another version"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{count, lines};

    #[test]
    fn results_are_counted() {
        let from: &[u8] = b"running 3 tests\ntest result: FAILED. 12 passed; 3 failed; 1 ignored\n";
        let results = lines(Some(from), "test result: ");
        assert_eq!(results.len(), 1);
        assert_eq!(count(&results[0], " passed"), 12);
        assert_eq!(count(&results[0], " failed"), 3);
        assert_eq!(count(&results[0], " lost"), 0);
    }
}
