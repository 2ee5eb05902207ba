//! The data that a run publishes for observers, as iceoryx2 publish-subscribe services.
//!
//! No part of the controller reads or writes them. The publisher is a separate process. Each
//! service keeps the newest samples for each subscriber and drops older ones, so a subscriber that
//! is slow, frozen or dead never delays the publisher.

mod ends;

pub use ends::{SampleNumber, ServiceError, ServicePayload, ServicePublisher, ServiceSubscriber};

use iceoryx2::prelude::ZeroCopySend;
use tandem_shm::topic::Subscribe;

use tandem_board_host::{RunName, Wire, process_list};

/// Capacities of [`Event::text`] and of a CAN FD frame's data, in bytes.
const TEXT_BYTES: usize = 112;
const DATA_BYTES: usize = 64;

/// The state of the run; service `tandem/RUN/roles`, every 100 ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemRoles")]
#[repr(C)]
pub struct Roles {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// Scenario time, s.
    pub time_s: f64,
    /// Requested scenario time, s.
    pub duration_s: f64,
    /// The longest time between two accepted control frames so far, ms.
    pub gap_max_ms: f64,
    /// The gap at the last change of the obeyed system, ms; 0 before the first change.
    pub takeover_gap_ms: f64,
    /// How many times the obeyed system has changed.
    pub takeovers: u32,
    /// The term that the vehicle obeys.
    pub term: u32,
    /// The system that the vehicle obeys: 0 = A, 1 = B; 255 = none yet.
    pub obeyed: u8,
    /// For A and B: 0 off, 1 starting, 2 standby, 3 master, 4 degraded master, 5 safe stop,
    /// 6 suspended, 7 master that parks.
    pub state: [u8; 2],
    /// Whether each core of A, then of B, has shown activity in the last 300 ms.
    pub alive: [u8; 6],
    /// For A and B: whether its heartbeats arrive at the other system, one bit for each line.
    pub beats: [u8; 2],
    /// For A and B: which of its wires are cut, one bit for each: start, heartbeat-1, heartbeat-2,
    /// time, level, link, can.
    pub cuts: [u8; 2],
    /// Unused.
    pub reserved: [u8; 3],
}

/// The controlled vehicle; service `tandem/RUN/vehicle`, every 20 ms of scenario time.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemVehicle")]
#[repr(C)]
pub struct Vehicle {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// Position in x, m.
    pub x: f64,
    /// Position in y, m.
    pub y: f64,
    /// Heading, rad.
    pub heading: f64,
    /// Speed, m/s.
    pub speed: f64,
    /// Longitudinal acceleration, m/s².
    pub accel: f64,
    /// Lateral acceleration, m/s².
    pub lat_accel: f64,
    /// Distance from the centre of the lane, positive to the left, m.
    pub lateral_error: f64,
    /// Bumper-to-bumper distance to the vehicle ahead in the lane, m; NaN if there is none.
    pub lead_gap: f64,
    /// Number of the lane.
    pub lane: i64,
}

/// A clock that shows the vehicle's time.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemClock")]
#[repr(C)]
pub struct ChainedClock {
    /// When it last told its time, by the run's clock, ns; 0 if it has none.
    pub at_ns: u64,
    /// When it last heard another clock, by the run's clock, ns; 0 if it has heard none.
    pub heard_ns: u64,
    /// How much later the clock that it follows was than it thought, ns.
    pub offset_ns: i32,
    /// Delay of the messages of that clock, ns; 0 if it has none.
    pub delay_ns: u32,
    /// Largest error of what it heard that the protocol knows of, ns.
    pub error_ns: u32,
    /// How much faster the vehicle's time runs than the clock of its system, ppb.
    pub rate_ppb: i32,
    /// Leaps of the clock that it follows, told or followed.
    pub leaps: u32,
    /// Whom it follows: 0 none, 1 the grandmaster, 2 the other system.
    pub source: u8,
    /// Bits of AUTOSAR's StbM: 0x01 time-out, 0x04 synchronised to a gateway, 0x08 the time was
    /// set, 0x10 a leap to the future, 0x20 a leap to the past; and 0x80 holdover.
    pub status: u8,
    /// Why it has no time of the grandmaster; 0 if it has, 255 if it looks for none.
    pub why: u8,
    /// Unused.
    pub reserved: u8,
}

/// The vehicle's time; service `tandem/RUN/time`, every 100 ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemClocks")]
#[repr(C)]
pub struct VehicleClocks {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// The clocks of A, of B and of the SoC.
    pub clocks: [ChainedClock; 3],
    /// How much later the time of A is than that of B, ns; `i32::MIN` while one of them has none.
    pub apart_ns: i32,
    /// How many control cycles of A and B began together in the last 5 s.
    pub cycles: u32,
    /// The median of the times between their starts, ns.
    pub skew_p50_ns: u32,
    /// The 99th percentile of these times, ns.
    pub skew_p99_ns: u32,
    /// By which clock each sensor stamps its lists, the radars, then the camera: 0 its own, 1 in
    /// the vehicle's time, 2 in holdover; 255 if none has arrived for 5 s.
    pub sensors: [u8; 6],
    /// Unused.
    pub reserved: [u8; 2],
}

/// A frame on the bus; service `tandem/RUN/can`.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("TandemCanFrame")]
#[repr(C)]
pub struct Frame {
    /// When the frame was on the bus, by the run's clock, ns.
    pub at_ns: u64,
    /// Its identifier.
    pub id: u32,
    /// 1 if the identifier has 29 bits, plus 2 if it is a CAN FD frame.
    pub flags: u8,
    /// The vehicle's ruling on a control frame: 1 accepted, 2 fenced, 3 not master, 4 invalid,
    /// 5 stale, 6 implausible; 0 for other frames.
    pub ruling: u8,
    /// Number of data bytes.
    pub length: u8,
    /// Unused.
    pub reserved: u8,
    /// The data, then zeros.
    pub data: [u8; DATA_BYTES],
}

/// A trace record of a core or a supply; service `tandem/RUN/trace`. Records of the schedulers are
/// only in the recording.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("TandemEvent")]
#[repr(C)]
pub struct Event {
    /// When the event was recorded, by the run's clock, ns.
    pub at_ns: u64,
    /// 0 = A, 1 = B.
    pub system: u8,
    /// The core; 255 = the supply; 254 = the vehicle, about this system: what it obeys, and what
    /// was done to the system from outside.
    pub core: u8,
    /// Number of bytes of the text.
    pub length: u8,
    /// Unused.
    pub reserved: [u8; 5],
    /// Description of the event, UTF-8; then zeros.
    pub text: [u8; TEXT_BYTES],
}

impl Frame {
    /// Makes a frame with the first 64 bytes of this data.
    #[must_use]
    pub fn new(at_ns: u64, id: u32, flags: u8, ruling: u8, data: &[u8]) -> Self {
        let (length, data) = padded(data);
        Self {
            at_ns,
            id,
            flags,
            ruling,
            length,
            reserved: 0,
            data,
        }
    }
}

impl Roles {
    /// Returns the names of the wires that start at this system and are cut now; 0 = A, 1 = B.
    ///
    /// # Panics
    /// If there is no such system.
    pub fn cut_wires(&self, system: usize) -> impl Iterator<Item = &'static str> {
        let cuts = self.cuts[system];
        let all = Wire::ALL.into_iter().enumerate();
        let cut = all.filter(move |(bit, _)| cuts >> bit & 1 == 1);
        cut.map(|(_, wire)| wire.name())
    }
}

impl Event {
    /// The value of [`Event::core`] for an event of the vehicle.
    pub const VEHICLE: u8 = 254;

    /// Returns the part of the system that the event is of, in words.
    #[must_use]
    pub fn part(&self) -> String {
        match self.core {
            u8::MAX => "supply".to_owned(),
            Self::VEHICLE => "outside".to_owned(),
            core => format!("core {core}"),
        }
    }

    /// Makes an event with the first 112 bytes of this text.
    #[must_use]
    pub fn new(at_ns: u64, system: u8, core: u8, text: &str) -> Self {
        let ends = (0..=text.len().min(TEXT_BYTES)).rev();
        let end = { ends }
            .find(|end| text.is_char_boundary(*end))
            .unwrap_or(0);
        let (length, text) = padded(&text.as_bytes()[..end]);
        Self {
            at_ns,
            system,
            core,
            length,
            reserved: [0; 5],
            text,
        }
    }

    /// Returns the description of the event.
    #[must_use]
    pub fn text(&self) -> &str {
        let bytes = self.text.get(..self.length.into()).unwrap_or(&self.text);
        core::str::from_utf8(bytes).unwrap_or("")
    }
}

fn padded<const N: usize>(bytes: &[u8]) -> (u8, [u8; N]) {
    let taken = bytes.len().min(N);
    let mut all = [0; N];
    all[..taken].copy_from_slice(&bytes[..taken]);
    (taken as u8, all)
}

impl Default for Frame {
    fn default() -> Self {
        Self::new(0, 0, 0, 0, &[])
    }
}

impl Default for Event {
    fn default() -> Self {
        Self::new(0, 0, 0, "")
    }
}

/// The names of the services, and how many samples each keeps.
macro_rules! services {
    ($($payload:ty: $name:literal, $kept:literal;)*) => {$(
        impl ServicePayload for $payload {
            const NAME: &'static str = $name;
            const KEPT: usize = $kept;
        }
    )*};
}

services! {
    Roles: "roles", 16;
    Vehicle: "vehicle", 64;
    Frame: "can", 1_024;
    Event: "trace", 512;
    VehicleClocks: "time", 16;
}

/// The publishers of a run's services. A value that cannot be published is lost for observers only.
#[derive(Debug)]
pub struct Publisher {
    /// The state of the run.
    pub roles: ServicePublisher<Roles>,
    /// The controlled vehicle.
    pub vehicle: ServicePublisher<Vehicle>,
    /// Frames on the bus.
    pub can: ServicePublisher<Frame>,
    /// Events of cores and supplies.
    pub trace: ServicePublisher<Event>,
    /// The vehicle's time.
    pub time: ServicePublisher<VehicleClocks>,
}

impl Publisher {
    /// Creates the services of this run.
    ///
    /// # Errors
    /// If iceoryx2 refuses an operation.
    pub fn create(run: &RunName) -> Result<Self, ServiceError> {
        let node = &ends::node()?;
        Ok(Self {
            roles: ServicePublisher::create_on(node, run)?,
            vehicle: ServicePublisher::create_on(node, run)?,
            can: ServicePublisher::create_on(node, run)?,
            trace: ServicePublisher::create_on(node, run)?,
            time: ServicePublisher::create_on(node, run)?,
        })
    }
}

/// A sample from a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum News {
    /// The state of the run.
    Roles(Roles),
    /// The controlled vehicle.
    Vehicle(Vehicle),
    /// A frame on the bus.
    Frame(Frame),
    /// A trace record of a core or a supply.
    Event(Event),
    /// The vehicle's time.
    Time(VehicleClocks),
}

/// An observer of a run.
#[derive(Debug)]
pub struct Observer {
    run: RunName,
    roles: ServiceSubscriber<Roles>,
    vehicle: ServiceSubscriber<Vehicle>,
    can: ServiceSubscriber<Frame>,
    trace: ServiceSubscriber<Event>,
    time: ServiceSubscriber<VehicleClocks>,
}

impl Observer {
    /// Observes the run with this name, or the run started by the `tandem run` with this process
    /// id; without a name, the only active run.
    ///
    /// # Errors
    /// If no run or more than one matches, or if the run does not publish.
    pub fn on(name: Option<&str>) -> Result<Self, ServiceError> {
        match process_list::run_named(name) {
            Ok(run) => Self::of(&run),
            Err(error) => {
                // A run in emulated machines has no processes that the list knows.
                let run = name.and_then(|name| name.parse().ok());
                let observer = run.and_then(|run| Self::of(&run).ok());
                observer.ok_or_else(|| ServiceError(error.to_string()))
            }
        }
    }

    /// Observes this run, which may have no processes on this machine.
    ///
    /// # Errors
    /// If the run does not publish.
    pub fn of(run: &RunName) -> Result<Self, ServiceError> {
        let node = &ends::node()?;
        Ok(Self {
            roles: ServiceSubscriber::on_node(node, run)?,
            vehicle: ServiceSubscriber::on_node(node, run)?,
            can: ServiceSubscriber::on_node(node, run)?,
            trace: ServiceSubscriber::on_node(node, run)?,
            time: ServiceSubscriber::on_node(node, run)?,
            run: run.clone(),
        })
    }

    /// Returns how many samples this observer has lost: it polled too late.
    #[must_use]
    pub fn lost(&self) -> u64 {
        let lost = [
            self.roles.lost(),
            self.vehicle.lost(),
            self.can.lost(),
            self.trace.lost(),
            self.time.lost(),
        ];
        lost.into_iter().map(u64::from).sum()
    }

    /// Returns the name of the run.
    #[must_use]
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// Passes to `into` every sample that has arrived since the last call. Never blocks.
    pub fn poll(&mut self, into: &mut dyn FnMut(News)) {
        drain(&mut self.vehicle, News::Vehicle, into);
        drain(&mut self.can, News::Frame, into);
        drain(&mut self.trace, News::Event, into);
        drain(&mut self.time, News::Time, into);
        // The roles are last, because they summarise the other samples.
        drain(&mut self.roles, News::Roles, into);
    }
}

fn drain<T>(from: &mut impl Subscribe<T>, news: fn(T) -> News, into: &mut dyn FnMut(News)) {
    while let Some(value) = from.take() {
        into(news(value));
    }
}
