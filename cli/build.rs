//! Says on the terminal what a first build does, and how long it takes. Cargo repeats its own
//! warnings at each build, and this is news only once.

use std::fs::File;
use std::io::Write as _;
use std::thread::available_parallelism;

/// CPU time of a first build, s (docs/performance.md), and the least that it takes with many CPUs.
const CPU_S: usize = 110;
const ALONE_S: usize = 30;

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let is_release = std::env::var("PROFILE").is_ok_and(|profile| profile == "release");
    let cpus = available_parallelism().map_or(1, usize::from);
    let seconds = (CPU_S / cpus).max(ALONE_S);
    if let (true, Ok(mut terminal)) = (is_release, File::options().write(true).open("/dev/tty")) {
        let _ = writeln!(
            terminal,
            "\rThe first build compiles Tandem, iceoryx2 and FreeRTOS: about \
             {seconds} s on {cpus} CPUs. The next build takes only what you change."
        );
    }
}
