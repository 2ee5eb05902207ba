//! Names that two things share: public types of different crates, and files of product code.

use crate::read;
use anyhow::Result;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Names that several crates give to a public type, each with the reason: lines `Name: reason`.
const ACCEPTED: &str = "xtask/shared-names.txt";
/// Files that cargo or the language names.
const NAMED_BY_RULE: [&str; 4] = ["build", "lib", "main", "mod"];
/// A file of test cases has the name of the trait that they test.
const CASES: &str = "board/conformance/src/cases/";
/// At most this many files of product code may share a name: a trait, its model and one user of it.
const MOST_FILES: usize = 3;

/// Finds names with several meanings. `types` are public types with their crates, `files` all
/// files.
pub(crate) fn findings(
    root: &Path,
    types: &BTreeMap<String, BTreeSet<String>>,
    files: &[(String, String)],
) -> Result<Vec<String>> {
    let accepted = read(root.join(ACCEPTED))?;
    let mut findings = shared_types(types, &accepted);
    let files: Vec<&str> = files.iter().map(|(file, _)| file.as_str()).collect();
    findings.extend(shared_files(&files));
    Ok(findings)
}

fn shared_types(types: &BTreeMap<String, BTreeSet<String>>, accepted: &str) -> Vec<String> {
    let accepted: BTreeMap<&str, &str> = accepted
        .lines()
        .filter_map(|it| it.split_once(": "))
        .collect();
    let shared = types.iter().filter(|(_, crates)| crates.len() > 1);
    let shared: BTreeMap<&str, _> = shared
        .map(|(name, crates)| (name.as_str(), crates))
        .collect();
    let new = shared
        .iter()
        .filter(|(name, _)| !accepted.contains_key(*name));
    let new = new.map(|(name, crates)| {
        format!("{name}: a public type in each of {crates:?}; rename one, or give the reason in {ACCEPTED}")
    });
    let stale = accepted.keys().filter(|name| !shared.contains_key(*name));
    let stale = stale.map(|name| format!("{ACCEPTED}: {name} is the name of one type only"));
    new.chain(stale).collect()
}

fn shared_files(files: &[&str]) -> Vec<String> {
    let mut by_name = BTreeMap::<&str, Vec<&str>>::new();
    for file in files {
        let is_product = file.contains("/src/") && !format!("/{file}").contains("/tests/");
        let name = Path::new(file)
            .file_stem()
            .and_then(|stem| stem.to_str())
            .unwrap_or_default();
        if is_product
            && name != "tests"
            && !NAMED_BY_RULE.contains(&name)
            && !file.starts_with(CASES)
        {
            by_name.entry(name).or_default().push(file);
        }
    }
    let many = by_name
        .into_iter()
        .filter(|(_, files)| files.len() > MOST_FILES);
    many.map(|(name, files)| format!("{name}.rs: {} files: {}", files.len(), files.join(", ")))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_of_two_crates_needs_a_reason() {
        let types: BTreeMap<String, BTreeSet<String>> = [
            ("Role", &["bus", "redundancy"][..]),
            ("Phase", &["redundancy"]),
        ]
        .map(|(name, crates)| {
            (
                name.to_owned(),
                crates.iter().map(ToString::to_string).collect(),
            )
        })
        .into();
        let found = shared_types(&types, "");
        assert_eq!(found.len(), 1);
        assert!(found[0].starts_with("Role: a public type in each of {\"bus\", \"redundancy\"}"));
        assert!(shared_types(&types, "Role: sent as it is held\n").is_empty());
        // The list gives a reason for a name that is no longer shared.
        let stale = shared_types(&types, "Role: sent as it is held\nPhase: old\n");
        assert_eq!(
            stale,
            ["xtask/shared-names.txt: Phase is the name of one type only"]
        );
    }

    #[test]
    fn a_file_name_stands_in_three_places_at_most() {
        let files = |folders: &[&str]| -> Vec<String> {
            folders
                .iter()
                .map(|folder| format!("{folder}/flash.rs"))
                .collect()
        };
        let three = ["board/api/src", "board/peripherals/src", "board/host/src"];
        let apart = ["board/host/tests", "board/conformance/src/cases"];
        let found = |folders: &[&str]| {
            let files = files(folders);
            shared_files(&files.iter().map(String::as_str).collect::<Vec<_>>())
        };
        assert!(found(&[&three[..], &apart].concat()).is_empty());
        let four = [&three[..], &["boot/src"]].concat();
        assert!(found(&four)[0].starts_with("flash.rs: 4 files: board/api/src/flash.rs, "));
    }
}
