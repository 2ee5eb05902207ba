//! The vehicle: obeys the highest term, and tells both systems which one that is.

use core::fmt::Write;

use tandem_bus::{FrameReceiver, FrameTransmitter, GateEcho, Message};
use tandem_redundancy::tandem_board::{Duration, Instant};
use tandem_redundancy::{Config, Term};
use tandem_shm::broadcast;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::Map;
use tandem_shm::region::EndError;

use crate::lmu::{FRAMES, FRAMES_VEHICLE, Frame};

/// Period of the echo.
const ECHO_PERIOD: Duration = Duration::from_ms(10);

/// What receives the commands.
pub struct Vehicle<'a> {
    transmitter: FrameTransmitter,
    receiver: FrameReceiver,
    to_bus: broadcast::Writer<'a, Frame>,
    from_bus: [broadcast::Receiver<'a, Frame>; 2],
    obeyed: Term,
    obeyed_at: Instant,
    /// Commands obeyed, of A and of B.
    commands: [u32; 2],
    /// Frames that did not pass their protection, and commands of an old term.
    refused: u32,
    /// The longest time between two commands that were obeyed.
    gap: Duration,
    next_echo: Instant,
}

impl<'a> Vehicle<'a> {
    /// Attaches the vehicle.
    pub fn attach(map: &Map<'a>, core: Incarnation, now: Instant) -> Result<Self, EndError> {
        Ok(Self {
            transmitter: FrameTransmitter::new(),
            receiver: FrameReceiver::new(),
            to_bus: FRAMES_VEHICLE.writer(map, core)?,
            from_bus: [FRAMES[0].receiver(map)?, FRAMES[1].receiver(map)?],
            obeyed: Term::NONE,
            obeyed_at: now,
            commands: [0; 2],
            refused: 0,
            gap: Duration::ZERO,
            next_echo: now,
        })
    }

    /// One millisecond of the vehicle.
    pub fn step(&mut self, now: Instant) {
        for ring in 0..self.from_bus.len() {
            while let Ok(Some((_, Frame(frame)))) = self.from_bus[ring].receive() {
                match self.receiver.receive(u32::from(frame.id), frame.data()) {
                    Ok(Message::Control { system, control }) => {
                        self.obey(now, system, Term::from_bits(control.term));
                    }
                    Ok(_) => {}
                    Err(_) => self.refused += 1,
                }
            }
        }
        if now >= self.next_echo {
            let age = now.since(self.obeyed_at);
            let echo = GateEcho {
                term: self.obeyed.bits(),
                term_age: age.as_ms_f64() as f32,
                ..GateEcho::default()
            };
            let frame = self.transmitter.encode(&Message::GateEcho(echo));
            self.to_bus.publish(&Frame(frame));
            self.next_echo = now + ECHO_PERIOD;
        }
    }

    fn obey(&mut self, now: Instant, system: u8, term: Term) {
        if term < self.obeyed {
            self.refused += 1;
            return;
        }
        if self.obeyed != Term::NONE {
            self.gap = self.gap.max(now.since(self.obeyed_at));
        }
        (self.obeyed, self.obeyed_at) = (term, now);
        self.commands[usize::from(system != 0)] += 1;
    }

    /// Writes the result to `log`. Returns whether A, then B drove, without a frame refused and
    /// within the bound of the redundancy.
    pub fn judge(&self, log: &mut impl Write) -> bool {
        let ([a, b], gap, refused) = (self.commands, self.gap.as_us(), self.refused);
        // Seen at the next step, up to 1 ms later.
        let bound = (Config::rt().gap_bound() + Duration::from_ms(1)).as_us();
        let _ = writeln!(
            log,
            "vehicle: {a} commands of A, then {b} of B, {refused} refused"
        );
        let _ = writeln!(log, "vehicle: longest gap {gap} us, bound {bound} us");
        a >= 50 && b >= 50 && refused == 0 && gap <= bound
    }
}
