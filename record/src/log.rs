//! The vehicle's own records, beside the trace and the frames.

use serde::{Deserialize, Serialize};

/// How the run was started.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Header {
    /// Name of the scenario.
    pub scenario: String,
    /// Seed of the sensors' noise.
    pub seed: u64,
    /// Planned scenario time, s.
    pub duration_s: f64,
    /// Time of day minus the run's clock, µs since 1970: the CAN log uses the time of day.
    pub epoch_us: u64,
    /// The CPU that each core is pinned to, in the order A0, A1, … B2; empty if they are not.
    #[serde(default)]
    pub cpus: Vec<usize>,
}

/// The lanes around the ego vehicle at one time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct RoadPiece {
    /// When the vehicle was there, ns.
    pub at_ns: u64,
    /// The lanes.
    pub lanes: Vec<Lane>,
}

/// A piece of one lane.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Lane {
    /// Left border, m.
    pub left: Vec<[f64; 2]>,
    /// Right border, m.
    pub right: Vec<[f64; 2]>,
}

/// The state of the world at one time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Sample {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// X position of the ego vehicle, m.
    pub x: f64,
    /// Y position, m.
    pub y: f64,
    /// Heading, rad.
    pub heading: f64,
    /// Speed, m/s.
    pub speed: f64,
    /// The speed that the driver has set, m/s.
    pub set_speed: Option<f64>,
    /// Longitudinal acceleration, m/s².
    pub accel: f64,
    /// Lateral acceleration, m/s².
    pub lat_accel: f64,
    /// The lane that the vehicle is in: its number in the scenario's road.
    pub lane: usize,
    /// Distance from that lane's centre line, left positive, m.
    pub lateral_error: f64,
    /// Distance to the vehicle ahead in the ego's lane, bumper to bumper, m.
    pub lead_gap: Option<f64>,
    /// How fast that distance shrinks, m/s.
    pub closing_speed: Option<f64>,
    /// Surrounding vehicles; empty in samples that omit them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<Other>,
}

/// Another vehicle, as a rectangle.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Other {
    /// X position of its centre, m.
    pub x: f64,
    /// Y position of its centre, m.
    pub y: f64,
    /// Heading, rad.
    pub heading: f64,
    /// Length, m.
    pub length: f64,
    /// Width, m.
    pub width: f64,
}

/// The vehicle's own figures of the drive, taken at every millisecond.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct DriveFigures {
    /// Collisions of the ego vehicle.
    pub collisions: u32,
    /// Those collisions that the ego vehicle caused.
    #[serde(default)]
    pub collisions_by_ego: u32,
    /// Those collisions in which the ego vehicle was stationary.
    #[serde(default)]
    pub hit_while_standing: u32,
    /// Largest distance of a corner of the vehicle outside all lanes of its direction, m.
    #[serde(default)]
    pub excursion_max_m: f64,
    /// How many others had to brake with more than 1.5 m/s² for the vehicle.
    #[serde(default)]
    pub forced_brakes: u32,
    /// The hardest of that braking, m/s², positive.
    #[serde(default)]
    pub forced_brake_max: f64,
    /// Time on lanes of the other direction, s.
    #[serde(default)]
    pub wrong_way_s: f64,
    /// Time for which the vehicle stood although nothing ahead required it, s.
    #[serde(default)]
    pub standing_s: f64,
    /// When a goal of the scenario was reached, s; `None` if none was.
    #[serde(default)]
    pub goal_reached_s: Option<f64>,
    /// Time for which the vehicle drove outside its operational design domain, s.
    #[serde(default)]
    pub outside_domain_s: f64,
    /// When the function first asked the driver to take over, s.
    #[serde(default)]
    pub takeover_asked_s: Option<f64>,
    /// When the function first made its minimal-risk stop, s.
    #[serde(default)]
    pub safe_stop_s: Option<f64>,
    /// Largest distance from the centre of the lane outside lane changes, m.
    pub lateral_error_max_m: f64,
    /// The number of lane changes.
    pub lane_changes: u32,
    /// Smallest distance to the vehicle ahead, m.
    pub lead_gap_min_m: Option<f64>,
    /// Smallest time to collision: distance to the vehicle ahead over the speed of approach, s.
    pub ttc_min_s: Option<f64>,
    /// Distance driven, m.
    pub distance_m: f64,
    /// Accelerations and jerk that passengers feel.
    pub comfort: Comfort,
    /// The reason for the hardest braking above 4 m/s², and the deceleration that was needed.
    #[serde(default)]
    pub brake_reason: Option<String>,
}

/// Extremes of the accelerations and the jerk that passengers feel.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Comfort {
    /// Strongest acceleration, m/s².
    pub accel_max: f64,
    /// Strongest braking, m/s², positive.
    pub brake_max: f64,
    /// Strongest lateral acceleration to either side, m/s².
    pub lat_accel_max: f64,
    /// Strongest braking outside emergencies (which need more than 3 m/s²), m/s², positive.
    #[serde(default)]
    pub calm_brake_max: f64,
    /// 99th percentile of the longitudinal jerk, sampled every millisecond, m/s³.
    pub jerk_p99: f64,
    /// Largest longitudinal jerk over 100 ms, m/s³.
    #[serde(default)]
    pub jerk_max: f64,
    /// Largest longitudinal jerk over 100 ms outside emergencies, m/s³.
    #[serde(default)]
    pub calm_jerk_max: f64,
}

/// The time of a clock, ten times a second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockState {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// Code of the [`TimeSource`](tandem_cores::core0::TimeSource).
    pub source: u8,
    /// Bits of the [`TimeStatus`](tandem_timesync::TimeStatus).
    pub status: u8,
    /// By how much the vehicle's time is later than the run's clock: low word, ns.
    pub ahead_ns: u32,
    /// How much faster the vehicle's time runs than the system's clock, ppb.
    pub rate_ppb: i32,
}

/// What another clock told, when this one has heard it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ClockSample {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// As in [`ClockState`].
    pub source: u8,
    /// How much later it is than this clock thought, ns.
    pub offset_ns: i32,
    /// Delay of its messages, ns; 0 if it has none.
    pub delay_ns: u32,
    /// Largest error of the sample that the protocol knows of, ns.
    pub error_ns: u32,
}

/// What the SoC's process tells of its time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SocTime {
    /// When it was told: the run's clock, ns.
    pub at_ns: u64,
    /// Its time; `None` before the first sample.
    pub state: Option<ClockState>,
    /// The newest sample; `None` before the first.
    pub sample: Option<ClockSample>,
    /// As in [`GrandmasterTime`](tandem_cores::trace::Event::GrandmasterTime).
    pub why: u8,
}

/// A record of the vehicle itself, beside the trace and the frames.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "r", rename_all = "snake_case")]
pub enum VehicleRecord {
    /// The first record.
    Header(Header),
    /// The world began to move: the first control frame was accepted.
    Start {
        /// Time, ns.
        at_ns: u64,
    },
    /// The state of the world.
    Sample(Sample),
    /// The road around the vehicle.
    Road(RoadPiece),
    /// A system got power, or lost it.
    Power {
        /// When the vehicle saw it, ns.
        at_ns: u64,
        /// 0 = A, 1 = B.
        system: u8,
        /// Whether the system has power and is out of reset.
        on: bool,
    },
    /// A fault was injected into a system from outside, or ended.
    Hand {
        /// When the vehicle saw it, ns.
        at_ns: u64,
        /// 0 = A, 1 = B.
        system: u8,
        /// What was done, in words.
        what: String,
        /// The wires that start at the system and are cut now, one bit for each, in the order of
        /// [`Wire::ALL`](tandem_peripherals::network::Wire::ALL).
        cuts: u8,
    },
    /// The process that had started the run died. The vehicle drove on for a stated time, and then
    /// ended the run.
    LauncherDied {
        /// When the vehicle saw it, ns.
        at_ns: u64,
    },
    /// The vehicle's process, which is the bus, did not run.
    HeldUp {
        /// When the process was due to run, ns.
        from_ns: u64,
        /// When the process ran, ns.
        to_ns: u64,
    },
    /// The ego vehicle touched another vehicle.
    Collision {
        /// Time, ns.
        at_ns: u64,
    },
    /// The vehicle's time in the SoC's process.
    SocTime(SocTime),
    /// The figures of the drive up to now; the last such record counts.
    Figures(DriveFigures),
    /// The last record of a run that reached its end.
    End {
        /// Time, ns.
        at_ns: u64,
        /// Trace records that were lost because the trace was full.
        lost_trace: u64,
        /// How long the vehicle's process, and therefore the world, was stopped, ms.
        stalled_ms: f64,
    },
}
