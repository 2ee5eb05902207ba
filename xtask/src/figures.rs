//! The single page of figures, `docs/figures.md`, made from files of the measuring commands.
//!
//! Prose links to that page and repeats no figure: two copies of a figure soon differ.

use crate::firmware::floor_of;
use crate::{read, read_json, write, write_json};
use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;

const PAGE: &str = "docs/figures.md";
/// `cargo xtask firmware bench --save`
const FIRMWARE: &str = "firmware-port/baseline.json";
/// `tandem bench --json`, without curves and batches.
const BENCH: &str = "docs/figures/bench.json";
/// `metrics.json` of a `tandem run`.
const RUN: &str = "docs/figures/run.json";
/// `tandem thesis --board BOARD --json FILE`
const THESIS: &str = "docs/figures/thesis-";
const BOARDS: [&str; 3] = ["host", "sim", "qemu"];
/// A percentile with fewer samples beyond it depends on chance; the page puts it in brackets.
const FEW: f64 = 10.0;

/// The paths, in words.
const PATHS: &str = "\
interrupt/floor: from the store that posts it to the handler, registers saved
wfi/floor: the least: `wfi` returns without a trap, the interrupt is cleared
doorbell/floor: the board's doorbell alone: which interrupt, no reset, no deadline, cleared
mailbox/signal-to-handler: signal a core that sleeps, to the first line of its task
mailbox/4-bytes: the same with a value
channel/4-bytes: publish a newest value, signal, read it in the task
fifo/4-bytes: the same through a queue; from time to time an end reads the other's index
heapless/spsc-4-bytes: peer: `heapless::spsc` and the doorbell; it does not say who sent, nor \
    survives a reset of one end
embassy/channel-4-bytes: peer: `embassy_sync::channel` under a spin lock, and the doorbell
freertos/message-buffer-4-bytes: peer: FreeRTOS's message buffer and the doorbell; it has no \
    fence, and loses its state with a core
lock/free: lock and unlock
lock/contended-3: three harts want it at once, until the last has given it back
pool/get-give: borrow 16 words and give them back
rtos/yield: a task yields, and no other is ready
rtos/shift-ticks: a task moves the next tick and all later ones
rtos/round-trip: FreeRTOS task to bare core 1 and back to the notified task
task/floor: from a bare core's store that posts the interrupt to the FreeRTOS task that it notifies
task/signal: the same by a signal through a mailbox
time/sample: the time base follows a sample
time/at: a local time becomes global time
time/gptp: Sync and Follow_Up become a sample
time/pulse: an edge and its transfer become a sample
time/can: SYNC and FUP become a sample
clock/two-readings: two readings of the clock in a row
";

/// Copies new measurements, if given, and writes the page. With `check` it only reports whether the
/// page is stale.
pub(crate) fn run(
    root: &Path,
    bench: Option<&Path>,
    run: Option<&Path>,
    check: bool,
) -> Result<()> {
    if let Some(bench) = bench {
        let mut results = read_json(bench)?;
        ensure!(
            results["machine"]["build"] == "release",
            "{}: figures of a debug build mean nothing",
            bench.display()
        );
        // Only the version: the rest describes the distribution's package.
        let kernel = results["machine"]["kernel"].as_str().unwrap_or_default();
        let version = kernel.split('-').next().unwrap_or_default().to_owned();
        results["machine"]["kernel"] = version.into();
        for list in ["results", "noise"] {
            for row in results[list].as_array_mut().context("no result")? {
                let row = row.as_object_mut().context("no row")?;
                for detail in [
                    "curve",
                    "batch_p50_ns",
                    "batch_p99_ns",
                    "batch_line_ns",
                    "batch_steal_ms",
                ] {
                    row.remove(detail);
                }
            }
        }
        write_json(root.join(BENCH), &results)?;
    }
    if let Some(metrics) = run {
        write_json(root.join(RUN), &read_json(metrics)?)?;
    }
    let page = page(root)?;
    let path = root.join(PAGE);
    if check {
        ensure!(
            read(&path)? == page,
            "{PAGE} is stale; run `cargo xtask figures`"
        );
        return Ok(());
    }
    write(&path, &page)
}

fn page(root: &Path) -> Result<String> {
    let mut page = String::from(
        "<!-- Written by `cargo xtask figures` from the files it names. Do not edit. -->\n\n\
         # Figures\n\n\
         What they mean, and what they do not: [performance.md](performance.md). New ones:\n\
         `cargo xtask figures --bench FILE --run FILE` with a file of `tandem bench --json` and a\n\
         `metrics.json`, and `cargo xtask firmware bench --save` for the instructions.\n",
    );
    page += &firmware(&read_json(root.join(FIRMWARE))?)?;
    page += &host(&read_json(root.join(BENCH))?)?;
    page += &drive(&read_json(root.join(RUN))?)?;
    let file = |board| read_json(root.join(format!("{THESIS}{board}.json")));
    let [host, sim, qemu] = BOARDS.map(file);
    page += &thesis(&[host?, sim?, qemu?])?;
    Ok(page)
}

/// Returns the section on the instructions of the paths between cores.
fn firmware(baseline: &Value) -> Result<String> {
    let rows = baseline["results"].as_array().context("no results")?;
    let min = |row: &Value| row["min"].as_f64();
    let named = |name: &str| rows.iter().find(|row| row["name"] == name);
    let text_of = |value: &Value| value.as_str().unwrap_or("unknown").to_owned();
    let mut text = format!(
        "\n## Instructions between cores, riscv32imac under QEMU\n\n`{FIRMWARE}`: path lengths, no \
         latencies; the same in each run.\nCompiled by {}, run by {}.\nA floor wakes the core in \
         the same way and hands nothing over: the ratio is to the floor's minimum.\n\n\
         | path | min | max | floor | over it |\n|---|---:|---:|---|---:|\n",
        text_of(&baseline["compiler"]),
        text_of(&baseline["emulator"]),
    );
    for row in rows {
        let (Some(name), Some(least)) = (row["name"].as_str(), min(row)) else {
            bail!("a row without name or min")
        };
        let mut known = PATHS.lines().filter_map(|line| line.split_once(": "));
        let known = known.find(|(path, _)| *path == name);
        let (_, what) = known.with_context(|| format!("{name} is not described in PATHS"))?;
        let floor = floor_of(name).map(|floor| (floor, named(floor).and_then(min)));
        let (floor, over) = match floor {
            Some((floor, Some(of))) => (format!("`{floor}`"), format!("{:.2}", least / of)),
            _ => ("–".to_owned(), "–".to_owned()),
        };
        writeln!(
            text,
            "| `{name}`: {what} | {} | {} | {floor} | {over} |",
            row["min"], row["max"],
        )?;
    }
    Ok(text)
}

/// Returns the section on times on the host, beside their floors.
fn host(results: &Value) -> Result<String> {
    let machine = &results["machine"];
    let text_of = |value: &Value| value.as_str().unwrap_or("unknown").to_owned();
    let under = match machine["hypervisor"].as_bool() {
        Some(true) => " under a hypervisor",
        _ => "",
    };
    let worst = |row: &Value| row["max_ns"].as_f64().unwrap_or(0.0);
    let noise = results["noise"].as_array().context("no noise")?.iter();
    let noise = noise.map(worst).fold(0.0, f64::max);
    let mut text = format!(
        "\n## Times on a host\n\n`{BENCH}`: {}{under}, {} CPUs, Linux {}, {}, {} build, {:.0} s.\nA program that only reads the clock is held up for {} at worst. The ratio to \
         the floor is the result;\nthe times are the machine's. A figure in brackets has \
         fewer than ten samples beyond it,\nor is a ratio to a floor \
         whose own p99.9 is more than ten times its median, by stalls or by taking turns.\n\n\
         | case | p50 | p99 | p99.9 | x p50 | x p99.9 |\n|---|---:|---:|---:|---:|---:|\n",
        text_of(&machine["cpu"]),
        machine["cpus"],
        text_of(&machine["kernel"]),
        text_of(&machine["scheduling"]),
        text_of(&machine["build"]),
        results["duration_s"].as_f64().unwrap_or(0.0),
        time(noise),
    );
    for row in results["results"].as_array().context("no results")? {
        let samples = row["samples"].as_f64().unwrap_or(0.0);
        let floor = |time: &str, ratio: &str| Some(row[time].as_f64()? / row[ratio].as_f64()?);
        let medians = floor("p50_ns", "ratio_to_floor_p50");
        let tails = floor("p99_9_ns", "ratio_to_floor_p99_9");
        // As in the table of `tandem bench`.
        let is_stalled = medians
            .zip(tails)
            .is_some_and(|(p50, p99_9)| p99_9 > 10.0 * p50);
        let figure = |name: &str, beyond: f64, show: &dyn Fn(f64) -> String| {
            let shown = row[name].as_f64().map_or("–".to_owned(), show);
            let is_stalled = is_stalled && name == "ratio_to_floor_p99_9";
            match samples * beyond >= FEW && !is_stalled {
                true => shown,
                false => format!("({shown})"),
            }
        };
        let ratio = |ratio: f64| format!("{ratio:.2}");
        writeln!(
            text,
            "| `{}` | {} | {} | {} | {} | {} |",
            text_of(&row["name"]),
            figure("p50_ns", 0.5, &time),
            figure("p99_ns", 0.01, &time),
            figure("p99_9_ns", 0.001, &time),
            figure("ratio_to_floor_p50", 0.5, &ratio),
            figure("ratio_to_floor_p99_9", 0.001, &ratio),
        )?;
    }
    Ok(text)
}

/// Returns the section on the results of a drive.
fn drive(metrics: &Value) -> Result<String> {
    let mut text = format!(
        "\n## A drive\n\n`{RUN}`: scenario {}, {:.1} s, {}.\n\n| figure | |\n|---|---:|\n",
        metrics["scenario"].as_str().unwrap_or("unknown"),
        metrics["duration_s"].as_f64().context("no duration_s")?,
        metrics["granted"].as_str().unwrap_or("unknown"),
    );
    let all = metrics.as_object().context("no metrics")?;
    for (name, value) in all {
        let Some(number) = value.as_f64() else {
            continue;
        };
        if let Some(stem) = name.strip_suffix("_ms") {
            writeln!(text, "| `{stem}` | {number:.2} ms |")?;
        } else if let Some(stem) = name.strip_suffix("_m") {
            writeln!(text, "| `{stem}` | {number:.2} m |")?;
        } else if value.is_u64() {
            writeln!(text, "| `{name}` | {number} |")?;
        }
    }
    for takeover in metrics["takeovers"].as_array().into_iter().flatten() {
        writeln!(
            text,
            "| takeover, {} to {}: {} | {:.1} ms without control |",
            takeover["from"].as_str().unwrap_or("?"),
            takeover["to"].as_str().unwrap_or("?"),
            takeover["cause"].as_str().unwrap_or("?"),
            takeover["gap_ms"].as_f64().unwrap_or(f64::NAN),
        )?;
    }
    Ok(text)
}

/// Returns the section on the experiments of the thesis on all boards; a board may lack one.
fn thesis(boards: &[Value; 3]) -> Result<String> {
    let mut text = format!(
        "\n## The experiments of the thesis\n\n`{THESIS}BOARD.json`, by `tandem thesis --board \
         BOARD --json FILE`. The command says what each figure is.\n\n\
         ![Outputs of both systems over time, on the host](figures/thesis.svg)\n\n\
         | experiment | thesis | bound | {} |\n|---|---:|---:|---:|---:|---:|\n",
        BOARDS.join(" | ")
    );
    let results = |board: &Value| board["results"].as_array().cloned().unwrap_or_default();
    for row in results(&boards[0]) {
        let name = row["name"].as_str().context("a row without name")?;
        let unit = row["unit"].as_str().context("a row without unit")?;
        let shown = |row: &Value, figure: &str| {
            let figure = row[figure].as_f64();
            figure.map_or("–".to_owned(), |it| format!("{} {unit}", round(it)))
        };
        let mut here = Vec::new();
        for board in boards {
            let rows = results(board);
            let found = rows.iter().find(|row| row["name"] == name);
            here.push(found.map_or("–".to_owned(), |row| shown(row, "here")));
        }
        let (thesis, bound) = (shown(&row, "thesis"), shown(&row, "bound"));
        writeln!(
            text,
            "| `{name}` | {thesis} | {bound} | {} |",
            here.join(" | ")
        )?;
    }
    Ok(text)
}

/// Formats whole numbers without decimals, others with two.
fn round(value: f64) -> String {
    let decimals = if value.fract() == 0.0 { 0 } else { 2 };
    format!("{value:.decimals$}")
}

/// Formats a time with three digits and its unit.
fn time(ns: f64) -> String {
    let (value, unit) = match ns {
        ns if ns < 1e3 => (ns, "ns"),
        ns if ns < 1e6 => (ns / 1e3, "µs"),
        ns => (ns / 1e6, "ms"),
    };
    let decimals = match value {
        value if value < 9.995 => 2,
        value if value < 99.95 => 1,
        _ => 0,
    };
    format!("{value:.decimals$} {unit}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The page agrees with its source files; `cargo xtask figures` writes it.
    #[test]
    fn the_page_is_current() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
        run(root, None, None, true).unwrap();
    }

    #[test]
    fn a_figure_that_rests_on_chance_stands_in_brackets() {
        let row = |samples: u64| {
            serde_json::json!({
                "name": "spin/tandem", "samples": samples, "p50_ns": 84.2, "p99_ns": 121.0,
                "p99_9_ns": 1_700.0, "ratio_to_floor_p50": 1.06,
            })
        };
        let shown = |samples: u64| {
            let results = serde_json::json!({
                "machine": {}, "noise": [], "results": [row(samples)],
            });
            let text = host(&results).unwrap();
            text.lines().last().unwrap().to_owned()
        };
        let sure = "| `spin/tandem` | 84.2 ns | 121 ns | 1.70 µs | 1.06 | – |";
        assert_eq!(shown(20_000), sure);
        assert!(shown(5_000).contains("| 121 ns | (1.70 µs) | 1.06 |"));
    }
}
