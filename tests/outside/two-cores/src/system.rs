//! One of the two systems: it sends commands while it is the master, and takes over if the other
//! one fails.

use core::fmt::Write;

use tandem_bus::{AbilityCode, Control, FrameReceiver, FrameTransmitter, Message, ModeCode};
use tandem_bus::{ReceiveError, RoleCode, Status};
use tandem_redundancy::tandem_board::{Duration, Edge, Instant, Line, ResetCause, SystemId};
use tandem_redundancy::{
    Ability, Action, Actions, Config, ControlHeader, Input, LineSnapshot, LinkReport, Loaded, Mode,
    ObeyedTerm, PeerReport, Redundancy, RedundancyEvent, Role, Term,
};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::Map;
use tandem_shm::region::EndError;
use tandem_shm::{broadcast, newest};

use crate::lmu::{FRAMES, FRAMES_VEHICLE, Frame, LINKS, WIRES};

/// Period of the status frame.
const STATUS_PERIOD: Duration = Duration::from_ms(50);

/// A system with its ends of the shared memory.
pub struct System<'a> {
    id: SystemId,
    config: Config,
    machine: Redundancy,
    transmitter: FrameTransmitter,
    receiver: FrameReceiver,
    to_bus: broadcast::Writer<'a, Frame>,
    from_bus: [broadcast::Receiver<'a, Frame>; 2],
    edges: [u32; 8],
    wires_out: newest::Writer<'a, [u32; 8]>,
    wires_in: newest::Reader<'a, [u32; 8]>,
    edges_in: [u32; 8],
    link_out: newest::Writer<'a, [u32; LinkReport::WORDS]>,
    link_in: newest::Reader<'a, [u32; LinkReport::WORDS]>,
    /// Valid frames of the vehicle.
    vehicle_frames: u32,
    /// Frames that did not pass their protection.
    refused: u32,
    next_control: Instant,
    next_status: Instant,
    next_report: Instant,
}

impl<'a> System<'a> {
    /// Attaches a system that starts at `now`.
    pub fn attach(
        id: SystemId,
        map: &Map<'a>,
        core: Incarnation,
        now: Instant,
    ) -> Result<Self, EndError> {
        let (own, peer) = (id.index(), id.peer().index());
        let config = Config::rt();
        Ok(Self {
            id,
            config,
            machine: Redundancy::new(config, id, ResetCause::PowerOn, Loaded::Blank, now),
            transmitter: FrameTransmitter::new(),
            receiver: FrameReceiver::new(),
            to_bus: FRAMES[own].writer(map, core)?,
            from_bus: [FRAMES[peer].receiver(map)?, FRAMES_VEHICLE.receiver(map)?],
            edges: [0; 8],
            wires_out: WIRES[own].writer(map, core)?,
            wires_in: WIRES[peer].reader(map)?,
            edges_in: [0; 8],
            link_out: LINKS[own].writer(map, core)?,
            link_in: LINKS[peer].reader(map)?,
            vehicle_frames: 0,
            refused: 0,
            next_control: now,
            next_status: now,
            next_report: now,
        })
    }

    /// Returns whether this system is the master.
    pub fn is_master(&self) -> bool {
        self.machine.role() == Role::Master
    }

    /// Returns how many frames did not pass their protection.
    pub fn refused(&self) -> u32 {
        self.refused
    }

    /// One millisecond of this system. `log` gets one line for each event.
    pub fn step(&mut self, now: Instant, log: &mut impl Write) {
        self.hear_bus(now, log);
        if let Ok(Some(words)) = self.link_in.fetch()
            && let Some(report) = LinkReport::from_words(&words)
        {
            self.give(now, Input::LinkReport(report), log);
        }
        if let Ok(Some(edges)) = self.wires_in.fetch() {
            self.edges_in = edges;
        }
        let edges = self.edges_in;
        // There is no power level here: it reads as high.
        let lines = LineSnapshot::new(
            |line, edge| edges[place(line, edge)],
            true,
            self.vehicle_frames,
        );
        self.give(now, Input::Poll(lines), log);
        self.wires_out.publish(&self.edges);
        self.speak(now);
    }

    fn hear_bus(&mut self, now: Instant, log: &mut impl Write) {
        for ring in 0..self.from_bus.len() {
            // A lost frame shows in the counters of the protection.
            while let Ok(Some((_, Frame(frame)))) = self.from_bus[ring].receive() {
                let message = match self.receiver.receive(u32::from(frame.id), frame.data()) {
                    Ok(message) => message,
                    Err(ReceiveError::Protection(_) | ReceiveError::Decode(_)) => {
                        self.refused += 1;
                        continue;
                    }
                };
                if let Some(input) = self.input_of(&message) {
                    self.give(now, input, log);
                }
            }
        }
    }

    /// What a message says to the redundancy.
    fn input_of(&mut self, message: &Message) -> Option<Input> {
        Some(match message {
            Message::Control { system, control } => Input::ControlFrame(ControlHeader {
                system: SystemId::from_index(usize::from(*system))?,
                term: Term::from_bits(control.term),
                role: Role::from_repr(control.role as u8)?,
                mode: Mode::from_repr(control.mode as u8)?,
            }),
            Message::Status { status, .. } => Input::StatusFrame(PeerReport {
                role: Role::from_repr(status.role as u8)?,
                mode: Mode::from_repr(status.mode as u8)?,
                term: Term::from_bits(status.term),
                can_alive: true,
                ability: Ability::from_bits(status.ability as u8),
            }),
            Message::GateEcho(echo) => {
                self.vehicle_frames = self.vehicle_frames.wrapping_add(1);
                Input::VehicleTerm(ObeyedTerm {
                    term: Term::from_bits(echo.term),
                    age: Duration::from_us((echo.term_age * 1e3) as u64),
                    sent: None,
                })
            }
            _ => return None,
        })
    }

    fn give(&mut self, now: Instant, input: Input, log: &mut impl Write) {
        let actions: Actions = self.machine.on(now, input);
        for action in actions.iter() {
            match action {
                Action::SendEdge(line, edge) => {
                    let count = &mut self.edges[place(line, edge)];
                    *count = count.wrapping_add(1);
                }
                Action::Transmit | Action::AlignControl => self.next_control = now,
                Action::Record(RedundancyEvent::Phase { from, to, on }) => {
                    let ms = now.as_ns() / 1_000_000;
                    let _ = writeln!(log, "{ms:4} ms {}: {from:?} -> {to:?} ({on:?})", self.id);
                }
                // No flash, no transmit buffer and no supply here.
                Action::Record(_) | Action::Persist(_) => {}
                Action::DiscardUnsent | Action::Reset(_) => {}
            }
        }
    }

    /// Sends what is due.
    fn speak(&mut self, now: Instant) {
        let system = self.id.index() as u8;
        let role = RoleCode::from_raw(self.machine.role() as u8).unwrap_or_default();
        let mode = ModeCode::from_raw(self.machine.mode() as u8).unwrap_or_default();
        if now >= self.next_control && self.machine.may_transmit(now) {
            let control = Control {
                role,
                mode,
                term: self.machine.term().bits(),
                steering_angle: 0.01,
                ..Control::default()
            };
            self.send(&Message::Control { system, control });
            self.next_control = now + self.config.control_period;
        }
        if now >= self.next_status {
            let report = self.machine.report();
            let ability = AbilityCode::from_raw(report.ability.bits()).unwrap_or_default();
            let term = report.term.bits();
            let status = Status {
                role,
                mode,
                ability,
                term,
                ..Status::default()
            };
            self.send(&Message::Status { system, status });
            self.next_status = now + STATUS_PERIOD;
        }
        if now >= self.next_report {
            let report = self.machine.link_report(now);
            self.link_out.publish(&report.to_words());
            self.next_report = now + self.config.report_period;
        }
    }

    fn send(&mut self, message: &Message) {
        self.to_bus
            .publish(&Frame(self.transmitter.encode(message)));
    }
}

/// The place of a line's edge in the counts.
fn place(line: Line, edge: Edge) -> usize {
    2 * line.index() + usize::from(edge == Edge::Falling)
}
