//! `cargo xtask test`: runs all tests, counts them, and lists those that failed.

use crate::suites::FREERTOS;
use crate::{cargo, run};
use anyhow::{Result, ensure};
use std::collections::BTreeSet;
use std::io::{BufRead as _, BufReader, Read, Write};
use std::path::Path;
use std::process::Stdio;

/// Runs all tests. Builds the programs first: the whole-process tests start `tandem` like a user.
pub(crate) fn test(root: &Path) -> Result<()> {
    // The runner hides the output of a test that passes.
    if std::env::var_os("TANDEM_SCENARIOS").is_none() {
        println!("SKIPPED: recorded scenarios (TANDEM_SCENARIOS=FOLDER is not set)");
    }
    if std::env::var_os(FREERTOS).is_none() {
        println!("SKIPPED: FreeRTOS's standard demo tasks ({FREERTOS}=FOLDER is not set)");
    }
    run(cargo(root, &["build", "--workspace", "--all-targets"]))?;
    let nextest = cargo(root, &["nextest", "--version"]).output();
    let commands: &[&[&str]] = if nextest.is_ok_and(|output| output.status.success()) {
        &[
            &["nextest", "run", "--workspace", "--no-fail-fast"],
            &["test", "--workspace", "--doc", "--no-fail-fast"],
        ]
    } else {
        println!("cargo-nextest is not installed; cargo test runs the same tests");
        &[&["test", "--workspace", "--no-fail-fast"]]
    };
    let (mut passed, mut failed) = (0, BTreeSet::new());
    let mut has_failed = false;
    for arguments in commands {
        let mut command = cargo(root, arguments);
        println!("$ {command:?}");
        // nextest writes its results to stderr, cargo test to stdout.
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let (stdout, stderr) = (child.stdout.take(), child.stderr.take());
        let read = std::thread::spawn(move || echo(stderr, &mut std::io::stderr()));
        let results = echo(stdout, &mut std::io::stdout());
        for (name, has_passed) in results.into_iter().chain(read.join().unwrap_or_default()) {
            if has_passed {
                passed += 1;
            } else {
                failed.insert(name);
            }
        }
        has_failed |= !child.wait()?.success();
    }
    println!("\n{passed} tests passed, {} failed", failed.len());
    for name in &failed {
        println!("FAILED: {name}");
    }
    ensure!(passed > 0, "no test ran");
    ensure!(!has_failed && failed.is_empty(), "not all tests pass");
    Ok(())
}

/// Copies the lines as they arrive. Returns the name of each test, and whether it passed.
fn echo(from: Option<impl Read>, to: &mut impl Write) -> Vec<(String, bool)> {
    let mut results = Vec::new();
    let pipe = from
        .into_iter()
        .flat_map(|pipe| BufReader::new(pipe).split(b'\n'));
    for line in pipe.map_while(Result::ok) {
        let _ = to.write_all(&[&line[..], b"\n"].concat());
        results.extend(result_in(&String::from_utf8_lossy(&line)));
    }
    results
}

/// Returns the test and its result from a line of a runner.
fn result_in(line: &str) -> Option<(String, bool)> {
    // A failed test's own output has such lines too, indented.
    if let Some(test) = line.strip_prefix("test ") {
        let (name, result) = test.trim_end().rsplit_once(" ... ")?;
        return ["ok", "FAILED"]
            .contains(&result)
            .then(|| (name.to_owned(), result == "ok"));
    }
    // "FAIL [  1.0s] (1/2) package::file name", and once more at the end.
    let line = line.trim();
    let status = line.split(' ').next()?;
    let has_passed = ["PASS", "LEAK"].contains(&status);
    let has_failed = ["FAIL", "LEAK-FAIL", "TIMEOUT"].contains(&status);
    let name = line.rsplit(") ").next()?;
    let is_result = has_passed || has_failed || status.starts_with("SIG");
    is_result.then(|| (name.to_owned(), has_passed))
}

#[cfg(test)]
mod tests {
    use super::{echo, result_in};

    #[test]
    fn each_line_of_a_runner_is_read_as_what_it_says() {
        let passed = |name: &str| Some((name.to_owned(), true));
        let failed = |name: &str| Some((name.to_owned(), false));
        for (line, wanted) in [
            (
                "        PASS [   2.031s] (  64/1371) tandem::processes deaths::one",
                passed("tandem::processes deaths::one"),
            ),
            (
                "        LEAK [   2.031s] (1/2) tandem two",
                passed("tandem two"),
            ),
            (
                "        FAIL [   0.005s] (2/2) tandem-shm lock::three",
                failed("tandem-shm lock::three"),
            ),
            (
                "   LEAK-FAIL [   0.005s] (2/2) tandem-shm four",
                failed("tandem-shm four"),
            ),
            (
                "     TIMEOUT [  45.000s] (2/2) tandem-shm five",
                failed("tandem-shm five"),
            ),
            (
                "     SIGSEGV [   0.005s] (2/2) tandem-shm six",
                failed("tandem-shm six"),
            ),
            (
                "     SIGKILL [   0.005s] (2/2) tandem-shm seven",
                failed("tandem-shm seven"),
            ),
            (
                "test board/api/src/lib.rs - Board (line 7) ... ok",
                passed("board/api/src/lib.rs - Board (line 7)"),
            ),
            ("test eight ... FAILED", failed("eight")),
            ("test nine ... ignored, needs a chip", None),
            // Output of a test.
            ("    test eight ... FAILED", None),
            (
                "     Summary [ 240.1s] 1371 tests run: 1370 passed, 1 failed, 27 skipped",
                None,
            ),
            (
                "        SLOW [> 60.000s] (  9/1371) tandem::processes ten",
                None,
            ),
            ("", None),
        ] {
            assert_eq!(result_in(line), wanted, "{line}");
        }
    }

    #[test]
    fn every_line_is_handed_on_and_a_line_that_is_not_text_ends_nothing() {
        let from: &[u8] = b"test one ... ok\n\xff\xfe\ntest two ... FAILED\n";
        let mut to = Vec::new();
        let results = echo(Some(from), &mut to);
        assert_eq!(to, from);
        assert_eq!(
            results,
            [("one".to_owned(), true), ("two".to_owned(), false)]
        );
    }
}
