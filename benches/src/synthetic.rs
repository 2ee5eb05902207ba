//! Synthetic results for tests.

use crate::hardware::Machine;
use crate::result::{Results, Row, SCHEMA};

/// Returns a row with this median; each further nine of a percentile adds half the median.
pub(crate) fn row(name: &str, p50_ns: f64) -> Row {
    let group = name.split('/').next().unwrap_or(name);
    let at = |nines: f64| (p50_ns * (1.0 + 0.5 * (nines - 0.3)) * 10.0).round() / 10.0;
    let curve = (0..100).map(|i| {
        let nines = f64::from(i) * 0.04;
        (1.0 - 10.0_f64.powf(-nines), at(nines))
    });
    Row {
        name: name.to_owned(),
        group: group.to_owned(),
        what: format!("what {name} is"),
        p50_ns,
        p90_ns: at(1.0),
        p99_ns: at(2.0),
        p99_9_ns: at(3.0),
        max_ns: at(9.0),
        samples: 100_000,
        ratio_to_floor_p50: Some(1.0),
        ratio_to_floor_p99_9: Some(1.0),
        batch_p50_ns: vec![p50_ns; 20],
        batch_steal_ms: vec![0.0; 20],
        curve: curve.collect(),
        ..Row::default()
    }
}

/// Returns a run with these rows.
pub(crate) fn results(results: Vec<Row>) -> Results {
    Results {
        schema: SCHEMA.to_owned(),
        machine: Machine::this(&[0, 1]),
        duration_s: 12.0,
        load: None,
        interrupted: false,
        noise: Vec::new(),
        results,
        skipped: Vec::new(),
    }
}
