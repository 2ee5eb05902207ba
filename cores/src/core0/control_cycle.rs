//! The control cycle: computes a command from the inputs and sends it as a frame.
//!
//! A cycle takes three locked sections. The first takes the release and all inputs, the second
//! computes, the third sends. More urgent tasks may run between them, so the third section asks the
//! redundancy again for role, term and the permission to send: no frame leaves with a role or term
//! that no longer holds. The mode of a command may be a cycle old.

use super::driving::{Driving, Output};
use super::shared::SharedState;
use super::tasks::released;
use super::{Core0Task, Executor, TaskBody, frames};
use crate::driving::knowledge::Knowledge;
use crate::layout::age_ns;
use crate::release::Release;
use crate::trace::Event;
use tandem_board::{Board, Instant, Link};
use tandem_bus::Message;
use tandem_redundancy::Mode;

/// Gear and parking brake are asked for in every fifth control cycle: their motors take a second.
const BODY_CYCLES: u32 = 5;

/// The inputs that the first section of a cycle takes.
struct Inputs {
    release: Instant,
    begin: Instant,
    /// The permitted mode and what has arrived; `None` before the start protocol.
    driving: Option<(Mode, super::can_port::Inbox)>,
    /// The other system waits for knowledge.
    wants_knowledge: bool,
}

/// Motion control and the control frame.
pub struct ControlTask<'b, B>(pub(super) &'b B);

impl<'b, B: Board> TaskBody<'b, B> for ControlTask<'b, B> {
    const ID: Core0Task = Core0Task::Control;

    fn shift(&mut self, executor: &impl Executor<'b, B>, by_ns: i64) {
        executor.shared(|shared| shared.grid.shift(by_ns));
    }

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        let now = self.0.now();
        let (inputs, pass_on, next) = executor.shared(|shared| {
            let release = shared.grid.release(now);
            if release.is_some() {
                shared.align_cycles();
            }
            let next = shared.grid.next();
            let Some(release) = release else {
                return (None, false, next);
            };
            if shared.mode() == Some(Mode::DegradedL2) {
                shared.grid.pass_on(release);
                return (None, true, next);
            }
            let inputs = shared.begin_cycle(executor, Self::ID, release);
            (Some(inputs), false, next)
        });
        if pass_on {
            executor.release(Core0Task::Degraded.into());
        }
        if let Some(inputs) = inputs {
            finish_cycle(executor, Self::ID, inputs);
        }
        next
    }
}

/// The control cycle of a system that drives alone.
pub struct DegradedTask;

impl<'b, B: Board> TaskBody<'b, B> for DegradedTask {
    const ID: Core0Task = Core0Task::Degraded;

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        let inputs = executor.shared(|shared| {
            let release = shared.grid.take_passed_on()?;
            Some(shared.begin_cycle(executor, Core0Task::Degraded, release))
        });
        if let Some(inputs) = inputs {
            finish_cycle(executor, Core0Task::Degraded, inputs);
        }
        Instant::NEVER
    }
}

/// The second and the third section of a cycle.
fn finish_cycle<'b, B: Board>(executor: &impl Executor<'b, B>, task: Core0Task, inputs: Inputs) {
    let Inputs {
        release,
        begin,
        driving,
        wants_knowledge,
    } = inputs;
    let compute = |state: &mut Driving| {
        let output = driving.map(|(mode, inbox)| {
            inbox.empty_into(state);
            state.cycle(begin, mode)
        });
        (output, wants_knowledge.then(|| state.knowledge()).flatten())
    };
    let (output, knowledge) = executor.drive(compute);
    executor.shared(|shared| {
        if let Some(output) = &output {
            shared.send_control(output, begin, release);
        }
        shared.end_cycle(knowledge.as_ref());
    });
    executor.ends(task);
}

impl<'b, B: Board> SharedState<'b, B> {
    fn begin_cycle(
        &mut self,
        executor: &impl Executor<'b, B>,
        task: Core0Task,
        release: Release,
    ) -> Inputs {
        executor.begins(task, released(self.board, task, release));
        let begin = self.board.now();
        let misses = &mut self.counters.deadline_misses;
        *misses = misses.saturating_add(release.missed);
        let driving = self.redundancy.running().map(|redundancy| {
            let mode = redundancy.mode();
            let inbox = core::mem::take(&mut self.can.inbox);
            let permitted = match self.scene_check.is_lied_to() && mode != Mode::None {
                true => Mode::SafeStop,
                false => self.check.permits(mode),
            };
            (permitted, inbox)
        });
        Inputs {
            release: release.at,
            begin,
            driving,
            wants_knowledge: self.redundancy.is_driving() && self.transfer.wants_knowledge(begin),
        }
    }

    /// Sends the report, this system's command for the other one, and the control frame if this
    /// system drives.
    fn send_control(&mut self, output: &Output, begin: Instant, release: Instant) {
        let phase = self.redundancy.phase();
        // Core 2 does not know the corrections of a scene.
        let same_scene = !self.scene_check.is_changed();
        let change = self.check.cycle(begin, phase, output, same_scene);
        self.trace_agreement(change);
        let Some(may_transmit) = self.redundancy.may_transmit() else {
            return;
        };
        self.redundancy.report();
        let next_cycle = self.time.cycle_word(self.grid.next());
        let own = self.check.datagram(
            begin,
            output,
            (self.scene_check.own(), self.followed.own, next_cycle),
        );
        let _full = self.board.link().try_send(own.as_ref());
        let transmitted = may_transmit && !self.check.is_wrong() && self.transmit(output);
        if transmitted && self.counters.control_cycles.is_multiple_of(BODY_CYCLES) {
            self.transmit_body(output);
        }
        if let Some(topic) = output.silent {
            let topic = topic as u8;
            self.trace(Event::SocSilent { topic });
        }
        self.trace(Event::ControlCycle {
            lateness_ns: age_ns(begin, release),
            execution_ns: age_ns(self.board.now(), begin),
            transmitted,
        });
    }

    /// Sends the control frame; returns whether the controller took it.
    fn transmit(&mut self, output: &Output) -> bool {
        let Some(redundancy) = self.redundancy.running() else {
            return false;
        };
        let sent_at = self.can.vehicle_clock.at(self.board.now());
        let mut control = frames::control(redundancy, output, sent_at);
        if redundancy.stops_for_its_command() {
            let corrected = self.check.read_back.corrected(output.command);
            control.steering_angle = corrected.steering_angle;
            control.acceleration = corrected.acceleration;
        }
        let message = Message::Control {
            system: self.system.index() as u8,
            control,
        };
        let encoded = self.can.transmitter.encode(&message);
        self.check.read_back.on_sent(encoded.data()[2], &control);
        frames::send_encoded(self.board, &encoded)
    }

    /// Asks for gear and parking brake, if the function has to do with them. The vehicle obeys the
    /// term of a control frame before this one. D-3
    fn transmit_body(&mut self, output: &Output) {
        let (Some(redundancy), Some(request)) = (self.redundancy.running(), output.body) else {
            return;
        };
        let message = Message::BodyControl {
            system: self.system.index() as u8,
            body_control: frames::body_control(redundancy, request),
        };
        let encoded = self.can.transmitter.encode(&message);
        // It is asked for again.
        let _full = frames::send_encoded(self.board, &encoded);
    }

    fn end_cycle(&mut self, knowledge: Option<&Knowledge>) {
        let cycles = &mut self.counters.control_cycles;
        *cycles = cycles.wrapping_add(1);
        let (now, link) = (self.board.now(), self.board.link());
        let redundancy = self.redundancy.running();
        self.transfer.cycle(now, redundancy, knowledge, link);
    }
}
