//! The table of faults in `docs/faults.md`.
#![forbid(unsafe_code)]
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::collections::BTreeSet;
use std::fmt::Write as _;
use tandem_faults::{Kind, Loss, Site};

/// Returns the variants of [`Kind`] with their comments, as written in the code.
fn variants() -> Vec<(String, String)> {
    let source = include_str!("../src/kind.rs");
    let (_, body) = source.split_once("pub enum Kind {\n").unwrap();
    let (body, _) = body.split_once("\n}\n").unwrap();
    let mut variants = Vec::new();
    let mut comment = Vec::new();
    // Lines with a deeper indentation are fields.
    let lines = body.lines().filter_map(|line| line.strip_prefix("    "));
    for line in lines.filter(|line| !line.starts_with(' ')) {
        if let Some(words) = line.strip_prefix("/// ") {
            comment.push(words);
        } else if line.starts_with(char::is_uppercase) {
            let name = line.split(|letter: char| !letter.is_alphabetic()).next();
            variants.push((name.unwrap().to_owned(), comment.join(" ")));
            comment.clear();
        }
    }
    variants
}

/// Returns the value of `what` for a variant.
fn word(variant: &str) -> String {
    let mut word = String::new();
    for letter in variant.chars() {
        if letter.is_uppercase() && !word.is_empty() {
            word.push('-');
        }
        word.extend(letter.to_lowercase());
    }
    word
}

fn loss(loss: Loss) -> &'static str {
    match loss {
        Loss::None => "none",
        Loss::Stall(_) => "stall",
        Loss::Power => "power",
        Loss::Silence => "silence",
        Loss::Mute => "mute",
        Loss::Clock(_) | Loss::Refused(_) => "clock",
    }
}

fn table() -> String {
    let mut text = "| `what` | effect | further keys | loss | sim | chaos | qemu |\n\
                    |---|---|---|---|---|---|---|\n"
        .to_owned();
    for (name, effect) in variants() {
        let word = word(&name);
        let kinds: Vec<Kind> = Kind::samples().filter(|kind| kind.word() == word).collect();
        let first = kinds
            .first()
            .unwrap_or_else(|| panic!("no sample of {word}"));
        let wire = matches!(first, Kind::Cut { .. } | Kind::Flap { .. }).then_some("`wire`");
        let amount = first.amount().map(|amount| format!("`amount`: {amount}"));
        let wire = wire.map(str::to_owned).into_iter();
        let keys: Vec<String> = wire.chain(amount).chain(first.own_keys()).collect();
        let losses: BTreeSet<&str> = kinds.iter().map(|kind| loss(kind.facts().loss)).collect();
        let losses: Vec<&str> = losses.into_iter().collect();
        let sites = [Site::Simulator, Site::Processes, Site::Machines].map(|site| {
            let labels = kinds.iter().filter(|kind| kind.is_for(site));
            let labels: BTreeSet<String> = labels.map(|kind| kind.label()).collect();
            let all: BTreeSet<String> = kinds.iter().map(|kind| kind.label()).collect();
            match labels.len() {
                0 => String::new(),
                count if count == all.len() => "yes".to_owned(),
                _ => labels.into_iter().collect::<Vec<_>>().join(", "),
            }
        });
        let (keys, losses, sites) = (keys.join(", "), losses.join(", "), sites.join(" | "));
        let effect = effect.trim_end_matches('.');
        writeln!(
            text,
            "| `{word}` | {effect} | {keys} | {losses} | {sites} |"
        )
        .unwrap();
    }
    text
}

/// The table in the docs agrees with the kinds; `UPDATE_DOCS=1` updates it. Each kind has a sample.
#[test]
fn the_table_of_the_docs_is_that_of_the_kinds() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/faults.md");
    let (begin, end) = ("<!-- kinds:begin -->\n", "<!-- kinds:end -->");
    let page = std::fs::read_to_string(path).unwrap();
    let (before, rest) = page.split_once(begin).unwrap();
    let (found, after) = rest.split_once(end).unwrap();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(path, format!("{before}{begin}{}{end}{after}", table())).unwrap();
    } else {
        let how = "docs/faults.md is out of date: UPDATE_DOCS=1 cargo test -p tandem-faults";
        assert_eq!(found, table(), "{how}");
    }
}
