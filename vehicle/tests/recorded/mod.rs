//! Recorded scenarios that are not part of the repository: `TANDEM_SCENARIOS` names their folder.

#![allow(
    clippy::unwrap_used,
    reason = "a test ends where a scenario cannot be read"
)]

use std::path::{Path, PathBuf};

use tandem_vehicle::Scenario;

/// Returns the embedded scenarios, then those in the folder that `TANDEM_SCENARIOS` names. Without
/// the variable the test says that it skips them.
pub(crate) fn scenarios() -> Vec<Scenario> {
    let embedded = Scenario::names().map(|name| Scenario::load(name).unwrap());
    embedded.chain(recorded()).collect()
}

/// Returns the recorded scenarios: the CommonRoad files of the folder, in the order of their names.
///
/// # Panics
/// If the named folder has no scenario, or one cannot be read.
fn recorded() -> Vec<Scenario> {
    let Some(folder) = std::env::var_os("TANDEM_SCENARIOS") else {
        let test = std::thread::current();
        let name = test.name().unwrap_or("a test");
        eprintln!("SKIPPED recorded scenarios in {name}: TANDEM_SCENARIOS is not set");
        return vec![];
    };
    let folder = Path::new(&folder);
    let entries = folder
        .read_dir()
        .unwrap_or_else(|error| panic!("TANDEM_SCENARIOS={}: {error}", folder.display()));
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    files.retain(|file| file.extension().is_some_and(|extension| extension == "xml"));
    files.sort();
    assert!(
        !files.is_empty(),
        "TANDEM_SCENARIOS={}: no scenario",
        folder.display()
    );
    let read = |file: &PathBuf| Scenario::read(file).unwrap();
    files.iter().map(read).collect()
}
