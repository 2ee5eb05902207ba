//! Measures the worker pool beside rayon, interleaved in one run. Argument: rounds (default 300).
#![allow(clippy::print_stdout, reason = "its output is its purpose")]
#![allow(clippy::unwrap_used, reason = "a measurement that cannot start ends")]

use std::hint::black_box;
use std::time::{Duration, Instant};

use rayon::prelude::*;
use tandem_exec::client::Random;
use tandem_exec_host::pool::WorkerPool;

/// `rounds` of work: about 1 ns each.
fn work(rounds: u64) -> impl Fn(&mut u64, &mut Random) + Copy + Send + Sync + 'static {
    move |element, random| {
        for _ in 0..rounds {
            *element = element.rotate_left(7) ^ random.draw();
        }
    }
}

fn main() {
    let rounds = std::env::args()
        .nth(1)
        .and_then(|text| text.parse().ok())
        .unwrap_or(300);
    let workers = std::thread::available_parallelism().unwrap().get();
    let rayon = rayon::ThreadPoolBuilder::new()
        .num_threads(workers)
        .build()
        .unwrap();
    println!("{workers} workers, {rounds} rounds; µs a run: p50, p99; ratio of the medians");
    for (len, cost) in [(64, 20_000), (1_000, 1_000), (10_000, 100), (1_000, 10_000)] {
        let work = work(cost);
        let mut pool = WorkerPool::new(workers, len, Duration::from_secs(60), work).unwrap();
        let (mut ours, mut theirs) = (vec![], vec![]);
        let mut lists = [vec![1_u64; len], vec![1; len]];
        for seed in 0..rounds {
            let begin = Instant::now();
            pool.run(&mut lists[0], seed).unwrap();
            ours.push(begin.elapsed());
            let begin = Instant::now();
            rayon.install(|| {
                lists[1]
                    .par_iter_mut()
                    .enumerate()
                    .for_each(|(index, element)| {
                        work(element, &mut Random::of_element(seed, index as u64));
                    });
            });
            theirs.push(begin.elapsed());
            black_box(&lists);
        }
        assert_eq!(lists[0], lists[1]);
        let of = |all: &mut Vec<Duration>, part: f64| {
            all.sort_unstable();
            all[((all.len() - 1) as f64 * part) as usize].as_secs_f64() * 1e6
        };
        let [o50, t50] = [&mut ours, &mut theirs].map(|all| of(all, 0.5));
        let [o99, t99] = [&mut ours, &mut theirs].map(|all| of(all, 0.99));
        println!(
            "{len:6} elements of ~{cost} ns: pool {o50:9.1} {o99:9.1}  rayon {t50:9.1} {t99:9.1}  ratio {:.2}",
            o50 / t50
        );
    }
}
