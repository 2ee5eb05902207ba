//! Random sequences of lost, doubled, swapped, late and corrupted messages, of jumping clocks and
//! of lies, over gPTP, pulse and CAN: no reader's time goes back, leaps or stops untold, and
//! without a liar each stated error holds. S-5
//!
//! `TANDEM_TIME_SEQUENCES` is the number of sequences, `TANDEM_TIME_FIRST` that of the first one,
//! and `TANDEM_TIME_JSON` the file for the counts.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "a test may panic and print"
)]

mod nodes;
mod oracle;
mod plan;
mod world;

use std::collections::BTreeMap;
use std::num::NonZero;
use std::thread;

use oracle::Violation;
use plan::{Liar, Place, Plan};
use world::World;

/// Sequences in the gate.
const FEW: u64 = 400;

struct Found {
    number: u64,
    liar: Liar,
    at_ms: u64,
    place: Place,
    what: Violation,
}

fn try_one(number: u64) -> Option<Found> {
    let plan = Plan::draw(number);
    let (at, place, what) = World::new(&plan, number).run()?;
    Some(Found {
        number,
        liar: plan.liar,
        at_ms: at / plan::MS,
        place,
        what,
    })
}

fn number(variable: &str, default: u64) -> u64 {
    let text = std::env::var(variable).ok();
    text.map_or(default, |text| text.parse().unwrap())
}

/// S-2, S-3, S-4, S-5: a bounded number of sequences; `cargo xtask campaign time` runs 100,000.
#[test]
fn no_reader_is_deceived_untold() {
    let (first, count) = (
        number("TANDEM_TIME_FIRST", 0),
        number("TANDEM_TIME_SEQUENCES", FEW),
    );
    let workers = thread::available_parallelism().map_or(1, NonZero::get) as u64;
    let found: Vec<Found> = thread::scope(|scope| {
        let work = |worker: u64| {
            let numbers = (first + worker..first + count).step_by(workers as usize);
            numbers.filter_map(try_one).collect::<Vec<_>>()
        };
        let workers: Vec<_> = (0..workers)
            .map(|it| scope.spawn(move || work(it)))
            .collect();
        workers
            .into_iter()
            .flat_map(|it| it.join().unwrap())
            .collect()
    });
    let mut kinds = BTreeMap::<_, Vec<&Found>>::new();
    for one in &found {
        kinds.entry((one.what, one.liar)).or_default().push(one);
    }
    for ((what, liar), of) in &kinds {
        println!("{:>7} {what:?}, liar {liar:?}", of.len());
        for one in of.iter().take(3) {
            println!(
                "        number {}, {} ms, {:?}",
                one.number, one.at_ms, one.place
            );
        }
    }
    println!("{count} sequences, {} violations", found.len());
    if let Ok(path) = std::env::var("TANDEM_TIME_JSON") {
        let text = format!(
            "{{\n  \"sequences\": {count},\n  \"violations\": {}\n}}\n",
            found.len()
        );
        std::fs::write(path, text).unwrap();
    }
    assert!(found.is_empty(), "{} violations", found.len());
}
