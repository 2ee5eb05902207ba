//! Damages scenario files at random and reads them: `cargo xtask campaign scenarios`.
//!
//! Each case must end within 5 s, and the whole within 1 GB; a panic ends the campaign.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line prints")]

use std::process::ExitCode;
use std::time::Instant;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use tandem_vehicle::fuzz;

const BASES: [&str; 3] = [
    include_str!("../fixtures/commonroad/areas-2018b.xml"),
    include_str!("../fixtures/commonroad/sign-2020a.xml"),
    include_str!("../scenarios/lane-drop.xml"),
];
/// What a number is replaced by.
const NUMBERS: [&str; 14] = [
    "0",
    "-1",
    "1e-308",
    "1e308",
    "NaN",
    "inf",
    "99999999",
    "-9e7",
    "0.0001",
    "1",
    "2",
    "86400",
    "",
    "9223372036854775807",
];
/// The longest time of a case, s, and the memory of all, KiB.
const TIME_MAX_S: f64 = 5.0;
const MEMORY_MAX_KIB: u64 = 1 << 20;

struct Draw(ChaCha8Rng);

impl Draw {
    fn below(&mut self, limit: usize) -> usize {
        (self.0.next_u64() % limit.max(1) as u64) as usize
    }
}

/// One random damage to the lines of a file.
fn damage(lines: &mut Vec<String>, draw: &mut Draw) {
    let (line, other) = (draw.below(lines.len()), draw.below(lines.len()));
    match draw.below(7) {
        0 => drop(lines.remove(line)),
        1 => lines.swap(line, other),
        2 => lines[line] = lines[other].clone(),
        3 => {
            // A piece of the file many times.
            let end = (line + 1 + draw.below(12)).min(lines.len());
            let piece = lines[line..end].to_vec();
            let times = 1 + draw.below(300);
            let repeated = std::iter::repeat_n(piece, times).flatten();
            lines.splice(line..line, repeated);
        }
        4 => lines[line] = lines[line].replacen('<', "", 1),
        _ => {
            let text = &lines[line];
            let is_number = |c: char| c.is_ascii_digit() || c == '.';
            let starts: Vec<usize> = text.match_indices(is_number).map(|(at, _)| at).collect();
            if let Some(&start) = starts.get(draw.below(starts.len())) {
                let rest = &text[start..];
                let end = start + rest.find(|c| !is_number(c)).unwrap_or(rest.len());
                let number = NUMBERS[draw.below(NUMBERS.len())];
                lines[line] = format!("{}{number}{}", &text[..start], &text[end..]);
            }
        }
    }
}

fn memory_kib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.split_whitespace().next()?.parse().ok()
}

fn main() -> ExitCode {
    let count = std::env::args().nth(1).and_then(|text| text.parse().ok());
    let Some(count) = count else {
        println!("usage: scenarios COUNT");
        return ExitCode::from(2);
    };
    let (mut read, mut slowest) = (0_u64, (0.0, 0_u64));
    for seed in 0..count {
        let mut draw = Draw(ChaCha8Rng::seed_from_u64(seed));
        let base = BASES[draw.below(BASES.len())];
        let mut lines: Vec<String> = base.lines().map(str::to_owned).collect();
        for _ in 0..=draw.below(4) {
            if !lines.is_empty() {
                damage(&mut lines, &mut draw);
            }
        }
        let begin = Instant::now();
        read += u64::from(fuzz::scenario(lines.join("\n").as_bytes()));
        let took = begin.elapsed().as_secs_f64();
        if took > slowest.0 {
            slowest = (took, seed);
        }
    }
    let memory = memory_kib().unwrap_or(0);
    let (slow_s, seed) = slowest;
    println!("{count} files: {read} driven, {} refused", count - read);
    println!(
        "slowest {slow_s:.2} s (seed {seed}), memory {} MiB",
        memory >> 10
    );
    let bad = slow_s > TIME_MAX_S || memory > MEMORY_MAX_KIB;
    ExitCode::from(u8::from(bad))
}
