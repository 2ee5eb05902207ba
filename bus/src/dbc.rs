//! Enums, structs, messages and frames of `dbc/tandem.dbc`. Made by `cargo xtask dbc`: not to be edited.

use crate::signal::{FrameError, FrameInfo, Signal, Walk, layouts, value_tables};

/// A sensor that sends object lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SensorId {
    /// Front long-range radar.
    RadarFront,
    /// Front left corner radar.
    RadarFrontLeft,
    /// Front right corner radar.
    RadarFrontRight,
    /// Rear left corner radar.
    RadarRearLeft,
    /// Rear right corner radar.
    RadarRearRight,
    /// Camera behind the windscreen.
    CameraFront,
}

impl SensorId {
    /// Every sensor, in the order of the DBC.
    pub const ALL: [Self; 6] = [
        Self::RadarFront,
        Self::RadarFrontLeft,
        Self::RadarFrontRight,
        Self::RadarRearLeft,
        Self::RadarRearRight,
        Self::CameraFront,
    ];

    /// Name of the sensor's node in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::RadarFront => "RadarFront",
            Self::RadarFrontLeft => "RadarFrontLeft",
            Self::RadarFrontRight => "RadarFrontRight",
            Self::RadarRearLeft => "RadarRearLeft",
            Self::RadarRearRight => "RadarRearRight",
            Self::CameraFront => "CameraFront",
        }
    }
}

value_tables! {
    /// Values of the signal `Ability`.
    AbilityCode[4] { All = 0, Lacks = 1, StopOnly = 2, None = 3 }
    /// Values of the signal `Agreement`.
    AgreementCode[3] { Agreed = 0, Disagreed = 1, Unresolved = 2 }
    /// Values of the signal `BrakeRequest`.
    BrakeRequestCode[3] { Keep = 0, Apply = 1, Release = 2 }
    /// Values of the signal `Class`.
    ClassCode[6] { Unknown = 0, Car = 1, Truck = 2, Motorcycle = 3, Pedestrian = 4, Static = 5 }
    /// Values of the signal `Gear`.
    GearCode[3] { Drive = 0, Neutral = 1, Park = 2 }
    /// Values of the signal `Mode`.
    ModeCode[5] { None = 0, L3 = 1, DegradedL2 = 2, SafeStop = 3, Parking = 4 }
    /// Values of the signal `ParkingBrake`.
    ParkingBrakeCode[4] { Released = 0, Applying = 1, Applied = 2, Releasing = 3 }
    /// Values of the signal `Role`.
    RoleCode[4] { Starting = 0, Master = 1, Standby = 2, Suspended = 3 }
    /// Values of the signal `Route`.
    RouteCode[4] { Free = 0, Left = 1, Right = 2, Keep = 3 }
    /// Values of the signal `TimeState`.
    TimeStateCode[3] { OwnClock = 0, Global = 1, Holdover = 2 }
}

layouts! {
    /// Vehicle control. Sent by the master only; the vehicle accepts the highest term.
    ///
    /// Layout of `ControlA`, `ControlB`.
    Control[0x0A0, 0x0A1] {
        /// Role of the sender.
        role: RoleCode = ROLE("Role", 24, 2, 0..=3),
        /// Function that produced the command; None: the driver drives, and the command repeats the present motion.
        mode: ModeCode = MODE("Mode", 26, 3, 0..=7),
        /// The function asks the driver to take over.
        takeover_request: bool = TAKEOVER_REQUEST("TakeoverRequest", 30, 1, 0..=1),
        /// Mastership term: the higher one fences the lower one off; its lowest bit is the system. 0 ..= 4294967295
        term: u32 = TERM("Term", 32, 32, 0..=4294967295),
        /// Requested road wheel angle, left positive. -0.65536 ..= 0.65534 rad in steps of 0.00002
        steering_angle: f32 = STEERING_ANGLE("SteeringAngle", 64, 16, -32768..=32767; 2e-5),
        /// Requested longitudinal acceleration. -32.768 ..= 32.767 m/s2 in steps of 0.001
        acceleration: f32 = ACCELERATION("Acceleration", 80, 16, -32768..=32767; 0.001),
        /// Age of the sensor data on which the command is based. 0 ..= 6553.5 ms in steps of 0.1
        command_age: f32 = COMMAND_AGE("CommandAge", 96, 16, 0..=65535; 0.1),
        /// Time at which the frame was made, on the vehicle's clock as the echo tells it; wraps around; 0 = unknown. 0 ..= 65535 ms
        sent_at: u16 = SENT_AT("SentAt", 112, 16, 0..=65535),
    }
    /// Gear and parking brake. Sent by the master only while it parks, and while it holds the vehicle after that; the vehicle obeys the term of the last accepted control frame.
    ///
    /// Layout of `BodyControlA`, `BodyControlB`.
    BodyControl[0x0A2, 0x0A3] {
        /// Requested gear; Park takes effect at standstill.
        gear: GearCode = GEAR("Gear", 25, 2, 0..=3),
        /// Request to the parking brake.
        brake_request: BrakeRequestCode = BRAKE_REQUEST("BrakeRequest", 27, 2, 0..=3),
        /// Mastership term of the sender; its lowest bit is the system. 0 ..= 4294967295
        term: u32 = TERM("Term", 32, 32, 0..=4294967295),
    }
    /// The mastership term that the vehicle obeys: the term of the last accepted control frame.
    ///
    /// Layout of `GateEcho`.
    GateEcho[0x0A8] {
        /// Number of control frames of the obeyed or a higher term that were implausible or arrived too late; wraps around. 0 ..= 255
        refused: u8 = REFUSED("Refused", 24, 8, 0..=255),
        /// Highest mastership term that was accepted; 0 = none yet. 0 ..= 4294967295
        term: u32 = TERM("Term", 32, 32, 0..=4294967295),
        /// Time since the last control frame of this term was accepted; 6553.5 = that or more. 0 ..= 6553.5 ms in steps of 0.1
        term_age: f32 = TERM_AGE("TermAge", 64, 16, 0..=65535; 0.1),
        /// Counter of the last accepted control frame. 0 ..= 255
        obeyed_counter: u8 = OBEYED_COUNTER("ObeyedCounter", 80, 8, 0..=255),
        /// Requested road wheel angle of the last accepted control frame, left positive. -0.65536 ..= 0.65534 rad in steps of 0.00002
        steering_angle: f32 = STEERING_ANGLE("SteeringAngle", 96, 16, -32768..=32767; 2e-5),
        /// Requested longitudinal acceleration of the last accepted control frame. -32.768 ..= 32.767 m/s2 in steps of 0.001
        acceleration: f32 = ACCELERATION("Acceleration", 112, 16, -32768..=32767; 0.001),
        /// Time at which the frame was made, on the vehicle's clock; wraps around. 0 ..= 65535 ms
        sent_at: u16 = SENT_AT("SentAt", 128, 16, 0..=65535),
    }
    /// Redundancy state.
    ///
    /// Layout of `StatusA`, `StatusB`.
    Status[0x0B0, 0x0B1] {
        /// Role of the sender.
        role: RoleCode = ROLE("Role", 24, 4, 0..=15),
        /// Active function.
        mode: ModeCode = MODE("Mode", 28, 4, 0..=15),
        /// This system has failed.
        sys_failure: bool = SYS_FAILURE("SysFailure", 32, 1, 0..=1),
        /// The sender considers the other system to have failed.
        cpsys_failure: bool = CPSYS_FAILURE("CpsysFailure", 33, 1, 0..=1),
        /// Heartbeat line 1 is silent.
        line1_silent: bool = LINE1_SILENT("Line1Silent", 34, 1, 0..=1),
        /// Heartbeat line 2 is silent.
        line2_silent: bool = LINE2_SILENT("Line2Silent", 35, 1, 0..=1),
        /// Whether the commands of both systems agree.
        agreement: AgreementCode = AGREEMENT("Agreement", 36, 2, 0..=3),
        /// How well the sender can drive: with all sensors, without one, only stop, not at all.
        ability: AbilityCode = ABILITY("Ability", 38, 2, 0..=3),
        /// Code of the sender's own failure. 0 ..= 255
        failure_mode: u8 = FAILURE_MODE("FailureMode", 40, 8, 0..=255),
        /// Highest mastership term known. 0 ..= 4294967295
        term: u32 = TERM("Term", 48, 32, 0..=4294967295),
        /// Abnormal resets so far, saturated. 0 ..= 65535
        abn_resets: u16 = ABN_RESETS("AbnResets", 80, 16, 0..=65535),
        /// Resets so far, saturated. 0 ..= 65535
        total_resets: u16 = TOTAL_RESETS("TotalResets", 96, 16, 0..=65535),
        /// Confirmed tracks. 0 ..= 255
        tracks: u8 = TRACKS("Tracks", 112, 8, 0..=255),
        /// Control cycles that were late, saturated. 0 ..= 255
        deadline_misses: u8 = DEADLINE_MISSES("DeadlineMisses", 120, 8, 0..=255),
    }
    /// The global time in two frames: SYNC, and FUP with the time at which SYNC was on the bus. Sent by the master only (AUTOSAR CanTSyn). The id is behind those of control, so that no control frame waits for the time.
    ///
    /// Layout of `TimeSyncA`, `TimeSyncB`.
    TimeSync[0x0C0, 0x0C1] {
        /// 16 SYNC, 24 FUP, 32 SYNC with CRC, 40 FUP with CRC. 0 ..= 255
        message_type: u8 = MESSAGE_TYPE("MessageType", 0, 8, 0..=255),
        /// CRC-8H2F over bytes 2.. and the data id of domain and counter; in frames without CRC a user byte. 0 ..= 255
        crc8: u8 = CRC8("Crc8", 8, 8, 0..=255),
        /// The same in SYNC and its FUP, and one more in the next pair. 0 ..= 15
        sequence_counter: u8 = SEQUENCE_COUNTER("SequenceCounter", 16, 4, 0..=15),
        /// Time domain. 0 ..= 15
        domain: u8 = DOMAIN("Domain", 20, 4, 0..=15),
        /// FUP: seconds to add to those of SYNC. 0 ..= 3
        overflow: u8 = OVERFLOW("Overflow", 24, 2, 0..=3),
        /// FUP: the time is that of a sub-domain, without the global master.
        to_sub_domain: bool = TO_SUB_DOMAIN("ToSubDomain", 26, 1, 0..=1),
        /// 0; in SYNC byte 3 is a user byte. 0 ..= 31
        reserved: u8 = RESERVED("Reserved", 27, 5, 0..=31),
        /// SYNC: whole seconds. FUP: nanoseconds to add. 0 ..= 4294967295
        time: u32 = TIME("Time", 32, 32, 0..=4294967295).big_endian(),
    }
    /// Motion of the vehicle from its chassis sensors.
    ///
    /// Layout of `EgoMotion`.
    EgoMotion[0x110] {
        /// 0 until the vehicle accepts the first control frame: until then the scenario does not advance.
        world_running: bool = WORLD_RUNNING("WorldRunning", 24, 1, 0..=1),
        /// Gear that is engaged.
        gear: GearCode = GEAR("Gear", 25, 2, 0..=3),
        /// State of the parking brake.
        parking_brake: ParkingBrakeCode = PARKING_BRAKE("ParkingBrake", 27, 2, 0..=3),
        /// Longitudinal speed over ground at the centre of gravity. -327.68 ..= 327.67 m/s in steps of 0.01
        speed: f32 = SPEED("Speed", 32, 16, -32768..=32767; 0.01),
        /// Left turn positive. -3.2768 ..= 3.2767 rad/s in steps of 0.0001
        yaw_rate: f32 = YAW_RATE("YawRate", 48, 16, -32768..=32767; 0.0001),
        /// Signal `LongAcceleration`. -65.536 ..= 65.534 m/s2 in steps of 0.002
        long_acceleration: f32 = LONG_ACCELERATION("LongAcceleration", 64, 16, -32768..=32767; 0.002),
        /// Left positive. -65.536 ..= 65.534 m/s2 in steps of 0.002
        lat_acceleration: f32 = LAT_ACCELERATION("LatAcceleration", 80, 16, -32768..=32767; 0.002),
        /// Measured road wheel angle, left positive. -0.65536 ..= 0.65534 rad in steps of 0.00002
        steering_angle: f32 = STEERING_ANGLE("SteeringAngle", 96, 16, -32768..=32767; 2e-5),
        /// Side slip angle at the centre of gravity. -0.65536 ..= 0.65534 rad in steps of 0.00002
        slip_angle: f32 = SLIP_ANGLE("SlipAngle", 112, 16, -32768..=32767; 2e-5),
    }
    /// Requests of the driver.
    ///
    /// Layout of `DriverRequest`.
    DriverRequest[0x120] {
        /// The driver requests automated driving.
        engage: bool = ENGAGE("Engage", 24, 1, 0..=1),
        /// The driver steers or brakes against the function.
        overrides: bool = OVERRIDES("Overrides", 25, 1, 0..=1),
        /// Lane that the route needs: left, right or the present one (Keep); Free: any lane.
        route: RouteCode = ROUTE("Route", 26, 2, 0..=3),
        /// The driver selects the shorter of two distances to the vehicle ahead.
        near_gap: bool = NEAR_GAP("NearGap", 28, 1, 0..=1),
        /// The driver wants the vehicle parked: the function stops, and the SoC may command it from walking speed on.
        park: bool = PARK("Park", 29, 1, 0..=1),
        /// Desired speed. 0 ..= 655.35 m/s in steps of 0.01
        set_speed: f32 = SET_SPEED("SetSpeed", 32, 16, 0..=65535; 0.01),
        /// Desired offset from the centre of the lane, left positive; limited to the room in the lane. -1.28 ..= 1.27 m in steps of 0.01
        lane_offset: f32 = LANE_OFFSET("LaneOffset", 48, 8, -128..=127; 0.01),
    }
    /// Begins the object list of one measurement; ObjectCount object frames follow.
    ///
    /// Layout of `RadarFrontHeader`, `RadarFrontLeftHeader`, `RadarFrontRightHeader`, `RadarRearLeftHeader`, `RadarRearRightHeader`, `CameraFrontHeader`.
    SensorHeader[0x200, 0x210, 0x220, 0x230, 0x240, 0x250] {
        /// Object frames that follow. 0 ..= 32
        object_count: u8 = OBJECT_COUNT("ObjectCount", 24, 6, 0..=32),
        /// Clock of MeasuredAt: the sensor's own, the global time, or the global time without its master.
        time_state: TimeStateCode = TIME_STATE("TimeState", 30, 2, 0..=3),
        /// Time of the measurement on the clock that TimeState names, wraps around; 0 = none. 0 ..= 4294967295 us
        measured_at: u32 = MEASURED_AT("MeasuredAt", 32, 32, 0..=4294967295),
    }
    /// One object. Vehicle frame: origin at the vehicle's centre of gravity, x forward, y left.
    ///
    /// Layout of `RadarFrontObject`, `RadarFrontLeftObject`, `RadarFrontRightObject`, `RadarRearLeftObject`, `RadarRearRightObject`, `CameraFrontObject`.
    SensorObject[0x201, 0x211, 0x221, 0x231, 0x241, 0x251] {
        /// Place in the list of this measurement. 0 ..= 31
        index: u8 = INDEX("Index", 24, 5, 0..=31),
        /// Kind of object.
        class: ClassCode = CLASS("Class", 29, 3, 0..=7),
        /// Centre of the object. -327.68 ..= 327.67 m in steps of 0.01
        x: f32 = X("X", 32, 16, -32768..=32767; 0.01),
        /// Centre of the object. -327.68 ..= 327.67 m in steps of 0.01
        y: f32 = Y("Y", 48, 16, -32768..=32767; 0.01),
        /// Velocity over ground minus the vehicle's velocity over ground, along the vehicle's x axis. -327.68 ..= 327.67 m/s in steps of 0.01
        vx: f32 = VX("VX", 64, 16, -32768..=32767; 0.01),
        /// The same along the vehicle's y axis. -327.68 ..= 327.67 m/s in steps of 0.01
        vy: f32 = VY("VY", 80, 16, -32768..=32767; 0.01),
        /// Signal `Length`. 0 ..= 25.5 m in steps of 0.1
        length: f32 = LENGTH("Length", 96, 8, 0..=255; 0.1),
        /// Signal `Width`. 0 ..= 12.75 m in steps of 0.05
        width: f32 = WIDTH("Width", 104, 8, 0..=255; 0.05),
        /// Standard deviation of X. 0 ..= 5.1 m in steps of 0.02
        x_deviation: f32 = X_DEVIATION("XDeviation", 112, 8, 0..=255; 0.02),
        /// Standard deviation of Y. 0 ..= 5.1 m in steps of 0.02
        y_deviation: f32 = Y_DEVIATION("YDeviation", 120, 8, 0..=255; 0.02),
    }
    /// Lanes ahead. Centre line of the vehicle's lane in the vehicle frame: y(x) = C0 + C1 x + C2 x^2 + C3 x^3.
    ///
    /// Layout of `CameraLanes`.
    CameraLanes[0x270] {
        /// The camera sees the vehicle's lane.
        valid: bool = VALID("Valid", 24, 1, 0..=1),
        /// There is a lane to the left in the same direction.
        left_exists: bool = LEFT_EXISTS("LeftExists", 25, 1, 0..=1),
        /// There is a lane to the right in the same direction.
        right_exists: bool = RIGHT_EXISTS("RightExists", 26, 1, 0..=1),
        /// The lane continues beyond OwnEnd, but outside the operational design domain.
        ends_domain: bool = ENDS_DOMAIN("EndsDomain", 27, 1, 0..=1),
        /// Clock of MeasuredAt: the sensor's own, the global time, or the global time without its master.
        time_state: TimeStateCode = TIME_STATE("TimeState", 28, 2, 0..=3),
        /// Signal `C0`. -32.768 ..= 32.767 m in steps of 0.001
        c0: f32 = C0("C0", 32, 16, -32768..=32767; 0.001),
        /// Signal `C1`. -1.6384 ..= 1.63835  in steps of 0.00005
        c1: f32 = C1("C1", 48, 16, -32768..=32767; 5e-5),
        /// Signal `C2`. -0.032768 ..= 0.032767 1/m in steps of 0.000001
        c2: f32 = C2("C2", 64, 16, -32768..=32767; 1e-6),
        /// Signal `C3`. -0.00032768 ..= 0.00032767 1/m2 in steps of 0.00000001
        c3: f32 = C3("C3", 80, 16, -32768..=32767; 1e-8),
        /// The polynomial is valid up to this x. 0 ..= 255 m
        view_range: u8 = VIEW_RANGE("ViewRange", 96, 8, 0..=255),
        /// Width of the vehicle's lane. 0 ..= 5.1 m in steps of 0.02
        width: f32 = WIDTH("Width", 104, 8, 0..=255; 0.02),
        /// Width of the lane to the left. 0 ..= 5.1 m in steps of 0.02
        left_width: f32 = LEFT_WIDTH("LeftWidth", 112, 8, 0..=255; 0.02),
        /// Width of the lane to the right. 0 ..= 5.1 m in steps of 0.02
        right_width: f32 = RIGHT_WIDTH("RightWidth", 120, 8, 0..=255; 0.02),
        /// Distance to the end of the vehicle's lane; 6553.5 = no end in sight. 0 ..= 6553.5 m in steps of 0.1
        own_end: f32 = OWN_END("OwnEnd", 128, 16, 0..=65535; 0.1),
        /// The same for the lane to the left. 0 ..= 6553.5 m in steps of 0.1
        left_end: f32 = LEFT_END("LeftEnd", 144, 16, 0..=65535; 0.1),
        /// The same for the lane to the right. 0 ..= 6553.5 m in steps of 0.1
        right_end: f32 = RIGHT_END("RightEnd", 160, 16, 0..=65535; 0.1),
        /// Posted speed limit; 655.35 = none. 0 ..= 655.35 m/s in steps of 0.01
        speed_limit: f32 = SPEED_LIMIT("SpeedLimit", 176, 16, 0..=65535; 0.01),
        /// Time of the measurement on the clock that TimeState names, wraps around; 0 = none. 0 ..= 4294967295 us
        measured_at: u32 = MEASURED_AT("MeasuredAt", 192, 32, 0..=4294967295),
    }
}

/// A frame of the vehicle bus with its values. `system` is 0 for A and 1 for B; a greater one
/// saturates to 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Message {
    /// Vehicle control.
    Control {
        /// 0 = A, 1 = B.
        system: u8,
        /// The values.
        control: Control,
    },
    /// Gear and parking brake.
    BodyControl {
        /// 0 = A, 1 = B.
        system: u8,
        /// The values.
        body_control: BodyControl,
    },
    /// The mastership term that the vehicle obeys.
    GateEcho(GateEcho),
    /// Redundancy state.
    Status {
        /// 0 = A, 1 = B.
        system: u8,
        /// The values.
        status: Status,
    },
    /// The global time in two frames.
    TimeSync {
        /// 0 = A, 1 = B.
        system: u8,
        /// The values.
        time_sync: TimeSync,
    },
    /// Motion of the vehicle from its chassis sensors.
    EgoMotion(EgoMotion),
    /// Requests of the driver.
    DriverRequest(DriverRequest),
    /// Begins the object list of one measurement.
    SensorHeader(SensorId, SensorHeader),
    /// One object.
    SensorObject(SensorId, SensorObject),
    /// Lanes ahead.
    CameraLanes(CameraLanes),
}

impl Message {
    /// Place of its frame in [`FRAMES`].
    pub(crate) const fn index(&self) -> usize {
        match self {
            Self::Control { system, .. } => [0, 1][(*system != 0) as usize],
            Self::BodyControl { system, .. } => [2, 3][(*system != 0) as usize],
            Self::GateEcho(_) => 4,
            Self::Status { system, .. } => [5, 6][(*system != 0) as usize],
            Self::TimeSync { system, .. } => [7, 8][(*system != 0) as usize],
            Self::EgoMotion(_) => 9,
            Self::DriverRequest(_) => 10,
            Self::SensorHeader(sensor, _) => [11, 13, 15, 17, 19, 21][sensor.index()],
            Self::SensorObject(sensor, _) => [12, 14, 16, 18, 20, 22][sensor.index()],
            Self::CameraLanes(_) => 23,
        }
    }

    /// The message of the frame with this id, with default values.
    #[inline(always)]
    pub(crate) fn blank(id: u16) -> Option<Self> {
        Some(match id {
            0x0A0 => Self::Control {
                system: 0,
                control: Control::default(),
            },
            0x0A1 => Self::Control {
                system: 1,
                control: Control::default(),
            },
            0x0A2 => Self::BodyControl {
                system: 0,
                body_control: BodyControl::default(),
            },
            0x0A3 => Self::BodyControl {
                system: 1,
                body_control: BodyControl::default(),
            },
            0x0A8 => Self::GateEcho(GateEcho::default()),
            0x0B0 => Self::Status {
                system: 0,
                status: Status::default(),
            },
            0x0B1 => Self::Status {
                system: 1,
                status: Status::default(),
            },
            0x0C0 => Self::TimeSync {
                system: 0,
                time_sync: TimeSync::default(),
            },
            0x0C1 => Self::TimeSync {
                system: 1,
                time_sync: TimeSync::default(),
            },
            0x110 => Self::EgoMotion(EgoMotion::default()),
            0x120 => Self::DriverRequest(DriverRequest::default()),
            0x200 => Self::SensorHeader(SensorId::RadarFront, SensorHeader::default()),
            0x210 => Self::SensorHeader(SensorId::RadarFrontLeft, SensorHeader::default()),
            0x220 => Self::SensorHeader(SensorId::RadarFrontRight, SensorHeader::default()),
            0x230 => Self::SensorHeader(SensorId::RadarRearLeft, SensorHeader::default()),
            0x240 => Self::SensorHeader(SensorId::RadarRearRight, SensorHeader::default()),
            0x250 => Self::SensorHeader(SensorId::CameraFront, SensorHeader::default()),
            0x201 => Self::SensorObject(SensorId::RadarFront, SensorObject::default()),
            0x211 => Self::SensorObject(SensorId::RadarFrontLeft, SensorObject::default()),
            0x221 => Self::SensorObject(SensorId::RadarFrontRight, SensorObject::default()),
            0x231 => Self::SensorObject(SensorId::RadarRearLeft, SensorObject::default()),
            0x241 => Self::SensorObject(SensorId::RadarRearRight, SensorObject::default()),
            0x251 => Self::SensorObject(SensorId::CameraFront, SensorObject::default()),
            0x270 => Self::CameraLanes(CameraLanes::default()),
            _ => return None,
        })
    }

    pub(crate) fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        match self {
            Self::Control { system, control } => {
                walk.implied(&const { Signal::new("System", 29, 1, 0..=1) }, *system)?;
                control.walk(walk)
            }
            Self::BodyControl {
                system,
                body_control,
            } => {
                walk.implied(&const { Signal::new("System", 24, 1, 0..=1) }, *system)?;
                body_control.walk(walk)
            }
            Self::GateEcho(gate_echo) => gate_echo.walk(walk),
            Self::Status { status, .. } => status.walk(walk),
            Self::TimeSync { time_sync, .. } => time_sync.walk(walk),
            Self::EgoMotion(ego_motion) => ego_motion.walk(walk),
            Self::DriverRequest(driver_request) => driver_request.walk(walk),
            Self::SensorHeader(_, sensor_header) => sensor_header.walk(walk),
            Self::SensorObject(_, sensor_object) => sensor_object.walk(walk),
            Self::CameraLanes(camera_lanes) => camera_lanes.walk(walk),
        }
    }
}

/// Every frame of the vehicle bus, in the order of the DBC, which is by id.
pub const FRAMES: [FrameInfo; 24] = [
    FrameInfo::new(0x0A0, "ControlA", 16, 10),
    FrameInfo::new(0x0A1, "ControlB", 16, 10),
    FrameInfo::new(0x0A2, "BodyControlA", 8, 0),
    FrameInfo::new(0x0A3, "BodyControlB", 8, 0),
    FrameInfo::new(0x0A8, "GateEcho", 20, 10),
    FrameInfo::new(0x0B0, "StatusA", 16, 100),
    FrameInfo::new(0x0B1, "StatusB", 16, 100),
    FrameInfo::new(0x0C0, "TimeSyncA", 8, 0).without_e2e(),
    FrameInfo::new(0x0C1, "TimeSyncB", 8, 0).without_e2e(),
    FrameInfo::new(0x110, "EgoMotion", 16, 10),
    FrameInfo::new(0x120, "DriverRequest", 8, 100),
    FrameInfo::new(0x200, "RadarFrontHeader", 8, 50),
    FrameInfo::new(0x201, "RadarFrontObject", 16, 50),
    FrameInfo::new(0x210, "RadarFrontLeftHeader", 8, 50),
    FrameInfo::new(0x211, "RadarFrontLeftObject", 16, 50),
    FrameInfo::new(0x220, "RadarFrontRightHeader", 8, 50),
    FrameInfo::new(0x221, "RadarFrontRightObject", 16, 50),
    FrameInfo::new(0x230, "RadarRearLeftHeader", 8, 50),
    FrameInfo::new(0x231, "RadarRearLeftObject", 16, 50),
    FrameInfo::new(0x240, "RadarRearRightHeader", 8, 50),
    FrameInfo::new(0x241, "RadarRearRightObject", 16, 50),
    FrameInfo::new(0x250, "CameraFrontHeader", 8, 50),
    FrameInfo::new(0x251, "CameraFrontObject", 16, 50),
    FrameInfo::new(0x270, "CameraLanes", 32, 50),
];
