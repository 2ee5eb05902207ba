//! Response-time analysis of core 0's tasks, from the times measured in a run.
//!
//! Fixed priorities, pre-emptive, locks with priority inheritance: the worst response of a task is
//! the smallest `R = C + B + Σ ⌈(R + J) / T⌉ · C` over all tasks and handlers above it (Joseph and
//! Pandya 1986; Audsley et al. 1993; blocking after Sha, Rajkumar and Lehoczky 1990).

use crate::task_tables::placed;
use crate::{read, read_json, write};
use anyhow::Result;
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;
use tandem_board::Duration;
use tandem_cores::doorbell::DOORBELL_DISTANCE;
use tandem_cores::task_table::{CORE_0, INTERRUPTS, ReleasedBy, SharedPart, TaskInfo};

/// The page with the table, and the name of the marks around the table.
const PAGE: &str = "docs/rtos-tasks.md";
const MARKS: &str = "response times";

/// A task or a handler; times in µs.
#[derive(Clone, Debug)]
struct Load {
    /// Shortest time between two releases.
    period: f64,
    /// The largest delay of a release from the start of its period.
    jitter: f64,
    /// Longest time on the processor.
    execution: f64,
}

/// Returns the worst response to a release, µs; `None` if there is none before `limit`.
///
/// `above` are all that may interrupt the task; `blocking` is its longest wait for lower tasks.
fn response(own: f64, blocking: f64, above: &[Load], limit: f64) -> Option<f64> {
    let mut response = own + blocking;
    // The loop ends: each step adds at least one release, and there are finitely many before the
    // limit.
    while response <= limit {
        let interference = |load: &Load| {
            // A release at the exact end of the response does not count. The margin is for inexact
            // sums of decimals.
            let releases = ((response + load.jitter) / load.period - 1e-9).ceil();
            releases.max(0.0) * load.execution
        };
        let next = own + blocking + above.iter().map(interference).sum::<f64>();
        if next <= response + 1e-9 {
            return Some(response);
        }
        response = next;
    }
    None
}

/// Returns the shortest times between two releases of a task, µs: one for each source that releases
/// it independently. For a task that only another task releases, this is its own period.
fn release_distances_us(info: &TaskInfo) -> Vec<f64> {
    let own = info.released_by.iter().filter_map(|by| match by {
        ReleasedBy::Period | ReleasedBy::OwnDeadline => Some(us(info.period)),
        ReleasedBy::Doorbell => Some(us(DOORBELL_DISTANCE)),
        ReleasedBy::Task(_) => None,
    });
    let own: Vec<f64> = own.collect();
    if own.is_empty() {
        vec![us(info.period)]
    } else {
        own
    }
}

/// Returns the number of critical sections for which a task may wait: the locks that a lower task
/// shares with it or with a higher one.
fn blocking_locks(index: usize) -> usize {
    let uses = |infos: &[TaskInfo], part| infos.iter().any(|info| info.uses.contains(&part));
    let (above, below) = CORE_0.split_at(index + 1);
    let parts = [SharedPart::Shared, SharedPart::Drive].into_iter();
    parts
        .filter(|part| uses(above, *part) && uses(below, *part))
        .count()
}

fn us(span: Duration) -> f64 {
    span.as_us() as f64
}

/// The measurements of one task in a run, the worst of both systems, µs.
#[derive(Clone, Copy, Debug, Default)]
struct Measured {
    p99: f64,
    max: f64,
    held: f64,
    response_p99: f64,
    response_max: f64,
    jobs: u64,
}

fn measured(list: &Value, key: &str, name: &str) -> Measured {
    let mut worst = Measured::default();
    let mine = |entry: &&Value| entry["core"] == 0 && entry[key] == name;
    for entry in list.as_array().into_iter().flatten().filter(mine) {
        let us = |name: &str| entry[name].as_f64().unwrap_or_default() * 1e3;
        worst.p99 = worst.p99.max(us("execution_p99_ms"));
        worst.max = worst.max.max(us("execution_max_ms"));
        worst.held = worst.held.max(us("lock_held_max_ms"));
        worst.response_p99 = worst.response_p99.max(us("response_p99_ms"));
        worst.response_max = worst.response_max.max(us("response_max_ms"));
        let jobs = entry["jobs"].as_u64().or(entry["count"].as_u64());
        worst.jobs += jobs.unwrap_or_default();
    }
    worst
}

/// The measurement on which a column of the analysis is based.
#[derive(Clone, Copy)]
enum By {
    P99,
    Max,
}

impl By {
    fn of(self, measured: Measured) -> f64 {
        match self {
            Self::P99 => measured.p99,
            Self::Max => measured.max,
        }
    }
}

/// Returns the worst response of each task, µs.
fn responses(metrics: &Value, overhead_us: f64, by: By) -> Vec<Option<f64>> {
    let tasks = CORE_0.map(|info| {
        let figures = measured(&metrics["tasks"], "task", info.name);
        // A job costs two switches: to it and away from it.
        (by.of(figures) + 2.0 * overhead_us, figures.held)
    });
    let handlers = INTERRUPTS.map(|info| Load {
        period: us(info.period),
        jitter: 0.0,
        execution: by.of(measured(&metrics["interrupts"], "interrupt", info.name)) + overhead_us,
    });
    let mut above: Vec<Load> = handlers.to_vec();
    let mut found = Vec::new();
    for (index, info) in CORE_0.iter().enumerate() {
        let (own, _) = tasks[index];
        let held = tasks[index + 1..].iter().map(|(_, held)| *held);
        let held = match by {
            // A lock is held for at most its job's execution time; a longer measurement includes
            // interrupts.
            By::P99 => held
                .zip(&tasks[index + 1..])
                .map(|(held, task)| held.min(task.0))
                .fold(0.0, f64::max),
            By::Max => held.fold(0.0, f64::max),
        };
        let limit = us(info.deadline.unwrap_or(info.period));
        let blocking = blocking_locks(index) as f64 * held;
        found.push(response(own, blocking, &above, limit));
        above.extend(release_distances_us(info).into_iter().map(|period| Load {
            period,
            jitter: 0.0,
            execution: own,
        }));
    }
    found
}

fn table(metrics: &Value, overhead_us: f64) -> String {
    let by_p99 = responses(metrics, overhead_us, By::P99);
    let by_max = responses(metrics, overhead_us, By::Max);
    let mut out = String::new();
    let text = |value: &Value| value.as_str().unwrap_or("?").to_owned();
    let _ = writeln!(
        out,
        "From a run of `{}`, seed {}, {:.1} s; {}. Switch and entry of an interrupt: {overhead_us} µs each. \
         The worst of both systems, in µs.\n",
        text(&metrics["scenario"]),
        metrics["seed"],
        metrics["duration_s"].as_f64().unwrap_or_default(),
        text(&metrics["granted"]),
    );
    out += "| task | period = deadline | jobs | execution p99 | max | longest lock | R by p99 | R by max | measured p99 | max |\n";
    out += "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|\n";
    let shown = |response: Option<f64>| {
        response.map_or_else(|| "> deadline".to_owned(), |us| format!("{us:.0}"))
    };
    for (index, info) in CORE_0.iter().enumerate() {
        let figures = measured(&metrics["tasks"], "task", info.name);
        let _ = writeln!(
            out,
            "| {} | {:.0} | {} | {:.1} | {:.1} | {:.1} | {} | {} | {:.0} | {:.0} |",
            info.name,
            us(info.period),
            figures.jobs,
            figures.p99,
            figures.max,
            figures.held,
            shown(by_p99[index]),
            shown(by_max[index]),
            figures.response_p99,
            figures.response_max,
        );
    }
    for info in INTERRUPTS {
        let figures = measured(&metrics["interrupts"], "interrupt", info.name);
        let _ = writeln!(
            out,
            "| interrupt: {} | {:.0} | {} | {:.1} | {:.1} | | | | | |",
            info.name,
            us(info.period),
            figures.jobs,
            figures.p99,
            figures.max,
        );
    }
    out
}

/// Writes the table for the run of this `metrics.json` to the page.
pub(crate) fn run(root: &Path, metrics: &Path, overhead_us: f64) -> Result<()> {
    let table = table(&read_json(metrics)?, overhead_us);
    let path = root.join(PAGE);
    write(&path, &placed(&read(&path)?, MARKS, &table)?)?;
    print!("{table}");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn load(execution: f64, period: f64) -> Load {
        Load {
            period,
            jitter: 0.0,
            execution,
        }
    }

    /// Returns the worst responses of tasks (C, T) in falling order of priority.
    fn responses_of(tasks: &[(f64, f64)]) -> Vec<Option<f64>> {
        let loads: Vec<Load> = tasks.iter().map(|(c, t)| load(*c, *t)).collect();
        (0..tasks.len())
            .map(|at| response(tasks[at].0, 0.0, &loads[..at], tasks[at].1))
            .collect()
    }

    /// Burns and Wellings, "Real-Time Systems and Programming Languages", task sets B and C of the
    /// chapter on scheduling: set C has utilisation 1 and is still schedulable.
    #[test]
    fn textbook_sets_have_their_responses() {
        let set_c = responses_of(&[(5.0, 20.0), (10.0, 40.0), (40.0, 80.0)]);
        assert_eq!(set_c, [Some(5.0), Some(15.0), Some(80.0)]);
        let set = responses_of(&[(3.0, 7.0), (3.0, 12.0), (5.0, 20.0)]);
        assert_eq!(set, [Some(3.0), Some(6.0), Some(20.0)]);
    }

    /// Tasks of 50 %, 33 % and 24 % overload the processor: the third one has no bounded response.
    #[test]
    fn what_cannot_be_done_in_time_has_no_response() {
        let set = responses_of(&[(10.0, 20.0), (10.0, 30.0), (12.0, 50.0)]);
        assert_eq!(set, [Some(10.0), Some(20.0), None]);
    }

    #[test]
    fn blocking_and_jitter_lengthen_the_response() {
        let above = [load(3.0, 7.0), load(3.0, 12.0)];
        assert_eq!(response(5.0, 0.0, &above, 100.0), Some(20.0));
        // 22 > 21: a fourth release of the first one, then a third of the second one.
        assert_eq!(response(5.0, 2.0, &above, 100.0), Some(28.0));
        let late = Load {
            jitter: 1.0,
            ..load(3.0, 7.0)
        };
        // 5 + 3 = 8. With a jitter of 1 the second release is at 7 - 1 < 8: 8 + 3 = 11.
        assert_eq!(response(5.0, 0.0, &[load(3.0, 8.0)], 100.0), Some(8.0));
        assert_eq!(response(5.0, 0.0, &[late], 100.0), Some(11.0));
    }

    /// The page states the same shortest time between doorbells as the task table of core 0.
    #[test]
    fn the_page_says_the_distance_of_doorbells() {
        let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(PAGE);
        let page = read(page).unwrap();
        let ms = us(DOORBELL_DISTANCE) / 1e3;
        assert!(page.contains(&format!("one interrupt in {ms} ms")));
    }

    /// Calculated by hand from the task table: the locks that lower tasks share with each task.
    #[test]
    fn a_task_waits_for_the_locks_that_those_below_share_with_it() {
        let found: Vec<usize> = (0..CORE_0.len()).map(blocking_locks).collect();
        assert_eq!(found, [1, 1, 2, 2, 2, 2, 2, 0]);
        let distances: Vec<_> = CORE_0.iter().map(release_distances_us).collect();
        let grid = [5e3, 10e3, 10e3, 5e3, 100e3, 10e3, 5e3].map(|us| vec![us]);
        assert_eq!(distances[0], [1e3, 5e3]);
        assert_eq!(distances[1..], grid);
    }

    #[test]
    fn the_table_has_every_task_and_takes_the_worse_system() {
        let task = |system: &str, max: f64| {
            json!({"system": system, "core": 0, "task": "control", "jobs": 5,
                   "execution_p99_ms": 0.01, "execution_max_ms": max})
        };
        let metrics = json!({"scenario": "cut-in", "seed": 1, "duration_s": 10.0,
            "granted": "rt", "tasks": [task("A", 0.02), task("B", 0.05)], "interrupts": []});
        let table = table(&metrics, 0.0);
        assert!(
            table.contains("| control | 10000 | 10 | 10.0 | 50.0 | 0.0 | 10 | 50 |"),
            "{table}"
        );
        assert!(CORE_0.iter().all(|info| table.contains(info.name)));
    }
}
