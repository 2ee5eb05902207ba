//! What is known of one run: the records that the vehicle process writes, and their collection.
//!
//! The vehicle sees everything that the controller does on the bus, so its log is the one witness
//! of a run. It is a file with one JSON record a line: a run that was cut short leaves a log that
//! can be read up to its last whole line.

use std::io::BufRead;
use std::path::Path;

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use tandem_board::SystemId;

/// One of the two systems, as the log writes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub(crate) enum System {
    /// System A.
    A,
    /// System B.
    B,
}

impl System {
    /// Both, A first.
    pub(crate) const ALL: [Self; 2] = [Self::A, Self::B];

    /// "A" or "B".
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::A => "A",
            Self::B => "B",
        }
    }
}

impl From<SystemId> for System {
    fn from(id: SystemId) -> Self {
        match id {
            SystemId::A => Self::A,
            SystemId::B => Self::B,
        }
    }
}

/// What a system is in the pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Role {
    /// Not yet in a role.
    Starting,
    /// Drives the vehicle.
    Master,
    /// Computes silently.
    Standby,
    /// Has failed and stays silent.
    Suspended,
}

/// Which function drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Mode {
    /// None.
    None,
    /// The full function.
    L3,
    /// Lane and distance keeping by one system alone.
    DegradedL2,
    /// Stops the vehicle.
    SafeStop,
}

/// What the vehicle did with a control frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Verdict {
    /// It was obeyed.
    Accepted,
    /// Its term was below one that was accepted before: it was ignored.
    Fenced,
    /// Its sender did not claim to be the master: it was ignored.
    NotMaster,
    /// Its protection (CRC, counter) or its content was wrong: it was ignored.
    Invalid,
}

/// First record of a log: what was asked for, and under what conditions.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct Header {
    /// Name of the scenario.
    pub(crate) scenario: String,
    /// Seed of the sensors' noise.
    pub(crate) seed: u64,
    /// Seconds of scenario time that were asked for.
    pub(crate) duration_s: f64,
}

/// The lanes around the own vehicle, recorded now and then.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct RoadSeen {
    /// When the vehicle was there, ns.
    pub(crate) at_ns: u64,
    /// The lanes.
    pub(crate) lanes: Vec<Lane>,
}

/// A piece of one lane.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Lane {
    /// Left border, m.
    pub(crate) left: Vec<[f64; 2]>,
    /// Right border, m.
    pub(crate) right: Vec<[f64; 2]>,
}

/// The state of the world at one time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Sample {
    /// The vehicle's clock, ns.
    pub(crate) at_ns: u64,
    /// Position of the own vehicle, m.
    pub(crate) x: f64,
    /// m
    pub(crate) y: f64,
    /// rad
    pub(crate) heading: f64,
    /// m/s
    pub(crate) speed: f64,
    /// What the driver has set, m/s.
    pub(crate) set_speed: Option<f64>,
    /// Longitudinal acceleration, m/s².
    pub(crate) accel: f64,
    /// Lateral acceleration, m/s².
    pub(crate) lat_accel: f64,
    /// The lane that the vehicle is in: its number in the scenario's road.
    pub(crate) lane: usize,
    /// Distance from that lane's centre line, left positive, m.
    pub(crate) lateral_error: f64,
    /// Distance to the vehicle ahead in the own lane, bumper to bumper, m.
    pub(crate) lead_gap: Option<f64>,
    /// How fast that distance shrinks, m/s.
    pub(crate) closing_speed: Option<f64>,
    /// Vehicles around; empty in samples that leave them out.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) others: Vec<Other>,
}

/// Another vehicle, as a rectangle.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Other {
    /// Centre, m.
    pub(crate) x: f64,
    /// m
    pub(crate) y: f64,
    /// rad
    pub(crate) heading: f64,
    /// m
    pub(crate) length: f64,
    /// m
    pub(crate) width: f64,
}

/// A control frame, as the vehicle saw it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ControlSeen {
    /// When it arrived, on the vehicle's clock, ns.
    pub(crate) at_ns: u64,
    /// When core 0 sent it, ns; the two systems' clocks are only compared with themselves.
    pub(crate) sent_ns: u64,
    /// Who sent it, by its CAN id.
    pub(crate) system: System,
    /// The mastership that the sender claims.
    pub(crate) term: u32,
    /// The function that made it.
    pub(crate) mode: Mode,
    /// What the vehicle did with it.
    pub(crate) verdict: Verdict,
}

/// A status frame, as the vehicle saw it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct StatusSeen {
    /// When it arrived, on the vehicle's clock, ns.
    pub(crate) at_ns: u64,
    /// Who sent it.
    pub(crate) system: System,
    /// The sender's role.
    pub(crate) role: Role,
    /// The sender's function.
    pub(crate) mode: Mode,
    /// The highest term that the sender knows.
    pub(crate) term: u32,
}

/// Something that a core reported in its trace.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct CoreEvent {
    /// When, on the core's clock, ns.
    pub(crate) at_ns: u64,
    /// The core's system.
    pub(crate) system: System,
    /// The core's number.
    pub(crate) core: u8,
    /// What happened.
    pub(crate) what: What,
}

/// What a core can report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "what", rename_all = "snake_case")]
pub(crate) enum What {
    /// The core began a life.
    Started {
        /// Which of its lives.
        generation: u32,
        /// Why, in words.
        cause: String,
    },
    /// The system has a new role or function.
    RoleChanged {
        /// The role.
        role: Role,
        /// The function.
        mode: Mode,
        /// The mastership term.
        term: u32,
    },
    /// This system has become the master in place of the other.
    TookOver {
        /// By which sign the other was taken for failed.
        cause: String,
        /// From its last sign of life to the decision, ms.
        detected_ms: f64,
    },
    /// This master found that it had been held up for so long that the other may have taken over.
    HeldUp,
    /// A control cycle began so late that its frame came out of time.
    LateCycle {
        /// After its release, ms.
        late_ms: f64,
    },
    /// A control command rests for the first time on one more measurement.
    ChainDone {
        /// From the measurement on core 1 over core 2 to the command on core 0, ms.
        latency_ms: f64,
    },
    /// A core of the own system does not answer.
    CoreSilent {
        /// Its number.
        core: u8,
    },
    /// Control cycles came so late that they were left out.
    DeadlineMiss {
        /// How many.
        missed: u32,
    },
    /// Something else, in words.
    Note {
        /// The words.
        text: String,
    },
}

/// The vehicle's own figures of the drive, taken at every millisecond.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Figures {
    /// Contacts of the own vehicle.
    pub(crate) collisions: u32,
    /// Largest distance from the centre of the lane outside lane changes, m.
    pub(crate) lateral_error_max_m: f64,
    /// How often the vehicle went to another lane.
    pub(crate) lane_changes: u32,
    /// Smallest distance to the vehicle ahead, m.
    pub(crate) gap_min_m: Option<f64>,
    /// Smallest time to collision with it, s.
    pub(crate) ttc_min_s: Option<f64>,
    /// Strongest acceleration, m/s².
    pub(crate) accel_max: f64,
    /// Strongest braking, m/s², positive.
    pub(crate) brake_max: f64,
    /// Strongest lateral acceleration to either side, m/s².
    pub(crate) lat_accel_max: f64,
    /// 99 of 100 milliseconds had less longitudinal jerk, m/s³.
    pub(crate) jerk_p99: f64,
    /// How far the vehicle went, m.
    pub(crate) distance_m: f64,
}

/// One line of the log.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "r", rename_all = "snake_case")]
pub(crate) enum Record {
    /// The first line.
    Header(Header),
    /// The world began to move: the first control frame was accepted.
    Start {
        /// ns
        at_ns: u64,
    },
    /// The state of the world.
    Sample(Sample),
    /// The road around the vehicle.
    Road(RoadSeen),
    /// A control frame.
    Control(ControlSeen),
    /// A status frame.
    Status(StatusSeen),
    /// A core's report.
    Event(CoreEvent),
    /// A system got power, or lost it.
    Power(PowerSeen),
    /// The own vehicle touched another one.
    Collision {
        /// ns
        at_ns: u64,
    },
    /// How the drive stands; the last such record counts.
    Figures(Figures),
    /// The last line of a run that went to its end.
    End {
        /// ns
        at_ns: u64,
        /// Trace records that were lost because the trace was full.
        lost_trace: u64,
        /// How long the vehicle's process was stopped, so that the world stood still, ms.
        stalled_ms: f64,
    },
}

/// A change of a system's power level.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct PowerSeen {
    /// When the vehicle saw it, ns.
    pub(crate) at_ns: u64,
    /// The system.
    pub(crate) system: System,
    /// Whether it has power and is out of reset.
    pub(crate) on: bool,
}

/// All records of one run, sorted by kind, each kind by time.
#[derive(Clone, Debug, Default)]
pub(crate) struct RunLog {
    /// The first line.
    pub(crate) header: Header,
    /// When the world began to move, ns; `None` if no control frame was ever accepted.
    pub(crate) start_ns: Option<u64>,
    /// When the run came to its end, ns; `None` if the log was cut short.
    pub(crate) end_ns: Option<u64>,
    /// Trace records that were lost.
    pub(crate) lost_trace: u64,
    /// How long the world stood still because its process was stopped, ms.
    pub(crate) stalled_ms: f64,
    /// The world over time.
    pub(crate) samples: Vec<Sample>,
    /// The road, piece by piece.
    pub(crate) road: Vec<RoadSeen>,
    /// All control frames in the order of the bus.
    pub(crate) control: Vec<ControlSeen>,
    /// All status frames in the order of the bus.
    pub(crate) status: Vec<StatusSeen>,
    /// What the cores reported.
    pub(crate) events: Vec<CoreEvent>,
    /// Changes of the systems' power.
    pub(crate) power: Vec<PowerSeen>,
    /// When the vehicle touched another one, ns.
    pub(crate) collisions_ns: Vec<u64>,
    /// The vehicle's own figures.
    pub(crate) figures: Figures,
}

impl RunLog {
    /// Reads the log of a run.
    ///
    /// # Errors
    /// If the file cannot be read or a line that is not the last is no record.
    pub(crate) fn read(path: &Path) -> anyhow::Result<Self> {
        let file = std::fs::File::open(path)
            .with_context(|| format!("the vehicle left no log at {}", path.display()))?;
        let mut log = Self::default();
        let mut lines = std::io::BufReader::new(file).lines().enumerate().peekable();
        while let Some((number, line)) = lines.next() {
            let line = line.with_context(|| format!("reading {}", path.display()))?;
            match serde_json::from_str(&line) {
                Ok(record) => log.push(record),
                // The writer was killed within this line.
                Err(_) if lines.peek().is_none() => break,
                Err(error) => {
                    return Err(error)
                        .with_context(|| format!("{}:{}", path.display(), number + 1));
                }
            }
        }
        // Cores report through buffers of their own, so their records come interleaved.
        log.events.sort_by_key(|event| event.at_ns);
        Ok(log)
    }

    /// Adds one record.
    pub(crate) fn push(&mut self, record: Record) {
        match record {
            Record::Header(header) => self.header = header,
            Record::Start { at_ns } => self.start_ns = Some(at_ns),
            Record::Sample(sample) => self.samples.push(sample),
            Record::Road(road) => self.road.push(road),
            Record::Control(frame) => self.control.push(frame),
            Record::Status(frame) => self.status.push(frame),
            Record::Event(event) => self.events.push(event),
            Record::Power(power) => self.power.push(power),
            Record::Collision { at_ns } => self.collisions_ns.push(at_ns),
            Record::Figures(figures) => self.figures = figures,
            Record::End {
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

    /// Scenario time of a point on the vehicle's clock, in seconds; negative before the start.
    pub(crate) fn seconds(&self, at_ns: u64) -> f64 {
        let start = self.start_ns.unwrap_or_default();
        (at_ns as f64 - start as f64) * 1e-9
    }

    /// Scenario time that was driven, in seconds.
    pub(crate) fn driven_s(&self) -> f64 {
        let last = self.end_ns.or_else(|| self.samples.last().map(|s| s.at_ns));
        match (self.start_ns, last) {
            (Some(_), Some(last)) => self.seconds(last).max(0.0),
            _ => 0.0,
        }
    }

    /// The control frames that the vehicle obeyed, in order.
    pub(crate) fn accepted(&self) -> impl Iterator<Item = &ControlSeen> {
        self.control
            .iter()
            .filter(|frame| frame.verdict == Verdict::Accepted)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    #[test]
    fn a_log_that_was_cut_short_is_read_up_to_its_last_whole_line() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        let start = serde_json::to_string(&Record::Start { at_ns: 7 }).unwrap();
        writeln!(file, "{start}").unwrap();
        write!(file, "{{\"r\":\"end\",\"at_").unwrap();
        let log = RunLog::read(file.path()).unwrap();
        assert_eq!(log.start_ns, Some(7));
        assert_eq!(log.end_ns, None);
    }

    #[test]
    fn a_broken_line_in_the_middle_is_an_error_that_names_the_line() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        let start = serde_json::to_string(&Record::Start { at_ns: 7 }).unwrap();
        writeln!(file, "{start}\nnonsense\n{start}").unwrap();
        let error = format!("{:#}", RunLog::read(file.path()).unwrap_err());
        assert!(error.contains(":2"), "{error}");
    }

    #[test]
    fn every_kind_of_record_survives_the_file() {
        let event = CoreEvent {
            at_ns: 3,
            system: System::B,
            core: 0,
            what: What::TookOver {
                cause: "power".into(),
                detected_ms: 2.5,
            },
        };
        let line = serde_json::to_string(&Record::Event(event.clone())).unwrap();
        let mut log = RunLog::default();
        log.push(serde_json::from_str(&line).unwrap());
        assert_eq!(log.events, [event]);
    }
}
