//! A recording in memory: all entries of one run, sorted by kind.

use tandem_board::{CoreId, SupplyEvent, SystemId, Traced};
use tandem_bus::{AbilityCode, Message, ModeCode, RoleCode};
use tandem_cores::trace::Event;
use tandem_vehicle::mastership::Mastership;
use tandem_vehicle::{LoggedFrame, Ruling};

use crate::clocks::TimeLog;
use crate::file::Entry;
use crate::log::{DriveFigures, Header, RoadPiece, Sample, VehicleRecord};
use crate::sensor_time::SensorTime;

/// A part of the run that stalled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stood {
    /// A CPU of the machine. A ready thread of higher priority than the run had to wait for it.
    Cpu(usize),
    /// The vehicle's process, and therefore the bus. The process was stopped, or had no CPU.
    Bus,
}

/// A time in which a part of the run stalled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stall {
    /// The part that stalled.
    pub of: Stood,
    /// Start of the stall, on the run's clock, ns.
    pub from_ns: u64,
    /// End of the stall, ns.
    pub to_ns: u64,
}

/// A control frame, as the vehicle judged it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ControlFrame {
    /// When it arrived, ns.
    pub at_ns: u64,
    /// When core 0 sent it, ns.
    pub sent_ns: u64,
    /// Its sender, by its CAN id.
    pub system: SystemId,
    /// The term that the sender claims; 0 if the frame is invalid.
    pub term: u32,
    /// The mode of the driving function that made it.
    pub mode: ModeCode,
    /// Whether the function asks the driver to take over.
    pub asks: bool,
    /// Age of the oldest measurement behind it at sending, ns; `None` if there is none.
    pub age_ns: Option<u64>,
    /// The vehicle's ruling on it.
    pub ruling: Ruling,
}

/// A status frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StatusFrame {
    /// When it arrived, ns.
    pub at_ns: u64,
    /// Its sender.
    pub system: SystemId,
    /// The sender's role.
    pub role: RoleCode,
    /// The sender's function.
    pub mode: ModeCode,
    /// How well its sender can drive.
    pub ability: AbilityCode,
}

/// An event of a core. The events of its scheduler are only in [`RunLog::trace`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoreEvent {
    /// The time of the event, ns.
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

/// A command with this age, or a greater one, is not based on a measurement, ms.
const NO_AGE_MS: f64 = 6_553.0;

/// The complete log of one run; each kind of entry is in the order of time.
#[derive(Clone, Debug, Default)]
pub struct RunLog {
    /// How the run was started.
    pub header: Header,
    /// When the world began to move, ns; `None` if no control frame was ever accepted.
    pub start_ns: Option<u64>,
    /// When the run reached its end, ns; `None` if the recording was cut short.
    pub end_ns: Option<u64>,
    /// Trace records that were lost.
    pub lost_trace: u64,
    /// How long the world stopped because its process was stopped, ms.
    pub stalled_ms: f64,
    /// The world over time.
    pub samples: Vec<Sample>,
    /// The road, piece by piece.
    pub road: Vec<RoadPiece>,
    /// All control frames in the order of the bus.
    pub control: Vec<ControlFrame>,
    /// The global time in the frames so far.
    pub sensor_time: SensorTime,
    /// When the sensors measured each list, ns, in order.
    pub measured_ns: Vec<u64>,
    /// All status frames in the order of the bus.
    pub status: Vec<StatusFrame>,
    /// The events that the cores reported, without those of their schedulers.
    pub events: Vec<CoreEvent>,
    /// All trace records of the cores; those of one core in their order.
    pub trace: Vec<Traced>,
    /// The events of the supplies, with their times, ns.
    pub supplies: Vec<(u64, SystemId, SupplyEvent)>,
    /// Changes of the systems' power.
    pub power: Vec<PowerChange>,
    /// Faults that were injected from outside, or ended: when, ns, into which system, in words.
    pub hands: Vec<(u64, SystemId, String)>,
    /// When the process that had started the run died, ns; `None` if it did not.
    pub launcher_died_ns: Option<u64>,
    /// Times in which the bus stalled.
    pub held_up: Vec<Stall>,
    /// When the vehicle touched another one, ns.
    pub collisions_ns: Vec<u64>,
    /// The vehicle's time on each clock.
    pub time: TimeLog,
    /// The vehicle's own figures.
    pub figures: DriveFigures,
}

impl RunLog {
    /// Adds one entry. After the last one call [`RunLog::sort`].
    pub fn push(&mut self, entry: Entry) {
        self.time.push(&entry);
        match entry {
            Entry::Trace(traced) => self.push_trace(traced),
            Entry::Supply(at, system, event) => self.supplies.push((at.as_ns(), system, event)),
            Entry::Frame(frame) => self.push_frame(&frame),
            Entry::Vehicle(record) => self.push_record(*record),
        }
    }

    /// Sorts by time, because the entries reached the recording through buffers of several writers.
    pub fn sort(&mut self) {
        self.events.sort_by_key(|event| event.at_ns);
        self.supplies.sort_by_key(|(at_ns, ..)| *at_ns);
        self.measured_ns.sort_unstable();
        self.time.sort();
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

    fn push_frame(&mut self, frame: &LoggedFrame) {
        let at_ns = frame.at.as_ns();
        self.sensor_time.hear(frame);
        let message = frame.message();
        if let Some(ruling) = frame.ruling {
            let (mode, asks, term, age_ns) = match message {
                Some(Message::Control { control, .. }) if ruling != Ruling::Invalid => {
                    let age_ms = Some(f64::from(control.command_age)).filter(|ms| *ms < NO_AGE_MS);
                    let age_ns = age_ms.map(|ms| (ms * 1e6) as u64);
                    (control.mode, control.takeover_request, control.term, age_ns)
                }
                _ => (ModeCode::None, false, 0, None),
            };
            self.control
                .extend(frame.controller().map(|system| ControlFrame {
                    at_ns,
                    sent_ns: frame.sent.as_ns(),
                    system,
                    term,
                    mode,
                    asks,
                    age_ns,
                    ruling,
                }));
        } else if let Some(Message::SensorHeader(_, header)) = message {
            let measured_ns = self.sensor_time.measured_ns(frame.at, &header);
            self.measured_ns.push(measured_ns);
        } else if let Some(Message::Status { system, status }) = message {
            self.status.extend(
                SystemId::from_index(system.into()).map(|system| StatusFrame {
                    at_ns,
                    system,
                    role: status.role,
                    mode: status.mode,
                    ability: status.ability,
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
            VehicleRecord::Hand {
                at_ns,
                system,
                what,
                ..
            } => {
                let system = SystemId::from_index(system.into());
                self.hands
                    .extend(system.map(|system| (at_ns, system, what)));
            }
            VehicleRecord::LauncherDied { at_ns } => self.launcher_died_ns = Some(at_ns),
            VehicleRecord::HeldUp { from_ns, to_ns } => self.held_up.push(Stall {
                of: Stood::Bus,
                from_ns,
                to_ns,
            }),
            VehicleRecord::Collision { at_ns } => self.collisions_ns.push(at_ns),
            VehicleRecord::Figures(figures) => self.figures = figures,
            VehicleRecord::SocTime(_) => {}
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

    /// Returns the scenario time of a point on the run's clock, s; negative before the start.
    #[must_use]
    pub fn seconds(&self, at_ns: u64) -> f64 {
        let start = self.start_ns.unwrap_or_default();
        (at_ns as f64 - start as f64) * 1e-9
    }

    /// Returns the CPU to which core 0 of a system is pinned. Only core 0 transmits and takes over.
    #[must_use]
    pub fn control_cpu(&self, system: SystemId) -> Option<usize> {
        let core = system.index() * CoreId::COUNT + CoreId::CONTROL.index();
        self.header.cpus.get(core).copied()
    }

    /// Returns the end of the run, ns; if it was ended early, the time of the last recorded sample.
    #[must_use]
    pub fn until_ns(&self) -> Option<u64> {
        self.end_ns.or_else(|| self.samples.last().map(|s| s.at_ns))
    }

    /// Returns the scenario time that was driven, s.
    #[must_use]
    pub fn driven_s(&self) -> f64 {
        match (self.start_ns, self.until_ns()) {
            (Some(_), Some(last)) => self.seconds(last).max(0.0),
            _ => 0.0,
        }
    }

    /// Returns the control frames that the vehicle obeyed, in order.
    pub fn accepted(&self) -> impl Iterator<Item = &ControlFrame> {
        self.control
            .iter()
            .filter(|frame| frame.ruling == Ruling::Accepted)
    }

    /// Returns gaps, changes of the driver and times with two masters, from the accepted frames.
    #[must_use]
    pub fn mastership(&self) -> Mastership {
        let mut mastership = Mastership::default();
        for frame in self.accepted() {
            mastership.accept(frame.at_ns, frame.system.index() as u8, frame.term);
        }
        mastership
    }

    /// Returns the systems in the order in which they drove. Successive entries are different.
    #[must_use]
    pub fn masters(&self) -> Vec<SystemId> {
        let mut masters: Vec<_> = self.accepted().map(|frame| frame.system).collect();
        masters.dedup();
        masters
    }
}
