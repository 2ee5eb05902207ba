//! Enums and structs of `idl/tandem.idl`. Made by `cargo xtask idl`: not to be edited.

use crate::cdr::{self, CdrError, Field, TopicType, Walk, enums, structs};
use tandem_bus::e2e::{self, Check, Checker};
use tandem_shm::{Corrupt, Payload};

enums! {
    /// Position of the gear selector. There is no reverse: no function drives backwards.
    Gear[3] {
        /// The drive train is locked.
        Park = 0,
        /// No torque reaches the wheels.
        Neutral = 1,
        /// Forwards.
        Drive = 2,
    }
    /// Request to the parking brake.
    BrakeRequest[3] {
        /// No request: the brake stays as it is.
        Keep = 0,
        /// Apply the brake.
        Apply = 1,
        /// Release the brake.
        Release = 2,
    }
}

structs! {
    /// One frame of the vehicle bus: CAN or CAN FD, with any identifier. The only type of the
    /// upward direction: each topic costs memory on the controller, and the SoC has the DBC. D-2
    CanFrame["tandem::CanFrame", 71] {
        /// CAN identifier: 11 bits, or 29 bits with bit 31 set, as in Linux' `can_id`.
        id: u32,
        /// Period of the frame; 0 = unknown or not periodic. 0 ..= 65535 ms
        period_ms: u16,
        /// How many of the data bytes belong to the frame. 0 ..= 64 bytes
        length: u8 = 0..=64,
        /// The data. A sender writes zeroes behind `length`.
        data: [u8; 64],
    }
    /// Motion that the drive train shall reach. D-3
    PowerControl["tandem::PowerControl", 20, 0x8001] {
        /// CRC of the end-to-end protection.
        crc: u16,
        /// Counter of the end-to-end protection: one more with each sample, wraps around.
        counter: u8,
        /// Speed to reach. 0.0 ..= 327.67 m/s
        target_speed: f32 = 0.0..=327.67,
        /// Acceleration with which to reach it; negative = slow down. -32.768 ..= 32.767 m/s2
        acceleration: f32 = -32.768..=32.767,
        /// Distance that is left to go. 0.0 ..= 6553.5 m
        distance: f32 = 0.0..=6553.5,
        /// Gear to select.
        target_gear: Gear,
    }
    /// Request to the steering. D-3
    LateralControl["tandem::LateralControl", 8, 0x8002] {
        /// CRC of the end-to-end protection.
        crc: u16,
        /// Counter of the end-to-end protection: one more with each sample, wraps around.
        counter: u8,
        /// The SoC steers. Otherwise the angle is ignored.
        enable: bool,
        /// Angle of the road wheels, left positive, as `SteeringAngle` of the DBC. The angle of the
        /// steering wheel is this one times the ratio of the steering gear. -0.65536 ..= 0.65534 rad
        road_wheel_angle: f32 = -0.65536..=0.65534,
    }
    /// Request to the brakes and the speed control. D-3
    LongitudinalControl["tandem::LongitudinalControl", 12, 0x8003] {
        /// CRC of the end-to-end protection.
        crc: u16,
        /// Counter of the end-to-end protection: one more with each sample, wraps around.
        counter: u8,
        /// The SoC brakes and controls the speed. Otherwise both values are ignored.
        enable: bool,
        /// Braking torque, the sum of all wheels. 0.0 ..= 20000.0 Nm
        brake_torque: f32 = 0.0..=20000.0,
        /// Speed to keep. 0.0 ..= 327.67 m/s
        speed: f32 = 0.0..=327.67,
    }
    /// Request to the parking brake, protected end to end. D-3
    ParkingBrake["tandem::ParkingBrake", 8, 0x8004] {
        /// CRC of the end-to-end protection.
        crc: u16,
        /// Counter of the end-to-end protection: one more with each sample, wraps around.
        counter: u8,
        /// What to do.
        request: BrakeRequest,
    }
}
