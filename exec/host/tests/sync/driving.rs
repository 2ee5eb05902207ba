//! The driving functions over recorded frames as three client processes in lockstep.

use std::path::{Path, PathBuf};

use tandem_golden::play;

use crate::group::{CONFIG, Group, Process, activations, check_all};
use crate::roles::Replay;

#[path = "../../../../tests/golden/recording.rs"]
mod recording;
pub(crate) use recording::DRIVE_MS;

pub(crate) const ALL: &[(&str, fn())] = &[
    (
        "three_drivers_agree_in_each_cycle_and_with_the_golden_outputs",
        all_agree,
    ),
    (
        "a_flipped_bit_of_an_output_is_found_in_the_same_cycle",
        output_flip,
    ),
    (
        "a_flipped_bit_of_a_frame_is_found_when_it_first_changes_an_output",
        frame_flip,
    ),
];

/// Activations before the first `Run`: RegisterServices, ServiceDiscovery, Init.
const BEFORE_RUN: usize = 3;

fn write(folder: &Path) -> (Vec<u32>, PathBuf) {
    let words = recording::record("cut-in");
    let path = folder.join("recording");
    let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    std::fs::write(&path, bytes).unwrap();
    (words, path)
}

/// Drives with one flipped bit in client 1. Returns the golden digest, the processes, and what the
/// master told.
fn drive(flip: &str) -> (String, [Process; 3], Vec<String>) {
    let group = Group::new(CONFIG);
    let (words, path) = write(group.folder.path());
    let golden = format!("digest {:?}", play(&words, DRIVE_MS));
    let mut master = group.master(0);
    let path = path.to_str().unwrap();
    let mut drivers =
        [(0, "-"), (1, flip), (2, "-")].map(|(id, flip)| group.driver(id, path, flip));
    drivers.iter_mut().for_each(Process::finish);
    master.finish();
    (golden, drivers, master.told.clone())
}

/// E-3, used for real: 300 control cycles, equal in each, and equal to the golden outputs.
fn all_agree() {
    let (golden, drivers, told) = drive("-");
    for driver in &drivers {
        assert_eq!(driver.told.last(), Some(&golden));
    }
    assert!(check_all(drivers.iter().map(|driver| &driver.told)) >= 300);
    assert!(
        !told.iter().any(|line| line.contains("Deviates")),
        "{told:?}"
    );
}

/// E-3: found in the cycle in which the output is wrong, named, excluded; the others drive on.
fn output_flip() {
    excluded("output@120", 120);
}

/// E-3: a wrong bit in a frame is found in the first cycle in which it changes what is computed.
fn frame_flip() {
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = write(folder.path());
    let bytes = std::fs::read(path).unwrap();
    let mut both = ["-", "frame@150"].map(|flip| Replay::new(&bytes, flip));
    let differs = |_: &usize| {
        let [right, wrong] = both.each_mut().map(Replay::step);
        right != wrong
    };
    let first = (0..300).find(differs).expect("the bit changes an output");
    assert!(first >= 150);
    excluded("frame@150", first);
}

fn excluded(flip: &str, wrong: usize) {
    let (golden, drivers, told) = drive(flip);
    let cycle = BEFORE_RUN + wrong + 1;
    let found: Vec<_> = told
        .iter()
        .filter(|line| line.starts_with("Deviates"))
        .collect();
    assert_eq!(found, [&format!("Deviates(ClientId(1), {cycle})")]);
    for driver in [&drivers[0], &drivers[2]] {
        assert_eq!(driver.told.last(), Some(&golden), "drives to the end");
        assert_eq!(activations(&driver.told).last().unwrap().code, "Terminate");
    }
    assert_ne!(
        drivers[1].told.last(),
        Some(&golden),
        "the excluded one ended early"
    );
    check_all(drivers.iter().map(|driver| &driver.told));
}
