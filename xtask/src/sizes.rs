//! The numbers of lines of each room, product and tests, compared with the committed table.

use crate::{git_files, read, write};
use anyhow::{Context, Result};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

const TABLE: &str = "docs/rooms.md";
const HEAD: &str = "\
<!-- Written by `cargo xtask tidy --save`. Only the last column is edited. -->

# Lines of Rust of each room

Tests are the folders `tests/` and `examples/`, the files `tests.rs`, and what follows a
`#[cfg(test)]` module. `cargo xtask tidy` fails if a room has more product lines than this table:
growth is a decision that a commit's body argues for. A limit holds for product lines, or `with
tests` for both; `--save` does not lift it.

| room | product | tests | limit |
|---|---:|---:|---|
";

/// Lines of a room.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Lines {
    product: usize,
    tests: usize,
}

/// A row of the table.
#[derive(Clone, Debug, Default, PartialEq)]
struct Room {
    lines: Lines,
    limit: String,
}

/// Rooms by their folders. A file belongs to the innermost of these folders that contains it.
type Rooms = BTreeMap<String, Room>;

/// Prints each room beside the table. Returns a finding for each that grew or exceeds its limit.
/// With `save` it first writes the current sizes to the table; then no room counts as grown.
pub(crate) fn findings(root: &Path, save: bool) -> Result<Vec<String>> {
    let table = read(root.join(TABLE))?;
    let mut known = rooms_in(&table)?;
    let now = counted(root, &known)?;
    println!(
        "{:<16} {:>7} {:>7} {:>7} {:>7}",
        "lines", "product", "table", "tests", "table"
    );
    let mut sum = Lines::default();
    for (name, lines) in &now {
        let then = known.get(name).cloned().unwrap_or_default().lines;
        let Lines { product, tests } = *lines;
        println!(
            "{name:<16} {product:>7} {:>7} {tests:>7} {:>7}",
            then.product, then.tests
        );
        sum = Lines {
            product: sum.product + product,
            tests: sum.tests + tests,
        };
    }
    println!("product {}, tests {}", sum.product, sum.tests);
    if save {
        known.retain(|name, room| now.contains_key(name) || !room.limit.is_empty());
        for (name, lines) in &now {
            known.entry(name.clone()).or_default().lines = *lines;
        }
        write(root.join(TABLE), &written(&known))?;
    }
    let mut findings = Vec::new();
    for (name, lines) in now {
        findings.extend(grown(&name, lines, known.get(&name))?);
    }
    Ok(findings)
}

/// Returns the finding about a room of this size, if any.
fn grown(name: &str, lines: Lines, known: Option<&Room>) -> Result<Option<String>> {
    let Some(known) = known else {
        return Ok(Some(format!(
            "{name}: a room that is not in {TABLE}; `cargo xtask tidy --save`"
        )));
    };
    let Lines { product, tests } = lines;
    if product > known.lines.product {
        return Ok(Some(format!(
            "{name}: {product} product lines, {} in {TABLE}: growth is a decision that a commit's \
             body argues for; then `cargo xtask tidy --save`",
            known.lines.product
        )));
    }
    let limited = match known.limit.strip_suffix(" with tests") {
        Some(limit) => Some((limit, product + tests)),
        None if known.limit.is_empty() => None,
        None => Some((known.limit.as_str(), product)),
    };
    let Some((limit, is)) = limited else {
        return Ok(None);
    };
    let most: usize = limit
        .parse()
        .with_context(|| format!("{TABLE}: the limit of {name}"))?;
    Ok((is > most).then(|| {
        format!(
            "{name}: {is} lines; its limit in {TABLE} is {}",
            known.limit
        )
    }))
}

fn rooms_in(table: &str) -> Result<Rooms> {
    let rows = table.lines().filter(|line| line.starts_with('|')).skip(2);
    let rooms = rows.map(|row| {
        let cells: Vec<&str> = row.split('|').map(str::trim).collect();
        let [_, name, product, tests, limit, _] = cells[..] else {
            return None;
        };
        let (product, tests) = (product.parse().ok()?, tests.parse().ok()?);
        let (lines, limit) = (Lines { product, tests }, limit.to_owned());
        Some((name.to_owned(), Room { lines, limit }))
    });
    rooms
        .collect::<Option<_>>()
        .with_context(|| format!("{TABLE}: a row is not `| room | product | tests | limit |`"))
}

fn written(rooms: &Rooms) -> String {
    let mut text = HEAD.to_owned();
    for (name, Room { lines, limit }) in rooms {
        let _ = writeln!(
            text,
            "| {name} | {} | {} | {limit} |",
            lines.product, lines.tests
        );
    }
    text
}

/// Counts the files that git tracks.
fn counted(root: &Path, known: &Rooms) -> Result<BTreeMap<String, Lines>> {
    let mut rooms = BTreeMap::<String, Lines>::new();
    for file in git_files(root, &["*.rs"])? {
        let text = read(root.join(&file))?;
        let contains = |room: &&String| {
            file.strip_prefix(room.as_str())
                .is_some_and(|rest| rest.starts_with('/'))
        };
        let first = || file.split('/').next().unwrap_or_default().to_owned();
        let room = known.keys().filter(contains).max_by_key(|room| room.len());
        let lines = rooms
            .entry(room.cloned().unwrap_or_else(first))
            .or_default();
        let of_file = lines_of(&file, &text);
        lines.product += of_file.product;
        lines.tests += of_file.tests;
    }
    Ok(rooms)
}

fn lines_of(file: &str, text: &str) -> Lines {
    let lines: Vec<&str> = text.lines().collect();
    let begins_tests = |pair: &[&str]| {
        let name = pair[1]
            .trim_start()
            .strip_prefix("mod ")
            .and_then(|rest| rest.split_once(" {"));
        pair[0].trim() == "#[cfg(test)]" && name.is_some()
    };
    let place = format!("/{file}");
    // An example is compiled and run like a test, and no product depends on it.
    let is_example = place.contains("/examples/");
    let is_test = is_example || place.contains("/tests/") || file.ends_with("/tests.rs");
    let product = match lines.windows(2).position(begins_tests) {
        _ if is_test => 0,
        Some(at) => at,
        None => lines.len(),
    };
    Lines {
        product,
        tests: lines.len() - product,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tests_are_counted_apart() {
        let lines = |file: &str, text: &str| {
            let Lines { product, tests } = lines_of(file, text);
            (product, tests)
        };
        let text = "a\nb\n#[cfg(test)]\nmod tests {\n}\n";
        assert_eq!(lines("shm/src/a.rs", text), (2, 3));
        assert_eq!(lines("shm/src/tests.rs", text), (0, 5));
        assert_eq!(lines("shm/tests/a.rs", text), (0, 5));
        assert_eq!(lines("shm/examples/a.rs", text), (0, 5));
        assert_eq!(lines("tests/src/a.rs", text), (0, 5));
        // The test module is in another file; its lines are counted there.
        assert_eq!(
            lines("shm/src/a.rs", "a\n#[cfg(test)]\nmod tests;\nb\n"),
            (4, 0)
        );
    }

    #[test]
    fn a_room_grows_with_its_row_only() {
        let lines = |product, tests| Lines { product, tests };
        let found = |product, tests, limit: &str| {
            let room = Room {
                lines: lines(100, 50),
                limit: limit.to_owned(),
            };
            grown("shm", lines(product, tests), Some(&room)).unwrap()
        };
        assert_eq!(found(100, 90, ""), None);
        let text = found(101, 50, "").unwrap();
        assert!(
            text.starts_with("shm: 101 product lines, 100 in docs/rooms.md: growth"),
            "{text}"
        );
        // A room must stay within its limit even if it has not grown.
        assert_eq!(found(100, 50, "100"), None);
        assert!(found(100, 50, "99").is_some());
        assert_eq!(found(90, 50, "140 with tests"), None);
        assert!(found(90, 51, "140 with tests").is_some());
        assert!(grown("new", lines(1, 0), None).unwrap().is_some());
        assert!(
            grown(
                "shm",
                lines(0, 0),
                Some(&Room {
                    limit: "few".into(),
                    ..Room::default()
                })
            )
            .is_err()
        );
    }

    #[test]
    fn the_table_is_read_as_it_is_written() {
        let room = |product, limit: &str| Room {
            lines: Lines { product, tests: 1 },
            limit: limit.to_owned(),
        };
        let rooms = Rooms::from([
            ("exec".to_owned(), room(7, "1500 with tests")),
            ("exec/host".to_owned(), room(8, "")),
        ]);
        assert_eq!(rooms_in(&written(&rooms)).unwrap(), rooms);
        assert!(rooms_in(&written(&rooms).replace("| 7", "| many")).is_err());
    }
}
