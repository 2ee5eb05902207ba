//! CAN at core 0: end-to-end checks, counters, and inputs that the drive has not used yet.

use super::vehicle_clock::VehicleClock;
use super::{Driving, frames};
use crate::driving::function::Driver;
use crate::driving::parking::BodyState;
use crate::driving::types::{Command, Ego};
use heapless::Deque;
use tandem_board::Instant;
use tandem_bus::{DriverRequest, EgoMotion, FrameReceiver, FrameTransmitter};

/// Capacity for motions of the chassis between two control cycles; usually one arrives.
const MOTIONS: usize = 6;
/// A slower vehicle counts as standing, m/s: the noise of the measured speed is smaller.
const STANDSTILL: f32 = 0.1;

/// The inputs that have arrived since the driving function last ran.
#[derive(Default)]
pub(super) struct Inbox {
    motions: Deque<(Instant, Ego), MOTIONS>,
    /// The command that the vehicle obeys, unless this system drives.
    obeyed: Option<Command>,
    driver: Option<Driver>,
    body: Option<BodyState>,
}

impl Inbox {
    /// Delivers all inputs, with motions in the order of their arrival.
    pub(super) fn empty_into(self, driving: &mut Driving) {
        for (at, ego) in &self.motions {
            driving.on_ego(*at, *ego);
        }
        if let Some(command) = self.obeyed {
            driving.on_obeyed(command);
        }
        if let Some(driver) = self.driver {
            driving.on_driver(driver);
        }
        if let Some(body) = self.body {
            driving.on_body(body);
        }
    }
}

/// Both directions of CAN.
pub(super) struct CanPort {
    pub(super) receiver: FrameReceiver,
    pub(super) transmitter: FrameTransmitter,
    /// Valid frames that neither system sent; wraps around.
    pub(super) third_party_frames: u32,
    /// Emptied at the beginning of each control cycle.
    pub(super) inbox: Inbox,
    pub(super) vehicle_clock: VehicleClock,
    /// The vehicle does not move.
    pub(super) stands: bool,
}

impl CanPort {
    pub(super) fn new() -> Self {
        Self {
            receiver: FrameReceiver::new(),
            transmitter: FrameTransmitter::new(),
            third_party_frames: 0,
            inbox: Inbox::default(),
            vehicle_clock: VehicleClock::default(),
            stands: false,
        }
    }

    pub(super) fn on_ego(&mut self, at: Instant, ego: Ego) {
        self.stands = ego.speed.abs() < STANDSTILL;
        let motions = &mut self.inbox.motions;
        if motions.is_full() {
            let _oldest = motions.pop_front();
        }
        let _fits = motions.push_back((at, ego));
    }

    pub(super) fn on_driver(&mut self, request: &DriverRequest) {
        self.inbox.driver = Some(frames::driver(request));
    }

    pub(super) const fn on_body(&mut self, motion: &EgoMotion) {
        self.inbox.body = Some(frames::body_state(motion));
    }

    /// Records the command that a vehicle obeys of another system.
    pub(super) const fn on_obeyed(&mut self, command: Command) {
        self.inbox.obeyed = Some(command);
    }
}
