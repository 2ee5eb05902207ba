//! What happened to the vehicle, in words, for readers of a report or of a live view.

use tandem_board::{SupplyEvent, SystemId};
use tandem_bus::ModeCode;

use crate::RunLog;
use crate::run_log::PowerChange;

/// A reset is recorded this close to the fall of the power level, ns. Without one the supply ended.
const RESET_WITHIN_NS: u64 = 50_000_000;

/// Slower than the first the vehicle stands, faster than the second it has driven off, m/s.
const STANDS: f64 = 0.1;
const ROLLS: f64 = 0.5;

/// What the vehicle obeys, from its accepted control frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Obeyed {
    mode: Option<ModeCode>,
    asks: bool,
}

impl Obeyed {
    /// Takes the next accepted control frame: its mode, and whether it asks the driver to take
    /// over. Returns what has changed, in words; at the first frame, what is not the full function.
    pub fn change(&mut self, mode: ModeCode, asks: bool) -> impl Iterator<Item = &'static str> {
        let before = self.mode.replace(mode);
        let asked = core::mem::replace(&mut self.asks, asks);
        let drives = (before.unwrap_or(ModeCode::L3) != mode).then_some(match mode {
            ModeCode::L3 => "is driven by the full function, L3",
            ModeCode::DegradedL2 => "is driven in degraded mode, L2",
            ModeCode::SafeStop => "makes its minimal-risk stop",
            ModeCode::Parking => "is parked by the SoC",
            ModeCode::None => "is driven by the driver",
        });
        let takeover = (asked != asks).then_some(match asks {
            true => "asks the driver to take over",
            false => "no longer asks the driver to take over",
        });
        drives.into_iter().chain(takeover)
    }
}

/// Who a row of events is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Who {
    /// The vehicle.
    Vehicle,
    /// The power of a system.
    Power(SystemId),
    /// A hand on a system, from outside.
    Hand(SystemId),
    /// The process that started the run.
    Launcher,
}

impl core::fmt::Display for Who {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Vehicle => f.write_str("vehicle"),
            Self::Power(system) => write!(f, "system {system}"),
            Self::Hand(system) => write!(f, "hand on {system}"),
            Self::Launcher => f.write_str("tandem run"),
        }
    }
}

/// Returns what happened beside the events of cores: when, ns, to whom, and what, in words. Not in
/// the order of time.
#[must_use]
pub fn happenings(log: &RunLog) -> Vec<(u64, Who, String)> {
    let mut rows: Vec<(u64, Who, String)> = Vec::new();
    let mut row = |at_ns, who, what: &str| rows.push((at_ns, who, what.to_owned()));
    for at_ns in &log.collisions_ns {
        row(*at_ns, Who::Vehicle, "collision");
    }
    if let Some(at_ns) = log.start_ns {
        row(at_ns, Who::Vehicle, "obeys the first control frame");
    }
    let mut obeyed = Obeyed::default();
    for frame in log.accepted() {
        for what in obeyed.change(frame.mode, frame.asks) {
            row(frame.at_ns, Who::Vehicle, what);
        }
    }
    let mut stands = log
        .samples
        .first()
        .is_some_and(|first| first.speed < STANDS);
    for sample in &log.samples {
        let limit = if stands { ROLLS } else { STANDS };
        if (sample.speed < limit) != stands {
            stands = !stands;
            let what = if stands { "stands" } else { "drives off" };
            row(sample.at_ns, Who::Vehicle, what);
        }
    }
    for change in &log.power {
        row(change.at_ns, Who::Power(change.system), power(log, change));
    }
    for (at_ns, system, what) in &log.hands {
        row(*at_ns, Who::Hand(*system), what);
    }
    if let Some(at_ns) = log.launcher_died_ns {
        row(at_ns, Who::Launcher, "was killed; the vehicle ends the run");
    }
    rows
}

/// Tells a loss of power from a reset: before a reset the supply says why.
fn power(log: &RunLog, change: &PowerChange) -> &'static str {
    let is_reset = |(at_ns, system, event): &(u64, SystemId, SupplyEvent)| {
        *system == change.system
            && matches!(event, SupplyEvent::Reset(_) | SupplyEvent::Suspended)
            && at_ns.abs_diff(change.at_ns) < RESET_WITHIN_NS
    };
    match (change.on, log.supplies.iter().any(is_reset)) {
        (true, _) => "has power",
        (false, true) => "is held in reset",
        (false, false) => "is without power: its supply has ended",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::{Sample, VehicleRecord};
    use crate::run_log::ControlFrame;
    use tandem_board::{Instant, ResetCause};
    use tandem_vehicle::Ruling;

    const MS: u64 = 1_000_000;

    /// Each change of the mode, each request, stop, hand, cut and loss of power is told once.
    #[test]
    fn what_happened_is_told_in_words() {
        let mut log = RunLog::default();
        for (at_ms, mode, asks) in [
            (0, ModeCode::L3, false),
            (10, ModeCode::DegradedL2, false),
            (20, ModeCode::DegradedL2, true),
            (30, ModeCode::DegradedL2, true),
            (40, ModeCode::SafeStop, true),
            (50, ModeCode::None, false),
        ] {
            log.control.push(ControlFrame {
                at_ns: at_ms * MS,
                sent_ns: at_ms * MS,
                system: SystemId::A,
                term: 2,
                mode,
                asks,
                age_ns: None,
                ruling: Ruling::Accepted,
            });
        }
        for (at_ms, speed) in [(60, 3.0), (70, 0.0), (80, 0.3), (90, 0.6)] {
            let at_ns = at_ms * MS;
            log.samples.push(Sample {
                at_ns,
                speed,
                ..Sample::default()
            });
        }
        for (at_ms, system) in [(200, 0), (400, 1)] {
            let at_ns = at_ms * MS;
            log.push(
                VehicleRecord::Power {
                    at_ns,
                    system,
                    on: false,
                }
                .into(),
            );
        }
        let (at, cause) = (Instant::from_ns(190 * MS), ResetCause::Watchdog);
        let reset = SupplyEvent::Reset(cause);
        log.push(crate::Entry::Supply(at, SystemId::A, reset));
        let (at_ns, system, cuts) = (500 * MS, 1, 2);
        let what = "its wire heartbeat-1 is cut".to_owned();
        log.push(
            VehicleRecord::Hand {
                at_ns,
                system,
                what,
                cuts,
            }
            .into(),
        );
        log.push(VehicleRecord::LauncherDied { at_ns: 600 * MS }.into());
        let told = happenings(&log).into_iter();
        let told: Vec<String> = told
            .map(|(at_ns, who, what)| format!("{} {who}: {what}", at_ns / MS))
            .collect();
        assert_eq!(
            told,
            [
                "10 vehicle: is driven in degraded mode, L2",
                "20 vehicle: asks the driver to take over",
                "40 vehicle: makes its minimal-risk stop",
                "50 vehicle: is driven by the driver",
                "50 vehicle: no longer asks the driver to take over",
                "70 vehicle: stands",
                "90 vehicle: drives off",
                "200 system A: is held in reset",
                "400 system B: is without power: its supply has ended",
                "500 hand on B: its wire heartbeat-1 is cut",
                "600 tandem run: was killed; the vehicle ends the run",
            ]
        );
    }
}
