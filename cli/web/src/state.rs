//! The state of a run as JSON: what `/state` returns and each event of `/events` contains.

use serde::Serialize;
use tandem_board::SystemId;

use crate::history::History;
use tandem_watch::state_name;

/// At this distance ahead, m, the road counts as free.
const FREE_M: f64 = 999.0;

/// The state of a run.
#[derive(Debug, Serialize)]
pub(crate) struct State<'a> {
    run: &'a str,
    /// The run no longer publishes.
    ended: bool,
    /// The other fields are `null` or empty until the run has published.
    time_s: Option<f64>,
    duration_s: Option<f64>,
    /// `A` or `B`; `null` before the first control frame.
    obeyed: Option<String>,
    term: Option<u32>,
    takeovers: Option<u32>,
    gap_max_ms: Option<f64>,
    takeover_gap_ms: Option<f64>,
    frames_per_s: u64,
    /// The times in which no system that could drive stood by, the newest last.
    alone: Vec<AloneState>,
    systems: Vec<System>,
    vehicle: Option<VehicleState>,
    /// The newest first.
    events: Vec<EventState<'a>>,
    /// What the last button did.
    said: &'a str,
}

#[derive(Debug, Serialize)]
struct System {
    name: String,
    state: &'static str,
    /// Whether each core has shown activity in the last 300 ms.
    cores_alive: [bool; 3],
    /// Whether the heartbeats of each line arrive at the other system.
    heartbeats: [bool; 2],
    /// The wires that start at the system and are cut.
    cut: Vec<&'static str>,
}

/// A time without redundancy.
#[derive(Debug, Serialize)]
struct AloneState {
    since_s: f64,
    /// `null` while it lasts.
    until_s: Option<f64>,
}

#[derive(Debug, Serialize)]
struct VehicleState {
    x_m: f64,
    y_m: f64,
    speed_m_s: f64,
    accel_m_s2: f64,
    lateral_accel_m_s2: f64,
    lane: i64,
    lateral_error_m: f64,
    /// `null` if the road ahead is free.
    lead_gap_m: Option<f64>,
}

/// An event of a core or a supply.
#[derive(Debug, Serialize)]
pub(crate) struct EventState<'a> {
    /// Scenario time, s.
    pub(crate) at_s: f64,
    /// `A0`, or `A supply`.
    pub(crate) who: String,
    /// What happened.
    pub(crate) what: &'a str,
}

impl<'a> State<'a> {
    /// Returns the newest state.
    pub(crate) fn of(history: &'a History) -> Self {
        let picture = &history.picture;
        let roles = picture.roles;
        let systems = roles.map(|roles| {
            let system = |system: SystemId| {
                let index = system.index();
                System {
                    name: system.to_string(),
                    state: state_name(roles.state[index]),
                    cores_alive: [0, 1, 2].map(|core| roles.alive[3 * index + core] != 0),
                    heartbeats: [0, 1].map(|line| roles.beats[index] >> line & 1 == 1),
                    cut: roles.cut_wires(index).collect(),
                }
            };
            SystemId::ALL.map(system).into()
        });
        Self {
            run: &picture.run,
            ended: picture.has_ended(),
            time_s: roles.map(|it| it.time_s),
            duration_s: roles.map(|it| it.duration_s),
            obeyed: picture.obeyed().map(|it| it.to_string()),
            term: roles.map(|it| it.term),
            takeovers: roles.map(|it| it.takeovers),
            gap_max_ms: roles.map(|it| it.gap_max_ms),
            takeover_gap_ms: roles.map(|it| it.takeover_gap_ms),
            frames_per_s: picture.frames_per_s(),
            alone: { picture.alone.iter() }
                .map(|it| AloneState {
                    since_s: it.since_s,
                    until_s: it.until_s,
                })
                .collect(),
            systems: systems.unwrap_or_default(),
            vehicle: picture.vehicle.map(|it| VehicleState {
                x_m: it.x,
                y_m: it.y,
                speed_m_s: it.speed,
                accel_m_s2: it.accel,
                lateral_accel_m_s2: it.lat_accel,
                lane: it.lane,
                lateral_error_m: it.lateral_error,
                lead_gap_m: ahead_m(it.lead_gap),
            }),
            events: events(history),
            said: &history.said,
        }
    }
}

/// Returns the distance to the vehicle ahead, m; `None` if the road is free.
pub(crate) fn ahead_m(lead_gap: f64) -> Option<f64> {
    (lead_gap <= FREE_M).then_some(lead_gap)
}

/// Returns the newest events, the newest first.
pub(crate) fn events(history: &History) -> Vec<EventState<'_>> {
    let begin_ns = history.picture.begin_ns();
    let events = history.picture.events.iter().rev().map(|event| {
        let system = if event.system == 0 { 'A' } else { 'B' };
        EventState {
            at_s: event.at_ns.saturating_sub(begin_ns) as f64 * 1e-9,
            who: format!("{system} {}", event.part()),
            what: event.text(),
        }
    });
    events.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::history::tests::history;

    #[test]
    fn the_state_is_json_before_and_after_the_first_message() {
        let empty = serde_json::to_value(State::of(&History::new("tandem-1-a"))).unwrap();
        assert_eq!(empty["run"], "tandem-1-a");
        assert!(empty["obeyed"].is_null() && empty["vehicle"].is_null());
        let history = history();
        let state = serde_json::to_value(State::of(&history)).unwrap();
        assert_eq!(state["obeyed"], "B");
        assert_eq!(state["systems"][0]["state"], "off");
        let alone = serde_json::json!([{"since_s": 80.0, "until_s": null}]);
        assert_eq!(state["alone"], alone);
        assert_eq!(state["systems"][1]["state"], "degraded master");
        assert_eq!(state["events"][0]["what"], "takes over: <power level> fell");
    }
}
