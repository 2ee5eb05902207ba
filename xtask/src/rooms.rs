//! The directions of dependency between the modules of a crate.

use crate::cargo;
use anyhow::{Context, Result};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// The second workspace: its folder is one room.
const FIRMWARE: &str = "firmware-port";

/// Finds circles of dependency between modules.
pub(crate) fn findings(root: &Path) -> Result<Vec<String>> {
    let mut findings = Vec::new();
    for workspace in [root, &root.join(FIRMWARE)] {
        let metadata = metadata(workspace)?;
        for package in metadata["packages"].as_array().into_iter().flatten() {
            let manifest = package["manifest_path"].as_str().unwrap_or_default();
            let folder = Path::new(manifest).with_file_name("");
            let circle = circle(&module_uses(&folder.join("src"))?);
            let room = folder.strip_prefix(root).unwrap_or(&folder);
            if !circle.is_empty() {
                let room = room.display();
                findings.push(format!("{room}: modules that use each other: {circle:?}"));
            }
        }
    }
    Ok(findings)
}

fn metadata(folder: &Path) -> Result<Value> {
    let output = cargo(folder, &["metadata", "--format-version=1", "--no-deps"]).output()?;
    serde_json::from_slice(&output.stdout).context("cargo metadata")
}

/// For each top module of a crate: the others that it names.
type Uses = BTreeMap<String, BTreeSet<String>>;

fn module_uses(src: &Path) -> Result<Uses> {
    let mut texts: BTreeMap<String, String> = BTreeMap::new();
    let mut root = String::new();
    for entry in fs::read_dir(src).with_context(|| src.display().to_string())? {
        let path = entry?.path();
        let name = path.file_stem().and_then(|name| name.to_str());
        let name = name.unwrap_or_default().to_owned();
        if path.is_dir() {
            // A crate's programs are separate crates.
            if name != "bin" {
                read_folder(&path, texts.entry(name).or_default())?;
            }
        } else if name == "lib" || name == "main" {
            root.push_str(&fs::read_to_string(&path)?);
        } else {
            let text = without_tests(&fs::read_to_string(&path)?);
            // In this file `super` is the crate.
            let text = text.replace("super::", "crate::");
            texts.entry(name).or_default().push_str(&text);
        }
    }
    let mut homes: Homes = texts
        .keys()
        .map(|name| (name.clone(), name.clone()))
        .collect();
    for (name, home) in handed_on(&root) {
        if texts.contains_key(&home) {
            homes.entry(name).or_insert(home);
        }
    }
    let uses = texts.into_iter().map(|(name, text)| {
        let mut used = named_modules(&text, &homes);
        used.remove(&name);
        (name, used)
    });
    Ok(uses.collect())
}

/// The module of each name behind `crate::`.
type Homes = BTreeMap<String, String>;

/// The names that a crate's root re-exports (`pub use module::{Name, ..}`), with their modules.
fn handed_on(root: &str) -> Homes {
    let mut homes = Homes::new();
    for item in root.split(';') {
        let Some((_, item)) = item.split_once("use ") else {
            continue;
        };
        let Some((module, names)) = item.split_once("::") else {
            continue;
        };
        let names = names.split(|c: char| !c.is_alphanumeric() && c != '_');
        let names = names.filter(|name| !name.is_empty());
        homes.extend(names.map(|name| (name.to_owned(), module.trim().to_owned())));
    }
    homes
}

fn read_folder(folder: &Path, into: &mut String) -> Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            read_folder(&path, into)?;
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push_str(&without_tests(&fs::read_to_string(&path)?));
        }
    }
    Ok(())
}

/// The code without comments, and without the tests, which are last in a file.
fn without_tests(text: &str) -> String {
    let code = text.split("#[cfg(test)]\nmod tests").next().unwrap_or(text);
    let lines = code
        .lines()
        .filter(|line| !line.trim_start().starts_with("//"));
    lines.collect::<Vec<_>>().join("\n")
}

/// The modules of the names behind `crate::`, alone or in braces.
fn named_modules(text: &str, homes: &Homes) -> BTreeSet<String> {
    let mut named = BTreeSet::new();
    for behind in text.split("crate::").skip(1) {
        let (list, is_list) = match behind.strip_prefix('{') {
            Some(list) => (list, true),
            None => (behind, false),
        };
        let mut depth = 0;
        let mut word = String::new();
        let mut at_begin = true;
        for letter in list.chars() {
            if letter.is_alphanumeric() || letter == '_' {
                word.push(letter);
                continue;
            }
            if at_begin && depth == 0 {
                named.extend(homes.get(&word).cloned());
            }
            at_begin = at_begin && word.is_empty() && letter.is_whitespace() || letter == ',';
            word.clear();
            match letter {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ';' => break,
                _ if !is_list => break,
                _ => {}
            }
        }
    }
    named
}

/// The modules that remain when those that use no other, or that no other uses, are removed
/// repeatedly.
fn circle(uses: &Uses) -> BTreeSet<String> {
    let mut left = uses.clone();
    loop {
        let free = |(name, used): &(&String, &BTreeSet<String>)| {
            !used.iter().any(|used| left.contains_key(used))
                || !left.values().any(|used| used.contains(*name))
        };
        let Some(name) = left.iter().find(free).map(|(name, _)| name.clone()) else {
            return left.into_keys().collect();
        };
        left.remove(&name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn modules_are_found_alone_and_in_braces() {
        let modules = ["a", "b", "c", "d"].map(|name| (name.to_owned(), name.to_owned()));
        let mut homes = Homes::from(modules);
        let text = "use crate::{a::{X, d}, b};\nfn f() { crate::c::g(crate::e) }";
        assert_eq!(named_modules(text, &homes), set(&["a", "b", "c"]));
        // A name that the crate's root re-exports belongs to its module.
        homes.extend(handed_on("mod d;\npub use d::{E, F};\npub use std::fmt;"));
        assert_eq!(named_modules("crate::F;", &homes), set(&["d"]));
    }

    #[test]
    fn a_circle_is_found() {
        let uses = |arrows: &[(&str, &[&str])]| -> Uses {
            let arrows = arrows.iter();
            arrows
                .map(|(from, to)| (from.to_string(), set(to)))
                .collect()
        };
        let tree = uses(&[("a", &["b", "c"]), ("b", &["c"]), ("c", &[])]);
        assert_eq!(circle(&tree), set(&[]));
        let round = uses(&[("a", &["b"]), ("b", &["c", "d"]), ("c", &["b"]), ("d", &[])]);
        assert_eq!(circle(&round), set(&["b", "c"]));
    }
}
