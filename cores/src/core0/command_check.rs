//! Checks this system's command against the other system's command, against the vehicle's echo, and
//! against the result of core 2, which computes the step again. T-RED-9
//!
//! Invariant: once this system has found its command wrong, it sends no control frame in this
//! incarnation.

use super::agreement::{Agreement, Change, Deviation, Stage};
use super::driving::Output;
use super::frames;
use super::peer_command::{PeerCommand, PeerCommandLink};
use super::read_back::{ReadBack, Verdict};
use super::scene_check::PeerScene;
use crate::driving::types::{Command, ControlStep, StepFunction};
use tandem_board::Instant;
use tandem_bus::{GateEcho, ModeCode};
use tandem_redundancy::{Mode, Phase, Redundancy};
use tandem_shm::newest::Writer;

/// This system's command and the evidence against it.
pub(super) struct CommandCheck<'b> {
    agreement: Agreement,
    link: PeerCommandLink,
    /// The other system's command since the last control cycle, and the function that computed it.
    received: Option<(Command, ModeCode)>,
    /// What this system would have commanded in its last control cycle.
    last_output: Option<Output>,
    pub(super) read_back: ReadBack,
    /// This system's command was found wrong.
    is_wrong: bool,
    /// Where core 2 finds the step to compute again; `None` until the LMU is attached.
    pub(super) steps: Option<Writer<'b, ControlStep>>,
}

impl CommandCheck<'_> {
    pub(super) fn new() -> Self {
        Self {
            agreement: Agreement::new(),
            link: PeerCommandLink::new(),
            received: None,
            last_output: None,
            read_back: ReadBack::new(),
            is_wrong: false,
            steps: None,
        }
    }

    /// How well both systems agree.
    pub(super) const fn stage(&self) -> Stage {
        self.agreement.stage()
    }

    /// Returns whether this system's command was found wrong.
    pub(super) const fn is_wrong(&self) -> bool {
        self.is_wrong
    }

    /// Records that this system's command is wrong. Returns whether this is new.
    pub(super) const fn on_wrong(&mut self) -> bool {
        !core::mem::replace(&mut self.is_wrong, true)
    }

    /// Takes the command of the other system, from its control frame or the link.
    pub(super) fn on_peer_command(&mut self, command: Command, mode: ModeCode) {
        self.received = Some((command, mode));
    }

    /// Takes the stage that the other system reports.
    pub(super) fn on_peer_stage(&mut self, stage: Stage) -> Option<Change> {
        self.agreement.on_stage_of_peer(stage)
    }

    /// Takes the command of the other system from a datagram.
    pub(super) fn on_datagram(&mut self, now: Instant, words: &[u32]) -> Option<PeerCommand> {
        self.link.on_datagram(now, words)
    }

    /// Takes the vehicle's echo. Returns what it says of this system's command.
    pub(super) fn on_echo(&mut self, redundancy: &Redundancy, echo: &GateEcho) -> Verdict {
        let stops = redundancy.stops_for_its_command();
        let term = redundancy.term().bits();
        let has_standby = redundancy.phase() == Phase::Master;
        self.read_back.on_echo(term, echo, has_standby, stops)
    }

    /// Returns the mode that the redundancy and the agreement permit; [`Driving`](super::Driving)
    /// may do less.
    pub(super) fn permits(&self, mode: Mode) -> Mode {
        if mode != Mode::None && self.stage() == Stage::Unresolved {
            Mode::SafeStop
        } else {
            mode
        }
    }

    /// Compares this system's command with the other's and publishes the step for core 2. `output`:
    /// the output of this cycle. `same_scene`: core 2 has the scene that the step used.
    pub(super) fn cycle(
        &mut self,
        now: Instant,
        phase: Option<Phase>,
        output: &Output,
        same_scene: bool,
    ) -> Option<Change> {
        let last = self.last_output.replace(*output);
        let received = self.received.take();
        let own = match phase {
            Some(Phase::Standby) => Some((output.standalone, output)),
            // The other system's command is one cycle old.
            Some(Phase::Master | Phase::DegradedMaster) => {
                last.as_ref().map(|last| (last.command, last))
            }
            _ => None,
        };
        let deviation = received
            .zip(own)
            .and_then(|((theirs, their_mode), (own, by))| {
                let drives = !matches!(by.mode, Mode::None | Mode::SafeStop);
                let alike = drives && frames::function(by.mode, by.state) == their_mode;
                alike.then(|| Deviation::of(&own, &theirs, output.speed))
            });
        let needs_scene = |of| !matches!(of, StepFunction::Trajectory | StepFunction::Parking);
        let is_known = |step: &&ControlStep| same_scene || !needs_scene(step.function);
        if let (Some(steps), Some(step)) = (&mut self.steps, output.step.as_ref().filter(is_known))
        {
            steps.publish(step);
        }
        let phase = phase.unwrap_or(Phase::Starting);
        self.agreement.cycle(now, phase, deviation)
    }

    /// Returns the datagram with this system's command, its scene, the SoC that it follows and its
    /// next cycle, for the other one.
    pub(super) fn datagram(
        &mut self,
        now: Instant,
        output: &Output,
        (scene, soc, next_cycle): (Option<PeerScene>, u16, u32),
    ) -> impl AsRef<[u32]> + use<> {
        let mode = if self.agreement.is_warm(now) {
            output.mode
        } else {
            Mode::None
        };
        let own = PeerCommand {
            mode: frames::function(mode, output.state),
            stage: self.stage(),
            command: output.standalone,
            soc,
            next_cycle,
            scene,
        };
        self.link.datagram(now, own)
    }
}
