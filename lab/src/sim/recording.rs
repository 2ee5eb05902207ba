//! Writes the report of one simulated sequence, with the same files as for a run.

use std::fmt::Write as _;

use anyhow::Result;
use tandem_board::Duration;
use tandem_record::file::candump_line;
use tandem_record::gap::Bounds;
use tandem_record::verdict::{Beside, Limits};
use tandem_redundancy::Config;
use tandem_sim::{Bench, Profile};

use tandem::collected::Collected;
use tandem::metrics::Surroundings;
use tandem::output::ReportFolder;

/// Writes the report. The events of `bench` remain available.
pub(super) fn write(bench: &mut Bench, out: &ReportFolder, profile: Profile) -> Result<()> {
    let mut candump = String::new();
    for frame in bench.frames() {
        writeln!(candump, "{}", candump_line(&frame, 0))?;
    }
    let Profile { limits, time, .. } = profile;
    let granted = format!("virtual time, {time:?}; the world is not recorded").to_lowercase();
    let around = around(limits, time.allowance(), granted);
    let collected = Collected::of(out, bench.recording(), &candump)?;
    collected.write(out, &around)?;
    Ok(())
}

/// Returns the surroundings of a drive in virtual time with these limits. `allowance`: how late a
/// frame may be.
pub(crate) fn around(limits: Config, allowance: Duration, granted: String) -> Surroundings {
    // The vehicle receives frames once a millisecond.
    let on_bus = allowance + Duration::from_ms(1);
    Surroundings {
        granted,
        timing: "virtual".to_owned(),
        detection_bound_ms: Some((limits.takeover_bound() + on_bus).as_ms_f64()),
        beside: Beside {
            bounds: Bounds::new(Limits::of_profile(&limits), on_bus, Duration::ZERO),
            product: Some(limits),
            ..Beside::default()
        },
        ..Surroundings::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem::output::{METRICS, REPORT, TRACE};
    use tandem_faults::Group;

    /// The report of a simulated takeover has the same files as that of a run of processes.
    #[test]
    fn a_sequence_has_the_report_of_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("report");
        let profile = Profile::from(Config::rt());
        // The sequence is a power loss of the master.
        let (trial, mut bench) = profile.run(&Group::Single.sequence(1_420), true);
        let story = |bench: &mut Bench| bench.story().len();
        let before = story(&mut bench);
        write(&mut bench, &ReportFolder::check(&place).unwrap(), profile).unwrap();
        assert_eq!(story(&mut bench), before);
        let read = |name: &str| std::fs::read(place.join(name)).unwrap();
        let metrics: serde_json::Value = serde_json::from_slice(&read(METRICS)).unwrap();
        let takeover = &metrics["takeovers"][0];
        assert_eq!(
            (&takeover["from"], &takeover["to"]),
            (&"A".into(), &"B".into())
        );
        assert_eq!(
            metrics["takeovers"].as_array().map(Vec::len),
            Some(trial.changes)
        );
        let page = String::from_utf8(read(REPORT)).unwrap();
        assert!(
            page.contains("fault begins: power-loss"),
            "the injected fault is an event"
        );
        assert!(page.contains("everything is restored"));
        assert!(read(TRACE).len() > 100_000 && read(REPORT).len() > 10_000);
    }
}
