//! The world loop: each millisecond the world receives the controllers' frames, moves, and
//! sends the readings of its sensors.

use tandem_board::{CanFrame, CanId, Carried, CoreId, Instant, SystemId, VehicleBus};
use tandem_bus::{Control, Message, TimeSync};

use crate::gate::Ruling;
use crate::world::World;

/// A frame on the bus, as it is recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LoggedFrame {
    /// When the bus carried it: the log's time stamp. It never decreases from frame to frame.
    pub at: Instant,
    /// When its sender sent it.
    pub sent: Instant,
    /// The frame.
    pub frame: CanFrame,
    /// The vehicle's ruling, if it is a control frame.
    pub ruling: Option<Ruling>,
}

impl LoggedFrame {
    /// Returns its standard id; `None` if it has an extended one. The DBC has standard ids only.
    #[must_use]
    pub fn id(&self) -> Option<u16> {
        match self.frame.id() {
            CanId::Standard(id) => Some(id),
            CanId::Extended(_) => None,
        }
    }

    /// Returns the decoded message; `None` if the DBC has no such frame.
    #[must_use]
    pub fn message(&self) -> Option<Message> {
        Message::decode(self.id()?.into(), self.frame.data()).ok()
    }

    /// Returns the system whose control frame it is, by its id; `None` for any other frame.
    #[must_use]
    pub fn controller(&self) -> Option<SystemId> {
        let id = self.id()?;
        let index = Control::IDS.iter().position(|known| *known == id)?;
        SystemId::from_index(index)
    }
}

impl World {
    /// Runs one period: receives the frames of the controllers, then runs the world up to `due` and
    /// sends the frames of its sensors. `due` is when the period was due: a late call does not
    /// change the world. `seen` receives each frame in bus order, with its ruling.
    pub fn run_period(
        &mut self,
        due: Instant,
        bus: &mut impl VehicleBus,
        seen: &mut dyn FnMut(LoggedFrame),
    ) {
        let now = bus.now();
        bus.transmitted(&mut |_, _, carried| seen(self.hear(now, carried)));
        self.step(due.as_ns(), &mut |id, data| send(bus, seen, due, id, data));
        bus.ring_receivers();
    }

    /// Runs the world up to `due`, for a period before [`World::next_frame`]. Sends nothing.
    pub fn run_quiet_period(&mut self, due: Instant) {
        self.step(due.as_ns(), &mut |_, _| {});
    }

    /// Runs between two periods: receives the controllers' frames, and immediately sends the echo
    /// of one that acts. Call it after all due periods have run.
    pub fn run_between(&mut self, bus: &mut impl VehicleBus, seen: &mut dyn FnMut(LoggedFrame)) {
        let now = bus.now();
        bus.transmitted(&mut |_, _, carried| seen(self.hear(now, carried)));
        self.echo(now.as_ns(), &mut |id, data| send(bus, seen, now, id, data));
        bus.ring_receivers();
    }

    /// Receives a controller's frame at `now`.
    pub fn hear(&mut self, now: Instant, Carried { frame, sent, at }: Carried) -> LoggedFrame {
        let judged = match frame.id() {
            CanId::Standard(id) => {
                let index = TimeSync::IDS.iter().position(|of_time| *of_time == id);
                if let Some(from) = index.and_then(SystemId::from_index) {
                    self.on_time_sync(from, at.as_ns(), frame.data());
                }
                self.on_frame(now.as_ns(), id.into(), frame.data())
            }
            CanId::Extended(_) => None,
        };
        LoggedFrame {
            at,
            sent,
            frame,
            ruling: judged.map(|acceptance| acceptance.ruling),
        }
    }
}

/// Puts a frame of the world on the bus, and passes it to `seen`.
fn send(
    bus: &mut impl VehicleBus,
    seen: &mut dyn FnMut(LoggedFrame),
    sent: Instant,
    id: u16,
    data: &[u8],
) {
    // The world sends only messages of the DBC, and each of them fits in a frame.
    if let Ok(frame) = CanFrame::new(CanId::Standard(id), true, data) {
        let at = bus.broadcast(&frame);
        seen(LoggedFrame {
            at,
            sent,
            frame,
            ruling: None,
        });
    }
}

/// A bus between the world and the driving functions in the same program, without a board.
#[derive(Clone, Debug)]
pub struct LocalBus {
    /// The time of the bus and of the world.
    pub now: Instant,
    /// Frames that the vehicle sent in the last period. The controller takes them.
    pub from_vehicle: Vec<CanFrame>,
    /// Frames that the vehicle receives in the next period.
    pub to_vehicle: Vec<CanFrame>,
}

impl LocalBus {
    /// A bus without frames.
    #[must_use]
    pub const fn new(now: Instant) -> Self {
        Self {
            now,
            from_vehicle: Vec::new(),
            to_vehicle: Vec::new(),
        }
    }
}

impl VehicleBus for LocalBus {
    fn now(&self) -> Instant {
        self.now
    }

    fn transmitted(&mut self, seen: &mut dyn FnMut(SystemId, CoreId, Carried)) {
        let (sent, at) = (self.now, self.now);
        for frame in self.to_vehicle.drain(..) {
            seen(SystemId::A, CoreId::CONTROL, Carried { frame, sent, at });
        }
    }

    fn broadcast(&mut self, frame: &CanFrame) -> Instant {
        self.from_vehicle.push(*frame);
        self.now
    }
}
