//! The data that a run publishes for observers, as iceoryx2 publish-subscribe services.
//!
//! No part of the controller reads or writes them. The publisher is a separate process. Each
//! service keeps the newest samples for each subscriber and drops older ones, so a subscriber that
//! is slow, frozen or dead never delays the publisher.

use core::fmt::Debug;

use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher as Sending;
use iceoryx2::port::subscriber::Subscriber as Receiving;
use iceoryx2::prelude::{
    LogLevel, NodeBuilder, ServiceName, SignalHandlingMode, ZeroCopySend, ipc, set_log_level,
};

use crate::name::RunName;
use crate::process_list;

/// Maximum number of simultaneous observers of a run.
const OBSERVERS: usize = 8;
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
    /// 6 suspended.
    pub state: [u8; 2],
    /// Whether each core of A, then of B, has shown activity in the last 300 ms.
    pub alive: [u8; 6],
    /// For A and B: whether its heartbeats arrive at the other system, one bit for each line.
    pub beats: [u8; 2],
    /// Unused.
    pub reserved: [u8; 5],
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
    /// The core; 255 = the supply.
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

impl Event {
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

/// Why a run cannot be published or observed.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct ServiceError(String);

fn refused<E: Debug>(what: &str) -> impl FnOnce(E) -> ServiceError {
    let what = what.to_owned();
    move |error| ServiceError(format!("{what}: {error:?}"))
}

fn node() -> Result<Node<ipc::Service>, ServiceError> {
    set_log_level(LogLevel::Fatal);
    NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create::<ipc::Service>()
        .map_err(refused("a node of iceoryx2"))
}

/// Number of samples kept for each observer, by service.
const KEPT_ROLES: usize = 16;
const KEPT_VEHICLE: usize = 64;
const KEPT_CAN: usize = 1_024;
const KEPT_TRACE: usize = 512;

/// A value that a service can carry.
trait Sample: ZeroCopySend + Debug + Copy + 'static {}

impl<T: ZeroCopySend + Debug + Copy + 'static> Sample for T {}

fn name_of(run: &RunName, name: &str) -> Result<ServiceName, ServiceError> {
    let text = format!("tandem/{run}/{name}");
    ServiceName::new(&text).map_err(refused(&text))
}

/// Creates a service and its publisher.
fn publisher<T: Sample>(
    node: &Node<ipc::Service>,
    run: &RunName,
    name: &str,
    kept: usize,
) -> Result<Sending<ipc::Service, T, ()>, ServiceError> {
    let builder = node.service_builder(&name_of(run, name)?);
    let service = builder
        .publish_subscribe::<T>()
        .max_publishers(1)
        .max_subscribers(OBSERVERS)
        .max_nodes(2 * OBSERVERS)
        .subscriber_max_buffer_size(kept)
        .enable_safe_overflow(true)
        .create()
        .map_err(refused(name))?;
    let publisher = service.publisher_builder().create();
    publisher.map_err(refused(name))
}

/// Opens a service and subscribes to it.
fn subscriber<T: Sample>(
    node: &Node<ipc::Service>,
    run: &RunName,
    name: &str,
) -> Result<Receiving<ipc::Service, T, ()>, ServiceError> {
    let builder = node.service_builder(&name_of(run, name)?);
    let service = builder.publish_subscribe::<T>().open();
    let subscriber = service
        .map_err(refused(name))?
        .subscriber_builder()
        .create();
    subscriber.map_err(refused(name))
}

/// The publishing end of a run's services.
pub struct Publisher {
    roles: Sending<ipc::Service, Roles, ()>,
    vehicle: Sending<ipc::Service, Vehicle, ()>,
    can: Sending<ipc::Service, Frame, ()>,
    trace: Sending<ipc::Service, Event, ()>,
    _node: Node<ipc::Service>,
}

impl Publisher {
    /// Creates the services of this run.
    ///
    /// # Errors
    /// If iceoryx2 refuses an operation.
    pub fn create(run: &RunName) -> Result<Self, ServiceError> {
        let node = node()?;
        Ok(Self {
            roles: publisher(&node, run, "roles", KEPT_ROLES)?,
            vehicle: publisher(&node, run, "vehicle", KEPT_VEHICLE)?,
            can: publisher(&node, run, "can", KEPT_CAN)?,
            trace: publisher(&node, run, "trace", KEPT_TRACE)?,
            _node: node,
        })
    }

    /// Publishes the state of the run. Never blocks; an observer that is slow loses old samples.
    pub fn roles(&self, roles: Roles) {
        // If the sample cannot be published, only observers lose it.
        let _ = self.roles.send_copy(roles);
    }

    /// Like [`Publisher::roles`], for the controlled vehicle.
    pub fn vehicle(&self, vehicle: Vehicle) {
        let _ = self.vehicle.send_copy(vehicle);
    }

    /// Like [`Publisher::roles`], for a frame on the bus.
    pub fn frame(&self, frame: Frame) {
        let _ = self.can.send_copy(frame);
    }

    /// Like [`Publisher::roles`], for an event.
    pub fn event(&self, event: Event) {
        let _ = self.trace.send_copy(event);
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
}

/// An observer of a run.
pub struct Observer {
    run: RunName,
    roles: Receiving<ipc::Service, Roles, ()>,
    vehicle: Receiving<ipc::Service, Vehicle, ()>,
    can: Receiving<ipc::Service, Frame, ()>,
    trace: Receiving<ipc::Service, Event, ()>,
    _node: Node<ipc::Service>,
}

impl Observer {
    /// Observes the run with this name, or the run started by the `tandem run` with this process
    /// id; without a name, the only active run.
    ///
    /// # Errors
    /// If no run or more than one matches, or if the run does not publish.
    pub fn on(name: Option<&str>) -> Result<Self, ServiceError> {
        let run = process_list::run_named(name).map_err(|error| ServiceError(error.to_string()))?;
        let node = node()?;
        Ok(Self {
            roles: subscriber(&node, &run, "roles")?,
            vehicle: subscriber(&node, &run, "vehicle")?,
            can: subscriber(&node, &run, "can")?,
            trace: subscriber(&node, &run, "trace")?,
            run,
            _node: node,
        })
    }

    /// Returns the name of the run.
    #[must_use]
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// Passes to `into` every sample that has arrived since the last call. Never blocks.
    pub fn poll(&self, into: &mut dyn FnMut(News)) {
        drain(&self.vehicle, &mut |vehicle| into(News::Vehicle(vehicle)));
        drain(&self.can, &mut |frame| into(News::Frame(frame)));
        drain(&self.trace, &mut |event| into(News::Event(event)));
        // The roles are last, because they summarise the other samples.
        drain(&self.roles, &mut |roles| into(News::Roles(roles)));
    }
}

fn drain<T: Sample>(from: &Receiving<ipc::Service, T, ()>, into: &mut dyn FnMut(T)) {
    while let Ok(Some(sample)) = from.receive() {
        into(*sample);
    }
}
