//! What stands in for the controller until it publishes: both systems, and a vehicle that obeys.

pub(crate) mod place;

use std::time::Duration;

use tandem_board_udp::UdpPlace;
use tandem_bus::{Control, EgoMotion, FrameTransmitter, GearCode, Message, ModeCode};
use tandem_bus::{DriverRequest, ParkingBrakeCode};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, controller_prefix};
use tandem_topics::{BrakeRequest, CanFrame, Gear, LateralControl, LongitudinalControl, TopicType};
use tandem_topics::{ParkingBrake, PowerControl};
use tandem_topics_host::approach::Orders;
use tandem_topics_host::node::Node;

pub(crate) use place::own_place;

/// Period of control frames and motions, s.
pub(crate) const CYCLE_S: f32 = 0.01;

/// A point mass that follows speed, gear and brake.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PointMass {
    /// m/s
    pub(crate) speed: f32,
    /// m
    pub(crate) driven: f32,
    pub(crate) gear: GearCode,
    pub(crate) brake: ParkingBrakeCode,
}

impl PointMass {
    /// Follows the orders for a cycle, as a function that parks; without orders it brakes.
    pub(crate) fn step(&mut self, orders: Option<&Orders>) {
        let drives = |orders: &&Orders| {
            orders.power.target_gear == Gear::Drive
                && orders.brake.request != BrakeRequest::Apply
                && orders.longitudinal.enable
                && orders.lateral.enable
                && self.gear == GearCode::Drive
                && self.brake == ParkingBrakeCode::Released
        };
        let wanted = orders.filter(drives).map_or(0.0, |orders| {
            orders.power.target_speed.min(orders.longitudinal.speed)
        });
        let most = orders.map_or(0.0, |orders| orders.power.acceleration);
        let brakes = orders.is_some_and(|orders| orders.longitudinal.brake_torque > 0.0);
        let slower = if brakes { -1.0 } else { most };
        let acceleration = (2.0 * (wanted - self.speed)).clamp(-2.0, most).min(slower);
        let before = self.speed;
        self.speed = (self.speed + acceleration * CYCLE_S).max(0.0);
        if wanted == 0.0 && self.speed < 0.02 {
            self.speed = 0.0;
        }
        self.driven += f32::midpoint(before, self.speed) * CYCLE_S;
        let Some(orders) = orders.filter(|_| self.speed == 0.0) else {
            return;
        };
        if orders.power.target_gear == Gear::Park {
            self.gear = GearCode::Park;
        }
        match orders.brake.request {
            BrakeRequest::Apply => self.brake = ParkingBrakeCode::Applied,
            BrakeRequest::Release => self.brake = ParkingBrakeCode::Released,
            BrakeRequest::Keep => {}
        }
    }

    /// Its frame.
    pub(crate) fn motion(&self) -> EgoMotion {
        EgoMotion {
            world_running: true,
            speed: self.speed,
            gear: self.gear,
            parking_brake: self.brake,
            ..EgoMotion::default()
        }
    }
}

/// Two systems on UDP, of which A is the master until it is gone.
pub(crate) struct StandIn {
    /// The participants of A and B; `None` after its death.
    pub(crate) nodes: [Option<Node<1, 4>>; 2],
    pub(crate) vehicle: PointMass,
    /// What each system has read last.
    pub(crate) orders: [Option<Orders>; 2],
    transmitter: FrameTransmitter,
    cycle: u32,
}

impl StandIn {
    pub(crate) fn open(place: UdpPlace) -> Self {
        let nodes = [0, 1].map(|system| {
            let [a, b, c, d] = std::process::id().to_le_bytes();
            let prefix = controller_prefix(system, [a, b, c, d, 0]);
            Some(Node::open_as(prefix, place, &OUTPUTS, &INPUTS).unwrap())
        });
        Self {
            nodes,
            vehicle: PointMass::default(),
            orders: [None; 2],
            transmitter: FrameTransmitter::new(),
            cycle: 0,
        }
    }

    /// Runs both participants for a cycle of 10 ms, then steps the vehicle and publishes.
    pub(crate) fn cycle(&mut self) {
        let end = std::time::Instant::now() + Duration::from_millis(10);
        while std::time::Instant::now() < end {
            for node in self.nodes.iter_mut().flatten() {
                node.turn(Duration::from_millis(2)).unwrap();
            }
        }
        for (node, orders) in self.nodes.iter_mut().zip(&mut self.orders) {
            if let Some(node) = node {
                read(node, orders);
            }
        }
        self.cycle += 1;
        let master = usize::from(self.nodes[0].is_none());
        self.vehicle.step(self.orders[master].as_ref());
        self.publish(&Message::EgoMotion(self.vehicle.motion()), None);
        let control = Control {
            mode: ModeCode::Parking,
            sent_at: self.cycle as u16,
            ..Control::default()
        };
        let system = master as u8;
        let message = Message::Control { system, control };
        self.publish(&message, Some(master));
        if self.cycle.is_multiple_of(10) {
            self.publish(&Message::DriverRequest(DriverRequest::default()), None);
        }
    }

    /// Publishes a frame that all but its sender hear. A system that is left hears all of them.
    fn publish(&mut self, message: &Message, sender: Option<usize>) {
        let frame = self.transmitter.encode(message);
        let sample = CanFrame {
            id: frame.id.into(),
            period_ms: message.frame().cycle_ms as u16,
            length: frame.len as u8,
            data: frame.bytes,
        };
        let payload = sample.encode().unwrap();
        let alone = self.nodes.iter().flatten().count() == 1;
        for (system, node) in self.nodes.iter_mut().enumerate() {
            if let Some(node) = node.as_mut().filter(|_| alone || sender != Some(system)) {
                node.write(0, &payload).unwrap();
            }
        }
    }
}

/// Reads the samples of all four topics.
fn read(node: &mut Node<1, 4>, orders: &mut Option<Orders>) {
    while let Some(sample) = node.take(0) {
        let power = PowerControl::decode(sample.payload()).unwrap();
        orders.get_or_insert_default().power = power;
    }
    while let Some(sample) = node.take(1) {
        let lateral = LateralControl::decode(sample.payload()).unwrap();
        orders.get_or_insert_default().lateral = lateral;
    }
    while let Some(sample) = node.take(2) {
        let longitudinal = LongitudinalControl::decode(sample.payload()).unwrap();
        orders.get_or_insert_default().longitudinal = longitudinal;
    }
    while let Some(sample) = node.take(3) {
        let brake = ParkingBrake::decode(sample.payload()).unwrap();
        orders.get_or_insert_default().brake = brake;
    }
}
