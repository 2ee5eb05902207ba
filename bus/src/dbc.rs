//! Enums, structs, messages and frames of `dbc/tandem.dbc`. Made by `cargo xtask dbc`: not to be edited.

use crate::signal::{FrameError, FrameInfo, Signal, ValueTable, Walk};

/// A sensor that sends object lists.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SensorId {
    /// Long range radar in front.
    RadarFront,
    /// Corner radar in front on the left.
    RadarFrontLeft,
    /// Corner radar in front on the right.
    RadarFrontRight,
    /// Corner radar behind on the left.
    RadarRearLeft,
    /// Corner radar behind on the right.
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

/// Values of the signal `Agreement`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum AgreementCode {
    /// Coded as 0.
    #[default]
    Agreed = 0,
    /// Coded as 1.
    Disagreed = 1,
    /// Coded as 2.
    Unresolved = 2,
}

impl AgreementCode {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 3] = [Self::Agreed, Self::Disagreed, Self::Unresolved];
}

impl ValueTable for AgreementCode {
    const VALUES: &'static [Self] = &Self::ALL;

    fn raw(self) -> u8 {
        self as u8
    }
}

/// Values of the signal `Class`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ClassCode {
    /// Coded as 0.
    #[default]
    Unknown = 0,
    /// Coded as 1.
    Car = 1,
    /// Coded as 2.
    Truck = 2,
    /// Coded as 3.
    Motorcycle = 3,
    /// Coded as 4.
    Pedestrian = 4,
    /// Coded as 5.
    Static = 5,
}

impl ClassCode {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 6] = [
        Self::Unknown,
        Self::Car,
        Self::Truck,
        Self::Motorcycle,
        Self::Pedestrian,
        Self::Static,
    ];
}

impl ValueTable for ClassCode {
    const VALUES: &'static [Self] = &Self::ALL;

    fn raw(self) -> u8 {
        self as u8
    }
}

/// Values of the signal `Mode`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ModeCode {
    /// Coded as 0.
    #[default]
    None = 0,
    /// Coded as 1.
    L3 = 1,
    /// Coded as 2.
    DegradedL2 = 2,
    /// Coded as 3.
    SafeStop = 3,
}

impl ModeCode {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 4] = [Self::None, Self::L3, Self::DegradedL2, Self::SafeStop];
}

impl ValueTable for ModeCode {
    const VALUES: &'static [Self] = &Self::ALL;

    fn raw(self) -> u8 {
        self as u8
    }
}

/// Values of the signal `Role`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RoleCode {
    /// Coded as 0.
    #[default]
    Starting = 0,
    /// Coded as 1.
    Master = 1,
    /// Coded as 2.
    Standby = 2,
    /// Coded as 3.
    Suspended = 3,
}

impl RoleCode {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 4] = [Self::Starting, Self::Master, Self::Standby, Self::Suspended];
}

impl ValueTable for RoleCode {
    const VALUES: &'static [Self] = &Self::ALL;

    fn raw(self) -> u8 {
        self as u8
    }
}

/// Values of the signal `Route`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RouteCode {
    /// Coded as 0.
    #[default]
    Free = 0,
    /// Coded as 1.
    Left = 1,
    /// Coded as 2.
    Right = 2,
    /// Coded as 3.
    Keep = 3,
}

impl RouteCode {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 4] = [Self::Free, Self::Left, Self::Right, Self::Keep];
}

impl ValueTable for RouteCode {
    const VALUES: &'static [Self] = &Self::ALL;

    fn raw(self) -> u8 {
        self as u8
    }
}

/// Vehicle control. Sent by the master only; the vehicle accepts the highest term.
///
/// Layout of `ControlA`, `ControlB`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Control {
    /// Role of the sender.
    pub role: RoleCode,
    /// Function that produced the command; None: the driver drives, and the command is what the vehicle does.
    pub mode: ModeCode,
    /// The function asks the driver to take over.
    pub takeover_request: bool,
    /// Mastership term: the higher one fences the lower one off; its lowest bit is the system. 0 ..= 4294967295
    pub term: u32,
    /// Requested road wheel angle, left positive. -0.65536 ..= 0.65534 rad in steps of 0.00002
    pub steering_angle: f32,
    /// Requested longitudinal acceleration. -32.768 ..= 32.767 m/s2 in steps of 0.001
    pub acceleration: f32,
    /// Age of the sensor data that the command rests on. 0 ..= 6553.5 ms in steps of 0.1
    pub command_age: f32,
    /// When the frame was made, on the clock of its sender, wraps around; 0 = not known. 0 ..= 65535 ms
    pub sent_at: u16,
}

impl Control {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 2] = [0x0A0, 0x0A1];

    pub(crate) const ROLE: Signal = Signal::new("Role", 24, 2, 0..=3);
    pub(crate) const MODE: Signal = Signal::new("Mode", 26, 3, 0..=7);
    pub(crate) const SYSTEM: Signal = Signal::new("System", 29, 1, 0..=1);
    pub(crate) const TAKEOVER_REQUEST: Signal = Signal::new("TakeoverRequest", 30, 1, 0..=1);
    pub(crate) const TERM: Signal = Signal::new("Term", 32, 32, 0..=4294967295);
    pub(crate) const STEERING_ANGLE: Signal =
        Signal::new("SteeringAngle", 64, 16, -32768..=32767).in_steps_of(2e-5);
    pub(crate) const ACCELERATION: Signal =
        Signal::new("Acceleration", 80, 16, -32768..=32767).in_steps_of(0.001);
    pub(crate) const COMMAND_AGE: Signal =
        Signal::new("CommandAge", 96, 16, 0..=65535).in_steps_of(0.1);
    pub(crate) const SENT_AT: Signal = Signal::new("SentAt", 112, 16, 0..=65535);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::ROLE, &mut self.role)?;
        walk.field(&Self::MODE, &mut self.mode)?;
        walk.field(&Self::TAKEOVER_REQUEST, &mut self.takeover_request)?;
        walk.field(&Self::TERM, &mut self.term)?;
        walk.field(&Self::STEERING_ANGLE, &mut self.steering_angle)?;
        walk.field(&Self::ACCELERATION, &mut self.acceleration)?;
        walk.field(&Self::COMMAND_AGE, &mut self.command_age)?;
        walk.field(&Self::SENT_AT, &mut self.sent_at)?;
        Ok(())
    }
}

/// The mastership term that the vehicle obeys: that of the last control frame which it accepted.
///
/// Layout of `GateEcho`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GateEcho {
    /// Control frames of the term that is obeyed that were refused as implausible or too long on their way, wraps around. 0 ..= 255
    pub refused: u8,
    /// Highest mastership term that was accepted; 0 = none yet. 0 ..= 4294967295
    pub term: u32,
    /// Time since the last control frame of this term was accepted; 6553.5 = that or more. 0 ..= 6553.5 ms in steps of 0.1
    pub term_age: f32,
    /// Counter of the control frame that is obeyed. 0 ..= 255
    pub obeyed_counter: u8,
    /// When the frame was made, on the clock of the vehicle, wraps around. 0 ..= 255 ms
    pub sent_at: u8,
    /// Road wheel angle that is obeyed, left positive. -0.65536 ..= 0.65534 rad in steps of 0.00002
    pub steering_angle: f32,
    /// Longitudinal acceleration that is obeyed. -32.768 ..= 32.767 m/s2 in steps of 0.001
    pub acceleration: f32,
}

impl GateEcho {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 1] = [0x0A8];
    /// Id of the frame.
    pub const ID: u16 = 0x0A8;

    pub(crate) const REFUSED: Signal = Signal::new("Refused", 24, 8, 0..=255);
    pub(crate) const TERM: Signal = Signal::new("Term", 32, 32, 0..=4294967295);
    pub(crate) const TERM_AGE: Signal = Signal::new("TermAge", 64, 16, 0..=65535).in_steps_of(0.1);
    pub(crate) const OBEYED_COUNTER: Signal = Signal::new("ObeyedCounter", 80, 8, 0..=255);
    pub(crate) const SENT_AT: Signal = Signal::new("SentAt", 88, 8, 0..=255);
    pub(crate) const STEERING_ANGLE: Signal =
        Signal::new("SteeringAngle", 96, 16, -32768..=32767).in_steps_of(2e-5);
    pub(crate) const ACCELERATION: Signal =
        Signal::new("Acceleration", 112, 16, -32768..=32767).in_steps_of(0.001);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::REFUSED, &mut self.refused)?;
        walk.field(&Self::TERM, &mut self.term)?;
        walk.field(&Self::TERM_AGE, &mut self.term_age)?;
        walk.field(&Self::OBEYED_COUNTER, &mut self.obeyed_counter)?;
        walk.field(&Self::SENT_AT, &mut self.sent_at)?;
        walk.field(&Self::STEERING_ANGLE, &mut self.steering_angle)?;
        walk.field(&Self::ACCELERATION, &mut self.acceleration)?;
        Ok(())
    }
}

/// Redundancy state.
///
/// Layout of `StatusA`, `StatusB`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Status {
    /// Role of the sender.
    pub role: RoleCode,
    /// Function in operation.
    pub mode: ModeCode,
    /// This system has failed.
    pub sys_failure: bool,
    /// The other system is taken for failed.
    pub cpsys_failure: bool,
    /// Heartbeat line 1 is silent.
    pub line1_silent: bool,
    /// Heartbeat line 2 is silent.
    pub line2_silent: bool,
    /// Whether the other system would command the same.
    pub agreement: AgreementCode,
    /// Which own fault. 0 ..= 255
    pub failure_mode: u8,
    /// Highest mastership term known. 0 ..= 4294967295
    pub term: u32,
    /// Abnormal resets so far, saturated. 0 ..= 65535
    pub abn_resets: u16,
    /// Resets so far, saturated. 0 ..= 65535
    pub total_resets: u16,
    /// Confirmed tracks. 0 ..= 255
    pub tracks: u8,
    /// Control cycles that were late, saturated. 0 ..= 255
    pub deadline_misses: u8,
}

impl Status {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 2] = [0x0B0, 0x0B1];

    pub(crate) const ROLE: Signal = Signal::new("Role", 24, 4, 0..=15);
    pub(crate) const MODE: Signal = Signal::new("Mode", 28, 4, 0..=15);
    pub(crate) const SYS_FAILURE: Signal = Signal::new("SysFailure", 32, 1, 0..=1);
    pub(crate) const CPSYS_FAILURE: Signal = Signal::new("CpsysFailure", 33, 1, 0..=1);
    pub(crate) const LINE1_SILENT: Signal = Signal::new("Line1Silent", 34, 1, 0..=1);
    pub(crate) const LINE2_SILENT: Signal = Signal::new("Line2Silent", 35, 1, 0..=1);
    pub(crate) const AGREEMENT: Signal = Signal::new("Agreement", 36, 2, 0..=3);
    pub(crate) const FAILURE_MODE: Signal = Signal::new("FailureMode", 40, 8, 0..=255);
    pub(crate) const TERM: Signal = Signal::new("Term", 48, 32, 0..=4294967295);
    pub(crate) const ABN_RESETS: Signal = Signal::new("AbnResets", 80, 16, 0..=65535);
    pub(crate) const TOTAL_RESETS: Signal = Signal::new("TotalResets", 96, 16, 0..=65535);
    pub(crate) const TRACKS: Signal = Signal::new("Tracks", 112, 8, 0..=255);
    pub(crate) const DEADLINE_MISSES: Signal = Signal::new("DeadlineMisses", 120, 8, 0..=255);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::ROLE, &mut self.role)?;
        walk.field(&Self::MODE, &mut self.mode)?;
        walk.field(&Self::SYS_FAILURE, &mut self.sys_failure)?;
        walk.field(&Self::CPSYS_FAILURE, &mut self.cpsys_failure)?;
        walk.field(&Self::LINE1_SILENT, &mut self.line1_silent)?;
        walk.field(&Self::LINE2_SILENT, &mut self.line2_silent)?;
        walk.field(&Self::AGREEMENT, &mut self.agreement)?;
        walk.field(&Self::FAILURE_MODE, &mut self.failure_mode)?;
        walk.field(&Self::TERM, &mut self.term)?;
        walk.field(&Self::ABN_RESETS, &mut self.abn_resets)?;
        walk.field(&Self::TOTAL_RESETS, &mut self.total_resets)?;
        walk.field(&Self::TRACKS, &mut self.tracks)?;
        walk.field(&Self::DEADLINE_MISSES, &mut self.deadline_misses)?;
        Ok(())
    }
}

/// Motion of the own vehicle from its chassis sensors.
///
/// Layout of `EgoMotion`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EgoMotion {
    /// 0 until the first control frame was accepted: the world stands still and waits.
    pub world_running: bool,
    /// Longitudinal speed over ground at the centre of gravity. -327.68 ..= 327.67 m/s in steps of 0.01
    pub speed: f32,
    /// Left turn positive. -3.2768 ..= 3.2767 rad/s in steps of 0.0001
    pub yaw_rate: f32,
    /// Signal `LongAcceleration`. -65.536 ..= 65.534 m/s2 in steps of 0.002
    pub long_acceleration: f32,
    /// Left positive. -65.536 ..= 65.534 m/s2 in steps of 0.002
    pub lat_acceleration: f32,
    /// Measured road wheel angle, left positive. -0.65536 ..= 0.65534 rad in steps of 0.00002
    pub steering_angle: f32,
    /// Side slip angle at the centre of gravity. -0.65536 ..= 0.65534 rad in steps of 0.00002
    pub slip_angle: f32,
}

impl EgoMotion {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 1] = [0x110];
    /// Id of the frame.
    pub const ID: u16 = 0x110;

    pub(crate) const WORLD_RUNNING: Signal = Signal::new("WorldRunning", 24, 1, 0..=1);
    pub(crate) const SPEED: Signal = Signal::new("Speed", 32, 16, -32768..=32767).in_steps_of(0.01);
    pub(crate) const YAW_RATE: Signal =
        Signal::new("YawRate", 48, 16, -32768..=32767).in_steps_of(0.0001);
    pub(crate) const LONG_ACCELERATION: Signal =
        Signal::new("LongAcceleration", 64, 16, -32768..=32767).in_steps_of(0.002);
    pub(crate) const LAT_ACCELERATION: Signal =
        Signal::new("LatAcceleration", 80, 16, -32768..=32767).in_steps_of(0.002);
    pub(crate) const STEERING_ANGLE: Signal =
        Signal::new("SteeringAngle", 96, 16, -32768..=32767).in_steps_of(2e-5);
    pub(crate) const SLIP_ANGLE: Signal =
        Signal::new("SlipAngle", 112, 16, -32768..=32767).in_steps_of(2e-5);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::WORLD_RUNNING, &mut self.world_running)?;
        walk.field(&Self::SPEED, &mut self.speed)?;
        walk.field(&Self::YAW_RATE, &mut self.yaw_rate)?;
        walk.field(&Self::LONG_ACCELERATION, &mut self.long_acceleration)?;
        walk.field(&Self::LAT_ACCELERATION, &mut self.lat_acceleration)?;
        walk.field(&Self::STEERING_ANGLE, &mut self.steering_angle)?;
        walk.field(&Self::SLIP_ANGLE, &mut self.slip_angle)?;
        Ok(())
    }
}

/// What the driver asks for.
///
/// Layout of `DriverRequest`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriverRequest {
    /// Automated driving is asked for.
    pub engage: bool,
    /// The driver steers or brakes against the function.
    pub overrides: bool,
    /// Where the route leads: to the lane on the left or right, or on in the own lane; Free: anywhere.
    pub route: RouteCode,
    /// The shorter of the two distances to the vehicle ahead.
    pub near_gap: bool,
    /// Desired speed. 0 ..= 655.35 m/s in steps of 0.01
    pub set_speed: f32,
    /// Desired place in the own lane, from its centre, left positive; as far as the lane has room. -1.28 ..= 1.27 m in steps of 0.01
    pub lane_offset: f32,
}

impl DriverRequest {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 1] = [0x120];
    /// Id of the frame.
    pub const ID: u16 = 0x120;

    pub(crate) const ENGAGE: Signal = Signal::new("Engage", 24, 1, 0..=1);
    pub(crate) const OVERRIDES: Signal = Signal::new("Overrides", 25, 1, 0..=1);
    pub(crate) const ROUTE: Signal = Signal::new("Route", 26, 2, 0..=3);
    pub(crate) const NEAR_GAP: Signal = Signal::new("NearGap", 28, 1, 0..=1);
    pub(crate) const SET_SPEED: Signal =
        Signal::new("SetSpeed", 32, 16, 0..=65535).in_steps_of(0.01);
    pub(crate) const LANE_OFFSET: Signal =
        Signal::new("LaneOffset", 48, 8, -128..=127).in_steps_of(0.01);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::ENGAGE, &mut self.engage)?;
        walk.field(&Self::OVERRIDES, &mut self.overrides)?;
        walk.field(&Self::ROUTE, &mut self.route)?;
        walk.field(&Self::NEAR_GAP, &mut self.near_gap)?;
        walk.field(&Self::SET_SPEED, &mut self.set_speed)?;
        walk.field(&Self::LANE_OFFSET, &mut self.lane_offset)?;
        Ok(())
    }
}

/// Begins the object list of one measurement; ObjectCount object frames follow.
///
/// Layout of `RadarFrontHeader`, `RadarFrontLeftHeader`, `RadarFrontRightHeader`, `RadarRearLeftHeader`, `RadarRearRightHeader`, `CameraFrontHeader`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorHeader {
    /// Object frames that follow. 0 ..= 32
    pub object_count: u8,
    /// Time of the measurement on the sensor's clock, wraps around. 0 ..= 4294967295 us
    pub measured_at: u32,
}

impl SensorHeader {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 6] = [0x200, 0x210, 0x220, 0x230, 0x240, 0x250];

    pub(crate) const OBJECT_COUNT: Signal = Signal::new("ObjectCount", 24, 8, 0..=32);
    pub(crate) const MEASURED_AT: Signal = Signal::new("MeasuredAt", 32, 32, 0..=4294967295);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::OBJECT_COUNT, &mut self.object_count)?;
        walk.field(&Self::MEASURED_AT, &mut self.measured_at)?;
        Ok(())
    }
}

/// One object. Vehicle frame: origin at the centre of gravity of the own vehicle, x forward, y left.
///
/// Layout of `RadarFrontObject`, `RadarFrontLeftObject`, `RadarFrontRightObject`, `RadarRearLeftObject`, `RadarRearRightObject`, `CameraFrontObject`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorObject {
    /// Place in the list of this measurement. 0 ..= 31
    pub index: u8,
    /// Kind of object.
    pub class: ClassCode,
    /// Centre of the object. -327.68 ..= 327.67 m in steps of 0.01
    pub x: f32,
    /// Centre of the object. -327.68 ..= 327.67 m in steps of 0.01
    pub y: f32,
    /// Velocity over ground minus own velocity over ground, along the own x axis. -327.68 ..= 327.67 m/s in steps of 0.01
    pub vx: f32,
    /// The same along the own y axis. -327.68 ..= 327.67 m/s in steps of 0.01
    pub vy: f32,
    /// Signal `Length`. 0 ..= 25.5 m in steps of 0.1
    pub length: f32,
    /// Signal `Width`. 0 ..= 12.75 m in steps of 0.05
    pub width: f32,
    /// Standard deviation of X. 0 ..= 5.1 m in steps of 0.02
    pub x_deviation: f32,
    /// Standard deviation of Y. 0 ..= 5.1 m in steps of 0.02
    pub y_deviation: f32,
}

impl SensorObject {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 6] = [0x201, 0x211, 0x221, 0x231, 0x241, 0x251];

    pub(crate) const INDEX: Signal = Signal::new("Index", 24, 5, 0..=31);
    pub(crate) const CLASS: Signal = Signal::new("Class", 29, 3, 0..=7);
    pub(crate) const X: Signal = Signal::new("X", 32, 16, -32768..=32767).in_steps_of(0.01);
    pub(crate) const Y: Signal = Signal::new("Y", 48, 16, -32768..=32767).in_steps_of(0.01);
    pub(crate) const VX: Signal = Signal::new("VX", 64, 16, -32768..=32767).in_steps_of(0.01);
    pub(crate) const VY: Signal = Signal::new("VY", 80, 16, -32768..=32767).in_steps_of(0.01);
    pub(crate) const LENGTH: Signal = Signal::new("Length", 96, 8, 0..=255).in_steps_of(0.1);
    pub(crate) const WIDTH: Signal = Signal::new("Width", 104, 8, 0..=255).in_steps_of(0.05);
    pub(crate) const X_DEVIATION: Signal =
        Signal::new("XDeviation", 112, 8, 0..=255).in_steps_of(0.02);
    pub(crate) const Y_DEVIATION: Signal =
        Signal::new("YDeviation", 120, 8, 0..=255).in_steps_of(0.02);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::INDEX, &mut self.index)?;
        walk.field(&Self::CLASS, &mut self.class)?;
        walk.field(&Self::X, &mut self.x)?;
        walk.field(&Self::Y, &mut self.y)?;
        walk.field(&Self::VX, &mut self.vx)?;
        walk.field(&Self::VY, &mut self.vy)?;
        walk.field(&Self::LENGTH, &mut self.length)?;
        walk.field(&Self::WIDTH, &mut self.width)?;
        walk.field(&Self::X_DEVIATION, &mut self.x_deviation)?;
        walk.field(&Self::Y_DEVIATION, &mut self.y_deviation)?;
        Ok(())
    }
}

/// Lanes ahead. Centre line of the own lane in the vehicle frame: y(x) = C0 + C1 x + C2 x^2 + C3 x^3.
///
/// Layout of `CameraLanes`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraLanes {
    /// The camera sees the own lane.
    pub valid: bool,
    /// There is a lane to the left in the same direction.
    pub left_exists: bool,
    /// There is a lane to the right in the same direction.
    pub right_exists: bool,
    /// The lane continues behind OwnEnd, but outside of the operational design domain.
    pub ends_domain: bool,
    /// Signal `C0`. -32.768 ..= 32.767 m in steps of 0.001
    pub c0: f32,
    /// Signal `C1`. -1.6384 ..= 1.63835  in steps of 0.00005
    pub c1: f32,
    /// Signal `C2`. -0.032768 ..= 0.032767 1/m in steps of 0.000001
    pub c2: f32,
    /// Signal `C3`. -0.00032768 ..= 0.00032767 1/m2 in steps of 0.00000001
    pub c3: f32,
    /// The polynomial holds up to this x. 0 ..= 255 m
    pub view_range: u8,
    /// Width of the own lane. 0 ..= 5.1 m in steps of 0.02
    pub width: f32,
    /// Width of the lane to the left. 0 ..= 5.1 m in steps of 0.02
    pub left_width: f32,
    /// Width of the lane to the right. 0 ..= 5.1 m in steps of 0.02
    pub right_width: f32,
    /// Distance to the end of the own lane; 6553.5 = no end in sight. 0 ..= 6553.5 m in steps of 0.1
    pub own_end: f32,
    /// The same for the lane to the left. 0 ..= 6553.5 m in steps of 0.1
    pub left_end: f32,
    /// The same for the lane to the right. 0 ..= 6553.5 m in steps of 0.1
    pub right_end: f32,
    /// Signed speed limit; 655.35 = none. 0 ..= 655.35 m/s in steps of 0.01
    pub speed_limit: f32,
}

impl CameraLanes {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 1] = [0x270];
    /// Id of the frame.
    pub const ID: u16 = 0x270;

    pub(crate) const VALID: Signal = Signal::new("Valid", 24, 1, 0..=1);
    pub(crate) const LEFT_EXISTS: Signal = Signal::new("LeftExists", 25, 1, 0..=1);
    pub(crate) const RIGHT_EXISTS: Signal = Signal::new("RightExists", 26, 1, 0..=1);
    pub(crate) const ENDS_DOMAIN: Signal = Signal::new("EndsDomain", 27, 1, 0..=1);
    pub(crate) const C0: Signal = Signal::new("C0", 32, 16, -32768..=32767).in_steps_of(0.001);
    pub(crate) const C1: Signal = Signal::new("C1", 48, 16, -32768..=32767).in_steps_of(5e-5);
    pub(crate) const C2: Signal = Signal::new("C2", 64, 16, -32768..=32767).in_steps_of(1e-6);
    pub(crate) const C3: Signal = Signal::new("C3", 80, 16, -32768..=32767).in_steps_of(1e-8);
    pub(crate) const VIEW_RANGE: Signal = Signal::new("ViewRange", 96, 8, 0..=255);
    pub(crate) const WIDTH: Signal = Signal::new("Width", 104, 8, 0..=255).in_steps_of(0.02);
    pub(crate) const LEFT_WIDTH: Signal =
        Signal::new("LeftWidth", 112, 8, 0..=255).in_steps_of(0.02);
    pub(crate) const RIGHT_WIDTH: Signal =
        Signal::new("RightWidth", 120, 8, 0..=255).in_steps_of(0.02);
    pub(crate) const OWN_END: Signal = Signal::new("OwnEnd", 128, 16, 0..=65535).in_steps_of(0.1);
    pub(crate) const LEFT_END: Signal = Signal::new("LeftEnd", 144, 16, 0..=65535).in_steps_of(0.1);
    pub(crate) const RIGHT_END: Signal =
        Signal::new("RightEnd", 160, 16, 0..=65535).in_steps_of(0.1);
    pub(crate) const SPEED_LIMIT: Signal =
        Signal::new("SpeedLimit", 176, 16, 0..=65535).in_steps_of(0.01);

    fn walk(&mut self, walk: &mut impl Walk) -> Result<(), FrameError> {
        walk.field(&Self::VALID, &mut self.valid)?;
        walk.field(&Self::LEFT_EXISTS, &mut self.left_exists)?;
        walk.field(&Self::RIGHT_EXISTS, &mut self.right_exists)?;
        walk.field(&Self::ENDS_DOMAIN, &mut self.ends_domain)?;
        walk.field(&Self::C0, &mut self.c0)?;
        walk.field(&Self::C1, &mut self.c1)?;
        walk.field(&Self::C2, &mut self.c2)?;
        walk.field(&Self::C3, &mut self.c3)?;
        walk.field(&Self::VIEW_RANGE, &mut self.view_range)?;
        walk.field(&Self::WIDTH, &mut self.width)?;
        walk.field(&Self::LEFT_WIDTH, &mut self.left_width)?;
        walk.field(&Self::RIGHT_WIDTH, &mut self.right_width)?;
        walk.field(&Self::OWN_END, &mut self.own_end)?;
        walk.field(&Self::LEFT_END, &mut self.left_end)?;
        walk.field(&Self::RIGHT_END, &mut self.right_end)?;
        walk.field(&Self::SPEED_LIMIT, &mut self.speed_limit)?;
        Ok(())
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
    /// The mastership term that the vehicle obeys.
    GateEcho(GateEcho),
    /// Redundancy state.
    Status {
        /// 0 = A, 1 = B.
        system: u8,
        /// The values.
        status: Status,
    },
    /// Motion of the own vehicle from its chassis sensors.
    EgoMotion(EgoMotion),
    /// What the driver asks for.
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
            Self::GateEcho(_) => 2,
            Self::Status { system, .. } => [3, 4][(*system != 0) as usize],
            Self::EgoMotion(_) => 5,
            Self::DriverRequest(_) => 6,
            Self::SensorHeader(sensor, _) => [7, 9, 11, 13, 15, 17][sensor.index()],
            Self::SensorObject(sensor, _) => [8, 10, 12, 14, 16, 18][sensor.index()],
            Self::CameraLanes(_) => 19,
        }
    }

    /// The message of the frame with this id, with default values.
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
            0x0A8 => Self::GateEcho(GateEcho::default()),
            0x0B0 => Self::Status {
                system: 0,
                status: Status::default(),
            },
            0x0B1 => Self::Status {
                system: 1,
                status: Status::default(),
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
                walk.implied(&Control::SYSTEM, *system)?;
                control.walk(walk)
            }
            Self::GateEcho(gate_echo) => gate_echo.walk(walk),
            Self::Status { status, .. } => status.walk(walk),
            Self::EgoMotion(ego_motion) => ego_motion.walk(walk),
            Self::DriverRequest(driver_request) => driver_request.walk(walk),
            Self::SensorHeader(_, sensor_header) => sensor_header.walk(walk),
            Self::SensorObject(_, sensor_object) => sensor_object.walk(walk),
            Self::CameraLanes(camera_lanes) => camera_lanes.walk(walk),
        }
    }
}

/// Every frame of the vehicle bus, in the order of the DBC, which is by id.
pub const FRAMES: [FrameInfo; 20] = [
    FrameInfo::new(0x0A0, "ControlA", 16, 10),
    FrameInfo::new(0x0A1, "ControlB", 16, 10),
    FrameInfo::new(0x0A8, "GateEcho", 16, 10),
    FrameInfo::new(0x0B0, "StatusA", 16, 100),
    FrameInfo::new(0x0B1, "StatusB", 16, 100),
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
