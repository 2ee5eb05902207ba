//! The world outside the systems: a gate without a vehicle, or a whole vehicle in its lane.

use std::collections::HashMap;
use std::sync::OnceLock;
use tandem_board::{CanFrame, CanId, Instant, VehicleBus as _};
use tandem_board_sim::WorldTick;
use tandem_bus::{EgoMotion, FrameTransmitter, Message, ModeCode, Status};
use tandem_faults::{DriveRoad, Forged};
use tandem_vehicle::gate::{Acceptance, Gate, Ruling};
use tandem_vehicle::{LoggedFrame, Scenario, World};

/// Ends core 1 of each system that receives it. It is not a frame of the DBC.
pub(crate) const POISON: CanId = CanId::Standard(0x7E0);

/// The world outside the systems, and the frames that it received from them.
pub struct OutsideVehicle {
    outside: Outside,
    /// Control frames that the gate accepted.
    pub accepted: Vec<Acceptance>,
    /// Control frames of an old term, which the gate refused.
    pub fenced: Vec<Acceptance>,
    /// Whether a system that is not master sent a control frame.
    pub(crate) chatters: bool,
    /// The shortest headway so far: gap to the vehicle in front divided by speed, s.
    pub(crate) headway_s: f64,
    /// The last accepted control frame.
    last: Option<CanFrame>,
    /// The mode in the last status frame of each system.
    stated: [ModeCode; 2],
    ticks: u64,
    pub(crate) silent: bool,
    pub(crate) poison: bool,
    /// What another node forges.
    pub(crate) forged: Vec<Forged>,
    /// The last frame of each id, while something is forged.
    newest: HashMap<u16, Vec<u8>>,
    /// Every frame on the bus, if the cores' events are kept.
    frames: Option<Vec<LoggedFrame>>,
}

/// The receiver of the control frames, which also sends the frames that the systems need.
enum Outside {
    Gate(Box<Alone>),
    World(Box<World>),
}

/// What it reports, m/s.
pub(crate) const ALONE_SPEED: f32 = 20.0;

/// A gate without a vehicle, which reports a constant speed.
struct Alone {
    gate: Gate,
    transmitter: FrameTransmitter,
    /// Arrival of the frame that the last echo reported, ns.
    echoed: Option<u64>,
}

impl OutsideVehicle {
    /// Creates a vehicle on this road, or only a gate.
    /// `keeps_frames`: whether to keep each frame.
    pub(crate) fn new(road: Option<DriveRoad>, keeps_frames: bool) -> Self {
        static LOADED: [OnceLock<Scenario>; DriveRoad::ALL.len()] =
            [const { OnceLock::new() }; DriveRoad::ALL.len()];
        let outside = if let Some(road) = road {
            let loaded = LOADED[road as usize]
                .get_or_init(|| Scenario::load(road.scenario()).expect("embedded"));
            let config = tandem_vehicle::WorldConfig::default();
            Outside::World(Box::new(World::new(loaded, config)))
        } else {
            Outside::Gate(Box::new(Alone {
                gate: Gate::new(),
                transmitter: FrameTransmitter::new(),
                echoed: None,
            }))
        };
        Self {
            outside,
            accepted: Vec::new(),
            fenced: Vec::new(),
            chatters: false,
            headway_s: f64::INFINITY,
            last: None,
            stated: [ModeCode::None; 2],
            ticks: 0,
            silent: false,
            poison: false,
            forged: Vec::new(),
            newest: HashMap::new(),
            frames: keeps_frames.then(Vec::new),
        }
    }

    /// Returns the vehicle with its traffic; `None` if there is only a gate.
    #[must_use]
    pub fn world(&self) -> Option<&World> {
        match &self.outside {
            Outside::World(world) => Some(world),
            Outside::Gate(_) => None,
        }
    }

    /// Returns whether the last accepted frame stops the vehicle because its sender has a fault.
    /// Without a scene the functions of core 0 are off; then the status frame of that system tells.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        let stops = |mode| mode == ModeCode::SafeStop;
        let driver = self.accepted.last().map(|frame| usize::from(frame.system));
        self.mode().is_some_and(stops) || driver.is_some_and(|of| stops(self.stated[of]))
    }

    /// Returns the mode of the last accepted frame.
    #[must_use]
    pub fn mode(&self) -> Option<ModeCode> {
        match self.last.as_ref().and_then(decoded) {
            Some(Message::Control { control, .. }) => Some(control.mode),
            _ => None,
        }
    }

    /// Returns every frame so far, if they are kept.
    pub(crate) fn frames(&self) -> Vec<LoggedFrame> {
        self.frames.clone().unwrap_or_default()
    }

    /// Begins or ends a forgery.
    pub(crate) fn forge(&mut self, forged: Forged, on: bool) {
        self.forged.retain(|it| *it != forged);
        if on {
            self.forged.push(forged);
        }
    }

    /// Judges a frame on the bus.
    fn hear(&mut self, at: Instant, frame: CanFrame) {
        if let CanId::Standard(id) = frame.id()
            && Status::IDS.contains(&id)
            && let Some(Message::Status { system, status }) = decoded(&frame)
        {
            self.stated[usize::from(system)] = status.mode;
        }
        let judged = match frame.id() {
            CanId::Standard(id) => self.outside.hear(at.as_ns(), id.into(), frame.data()),
            CanId::Extended(_) => None,
        };
        if let Some(frames) = &mut self.frames {
            frames.push(LoggedFrame {
                at,
                sent: at,
                frame,
                ruling: judged.map(|judged| judged.ruling),
            });
        }
        match judged {
            Some(judged) if judged.ruling == Ruling::Accepted => {
                self.accepted.push(judged);
                self.last = Some(frame);
            }
            Some(judged) if judged.ruling == Ruling::Fenced => self.fenced.push(judged),
            Some(judged) => self.chatters |= judged.ruling == Ruling::NotMaster,
            None => {}
        }
    }

    /// Sends each forged frame once. The gate hears it as well.
    fn send_forged(&mut self, tick: &mut WorldTick) {
        for forged in self.forged.clone() {
            let id = forged.frame.info().id;
            let Some(data) = self.newest.get(&id).and_then(|last| forged.after(last)) else {
                continue;
            };
            let frame = frame_of(CanId::Standard(id), &data);
            let at = tick.broadcast(&frame);
            self.hear(at, frame);
            self.newest.insert(id, data);
        }
    }

    /// Runs one millisecond: judges the received frames, then sends the vehicle's frames.
    pub(crate) fn tick(&mut self, tick: &mut WorldTick) {
        for on_bus in core::mem::take(&mut tick.heard) {
            if let (CanId::Standard(id), false) = (on_bus.frame.id(), self.forged.is_empty()) {
                self.newest.insert(id, on_bus.frame.data().to_vec());
            }
            self.hear(on_bus.at, on_bus.frame);
        }
        let (at_ns, silent) = (tick.at.as_ns(), self.silent);
        let forges = !self.forged.is_empty();
        let newest = &mut self.newest;
        let mut send = |id, data: &[u8]| {
            if forges {
                newest.insert(id, data.to_vec());
            }
            if !silent {
                tick.broadcast(&frame_of(CanId::Standard(id), data));
            }
        };
        match &mut self.outside {
            Outside::World(world) => {
                world.step(at_ns, &mut send);
                let now = world.snapshot();
                self.headway_s = self.headway_s.min(now.gap / now.speed);
            }
            Outside::Gate(_) if silent => {}
            Outside::Gate(alone) => alone.step(at_ns, self.ticks, &mut send),
        }
        if self.ticks.is_multiple_of(10) {
            self.send_forged(tick);
        }
        if self.ticks.is_multiple_of(100) && self.poison {
            tick.broadcast(&frame_of(POISON, &[0; 8]));
        }
        self.ticks += 1;
    }
}

impl Outside {
    fn hear(&mut self, at_ns: u64, id: u32, data: &[u8]) -> Option<Acceptance> {
        match self {
            Self::World(world) => world.on_frame(at_ns, id, data),
            Self::Gate(alone) => Some(alone.gate.on_frame(at_ns, id, data)?.acceptance),
        }
    }
}

impl Alone {
    fn step(&mut self, at_ns: u64, ticks: u64, send: &mut dyn FnMut(u16, &[u8])) {
        let motion = EgoMotion {
            speed: ALONE_SPEED,
            ..EgoMotion::default()
        };
        let cycle = ticks.is_multiple_of(10);
        let accepted = self.gate.accepted().map(|last| last.at_ns);
        let news = core::mem::replace(&mut self.echoed, accepted) != accepted;
        let echo = cycle || news || self.gate.is_overdue(at_ns);
        let messages = [
            echo.then(|| Message::GateEcho(self.gate.echo(at_ns))),
            cycle.then_some(Message::EgoMotion(motion)),
        ];
        for message in messages.into_iter().flatten() {
            let frame = self.transmitter.encode(&message);
            send(frame.id, frame.data());
        }
    }
}

/// Returns the message of a frame; `None` if it is none.
fn decoded(frame: &CanFrame) -> Option<Message> {
    match frame.id() {
        CanId::Standard(id) => Message::decode(id.into(), frame.data()).ok(),
        CanId::Extended(_) => None,
    }
}

fn frame_of(id: CanId, data: &[u8]) -> CanFrame {
    CanFrame::new(id, true, data).expect("a frame of at most 64 bytes")
}

/// Returns the same control frame with another steering angle. No receiver can detect the change.
pub(crate) fn another_command(frame: &CanFrame) -> CanFrame {
    // A small change is plausible for the gate.
    steered(frame, |angle| angle + 0.001)
}

/// Returns the control frame with its steering angle, rad, replaced by `steer(angle)`.
pub(crate) fn steered(frame: &CanFrame, steer: impl FnOnce(f32) -> f32) -> CanFrame {
    let CanId::Standard(id) = frame.id() else {
        return *frame;
    };
    let Ok(Message::Control {
        system,
        mut control,
    }) = Message::decode(id.into(), frame.data())
    else {
        return *frame;
    };
    control.steering_angle = steer(control.steering_angle);
    let encoded = FrameTransmitter::new().encode(&Message::Control { system, control });
    let mut data = encoded.data().to_vec();
    tandem_bus::e2e::protect(id, frame.data()[2], &mut data);
    frame_of(frame.id(), &data)
}
