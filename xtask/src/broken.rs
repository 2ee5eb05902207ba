//! Broken variants of the product, kept as patches: each must be caught by the test that it names.
//!
//! A patch begins with two lines: `Broken: what is wrong`, and `Caught by: arguments of cargo
//! nextest run` or `Caught by: simulator GROUP`. With the latter, one of 1,000 sequences of faults
//! of that group must break a rule, and shrink to at most three faults. A person starts the tests,
//! because each variant is a separate build. The gate only checks that each patch still applies.

use crate::{PRESENT, git_files, read};
use anyhow::{Context, Result, ensure};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// This word in place of a test means that the simulator catches the variant.
const SIMULATOR: &str = "simulator";

/// One variant.
struct Variant {
    name: String,
    patch: PathBuf,
    broken: String,
    caught_by: Vec<String>,
}

impl Variant {
    fn read(patch: PathBuf) -> Result<Self> {
        let shown = patch.display().to_string();
        let text = read(&patch)?;
        let mut lines = text.lines();
        let mut head = |word: &str| {
            let line = lines.next().and_then(|line| line.strip_prefix(word));
            let line = line.with_context(|| format!("{shown}: a line `{word}…` is missing"))?;
            Ok::<_, anyhow::Error>(line.trim().to_owned())
        };
        let broken = head("Broken:")?;
        let caught_by = head("Caught by:")?;
        let name = patch.file_stem().unwrap_or_default();
        Ok(Self {
            name: name.to_string_lossy().into_owned(),
            broken,
            caught_by: caught_by.split_whitespace().map(str::to_owned).collect(),
            patch,
        })
    }

    /// Runs `git apply` in this folder, which need not be a repository.
    fn apply(&self, folder: &Path, further: &[&str]) -> Result<bool> {
        let mut git = Command::new("git");
        git.arg("apply")
            .args(further)
            .arg(&self.patch)
            .current_dir(folder);
        git.env("GIT_CEILING_DIRECTORIES", folder.parent().unwrap_or(folder));
        Ok(git.status().context("git apply")?.success())
    }
}

/// Tests the variants whose name contains `filter`, or with `simulator` all that the simulator
/// catches. With `only_check` it only checks that their patches apply.
pub(crate) fn run(root: &Path, filter: &str, only_check: bool) -> Result<()> {
    let patches = git_files(root, &[&PRESENT[..], &["tests/broken/*.patch"]].concat())?;
    let variants = patches.iter().map(|patch| Variant::read(root.join(patch)));
    let mut variants: Vec<Variant> = variants.collect::<Result<_>>()?;
    variants.retain(|it| it.name.contains(filter) || it.caught_by[..1] == [filter]);
    ensure!(!variants.is_empty(), "no broken variant is called {filter}");
    let mut wrong = Vec::new();
    for variant in &variants {
        let found = if only_check {
            variant.apply(root, &["--check"])?
        } else {
            println!("{}: {}", variant.name, variant.broken);
            // After an error the other variants are still tested.
            is_caught(root, variant).unwrap_or_else(|error| {
                println!("{}: {error:#}", variant.name);
                false
            })
        };
        if !found {
            wrong.push(variant.name.as_str());
        }
    }
    let (good, bad) = match only_check {
        true => ("apply", "do not apply"),
        false => ("are caught", "are not caught"),
    };
    ensure!(wrong.is_empty(), "{bad}: {}", wrong.join(", "));
    println!("{} broken variants {good}", variants.len());
    Ok(())
}

/// Builds the variant and runs its test. The test must fail; a variant that does not compile, or
/// whose test does not exist, is not caught.
fn is_caught(root: &Path, variant: &Variant) -> Result<bool> {
    let copy = root.join("target/broken/tree");
    copy_tree(root, &copy)?;
    ensure!(
        variant.apply(&copy, &[])?,
        "{} does not apply",
        variant.patch.display()
    );
    let cargo = |what: &str| {
        let mut command = Command::new("cargo");
        command
            .arg(what)
            .current_dir(&copy)
            // Not the developer's folder: cargo distinguishes the crates of two copies only by the
            // times of their files, so broken crates could get into the developer's `tandem`.
            .env("CARGO_TARGET_DIR", root.join("target/broken/build"));
        command
    };
    if let [first, group] = &variant.caught_by[..]
        && first == SIMULATOR
    {
        let find = ["--quiet", "-p", "tandem-sim", "--example", "find"];
        let built = cargo("build").args(find).status().context("cargo build")?;
        ensure!(built.success(), "{} does not compile", variant.name);
        let found = cargo("run").args(find).args(["--", group]).status();
        return Ok(found.context("cargo run")?.success());
    }
    let nextest = |further: &[&str]| {
        let mut command = cargo("nextest");
        command.args(further).args(&variant.caught_by);
        command
    };
    let listed = nextest(&["list"])
        .stderr(Stdio::inherit())
        .output()
        .context("cargo nextest list")?;
    ensure!(listed.status.success(), "{} does not compile", variant.name);
    let count = String::from_utf8_lossy(&listed.stdout).lines().count();
    ensure!(count > 0, "{} names no test", variant.name);
    let passed = nextest(&["run"]).status().context("cargo nextest run")?;
    let caught = if passed.success() {
        "NOT CAUGHT"
    } else {
        "caught"
    };
    let by = variant.caught_by.join(" ");
    println!("{}: {caught} by {by}", variant.name);
    Ok(!passed.success())
}

/// Copies all files of the repository as they are now. A file with unchanged content keeps its
/// modification time, so that cargo builds only the differences.
fn copy_tree(root: &Path, copy: &Path) -> Result<()> {
    for name in git_files(root, &PRESENT)? {
        let content = fs::read(root.join(&name)).with_context(|| name.clone())?;
        let to = copy.join(&name);
        if fs::read(&to).is_ok_and(|there| there == content) {
            continue;
        }
        if let Some(folder) = to.parent() {
            fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        fs::write(&to, content).with_context(|| to.display().to_string())?;
    }
    Ok(())
}
