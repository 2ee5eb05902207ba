//! What the vehicle adds to the trace and the frames.

use serde::{Deserialize, Serialize};

/// From this on a command's age means that it rests on no measurement, ms.
const NO_AGE_MS: f64 = 6_553.0;

/// What was asked for.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Header {
    /// Name of the scenario.
    pub scenario: String,
    /// Seed of the sensors' noise.
    pub seed: u64,
    /// Seconds of scenario time that were asked for.
    pub duration_s: f64,
    /// Time of day less the run's clock, µs since 1970: the CAN log has the time of day.
    pub epoch_us: u64,
}

/// The lanes around the own vehicle at one time.
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
    /// Position of the own vehicle, m.
    pub x: f64,
    /// m
    pub y: f64,
    /// rad
    pub heading: f64,
    /// m/s
    pub speed: f64,
    /// What the driver has set, m/s.
    pub set_speed: Option<f64>,
    /// Longitudinal acceleration, m/s².
    pub accel: f64,
    /// Lateral acceleration, m/s².
    pub lat_accel: f64,
    /// The lane that the vehicle is in: its number in the scenario's road.
    pub lane: usize,
    /// Distance from that lane's centre line, left positive, m.
    pub lateral_error: f64,
    /// Distance to the vehicle ahead in the own lane, bumper to bumper, m.
    pub lead_gap: Option<f64>,
    /// How fast that distance shrinks, m/s.
    pub closing_speed: Option<f64>,
    /// Vehicles around; empty in samples that leave them out.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub others: Vec<Other>,
}

/// Another vehicle, as a rectangle.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Other {
    /// Centre, m.
    pub x: f64,
    /// m
    pub y: f64,
    /// rad
    pub heading: f64,
    /// m
    pub length: f64,
    /// m
    pub width: f64,
}

/// The vehicle's own figures of the drive, taken at every millisecond.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct DriveFigures {
    /// Contacts of the own vehicle.
    pub collisions: u32,
    /// Largest distance from the centre of the lane outside lane changes, m.
    pub lateral_error_max_m: f64,
    /// How often the vehicle went to another lane.
    pub lane_changes: u32,
    /// Smallest distance to the vehicle ahead, m.
    pub gap_min_m: Option<f64>,
    /// Smallest time to collision with it, s.
    pub ttc_min_s: Option<f64>,
    /// Strongest acceleration, m/s².
    pub accel_max: f64,
    /// Strongest braking, m/s², positive.
    pub brake_max: f64,
    /// Strongest lateral acceleration to either side, m/s².
    pub lat_accel_max: f64,
    /// 99 of 100 milliseconds had less longitudinal jerk, m/s³.
    pub jerk_p99: f64,
    /// How far the vehicle went, m.
    pub distance_m: f64,
}

/// What the vehicle adds to the trace and the frames.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "r", rename_all = "snake_case")]
pub enum VehicleRecord {
    /// The first one.
    Header(Header),
    /// The world began to move: the first control frame was accepted.
    Start {
        /// ns
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
    /// The own vehicle touched another one.
    Collision {
        /// ns
        at_ns: u64,
    },
    /// How the drive stands; the last such record counts.
    Figures(DriveFigures),
    /// The last record of a run that reached its end.
    End {
        /// ns
        at_ns: u64,
        /// Trace records that were lost because the trace was full.
        lost_trace: u64,
        /// How long the vehicle's process was stopped, so that the world stood still, ms.
        stalled_ms: f64,
    },
}
<<<<<<< HEAD
=======

/// A control frame, as the vehicle judged it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ControlFrame {
    /// When it arrived, ns.
    pub at_ns: u64,
    /// When core 0 sent it, ns.
    pub sent_ns: u64,
    /// Its sender, by its CAN id.
    pub system: SystemId,
    /// The mastership that the sender claims; 0 if the frame is invalid.
    pub term: u32,
    /// The function that made it.
    pub mode: Mode,
    /// Age of the oldest measurement behind it when it was sent, ns; `None` if there is none.
    pub age_ns: Option<u64>,
    /// What the vehicle did with it.
    pub verdict: Verdict,
}

/// The first frame of a sensor's list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Measurement {
    /// When it was on the bus, ns.
    pub at_ns: u64,
    /// When the sensor measured, ns.
    pub measured_ns: u64,
}

/// A status frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusFrame {
    /// When it arrived, ns.
    pub at_ns: u64,
    /// Its sender.
    pub system: SystemId,
    /// The sender's role.
    pub role: Role,
    /// The sender's function.
    pub mode: Mode,
}

/// An event of a core. Those of its scheduler are in [`RunLog::trace`] alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoreEvent {
    /// When, ns.
    pub at_ns: u64,
    /// The core's system.
    pub system: SystemId,
    /// The core.
    pub core: CoreId,
    /// What happened.
    pub event: Event,
}

/// A change of a system's power.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PowerChange {
    /// When the vehicle saw it, ns.
    pub at_ns: u64,
    /// The system.
    pub system: SystemId,
    /// Whether it has power and is out of reset.
    pub on: bool,
}

/// All of one run, each kind in the order of time.
#[derive(Clone, Debug, Default)]
pub struct RunLog {
    /// What was asked for.
    pub header: Header,
    /// When the world began to move, ns; `None` if no control frame was ever accepted.
    pub start_ns: Option<u64>,
    /// When the run reached its end, ns; `None` if the recording was cut short.
    pub end_ns: Option<u64>,
    /// Trace records that were lost.
    pub lost_trace: u64,
    /// How long the world stood still because its process was stopped, ms.
    pub stalled_ms: f64,
    /// The world over time.
    pub samples: Vec<Sample>,
    /// The road, piece by piece.
    pub road: Vec<RoadPiece>,
    /// All control frames in the order of the bus.
    pub control: Vec<ControlFrame>,
    /// What the sensors measured, in the order of the bus.
    pub measurements: Vec<Measurement>,
    /// All status frames in the order of the bus.
    pub status: Vec<StatusFrame>,
    /// What the cores reported, without the events of their schedulers.
    pub events: Vec<CoreEvent>,
    /// All that the cores wrote; those of one core in their order.
    pub trace: Vec<Traced>,
    /// What the supplies did and saw, ns.
    pub supplies: Vec<(u64, SystemId, SupplyEvent)>,
    /// Changes of the systems' power.
    pub power: Vec<PowerChange>,
    /// When the vehicle touched another one, ns.
    pub collisions_ns: Vec<u64>,
    /// The vehicle's own figures.
    pub figures: DriveFigures,
}

impl RunLog {
    /// Adds one entry. After the last one call [`RunLog::sort`].
    pub fn push(&mut self, entry: Entry) {
        match entry {
            Entry::Trace(traced) => self.push_trace(traced),
            Entry::Supply(at, system, event) => self.supplies.push((at.as_ns(), system, event)),
            Entry::Frame(frame) => self.push_frame(&frame),
            Entry::Vehicle(record) => self.push_record(*record),
        }
    }

    /// Orders what reached the recording through buffers of several writers.
    pub fn sort(&mut self) {
        self.events.sort_by_key(|event| event.at_ns);
        self.supplies.sort_by_key(|(at_ns, ..)| *at_ns);
    }

    fn push_trace(&mut self, traced: Traced) {
        self.trace.push(traced);
        if let Some(event) = Event::decode(traced.record).filter(|event| !event.is_scheduling()) {
            self.events.push(CoreEvent {
                at_ns: traced.at.as_ns(),
                system: traced.system,
                core: traced.core,
                event,
            });
        }
    }

    fn push_frame(&mut self, frame: &BusFrame) {
        let at_ns = frame.at.as_ns();
        let message = frame.message();
        if let Some(verdict) = frame.verdict {
            let (mode, term, age_ns) = match message {
                Some(Message::Control { control, .. }) if verdict != Verdict::Invalid => {
                    let age_ms = Some(f64::from(control.command_age)).filter(|ms| *ms < NO_AGE_MS);
                    let age_ns = age_ms.map(|ms| (ms * 1e6) as u64);
                    (control.mode, control.term, age_ns)
                }
                _ => (Mode::None, 0, None),
            };
            let index = Control::IDS.iter().position(|id| Some(*id) == frame.id());
            self.control.extend(index.and_then(|index| {
                Some(ControlFrame {
                    at_ns,
                    sent_ns: frame.sent.as_ns(),
                    system: SystemId::from_index(index)?,
                    term,
                    mode,
                    age_ns,
                    verdict,
                })
            }));
        } else if let Some(Message::SensorHeader(_, header)) = message {
            // The sensor's clock is the bus's, in µs, and wraps around.
            let on_the_way = ((at_ns / 1_000) as u32).wrapping_sub(header.measured_at);
            self.measurements.push(Measurement {
                at_ns,
                measured_ns: at_ns.saturating_sub(u64::from(on_the_way) * 1_000),
            });
        } else if let Some(Message::Status { system, status }) = message {
            self.status.extend(
                SystemId::from_index(system.into()).map(|system| StatusFrame {
                    at_ns,
                    system,
                    role: status.role,
                    mode: status.mode,
                }),
            );
        }
    }

    fn push_record(&mut self, record: VehicleRecord) {
        match record {
            VehicleRecord::Header(header) => self.header = header,
            VehicleRecord::Start { at_ns } => self.start_ns = Some(at_ns),
            VehicleRecord::Sample(sample) => self.samples.push(sample),
            VehicleRecord::Road(road) => self.road.push(road),
            VehicleRecord::Power { at_ns, system, on } => {
                let system = SystemId::from_index(system.into());
                self.power
                    .extend(system.map(|system| PowerChange { at_ns, system, on }));
            }
            VehicleRecord::Collision { at_ns } => self.collisions_ns.push(at_ns),
            VehicleRecord::Figures(figures) => self.figures = figures,
            VehicleRecord::End {
                at_ns,
                lost_trace,
                stalled_ms,
            } => {
                self.end_ns = Some(at_ns);
                self.lost_trace = lost_trace;
                self.stalled_ms = stalled_ms;
            }
        }
    }

    /// Scenario time of a point on the run's clock, s; negative before the start.
    #[must_use]
    pub fn seconds(&self, at_ns: u64) -> f64 {
        let start = self.start_ns.unwrap_or_default();
        (at_ns as f64 - start as f64) * 1e-9
    }

    /// Scenario time that was driven, s.
    #[must_use]
    pub fn driven_s(&self) -> f64 {
        let last = self.end_ns.or_else(|| self.samples.last().map(|s| s.at_ns));
        match (self.start_ns, last) {
            (Some(_), Some(last)) => self.seconds(last).max(0.0),
            _ => 0.0,
        }
    }

    /// The control frames that the vehicle obeyed, in order.
    pub fn accepted(&self) -> impl Iterator<Item = &ControlFrame> {
        self.control
            .iter()
            .filter(|frame| frame.verdict == Verdict::Accepted)
    }

    /// Gaps, changes and two masters, from the frames that the vehicle obeyed.
    #[must_use]
    pub fn mastership(&self) -> Mastership {
        let mut mastership = Mastership::default();
        for frame in self.accepted() {
            mastership.accept(frame.at_ns, frame.system.index() as u8, frame.term);
        }
        mastership
    }

    /// The systems in the order in which they drove, without repetition.
    #[must_use]
    pub fn masters(&self) -> Vec<SystemId> {
        let mut masters: Vec<_> = self.accepted().map(|frame| frame.system).collect();
        masters.dedup();
        masters
    }
}
>>>>>>> cb9629c (Core 1 is released by the sensors' round, control follows the trajectory; reaction and age of sensor data are told)
