//! Lies to all cores of both systems, one signal after the other, and prints what it leads to.
//! Fails if the vehicle gets farther off its lane than `docs/redundancy.md` says. `cargo xtask
//! campaign wrong-in-both` runs it.
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};
use tandem_board::SystemId;
use tandem_cores::trace::Event;
use tandem_faults::{Group, Kind, Sequence, Signal, Way};
use tandem_record::verdict::Rule;
use tandem_redundancy::Config;
use tandem_sim::{Profile, Tried};

/// The largest offset from the lane that is documented, m.
const LARGEST_M: f64 = 4.0;

/// Returns the lie to both systems that this sequence tells one core of A; `None` if it is another
/// fault, or not one of core 0 of the system that drives beside a standby.
fn to_both(mut sequence: Sequence) -> Option<(Signal, Sequence)> {
    let setting = sequence.setting?;
    let fault = *sequence.faults.first()?;
    let Kind::WrongValue(wrong) = fault.kind else {
        return None;
    };
    let is_first = setting.driver == SystemId::A && !setting.is_alone && fault.way == Way::A;
    if !is_first || wrong.core != 0 || !wrong.signal.cores().contains(&1) {
        return None;
    }
    sequence.faults = [0, 1]
        .map(|core| {
            let mut fault = fault;
            fault.way = Way::Both;
            fault.kind = Kind::WrongValue(tandem_faults::WrongValue { core, ..wrong });
            fault
        })
        .to_vec();
    Some((wrong.signal, sequence))
}

/// What the lies of one signal led to.
#[derive(Default)]
struct Row {
    lies: usize,
    named: usize,
    off_lane: usize,
    collisions: usize,
    aside_m: f64,
}

impl Row {
    fn add(&mut self, tried: &Tried) {
        let named = tried.found.as_ref().map(|found| found.event);
        self.lies += 1;
        self.named += usize::from(matches!(named, Some(Event::SensorLies { .. })));
        self.off_lane += usize::from(tried.violations.contains(&Rule::OffLane));
        self.collisions += usize::from(tried.violations.contains(&Rule::Collision));
        self.aside_m = self.aside_m.max(tried.aside_m.unwrap_or(0.0));
    }
}

fn main() -> ExitCode {
    let numbers = 0..Group::Values.count().unwrap_or(0);
    let lies = Mutex::new(numbers.filter_map(|it| to_both(Group::Values.sequence(it))));
    let rows = Mutex::new(BTreeMap::<&str, Row>::new());
    let profile = Profile::from(Config::rt());
    std::thread::scope(|threads| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            threads.spawn(|| {
                loop {
                    let next = lies.lock().unwrap_or_else(PoisonError::into_inner).next();
                    let Some((signal, sequence)) = next else {
                        return;
                    };
                    let tried = profile.try_run(&sequence);
                    let mut rows = rows.lock().unwrap_or_else(PoisonError::into_inner);
                    rows.entry(signal.name()).or_default().add(&tried);
                }
            });
        }
    });
    println!("| signal | lies | named | off the lane | farthest aside, m | collisions |");
    println!("|---|---|---|---|---|---|");
    let mut is_worse = false;
    for (signal, row) in rows.into_inner().unwrap_or_else(PoisonError::into_inner) {
        let Row {
            lies,
            named,
            off_lane,
            collisions,
            aside_m,
        } = row;
        println!("| {signal} | {lies} | {named} | {off_lane} | {aside_m:.2} | {collisions} |");
        is_worse |= aside_m > LARGEST_M;
    }
    ExitCode::from(u8::from(is_worse))
}
