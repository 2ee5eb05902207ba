//! Which requirement is named by which tests.

use crate::tidy::rust_files;
use anyhow::{Context, Result, bail};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

/// Prints every requirement with the tests that name it.
pub(crate) fn run(root: &Path, require: &[String]) -> Result<()> {
    let requirements = requirements(root)?;
    let mut tests: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for file in rust_files(root)? {
        let text = fs::read_to_string(&file).with_context(|| file.display().to_string())?;
        let place = file
            .strip_prefix(root)
            .unwrap_or(&file)
            .display()
            .to_string();
        for (ids, test) in named_tests(&text) {
            for (id, _) in requirements
                .iter()
                .filter(|(id, _)| ids.iter().any(|named| named == id))
            {
                tests
                    .entry(id)
                    .or_default()
                    .push(format!("{place}: {test}"));
            }
        }
    }
    let mut proven = 0;
    for (id, title) in &requirements {
        let named = tests.get(id.as_str()).map_or(&[][..], Vec::as_slice);
        proven += usize::from(!named.is_empty());
        println!(
            "{} {id:<9} {title}",
            if named.is_empty() { "·" } else { "✓" }
        );
        named.iter().for_each(|test| println!("            {test}"));
    }
    println!(
        "{proven} of {} requirements are named by a test",
        requirements.len()
    );
    let missing: Vec<_> = require
        .iter()
        .filter(|id| !tests.contains_key(id.as_str()))
        .cloned()
        .collect();
    if !missing.is_empty() {
        bail!("no test names {}", missing.join(", "));
    }
    Ok(())
}

/// The rows of `docs/requirements.md`.
fn requirements(root: &Path) -> Result<Vec<(String, String)>> {
    let page = root.join("docs/requirements.md");
    let text = fs::read_to_string(&page).with_context(|| page.display().to_string())?;
    let rows = text.lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| ")?.split(" | ");
        let (id, title) = (cells.next()?, cells.next()?);
        let id_like = id.contains('-') && !id.starts_with('-');
        id_like.then(|| (id.to_owned(), title.trim_end_matches(" |").to_owned()))
    });
    Ok(rows.collect())
}

/// Tests of a file with the requirement ids in their documentation comments.
fn named_tests(text: &str) -> Vec<(Vec<String>, String)> {
    let mut found = Vec::new();
    let mut ids = Vec::new();
    let mut is_test = false;
    for line in text.lines().map(str::trim_start) {
        if let Some(comment) = line.strip_prefix("///") {
            ids.extend(ids_in(comment));
        } else if line.starts_with("#[") {
            is_test |= line.contains("test]") || line.contains("test(");
        } else {
            let name = line
                .split("fn ")
                .nth(1)
                .and_then(|rest| rest.split(['(', '<']).next());
            if let (Some(name), true, false) = (name, is_test, ids.is_empty()) {
                found.push((ids.clone(), name.to_owned()));
            }
            ids.clear();
            is_test = false;
        }
    }
    found
}

/// Requirement ids in a comment; `T-LOCK-1..3` names all three.
fn ids_in(comment: &str) -> Vec<String> {
    let mut ids = Vec::new();
    for word in comment.split(|c: char| !(c.is_ascii_alphanumeric() || c == '-' || c == '.')) {
        let (first, last) = word
            .trim_end_matches('.')
            .split_once("..")
            .unwrap_or((word, ""));
        let first = first.trim_end_matches('.');
        let Some((stem, number)) = first.rsplit_once('-') else {
            continue;
        };
        let Ok(number) = number.parse::<u32>() else {
            continue;
        };
        if !stem.chars().all(|c| c.is_ascii_uppercase() || c == '-') {
            continue;
        }
        let last = last.trim_start_matches('=').parse().unwrap_or(number);
        ids.extend((number..=last.min(number + 20)).map(|number| format!("{stem}-{number}")));
    }
    ids
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_found_alone_and_as_ranges() {
        assert_eq!(ids_in(" T-LOCK-2: no increment is lost"), ["T-LOCK-2"]);
        assert_eq!(
            ids_in(" T-RED-1..3, E-4."),
            ["T-RED-1", "T-RED-2", "T-RED-3", "E-4"]
        );
        assert!(ids_in(" a CRC-like word, x-1 and state-of-the-art").is_empty());
    }

    #[test]
    fn only_tests_count() {
        let text = "/// T-LOCK-1\nfn helper() {}\n/// T-LOCK-2\n#[test]\nfn counts() {}\n";
        assert_eq!(
            named_tests(text),
            [(vec!["T-LOCK-2".to_owned()], "counts".to_owned())]
        );
    }
}
