//! `cargo xtask campaign topics`: the matrix of topics between Tandem and foreign participants.

use crate::{cargo, target_dir, write_json};
use anyhow::{Context, Result, ensure};
use serde_json::json;
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

/// The result of one cell, as its test writes it.
struct Cell<'t> {
    /// What the cell demands, for example `late_joiner`.
    kind: &'t str,
    /// Writer and reader, for example `cyclone_to_tandem`.
    pair: &'t str,
    /// `passed`, `failed` or `skipped`.
    result: &'t str,
    /// A measured figure, or why the cell was skipped.
    text: &'t str,
}

/// Runs the matrix and prints its table; then runs that lose their network or their SoC. Writes the
/// counts of the matrix to `json`.
pub(crate) fn run(root: &Path, json: Option<&Path>) -> Result<()> {
    let results = target_dir(root).join("topics-matrix.txt");
    fs::create_dir_all(target_dir(root)).context("the target folder")?;
    fs::write(&results, "").with_context(|| results.display().to_string())?;
    let package = ["-p", "tandem-topics-host", "--test", "matrix"];
    let mut command = cargo(root, &["test"]);
    command.args(package).env("TANDEM_MATRIX_RESULTS", &results);
    println!("$ {command:?}");
    let status = command.status().context("cargo test")?;
    let text = crate::read(&results)?;
    let cells = cells(&text);
    print!("{}", table(&cells));
    let [passed, failed, skipped] = ["passed", "failed", "skipped"].map(|result| {
        let cells = cells.iter().filter(|cell| cell.result == result);
        cells.map(Cell::name).collect::<Vec<_>>()
    });
    if let Some(path) = json {
        let counts = json!({ "cells": cells.len(), "passed": passed.len(), "skipped": skipped });
        write_json(path, &counts)?;
    }
    ensure!(failed.is_empty(), "failed: {}", failed.join(", "));
    ensure!(!passed.is_empty(), "no cell ran");
    ensure!(status.success(), "{command:?} ended with {status}");
    println!("{} of {} cells passed", passed.len(), cells.len());
    let mut command = cargo(root, &["test", "-p", "tandem", "--test", "processes"]);
    command.args(["parking", "--", "--ignored"]);
    println!("$ {command:?}");
    let status = command.status().context("cargo test")?;
    ensure!(status.success(), "{command:?} ended with {status}");
    Ok(())
}

impl Cell<'_> {
    fn name(&self) -> String {
        format!("{}::{}", self.kind, self.pair)
    }
}

/// Returns the cells in the lines that their tests have written: name, result, text.
fn cells(text: &str) -> Vec<Cell<'_>> {
    let lines = text.lines().filter_map(|line| {
        let mut parts = line.splitn(3, '\t');
        let (kind, pair) = parts.next()?.split_once("::")?;
        Some(Cell {
            kind,
            pair,
            result: parts.next()?,
            text: parts.next().unwrap_or_default(),
        })
    });
    lines.collect()
}

/// Returns the table of pairs and kinds, and below it each figure and each reason.
fn table(cells: &[Cell<'_>]) -> String {
    let kinds: BTreeSet<&str> = cells.iter().map(|cell| cell.kind).collect();
    let pairs: BTreeSet<&str> = cells.iter().map(|cell| cell.pair).collect();
    let mut table = format!("\n{:<18}", "");
    for kind in &kinds {
        let _ = write!(table, " {kind:>18}");
    }
    for pair in pairs {
        let _ = write!(table, "\n{pair:<18}");
        for kind in &kinds {
            let mut here = cells
                .iter()
                .filter(|cell| (cell.kind, cell.pair) == (kind, pair));
            let result = here.next().map_or("-", |cell| cell.result);
            let _ = write!(table, " {result:>18}");
        }
    }
    table += "\n\n";
    for cell in cells.iter().filter(|cell| !cell.text.is_empty()) {
        let begin = if cell.result == "skipped" {
            "SKIPPED: "
        } else {
            ""
        };
        let _ = writeln!(table, "{begin}{}: {}", cell.name(), cell.text);
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_a_row_for_each_pair_and_a_column_for_each_kind() {
        let text =
            "plain::a_to_b\tpassed\t\nloss::a_to_b\tfailed\t80 %\nplain::b_to_a\tskipped\tno b\n";
        let table = table(&cells(text));
        let rows: Vec<Vec<&str>> = table
            .lines()
            .map(|line| line.split_whitespace().collect())
            .collect();
        assert_eq!(rows[1], ["loss", "plain"]);
        assert_eq!(rows[2], ["a_to_b", "failed", "passed"]);
        assert_eq!(rows[3], ["b_to_a", "-", "skipped"]);
        assert!(table.ends_with("loss::a_to_b: 80 %\nSKIPPED: plain::b_to_a: no b\n"));
    }
}
