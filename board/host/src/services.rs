//! What a run publishes for observers: iceoryx2 publish-subscribe services for any program.
//!
//! Nothing that drives reads or writes them. The publisher is a process of its own. Each service
//! keeps the newest samples for each subscriber and drops older ones, so a subscriber that is slow,
//! frozen or dead never holds the publisher up.

use core::fmt::Debug;

use iceoryx2::node::Node;
use iceoryx2::port::publisher::Publisher as Sending;
use iceoryx2::port::subscriber::Subscriber as Receiving;
use iceoryx2::prelude::{
    LogLevel, NodeBuilder, ServiceName, SignalHandlingMode, ZeroCopySend, ipc, set_log_level,
};

use crate::name::RunName;
use crate::process_list;

/// Observers of a run at the same time.
const OBSERVERS: usize = 8;
/// A length of [`Event::text`] and of a CAN FD frame's data, bytes.
const TEXT_BYTES: usize = 112;
const DATA_BYTES: usize = 64;

/// How the run stands; service `tandem/RUN/roles`, each 100 ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemRoles")]
#[repr(C)]
pub struct Roles {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// Scenario time, s.
    pub time_s: f64,
    /// Scenario time that was asked for, s.
    pub duration_s: f64,
    /// The longest time between two accepted control frames so far, ms.
    pub gap_max_ms: f64,
    /// The time between the last two accepted control frames of different systems, ms; 0 before.
    pub takeover_gap_ms: f64,
    /// How often the obeyed system has changed.
    pub takeovers: u32,
    /// The term that the vehicle obeys.
    pub term: u32,
    /// The system that the vehicle obeys: 0 = A, 1 = B; 255: none yet.
    pub obeyed: u8,
    /// For A and B: 0 off, 1 starting, 2 standby, 3 master, 4 degraded master, 5 safe stop,
    /// 6 suspended.
    pub state: [u8; 2],
    /// Whether each core of A, then of B, has shown a sign of life in the last 300 ms.
    pub alive: [u8; 6],
    /// For A and B: whether its heartbeats arrive at the other, a bit for each of the two lines.
    pub beats: [u8; 2],
    /// Nothing.
    pub reserved: [u8; 5],
}

/// The own vehicle; service `tandem/RUN/vehicle`, each 20 ms of scenario time.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("TandemVehicle")]
#[repr(C)]
pub struct Vehicle {
    /// The run's clock, ns.
    pub at_ns: u64,
    /// m
    pub x: f64,
    /// m
    pub y: f64,
    /// rad
    pub heading: f64,
    /// m/s
    pub speed: f64,
    /// m/s²
    pub accel: f64,
    /// m/s²
    pub lat_accel: f64,
    /// From the centre of the lane, to the left, m.
    pub lateral_error: f64,
    /// Bumper to bumper to the vehicle ahead in the lane, m; NaN if there is none.
    pub lead_gap: f64,
    /// Number of the lane.
    pub lane: i64,
}

/// A frame on the bus; service `tandem/RUN/can`.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("TandemCanFrame")]
#[repr(C)]
pub struct Frame {
    /// When it was on the bus, on the run's clock, ns.
    pub at_ns: u64,
    /// Its identifier.
    pub id: u32,
    /// 1 if the identifier has 29 bits, 2 if it is CAN FD.
    pub flags: u8,
    /// What the vehicle said of a control frame: 1 accepted, 2 fenced, 3 not master, 4 invalid,
    /// 5 stale, 6 implausible; 0: of no control frame.
    pub verdict: u8,
    /// Bytes of data.
    pub length: u8,
    /// Nothing.
    pub reserved: u8,
    /// The data, then zeros.
    pub data: [u8; DATA_BYTES],
}

/// A trace record of a core or a supply; service `tandem/RUN/trace`. The recording alone has the
/// records of the schedulers.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[type_name("TandemEvent")]
#[repr(C)]
pub struct Event {
    /// When, on the run's clock, ns.
    pub at_ns: u64,
    /// 0 = A, 1 = B.
    pub system: u8,
    /// The core; 255: the supply.
    pub core: u8,
    /// Bytes of the text.
    pub length: u8,
    /// Nothing.
    pub reserved: [u8; 5],
    /// What happened, in words, UTF-8; then zeros.
    pub text: [u8; TEXT_BYTES],
}

impl Frame {
    /// The frame with this data, of which 64 bytes are taken.
    #[must_use]
    pub fn new(at_ns: u64, id: u32, flags: u8, verdict: u8, data: &[u8]) -> Self {
        let (length, data) = padded(data);
        Self {
            at_ns,
            id,
            flags,
            verdict,
            length,
            reserved: 0,
            data,
        }
    }
}

impl Event {
    /// The event with this text, of which 112 bytes are taken.
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

    /// What happened, in words.
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

/// Samples that are kept for each observer, by service.
const KEPT_ROLES: usize = 16;
const KEPT_VEHICLE: usize = 64;
const KEPT_CAN: usize = 1_024;
const KEPT_TRACE: usize = 512;

/// A value that a service carries.
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

/// The services of a run, on the side that publishes.
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
    /// If iceoryx2 refuses.
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

    /// Publishes how the run stands. Never blocks; an observer that is behind loses the oldest.
    pub fn roles(&self, roles: Roles) {
        // If the sample cannot be published, only observers lose it.
        let _ = self.roles.send_copy(roles);
    }

    /// As [`Publisher::roles`], the own vehicle.
    pub fn vehicle(&self, vehicle: Vehicle) {
        let _ = self.vehicle.send_copy(vehicle);
    }

    /// As [`Publisher::roles`], a frame on the bus.
    pub fn frame(&self, frame: Frame) {
        let _ = self.can.send_copy(frame);
    }

    /// As [`Publisher::roles`], an event.
    pub fn event(&self, event: Event) {
        let _ = self.trace.send_copy(event);
    }
}

/// News from a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum News {
    /// How the run stands.
    Roles(Roles),
    /// The own vehicle.
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
    /// Observes the run of this name, or the one that `tandem run` with this process id started;
    /// without a name, the only run that is active.
    ///
    /// # Errors
    /// If there is no such run, there are several, or it does not publish.
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

    /// The run.
    #[must_use]
    pub const fn run(&self) -> &RunName {
        &self.run
    }

    /// Passes on every sample since the last call. Never blocks.
    pub fn poll(&self, into: &mut dyn FnMut(News)) {
        drain(&self.vehicle, &mut |vehicle| into(News::Vehicle(vehicle)));
        drain(&self.can, &mut |frame| into(News::Frame(frame)));
        drain(&self.trace, &mut |event| into(News::Event(event)));
        // Last: it summarises the samples before it.
        drain(&self.roles, &mut |roles| into(News::Roles(roles)));
    }
}

fn drain<T: Sample>(from: &Receiving<ipc::Service, T, ()>, into: &mut dyn FnMut(T)) {
    while let Ok(Some(sample)) = from.receive() {
        into(*sample);
    }
}
