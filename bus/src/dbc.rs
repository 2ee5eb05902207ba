//! The structs, enums and ids of `dbc/tandem.dbc`. Made by `cargo xtask dbc`: not to be edited.

use crate::DecodeError;
use crate::signal::{FrameInfo, Signal};

/// Values of the signal `Agreement`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Agreement {
    /// Coded as 0.
    #[default]
    Agreed = 0,
    /// Coded as 1.
    Disagreed = 1,
    /// Coded as 2.
    Unresolved = 2,
}

impl Agreement {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 3] = [Self::Agreed, Self::Disagreed, Self::Unresolved];

    /// The value's name in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Agreed => "Agreed",
            Self::Disagreed => "Disagreed",
            Self::Unresolved => "Unresolved",
        }
    }

    fn from_raw(raw: i64) -> Option<Self> {
        Self::ALL.into_iter().find(|value| *value as i64 == raw)
    }
}

/// Values of the signal `Class`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Class {
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

impl Class {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 6] = [
        Self::Unknown,
        Self::Car,
        Self::Truck,
        Self::Motorcycle,
        Self::Pedestrian,
        Self::Static,
    ];

    /// The value's name in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unknown => "Unknown",
            Self::Car => "Car",
            Self::Truck => "Truck",
            Self::Motorcycle => "Motorcycle",
            Self::Pedestrian => "Pedestrian",
            Self::Static => "Static",
        }
    }

    fn from_raw(raw: i64) -> Option<Self> {
        Self::ALL.into_iter().find(|value| *value as i64 == raw)
    }
}

/// Values of the signal `Mode`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mode {
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

impl Mode {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 4] = [Self::None, Self::L3, Self::DegradedL2, Self::SafeStop];

    /// The value's name in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "None",
            Self::L3 => "L3",
            Self::DegradedL2 => "DegradedL2",
            Self::SafeStop => "SafeStop",
        }
    }

    fn from_raw(raw: i64) -> Option<Self> {
        Self::ALL.into_iter().find(|value| *value as i64 == raw)
    }
}

/// Values of the signal `Role`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Role {
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

impl Role {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 4] = [Self::Starting, Self::Master, Self::Standby, Self::Suspended];

    /// The value's name in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Starting => "Starting",
            Self::Master => "Master",
            Self::Standby => "Standby",
            Self::Suspended => "Suspended",
        }
    }

    fn from_raw(raw: i64) -> Option<Self> {
        Self::ALL.into_iter().find(|value| *value as i64 == raw)
    }
}

/// Values of the signal `Route`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Route {
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

impl Route {
    /// Every value, in the order of the DBC.
    pub const ALL: [Self; 4] = [Self::Free, Self::Left, Self::Right, Self::Keep];

    /// The value's name in the DBC.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Free => "Free",
            Self::Left => "Left",
            Self::Right => "Right",
            Self::Keep => "Keep",
        }
    }

    fn from_raw(raw: i64) -> Option<Self> {
        Self::ALL.into_iter().find(|value| *value as i64 == raw)
    }
}

/// Vehicle control. Sent by the master only; the vehicle accepts the highest term.
///
/// Layout of `ControlA`, `ControlB`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Control {
    /// Role of the sender.
    pub role: Role,
    /// Function that produced the command; None: the driver drives, and the command is what the vehicle does.
    pub mode: Mode,
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
    /// When the frame was made, on the clock of its sender, wraps around; 0 = not told. 0 ..= 65535 ms
    pub sent_at: u16,
}

impl Control {
    /// Ids of the frames with this layout, in the order of the DBC.
    pub const IDS: [u16; 2] = [0x0A0, 0x0A1];
    /// Length of the frame, bytes.
    pub const LEN: usize = 16;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 10;

    pub(crate) const ROLE: Signal = Signal {
        name: "Role",
        start: 24,
        len: 2,
        factor: 1.0,
        min: 0,
        max: 3,
    };
    pub(crate) const MODE: Signal = Signal {
        name: "Mode",
        start: 26,
        len: 3,
        factor: 1.0,
        min: 0,
        max: 7,
    };
    pub(crate) const SYSTEM: Signal = Signal {
        name: "System",
        start: 29,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const TAKEOVER_REQUEST: Signal = Signal {
        name: "TakeoverRequest",
        start: 30,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const TERM: Signal = Signal {
        name: "Term",
        start: 32,
        len: 32,
        factor: 1.0,
        min: 0,
        max: 4294967295,
    };
    pub(crate) const STEERING_ANGLE: Signal = Signal {
        name: "SteeringAngle",
        start: 64,
        len: 16,
        factor: 2e-5,
        min: -32768,
        max: 32767,
    };
    pub(crate) const ACCELERATION: Signal = Signal {
        name: "Acceleration",
        start: 80,
        len: 16,
        factor: 0.001,
        min: -32768,
        max: 32767,
    };
    pub(crate) const COMMAND_AGE: Signal = Signal {
        name: "CommandAge",
        start: 96,
        len: 16,
        factor: 0.1,
        min: 0,
        max: 65535,
    };
    pub(crate) const SENT_AT: Signal = Signal {
        name: "SentAt",
        start: 112,
        len: 16,
        factor: 1.0,
        min: 0,
        max: 65535,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::ROLE.put(data, self.role as i64);
        Self::MODE.put(data, self.mode as i64);
        Self::TAKEOVER_REQUEST.put(data, i64::from(self.takeover_request));
        Self::TERM.put(data, i64::from(self.term));
        Self::STEERING_ANGLE.put_physical(data, self.steering_angle);
        Self::ACCELERATION.put_physical(data, self.acceleration);
        Self::COMMAND_AGE.put_physical(data, self.command_age);
        Self::SENT_AT.put(data, i64::from(self.sent_at));
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            role: Role::from_raw(Self::ROLE.get(data)?).ok_or(Self::ROLE.invalid())?,
            mode: Mode::from_raw(Self::MODE.get(data)?).ok_or(Self::MODE.invalid())?,
            takeover_request: Self::TAKEOVER_REQUEST.get(data)? != 0,
            term: Self::TERM.get(data)? as u32,
            steering_angle: Self::STEERING_ANGLE.get_physical(data)?,
            acceleration: Self::ACCELERATION.get_physical(data)?,
            command_age: Self::COMMAND_AGE.get_physical(data)?,
            sent_at: Self::SENT_AT.get(data)? as u16,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 8] {
        [
            ("Role", f64::from(self.role as u8)),
            ("Mode", f64::from(self.mode as u8)),
            (
                "TakeoverRequest",
                f64::from(u8::from(self.takeover_request)),
            ),
            ("Term", f64::from(self.term)),
            ("SteeringAngle", f64::from(self.steering_angle)),
            ("Acceleration", f64::from(self.acceleration)),
            ("CommandAge", f64::from(self.command_age)),
            ("SentAt", f64::from(self.sent_at)),
        ]
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 16;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 10;

    pub(crate) const REFUSED: Signal = Signal {
        name: "Refused",
        start: 24,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };
    pub(crate) const TERM: Signal = Signal {
        name: "Term",
        start: 32,
        len: 32,
        factor: 1.0,
        min: 0,
        max: 4294967295,
    };
    pub(crate) const TERM_AGE: Signal = Signal {
        name: "TermAge",
        start: 64,
        len: 16,
        factor: 0.1,
        min: 0,
        max: 65535,
    };
    pub(crate) const OBEYED_COUNTER: Signal = Signal {
        name: "ObeyedCounter",
        start: 80,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };
    pub(crate) const SENT_AT: Signal = Signal {
        name: "SentAt",
        start: 88,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };
    pub(crate) const STEERING_ANGLE: Signal = Signal {
        name: "SteeringAngle",
        start: 96,
        len: 16,
        factor: 2e-5,
        min: -32768,
        max: 32767,
    };
    pub(crate) const ACCELERATION: Signal = Signal {
        name: "Acceleration",
        start: 112,
        len: 16,
        factor: 0.001,
        min: -32768,
        max: 32767,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::REFUSED.put(data, i64::from(self.refused));
        Self::TERM.put(data, i64::from(self.term));
        Self::TERM_AGE.put_physical(data, self.term_age);
        Self::OBEYED_COUNTER.put(data, i64::from(self.obeyed_counter));
        Self::SENT_AT.put(data, i64::from(self.sent_at));
        Self::STEERING_ANGLE.put_physical(data, self.steering_angle);
        Self::ACCELERATION.put_physical(data, self.acceleration);
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            refused: Self::REFUSED.get(data)? as u8,
            term: Self::TERM.get(data)? as u32,
            term_age: Self::TERM_AGE.get_physical(data)?,
            obeyed_counter: Self::OBEYED_COUNTER.get(data)? as u8,
            sent_at: Self::SENT_AT.get(data)? as u8,
            steering_angle: Self::STEERING_ANGLE.get_physical(data)?,
            acceleration: Self::ACCELERATION.get_physical(data)?,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 7] {
        [
            ("Refused", f64::from(self.refused)),
            ("Term", f64::from(self.term)),
            ("TermAge", f64::from(self.term_age)),
            ("ObeyedCounter", f64::from(self.obeyed_counter)),
            ("SentAt", f64::from(self.sent_at)),
            ("SteeringAngle", f64::from(self.steering_angle)),
            ("Acceleration", f64::from(self.acceleration)),
        ]
    }
}

/// Redundancy state.
///
/// Layout of `StatusA`, `StatusB`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Status {
    /// Role of the sender.
    pub role: Role,
    /// Function in operation.
    pub mode: Mode,
    /// This system has failed.
    pub sys_failure: bool,
    /// The other system is taken for failed.
    pub cpsys_failure: bool,
    /// Heartbeat line 1 is silent.
    pub line1_silent: bool,
    /// Heartbeat line 2 is silent.
    pub line2_silent: bool,
    /// Whether the other system would command the same.
    pub agreement: Agreement,
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 16;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 100;

    pub(crate) const ROLE: Signal = Signal {
        name: "Role",
        start: 24,
        len: 4,
        factor: 1.0,
        min: 0,
        max: 15,
    };
    pub(crate) const MODE: Signal = Signal {
        name: "Mode",
        start: 28,
        len: 4,
        factor: 1.0,
        min: 0,
        max: 15,
    };
    pub(crate) const SYS_FAILURE: Signal = Signal {
        name: "SysFailure",
        start: 32,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const CPSYS_FAILURE: Signal = Signal {
        name: "CpsysFailure",
        start: 33,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const LINE1_SILENT: Signal = Signal {
        name: "Line1Silent",
        start: 34,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const LINE2_SILENT: Signal = Signal {
        name: "Line2Silent",
        start: 35,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const AGREEMENT: Signal = Signal {
        name: "Agreement",
        start: 36,
        len: 2,
        factor: 1.0,
        min: 0,
        max: 3,
    };
    pub(crate) const FAILURE_MODE: Signal = Signal {
        name: "FailureMode",
        start: 40,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };
    pub(crate) const TERM: Signal = Signal {
        name: "Term",
        start: 48,
        len: 32,
        factor: 1.0,
        min: 0,
        max: 4294967295,
    };
    pub(crate) const ABN_RESETS: Signal = Signal {
        name: "AbnResets",
        start: 80,
        len: 16,
        factor: 1.0,
        min: 0,
        max: 65535,
    };
    pub(crate) const TOTAL_RESETS: Signal = Signal {
        name: "TotalResets",
        start: 96,
        len: 16,
        factor: 1.0,
        min: 0,
        max: 65535,
    };
    pub(crate) const TRACKS: Signal = Signal {
        name: "Tracks",
        start: 112,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };
    pub(crate) const DEADLINE_MISSES: Signal = Signal {
        name: "DeadlineMisses",
        start: 120,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::ROLE.put(data, self.role as i64);
        Self::MODE.put(data, self.mode as i64);
        Self::SYS_FAILURE.put(data, i64::from(self.sys_failure));
        Self::CPSYS_FAILURE.put(data, i64::from(self.cpsys_failure));
        Self::LINE1_SILENT.put(data, i64::from(self.line1_silent));
        Self::LINE2_SILENT.put(data, i64::from(self.line2_silent));
        Self::AGREEMENT.put(data, self.agreement as i64);
        Self::FAILURE_MODE.put(data, i64::from(self.failure_mode));
        Self::TERM.put(data, i64::from(self.term));
        Self::ABN_RESETS.put(data, i64::from(self.abn_resets));
        Self::TOTAL_RESETS.put(data, i64::from(self.total_resets));
        Self::TRACKS.put(data, i64::from(self.tracks));
        Self::DEADLINE_MISSES.put(data, i64::from(self.deadline_misses));
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            role: Role::from_raw(Self::ROLE.get(data)?).ok_or(Self::ROLE.invalid())?,
            mode: Mode::from_raw(Self::MODE.get(data)?).ok_or(Self::MODE.invalid())?,
            sys_failure: Self::SYS_FAILURE.get(data)? != 0,
            cpsys_failure: Self::CPSYS_FAILURE.get(data)? != 0,
            line1_silent: Self::LINE1_SILENT.get(data)? != 0,
            line2_silent: Self::LINE2_SILENT.get(data)? != 0,
            agreement: Agreement::from_raw(Self::AGREEMENT.get(data)?)
                .ok_or(Self::AGREEMENT.invalid())?,
            failure_mode: Self::FAILURE_MODE.get(data)? as u8,
            term: Self::TERM.get(data)? as u32,
            abn_resets: Self::ABN_RESETS.get(data)? as u16,
            total_resets: Self::TOTAL_RESETS.get(data)? as u16,
            tracks: Self::TRACKS.get(data)? as u8,
            deadline_misses: Self::DEADLINE_MISSES.get(data)? as u8,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 13] {
        [
            ("Role", f64::from(self.role as u8)),
            ("Mode", f64::from(self.mode as u8)),
            ("SysFailure", f64::from(u8::from(self.sys_failure))),
            ("CpsysFailure", f64::from(u8::from(self.cpsys_failure))),
            ("Line1Silent", f64::from(u8::from(self.line1_silent))),
            ("Line2Silent", f64::from(u8::from(self.line2_silent))),
            ("Agreement", f64::from(self.agreement as u8)),
            ("FailureMode", f64::from(self.failure_mode)),
            ("Term", f64::from(self.term)),
            ("AbnResets", f64::from(self.abn_resets)),
            ("TotalResets", f64::from(self.total_resets)),
            ("Tracks", f64::from(self.tracks)),
            ("DeadlineMisses", f64::from(self.deadline_misses)),
        ]
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 16;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 10;

    pub(crate) const WORLD_RUNNING: Signal = Signal {
        name: "WorldRunning",
        start: 24,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const SPEED: Signal = Signal {
        name: "Speed",
        start: 32,
        len: 16,
        factor: 0.01,
        min: -32768,
        max: 32767,
    };
    pub(crate) const YAW_RATE: Signal = Signal {
        name: "YawRate",
        start: 48,
        len: 16,
        factor: 0.0001,
        min: -32768,
        max: 32767,
    };
    pub(crate) const LONG_ACCELERATION: Signal = Signal {
        name: "LongAcceleration",
        start: 64,
        len: 16,
        factor: 0.002,
        min: -32768,
        max: 32767,
    };
    pub(crate) const LAT_ACCELERATION: Signal = Signal {
        name: "LatAcceleration",
        start: 80,
        len: 16,
        factor: 0.002,
        min: -32768,
        max: 32767,
    };
    pub(crate) const STEERING_ANGLE: Signal = Signal {
        name: "SteeringAngle",
        start: 96,
        len: 16,
        factor: 2e-5,
        min: -32768,
        max: 32767,
    };
    pub(crate) const SLIP_ANGLE: Signal = Signal {
        name: "SlipAngle",
        start: 112,
        len: 16,
        factor: 2e-5,
        min: -32768,
        max: 32767,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::WORLD_RUNNING.put(data, i64::from(self.world_running));
        Self::SPEED.put_physical(data, self.speed);
        Self::YAW_RATE.put_physical(data, self.yaw_rate);
        Self::LONG_ACCELERATION.put_physical(data, self.long_acceleration);
        Self::LAT_ACCELERATION.put_physical(data, self.lat_acceleration);
        Self::STEERING_ANGLE.put_physical(data, self.steering_angle);
        Self::SLIP_ANGLE.put_physical(data, self.slip_angle);
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            world_running: Self::WORLD_RUNNING.get(data)? != 0,
            speed: Self::SPEED.get_physical(data)?,
            yaw_rate: Self::YAW_RATE.get_physical(data)?,
            long_acceleration: Self::LONG_ACCELERATION.get_physical(data)?,
            lat_acceleration: Self::LAT_ACCELERATION.get_physical(data)?,
            steering_angle: Self::STEERING_ANGLE.get_physical(data)?,
            slip_angle: Self::SLIP_ANGLE.get_physical(data)?,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 7] {
        [
            ("WorldRunning", f64::from(u8::from(self.world_running))),
            ("Speed", f64::from(self.speed)),
            ("YawRate", f64::from(self.yaw_rate)),
            ("LongAcceleration", f64::from(self.long_acceleration)),
            ("LatAcceleration", f64::from(self.lat_acceleration)),
            ("SteeringAngle", f64::from(self.steering_angle)),
            ("SlipAngle", f64::from(self.slip_angle)),
        ]
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
    pub route: Route,
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 8;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 100;

    pub(crate) const ENGAGE: Signal = Signal {
        name: "Engage",
        start: 24,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const OVERRIDES: Signal = Signal {
        name: "Overrides",
        start: 25,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const ROUTE: Signal = Signal {
        name: "Route",
        start: 26,
        len: 2,
        factor: 1.0,
        min: 0,
        max: 3,
    };
    pub(crate) const NEAR_GAP: Signal = Signal {
        name: "NearGap",
        start: 28,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const SET_SPEED: Signal = Signal {
        name: "SetSpeed",
        start: 32,
        len: 16,
        factor: 0.01,
        min: 0,
        max: 65535,
    };
    pub(crate) const LANE_OFFSET: Signal = Signal {
        name: "LaneOffset",
        start: 48,
        len: 8,
        factor: 0.01,
        min: -128,
        max: 127,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::ENGAGE.put(data, i64::from(self.engage));
        Self::OVERRIDES.put(data, i64::from(self.overrides));
        Self::ROUTE.put(data, self.route as i64);
        Self::NEAR_GAP.put(data, i64::from(self.near_gap));
        Self::SET_SPEED.put_physical(data, self.set_speed);
        Self::LANE_OFFSET.put_physical(data, self.lane_offset);
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            engage: Self::ENGAGE.get(data)? != 0,
            overrides: Self::OVERRIDES.get(data)? != 0,
            route: Route::from_raw(Self::ROUTE.get(data)?).ok_or(Self::ROUTE.invalid())?,
            near_gap: Self::NEAR_GAP.get(data)? != 0,
            set_speed: Self::SET_SPEED.get_physical(data)?,
            lane_offset: Self::LANE_OFFSET.get_physical(data)?,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 6] {
        [
            ("Engage", f64::from(u8::from(self.engage))),
            ("Overrides", f64::from(u8::from(self.overrides))),
            ("Route", f64::from(self.route as u8)),
            ("NearGap", f64::from(u8::from(self.near_gap))),
            ("SetSpeed", f64::from(self.set_speed)),
            ("LaneOffset", f64::from(self.lane_offset)),
        ]
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 8;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 50;

    pub(crate) const OBJECT_COUNT: Signal = Signal {
        name: "ObjectCount",
        start: 24,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 32,
    };
    pub(crate) const MEASURED_AT: Signal = Signal {
        name: "MeasuredAt",
        start: 32,
        len: 32,
        factor: 1.0,
        min: 0,
        max: 4294967295,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::OBJECT_COUNT.put(data, i64::from(self.object_count));
        Self::MEASURED_AT.put(data, i64::from(self.measured_at));
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            object_count: Self::OBJECT_COUNT.get(data)? as u8,
            measured_at: Self::MEASURED_AT.get(data)? as u32,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 2] {
        [
            ("ObjectCount", f64::from(self.object_count)),
            ("MeasuredAt", f64::from(self.measured_at)),
        ]
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
    pub class: Class,
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 16;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 50;

    pub(crate) const INDEX: Signal = Signal {
        name: "Index",
        start: 24,
        len: 5,
        factor: 1.0,
        min: 0,
        max: 31,
    };
    pub(crate) const CLASS: Signal = Signal {
        name: "Class",
        start: 29,
        len: 3,
        factor: 1.0,
        min: 0,
        max: 7,
    };
    pub(crate) const X: Signal = Signal {
        name: "X",
        start: 32,
        len: 16,
        factor: 0.01,
        min: -32768,
        max: 32767,
    };
    pub(crate) const Y: Signal = Signal {
        name: "Y",
        start: 48,
        len: 16,
        factor: 0.01,
        min: -32768,
        max: 32767,
    };
    pub(crate) const VX: Signal = Signal {
        name: "VX",
        start: 64,
        len: 16,
        factor: 0.01,
        min: -32768,
        max: 32767,
    };
    pub(crate) const VY: Signal = Signal {
        name: "VY",
        start: 80,
        len: 16,
        factor: 0.01,
        min: -32768,
        max: 32767,
    };
    pub(crate) const LENGTH: Signal = Signal {
        name: "Length",
        start: 96,
        len: 8,
        factor: 0.1,
        min: 0,
        max: 255,
    };
    pub(crate) const WIDTH: Signal = Signal {
        name: "Width",
        start: 104,
        len: 8,
        factor: 0.05,
        min: 0,
        max: 255,
    };
    pub(crate) const X_DEVIATION: Signal = Signal {
        name: "XDeviation",
        start: 112,
        len: 8,
        factor: 0.02,
        min: 0,
        max: 255,
    };
    pub(crate) const Y_DEVIATION: Signal = Signal {
        name: "YDeviation",
        start: 120,
        len: 8,
        factor: 0.02,
        min: 0,
        max: 255,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::INDEX.put(data, i64::from(self.index));
        Self::CLASS.put(data, self.class as i64);
        Self::X.put_physical(data, self.x);
        Self::Y.put_physical(data, self.y);
        Self::VX.put_physical(data, self.vx);
        Self::VY.put_physical(data, self.vy);
        Self::LENGTH.put_physical(data, self.length);
        Self::WIDTH.put_physical(data, self.width);
        Self::X_DEVIATION.put_physical(data, self.x_deviation);
        Self::Y_DEVIATION.put_physical(data, self.y_deviation);
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            index: Self::INDEX.get(data)? as u8,
            class: Class::from_raw(Self::CLASS.get(data)?).ok_or(Self::CLASS.invalid())?,
            x: Self::X.get_physical(data)?,
            y: Self::Y.get_physical(data)?,
            vx: Self::VX.get_physical(data)?,
            vy: Self::VY.get_physical(data)?,
            length: Self::LENGTH.get_physical(data)?,
            width: Self::WIDTH.get_physical(data)?,
            x_deviation: Self::X_DEVIATION.get_physical(data)?,
            y_deviation: Self::Y_DEVIATION.get_physical(data)?,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 10] {
        [
            ("Index", f64::from(self.index)),
            ("Class", f64::from(self.class as u8)),
            ("X", f64::from(self.x)),
            ("Y", f64::from(self.y)),
            ("VX", f64::from(self.vx)),
            ("VY", f64::from(self.vy)),
            ("Length", f64::from(self.length)),
            ("Width", f64::from(self.width)),
            ("XDeviation", f64::from(self.x_deviation)),
            ("YDeviation", f64::from(self.y_deviation)),
        ]
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
    /// The lane goes on behind OwnEnd, but outside of the operational design domain.
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
    /// Length of the frame, bytes.
    pub const LEN: usize = 32;
    /// Period of the frame, ms.
    pub const CYCLE_MS: u32 = 50;

    pub(crate) const VALID: Signal = Signal {
        name: "Valid",
        start: 24,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const LEFT_EXISTS: Signal = Signal {
        name: "LeftExists",
        start: 25,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const RIGHT_EXISTS: Signal = Signal {
        name: "RightExists",
        start: 26,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const ENDS_DOMAIN: Signal = Signal {
        name: "EndsDomain",
        start: 27,
        len: 1,
        factor: 1.0,
        min: 0,
        max: 1,
    };
    pub(crate) const C0: Signal = Signal {
        name: "C0",
        start: 32,
        len: 16,
        factor: 0.001,
        min: -32768,
        max: 32767,
    };
    pub(crate) const C1: Signal = Signal {
        name: "C1",
        start: 48,
        len: 16,
        factor: 5e-5,
        min: -32768,
        max: 32767,
    };
    pub(crate) const C2: Signal = Signal {
        name: "C2",
        start: 64,
        len: 16,
        factor: 1e-6,
        min: -32768,
        max: 32767,
    };
    pub(crate) const C3: Signal = Signal {
        name: "C3",
        start: 80,
        len: 16,
        factor: 1e-8,
        min: -32768,
        max: 32767,
    };
    pub(crate) const VIEW_RANGE: Signal = Signal {
        name: "ViewRange",
        start: 96,
        len: 8,
        factor: 1.0,
        min: 0,
        max: 255,
    };
    pub(crate) const WIDTH: Signal = Signal {
        name: "Width",
        start: 104,
        len: 8,
        factor: 0.02,
        min: 0,
        max: 255,
    };
    pub(crate) const LEFT_WIDTH: Signal = Signal {
        name: "LeftWidth",
        start: 112,
        len: 8,
        factor: 0.02,
        min: 0,
        max: 255,
    };
    pub(crate) const RIGHT_WIDTH: Signal = Signal {
        name: "RightWidth",
        start: 120,
        len: 8,
        factor: 0.02,
        min: 0,
        max: 255,
    };
    pub(crate) const OWN_END: Signal = Signal {
        name: "OwnEnd",
        start: 128,
        len: 16,
        factor: 0.1,
        min: 0,
        max: 65535,
    };
    pub(crate) const LEFT_END: Signal = Signal {
        name: "LeftEnd",
        start: 144,
        len: 16,
        factor: 0.1,
        min: 0,
        max: 65535,
    };
    pub(crate) const RIGHT_END: Signal = Signal {
        name: "RightEnd",
        start: 160,
        len: 16,
        factor: 0.1,
        min: 0,
        max: 65535,
    };
    pub(crate) const SPEED_LIMIT: Signal = Signal {
        name: "SpeedLimit",
        start: 176,
        len: 16,
        factor: 0.01,
        min: 0,
        max: 65535,
    };

    /// Writes all signals except the end-to-end protection, whose bytes become zero. Values out of
    /// range saturate, fractions round to nearest, NaN becomes 0.
    pub fn encode(&self, data: &mut [u8; Self::LEN]) {
        *data = [0; Self::LEN];
        Self::VALID.put(data, i64::from(self.valid));
        Self::LEFT_EXISTS.put(data, i64::from(self.left_exists));
        Self::RIGHT_EXISTS.put(data, i64::from(self.right_exists));
        Self::ENDS_DOMAIN.put(data, i64::from(self.ends_domain));
        Self::C0.put_physical(data, self.c0);
        Self::C1.put_physical(data, self.c1);
        Self::C2.put_physical(data, self.c2);
        Self::C3.put_physical(data, self.c3);
        Self::VIEW_RANGE.put(data, i64::from(self.view_range));
        Self::WIDTH.put_physical(data, self.width);
        Self::LEFT_WIDTH.put_physical(data, self.left_width);
        Self::RIGHT_WIDTH.put_physical(data, self.right_width);
        Self::OWN_END.put_physical(data, self.own_end);
        Self::LEFT_END.put_physical(data, self.left_end);
        Self::RIGHT_END.put_physical(data, self.right_end);
        Self::SPEED_LIMIT.put_physical(data, self.speed_limit);
    }

    /// Reads the signals. The end-to-end protection is not checked.
    ///
    /// # Errors
    /// [`DecodeError::WrongLength`], or [`DecodeError::InvalidSignal`] for a value
    /// that is out of the signal's range or not in its value table.
    pub fn decode(data: &[u8]) -> Result<Self, DecodeError> {
        if data.len() != Self::LEN {
            return Err(DecodeError::WrongLength);
        }
        Ok(Self {
            valid: Self::VALID.get(data)? != 0,
            left_exists: Self::LEFT_EXISTS.get(data)? != 0,
            right_exists: Self::RIGHT_EXISTS.get(data)? != 0,
            ends_domain: Self::ENDS_DOMAIN.get(data)? != 0,
            c0: Self::C0.get_physical(data)?,
            c1: Self::C1.get_physical(data)?,
            c2: Self::C2.get_physical(data)?,
            c3: Self::C3.get_physical(data)?,
            view_range: Self::VIEW_RANGE.get(data)? as u8,
            width: Self::WIDTH.get_physical(data)?,
            left_width: Self::LEFT_WIDTH.get_physical(data)?,
            right_width: Self::RIGHT_WIDTH.get_physical(data)?,
            own_end: Self::OWN_END.get_physical(data)?,
            left_end: Self::LEFT_END.get_physical(data)?,
            right_end: Self::RIGHT_END.get_physical(data)?,
            speed_limit: Self::SPEED_LIMIT.get_physical(data)?,
        })
    }

    /// The values by their names in the DBC: physical ones, flags and tables as numbers.
    #[must_use]
    pub fn values(&self) -> [(&'static str, f64); 16] {
        [
            ("Valid", f64::from(u8::from(self.valid))),
            ("LeftExists", f64::from(u8::from(self.left_exists))),
            ("RightExists", f64::from(u8::from(self.right_exists))),
            ("EndsDomain", f64::from(u8::from(self.ends_domain))),
            ("C0", f64::from(self.c0)),
            ("C1", f64::from(self.c1)),
            ("C2", f64::from(self.c2)),
            ("C3", f64::from(self.c3)),
            ("ViewRange", f64::from(self.view_range)),
            ("Width", f64::from(self.width)),
            ("LeftWidth", f64::from(self.left_width)),
            ("RightWidth", f64::from(self.right_width)),
            ("OwnEnd", f64::from(self.own_end)),
            ("LeftEnd", f64::from(self.left_end)),
            ("RightEnd", f64::from(self.right_end)),
            ("SpeedLimit", f64::from(self.speed_limit)),
        ]
    }
}

/// Every frame of the vehicle bus, in the order of the DBC, which is by id.
pub const FRAMES: [FrameInfo; 20] = [
    FrameInfo {
        id: 0x0A0,
        name: "ControlA",
        len: 16,
        cycle_ms: 10,
    },
    FrameInfo {
        id: 0x0A1,
        name: "ControlB",
        len: 16,
        cycle_ms: 10,
    },
    FrameInfo {
        id: 0x0A8,
        name: "GateEcho",
        len: 16,
        cycle_ms: 10,
    },
    FrameInfo {
        id: 0x0B0,
        name: "StatusA",
        len: 16,
        cycle_ms: 100,
    },
    FrameInfo {
        id: 0x0B1,
        name: "StatusB",
        len: 16,
        cycle_ms: 100,
    },
    FrameInfo {
        id: 0x110,
        name: "EgoMotion",
        len: 16,
        cycle_ms: 10,
    },
    FrameInfo {
        id: 0x120,
        name: "DriverRequest",
        len: 8,
        cycle_ms: 100,
    },
    FrameInfo {
        id: 0x200,
        name: "RadarFrontHeader",
        len: 8,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x201,
        name: "RadarFrontObject",
        len: 16,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x210,
        name: "RadarFrontLeftHeader",
        len: 8,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x211,
        name: "RadarFrontLeftObject",
        len: 16,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x220,
        name: "RadarFrontRightHeader",
        len: 8,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x221,
        name: "RadarFrontRightObject",
        len: 16,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x230,
        name: "RadarRearLeftHeader",
        len: 8,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x231,
        name: "RadarRearLeftObject",
        len: 16,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x240,
        name: "RadarRearRightHeader",
        len: 8,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x241,
        name: "RadarRearRightObject",
        len: 16,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x250,
        name: "CameraFrontHeader",
        len: 8,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x251,
        name: "CameraFrontObject",
        len: 16,
        cycle_ms: 50,
    },
    FrameInfo {
        id: 0x270,
        name: "CameraLanes",
        len: 32,
        cycle_ms: 50,
    },
];
