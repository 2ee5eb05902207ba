//! Relaxes each memory ordering of shm, one at a time: a loom model must fail.

use anyhow::{Context, Result, ensure};
use std::fs;
use std::path::Path;
use std::process::Command;

/// Orderings whose relaxation no loom model detects, each with the reason: lines `FILE FUNCTION
/// NUMBER: reason`.
const NOT_CAUGHT: &str = "shm/tests/weakened.txt";

/// One ordering in the sources: `number` counts within one function.
struct Site {
    file: &'static str,
    function: String,
    number: usize,
    line: usize,
}

/// The sources with orderings, and the tests that model them.
const SOURCES: [(&str, &[&str]); 8] = [
    (
        "incarnation",
        &["loom_announce", "loom_deaths", "loom_lock"],
    ),
    ("lock", &["loom_announce", "loom_deaths", "loom_lock"]),
    ("pool", &["loom_announce", "loom_deaths", "loom_lock"]),
    ("mailbox", &["loom_mailbox", "loom_deaths"]),
    ("ring", &["loom_channels"]),
    ("fifo", &["loom_channels"]),
    ("map", &["loom_channels"]),
    ("region", &["loom_region"]),
];

const STRONG: [&str; 4] = [
    "Ordering::Acquire",
    "Ordering::Release",
    "Ordering::AcqRel",
    "Ordering::SeqCst",
];

/// Weakens the orderings of the functions whose name contains `filter`, runs the models, and prints
/// which model caught each. Fails if an ordering is neither caught nor listed, or is both.
pub(crate) fn run(root: &Path, filter: &str) -> Result<()> {
    let copy = root.join("target/weakened");
    copy_of_shm(root, &copy)?;
    let excused = fs::read_to_string(root.join(NOT_CAUGHT))?;
    let mut wrong = 0;
    for (file, models) in SOURCES {
        let path = copy.join(format!("shm/src/{file}.rs"));
        let source = fs::read_to_string(&path)?;
        for site in sites(file, &source) {
            if !site.function.contains(filter) {
                continue;
            }
            let name = format!("{} {} {}", site.file, site.function, site.number);
            fs::write(&path, weaken(&source, site.line))?;
            let caught = failing_model(&copy, models)?;
            let reason = excused
                .lines()
                .find_map(|line| line.strip_prefix(&name)?.strip_prefix(": "));
            wrong += usize::from(caught.is_some() == reason.is_some());
            println!(
                "{name}: {}",
                caught.as_deref().or(reason).unwrap_or("NOT CAUGHT")
            );
        }
        fs::write(&path, source)?;
    }
    ensure!(wrong == 0, "{wrong} orderings differ from {NOT_CAUGHT}");
    Ok(())
}

/// Creates a workspace with `shm` alone.
fn copy_of_shm(root: &Path, copy: &Path) -> Result<()> {
    if copy.exists() {
        fs::remove_dir_all(copy)?;
    }
    fs::create_dir_all(copy)?;
    let manifest = fs::read_to_string(root.join("Cargo.toml"))?;
    let (before, rest) = manifest
        .split_once("members = [")
        .context("members of the workspace")?;
    let (_, after) = rest.split_once("[workspace.package]").context("package")?;
    let manifest = format!("{before}members = [\"shm\"]\n[workspace.package]{after}");
    fs::write(copy.join("Cargo.toml"), manifest)?;
    fs::copy(root.join("Cargo.lock"), copy.join("Cargo.lock"))?;
    let copied = Command::new("cp")
        .args(["-r", "shm"])
        .arg(copy)
        .current_dir(root)
        .status()?;
    ensure!(copied.success(), "cannot copy shm");
    Ok(())
}

fn sites(file: &'static str, source: &str) -> Vec<Site> {
    let mut sites: Vec<Site> = Vec::new();
    let mut function = String::new();
    for (line, text) in source.lines().enumerate() {
        if text.starts_with("#[cfg(test)]") {
            break;
        }
        if let Some((_, rest)) = text.split_once("fn ")
            && !text.trim_start().starts_with("//")
        {
            function = rest.split(['(', '<']).next().unwrap_or(rest).to_owned();
        }
        if STRONG.iter().any(|strong| text.contains(strong)) {
            let number = 1 + sites.iter().filter(|s| s.function == function).count();
            let function = function.clone();
            sites.push(Site {
                file,
                function,
                number,
                line,
            });
        }
    }
    sites
}

/// Returns the source with the ordering in this line relaxed; a fence is removed.
fn weaken(source: &str, at: usize) -> String {
    let weak = |(line, text): (usize, &str)| {
        if line != at {
            text.to_owned()
        } else if text.trim_start().starts_with("fence(") {
            String::new()
        } else {
            STRONG.iter().fold(text.to_owned(), |text, strong| {
                text.replace(strong, "Ordering::Relaxed")
            })
        }
    };
    let lines: Vec<_> = source.lines().enumerate().map(weak).collect();
    lines.join("\n") + "\n"
}

/// Returns the first model that fails.
fn failing_model(copy: &Path, models: &[&str]) -> Result<Option<String>> {
    for model in models {
        let output = Command::new("cargo")
            .current_dir(copy)
            .env("RUSTFLAGS", "--cfg loom -A warnings")
            .env("CARGO_TARGET_DIR", copy.join("../loom"))
            .args(["test", "--release", "-p", "tandem-shm", "--test", model])
            .output()?;
        let text = String::from_utf8_lossy(&output.stdout);
        let failed = text
            .lines()
            .find_map(|line| line.strip_prefix("test ")?.strip_suffix(" ... FAILED"));
        if let Some(failed) = failed {
            return Ok(Some(format!("{model}::{failed}")));
        }
        let error = String::from_utf8_lossy(&output.stderr);
        // A panic during another panic aborts the process before the line above is printed.
        let panicked = error
            .lines()
            .find_map(|line| line.strip_prefix("thread '")?.split('\'').next());
        if let Some(panicked) = panicked {
            return Ok(Some(format!("{model}::{panicked}")));
        }
        ensure!(output.status.success(), "{model} does not build:\n{error}");
    }
    Ok(None)
}
