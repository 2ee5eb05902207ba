//! `tandem time --board sim`: how far each link of the chain of time is from the truth, in virtual
//! time.

use std::fmt::Write as _;

use serde::Serialize;
use tandem::args::TimeArgs;
use tandem::failure::Failure;
use tandem_board::{Duration, Instant, SystemId};
use tandem_cores::trace::Event;
use tandem_peripherals::network::PortFault;
use tandem_sim::time_chain::{Chain, ChainConfig, Spread};

/// The scenario: the vehicle drives alone on a motorway.
const SCENARIO: &str = "free-lane";
/// Runs with different noise.
const SEEDS: u64 = 5;
/// After this time all clocks have converged.
const CONVERGES: Duration = Duration::from_ms(15_000);
/// How long is measured after that.
const MEASURES: Duration = Duration::from_ms(45_000);
/// How long no grandmaster is heard.
const HOLDOVER: Duration = Duration::from_ms(60_000);
/// By this the crystals of both systems change at the beginning of holdover, ppb: a crystal of 0.05
/// ppm a kelvin that warms by 4 K.
const WARMING_PPB: i32 = 200;
/// Two traces of both systems belong together if they are not further apart.
const TOGETHER: Duration = Duration::from_ms(60);
/// A clock that stays within this has converged, ns.
const CONVERGED_NS: i64 = 2_000;

/// One result.
#[derive(Clone, Debug, Serialize)]
struct Row {
    name: &'static str,
    p50: f64,
    p99: f64,
    max: f64,
    /// The limit of `max`.
    bound: f64,
    unit: &'static str,
    ok: bool,
    /// How many were measured.
    count: usize,
    /// What is measured.
    means: &'static str,
}

impl Row {
    /// Of deviations in ns; all other figures in µs.
    fn new(name: &'static str, deviations: &[i64], bound_us: f64, means: &'static str) -> Self {
        let spread = Spread::of(deviations.iter().copied());
        let us = |ns: u64| ns as f64 / 1_000.0;
        let (p50, p99, max) = spread.map_or((f64::NAN, f64::NAN, f64::NAN), |it| {
            (us(it.p50), us(it.p99), us(it.max))
        });
        Self {
            name,
            p50,
            p99,
            max,
            bound: bound_us,
            unit: "µs",
            ok: max <= bound_us,
            count: deviations.len(),
            means,
        }
    }
}

#[derive(Serialize)]
struct Json<'a> {
    board: &'static str,
    /// How long after power-on the error stays within 2 µs, s, for each system and seed.
    converged_s: &'a [f64],
    results: &'a [Row],
}

/// Deviations of all runs, ns.
#[derive(Default)]
struct Deviations {
    gptp: Vec<i64>,
    pulse: Vec<i64>,
    can: Vec<i64>,
    chain: Vec<i64>,
    skew: Vec<i64>,
    holdover: Vec<i64>,
    converged_s: Vec<f64>,
}

/// Measures the chain, prints the figures, and writes the file.
///
/// # Errors
/// [`Failure::Usage`] if the file cannot be written, [`Failure::Objections`] if a figure exceeds
/// its bound.
pub(crate) fn run(args: &TimeArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let mut all = Deviations::default();
    for seed in args.seed..args.seed + SEEDS {
        all.measure(seed);
    }
    let rows = all.rows();
    let json = Json {
        board: "sim",
        converged_s: &all.converged_s,
        results: &rows,
    };
    tandem::print(&json_to.write(&json, || table(&rows, &all.converged_s))?)?;
    let beyond = rows.iter().filter(|row| !row.ok);
    let beyond: Vec<_> = beyond
        .map(|row| {
            format!(
                "{} is {:.1} µs, its bound is {} µs",
                row.name, row.max, row.bound
            )
        })
        .collect();
    if beyond.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(beyond))
    }
}

impl Deviations {
    /// Drives once, with the grandmaster and then without.
    fn measure(&mut self, seed: u64) {
        let config = ChainConfig {
            seed,
            ..ChainConfig::default()
        };
        let mut chain = Chain::new(SCENARIO, config);
        chain.run_for(CONVERGES + MEASURES);
        let from = Instant::ORIGIN + CONVERGES;
        let driving = driving(&chain);
        let master = chain.offsets(driving, from);
        let standby = chain.offsets(driving.peer(), from);
        self.gptp.extend(master.iter().map(|(_, by)| by));
        self.pulse.extend(
            standby
                .iter()
                .filter_map(|(at, by)| Some(by - near(&master, *at)?)),
        );
        let (stamps, _) = chain.stamps(from);
        self.can.extend(
            stamps
                .iter()
                .map(|(at, by)| by - near(&master, *at).unwrap_or(0)),
        );
        self.chain.extend(stamps.iter().map(|(_, by)| by));
        self.skew.extend(chain.skews(from));
        for of in SystemId::ALL {
            let offsets = chain.offsets(of, Instant::ORIGIN);
            let far = offsets.iter().rposition(|(_, by)| by.abs() > CONVERGED_NS);
            let good = offsets.get(far.map_or(0, |far| far + 1));
            let good_s = good.map_or(f64::NAN, |(at, _)| at.as_ns() as f64 / 1e9);
            self.converged_s.push(good_s);
        }
        self.hold_over(chain, driving);
    }

    fn hold_over(&mut self, mut chain: Chain, driving: SystemId) {
        let silent = PortFault {
            lost_out: 1_000,
            ..PortFault::default()
        };
        chain.grandmasters[0].station.disturb(silent);
        for (of, by) in [(SystemId::A, WARMING_PPB), (SystemId::B, -WARMING_PPB)] {
            let crystal = ChainConfig::default().drift_ppb[of.index()];
            chain.drive.pair.set_clock_rate(of, crystal + by);
        }
        chain.run_for(HOLDOVER);
        let offsets = chain.offsets(driving, Instant::ORIGIN);
        self.holdover.extend(offsets.last().map(|(_, by)| by));
    }

    fn rows(&self) -> [Row; 6] {
        [
            Row::new(
                "gptp/offset",
                &self.gptp,
                1.0,
                "the system that drives, from the grandmaster, over Ethernet",
            ),
            Row::new(
                "pulse/offset",
                &self.pulse,
                2.0,
                "the standby, from the system that drives; a line takes 1 µs",
            ),
            Row::new(
                "can/offset",
                &self.can,
                5.0,
                "stamps of the sensors' lists, from the system that drives; they count 1 µs",
            ),
            Row::new(
                "chain/offset",
                &self.chain,
                6.0,
                "stamps of the sensors' lists, from the grandmaster",
            ),
            Row::new(
                "control/skew",
                &self.skew,
                20.0,
                "starts of the control cycles of both systems; 572 µs in the thesis",
            ),
            Row::new(
                "holdover/drift",
                &self.holdover,
                20.0,
                "a minute without grandmaster; each crystal changes by 0.2 ppm at its begin",
            ),
        ]
    }
}

/// Returns the system that drives at the end.
fn driving(chain: &Chain) -> SystemId {
    let is_cycle = |event: &Event| {
        matches!(
            event,
            Event::ControlCycle {
                transmitted: true,
                ..
            }
        )
    };
    let mut last = chain.drive.events.iter().rev();
    let last = last.find(|(.., event)| is_cycle(event));
    last.map_or(SystemId::A, |(_, system, ..)| *system)
}

/// Returns the deviation that was traced next to `at`.
fn near(offsets: &[(Instant, i64)], at: Instant) -> Option<i64> {
    let behind = offsets.partition_point(|(other, _)| *other < at);
    let around = offsets.get(behind.saturating_sub(1)..(behind + 1).min(offsets.len()))?;
    let apart = |(other, _): &&(Instant, i64)| at.as_ns().abs_diff(other.as_ns());
    let nearest = around.iter().min_by_key(apart)?;
    (apart(&nearest) <= TOGETHER.as_ns()).then_some(nearest.1)
}

fn table(rows: &[Row], converged_s: &[f64]) -> String {
    let mut text = format!(
        "{:15} {:>9} {:>9} {:>9} {:>9}  of what\n",
        "µs", "p50", "p99", "max", "bound"
    );
    for row in rows {
        let mark = if row.ok { "" } else { "  BEYOND ITS BOUND" };
        let _ = writeln!(
            text,
            "{:15} {:>9.3} {:>9.3} {:>9.3} {:>9.1}  {}{mark}",
            row.name, row.p50, row.p99, row.max, row.bound, row.means
        );
    }
    let slowest = converged_s.iter().copied().fold(0.0, f64::max);
    let _ = writeln!(
        text,
        "\n{SEEDS} drives in virtual time, crystals of +100 and -100 ppm; \
         within 2 µs after {slowest:.1} s at most"
    );
    text
}
