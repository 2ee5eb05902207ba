//! Lists the tests that name each requirement.

use crate::read;
use crate::tidy::rust_files;
use anyhow::{Result, bail};
use std::collections::BTreeMap;
use std::path::Path;

/// Prints every requirement with the tests that name it.
pub(crate) fn run(root: &Path, require: &[String]) -> Result<()> {
    let requirements = requirements(root)?;
    let mut tests: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    let mut tables: BTreeMap<&str, BTreeMap<String, String>> = BTreeMap::new();
    let files = rust_files(root)?;
    let folder_of = |file: &str| file.rfind('/').unwrap_or_default();
    for (file, text) in &files {
        tables
            .entry(&file[..folder_of(file)])
            .or_default()
            .extend(cases(text));
    }
    for (file, text) in &files {
        for (ids, test) in named_tests(text, &tables[&file[..folder_of(file)]]) {
            for (id, _) in requirements.iter().filter(|(id, _)| ids.contains(id)) {
                tests.entry(id).or_default().push(format!("{file}: {test}"));
            }
        }
    }
    let mut proven = 0;
    for (id, title) in &requirements {
        let named = tests.get(id.as_str()).map_or(&[][..], Vec::as_slice);
        proven += usize::from(!named.is_empty());
        let mark = if named.is_empty() { "·" } else { "✓" };
        println!("{mark} {id:<9} {title}");
        named.iter().for_each(|test| println!("            {test}"));
    }
    println!(
        "{proven} of {} requirements are named by a test",
        requirements.len()
    );
    let ids: Vec<&str> = requirements.iter().map(|(id, _)| id.as_str()).collect();
    require_tests(&ids, require, |id| tests.contains_key(id))
}

/// Fails if a prefix matches no requirement, or a matching requirement has no test.
fn require_tests(ids: &[&str], prefixes: &[String], has_test: impl Fn(&str) -> bool) -> Result<()> {
    let mut missing = Vec::new();
    for prefix in prefixes {
        // T-RED-1 does not mean T-RED-10.
        let fits = |id: &&&str| {
            let rest = id.strip_prefix(prefix.as_str());
            rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('-'))
        };
        let mut wanted = ids.iter().filter(fits).peekable();
        if wanted.peek().is_none() {
            bail!("no requirement begins with {prefix}");
        }
        missing.extend(wanted.copied().filter(|id| !has_test(id)));
    }
    if !missing.is_empty() {
        bail!("no test names {}", missing.join(", "));
    }
    Ok(())
}

/// Returns the rows of `docs/requirements.md`.
fn requirements(root: &Path) -> Result<Vec<(String, String)>> {
    let text = read(root.join("docs/requirements.md"))?;
    let rows = text.lines().filter_map(|line| {
        let mut cells = line.strip_prefix("| ")?.split(" | ");
        let (id, title) = (cells.next()?, cells.next()?);
        let id_like = id.contains('-') && !id.starts_with('-');
        id_like.then(|| (id.to_owned(), title.trim_end_matches(" |").to_owned()))
    });
    Ok(rows.collect())
}

/// The text with which a case in a table begins, in the conformance suite and in programs with
/// their own harness.
const CASES: [&str; 3] = ["case!(", "Case {", "Trial::test("];

/// Returns the functions that the tables of a file name, with the names of their cases.
fn cases(text: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    for begin in CASES {
        for piece in text.split(begin).skip(1) {
            // A case begins with its name and ends where the next case begins.
            let piece = CASES
                .iter()
                .fold(piece, |rest, next| rest.split(next).next().unwrap_or(rest));
            let mut parts = piece.splitn(3, '"').skip(1);
            let (Some(name), Some(rest)) = (parts.next(), parts.next()) else {
                continue;
            };
            if !name.contains(['-', '_']) || name.contains(' ') {
                continue;
            }
            let end = rest.find("\n\n").unwrap_or(rest.len());
            let words = rest[..end].split(|c: char| !(c.is_alphanumeric() || c == '_'));
            found.extend(words.map(|word| (word.to_owned(), name.to_owned())));
        }
    }
    found
}

/// Returns the tests of a file with the requirement ids in their documentation comments. `cases`:
/// the cases of the tables in its folder.
fn named_tests(text: &str, cases: &BTreeMap<String, String>) -> Vec<(Vec<String>, String)> {
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
            // A program with its own harness lists its tests in a table.
            is_test |= name.is_some_and(|name| text.contains(&format!("\"{name}\"")));
            let case = name.and_then(|name| cases.get(name));
            let test = case.map(String::as_str).or(name.filter(|_| is_test));
            if let (Some(test), false) = (test, ids.is_empty()) {
                found.push((ids.clone(), test.to_owned()));
            }
            ids.clear();
            is_test = false;
        }
    }
    found
}

/// Returns the requirement ids in a comment; `T-LOCK-1..3` names all three.
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
    fn a_prefix_requires_a_test_for_each_requirement_that_begins_with_it() {
        let ids = ["T-RED-1", "T-RED-10", "T-REDO-1", "T-LOCK-1"];
        let require = |prefix: &str| {
            let has_test = |id: &str| id != "T-RED-10" && id != "T-REDO-1";
            require_tests(&ids, &[prefix.to_owned()], has_test).map_err(|e| e.to_string())
        };
        assert_eq!(require("T-LOCK"), Ok(()));
        assert_eq!(require("T-RED-1"), Ok(()));
        assert_eq!(require("T-RED"), Err("no test names T-RED-10".to_owned()));
        assert_eq!(
            require("T-X"),
            Err("no requirement begins with T-X".to_owned())
        );
    }

    #[test]
    fn only_tests_count() {
        let text = "/// T-LOCK-1\nfn helper() {}\n/// T-LOCK-2\n#[test]\nfn counts() {}\n\
                    /// T-LOCK-3\nfn of_table() {}\nconst TESTS: _ = [(\"of_table\", of_table)];\n";
        let expected = [("T-LOCK-2", "counts"), ("T-LOCK-3", "of_table")]
            .map(|(id, test)| (vec![id.to_owned()], test.to_owned()));
        assert_eq!(named_tests(text, &BTreeMap::new()), expected);
    }

    /// The table may be in another file of the folder.
    #[test]
    fn cases_of_tables_count() {
        let table = "case!(\"line-count\", Plain, A0: lines::counter::<B>),\n\
                     Case {\n name: \"a_dead_system_is_silent\",\n core: none,\n vehicle: silence,\n }\n";
        let of_table: BTreeMap<_, _> = cases(table).into_iter().collect();
        let text = "/// T-CHIP-5\npub(super) fn counter<B: Board>() {}\n/// T-RED-9\nfn silence(x: u8) {}\n\
                    /// T-RED-1\nfn helper() {}\n";
        let expected = [
            ("T-CHIP-5", "line-count"),
            ("T-RED-9", "a_dead_system_is_silent"),
        ]
        .map(|(id, test)| (vec![id.to_owned()], test.to_owned()));
        assert_eq!(named_tests(text, &of_table), expected);
    }
}
