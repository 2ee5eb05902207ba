//! The bootloader's desk beside an application: it answers testers, and approves the release.
//!
//! A paired release is approved by both systems or by none. Each one tells its stage on CAN:
//!
//! | stage | the other system must be at | then |
//! |---|---|---|
//! | trial | anything; a role for [`PROVES_ITSELF`] | works |
//! | works | works | it records that it is ready |
//! | ready | ready | approved |
//!
//! A start rolls a release back that is not ready. A system that is ready cannot know whether the
//! other one has approved it: it starts the release again. If the other one then runs another
//! release, this one gives its release up. T-BOOT-1, U-3

use crate::environment::{Environment, EnvironmentStore, Trial};
use crate::flash_access::{FlashFault, manifest_at};
use crate::info;
use crate::loader::{HOST_SILENCE, approve, bootloader_works};
use crate::log::{append, wrong_testers};
use crate::map::{ImageTarget, Slot};
use crate::protocol::{Answer, HostRequest, RELEASES, Refusal, ReleaseStage, TO_LOADER};
use crate::tester::{Judged, Tester};
use crate::trust::{Trust, TrustMode};
use embedded_storage::nor_flash::NorFlash;
use strum::VariantArray as _;
use tandem_board::{
    CanFrame, DeskAction, Duration, Instant, MonotonicCounter, ResetRequest, SystemId, TesterDesk,
};

/// A release works if its system has had a role for this long without a break.
pub const PROVES_ITSELF: Duration = Duration::from_ms(1_000);
/// Period of the release frames, and of attempts to write the flash.
const TELLS_EVERY: Duration = Duration::from_ms(200);
/// A release frame of the other system is true for this long.
const TRUE_FOR: Duration = Duration::from_ms(1_000);
/// What the other system tells counts after it has told nothing else for this long: a forged frame
/// stands against five true ones.
const TOLD_FOR: Duration = Duration::from_ms(1_000);
/// At most one question is answered in this time: a search of the log takes milliseconds.
const ANSWERS_EVERY: Duration = Duration::from_ms(20);
/// How many times core 0 is told that this start works, because a word to it may be lost.
const CONFIRMATIONS: u8 = 5;

/// The release that runs.
#[derive(Clone, Copy, Debug)]
struct Release {
    version: u32,
    stage: ReleaseStage,
    paired: bool,
    security_counter: u8,
}

/// What the other system tells.
#[derive(Clone, Copy, Debug)]
struct Peer {
    version: u32,
    /// When it told that last.
    at: Instant,
    /// Since when it has told nothing below each stage.
    since: [Option<Instant>; ReleaseStage::VARIANTS.len()],
}

impl Peer {
    /// `before`: what it told before, of the same version.
    fn told(before: Option<Self>, now: Instant, stage: ReleaseStage, version: u32) -> Self {
        let mut since = before.map_or([None; ReleaseStage::VARIANTS.len()], |before| before.since);
        for (index, since) in since.iter_mut().enumerate() {
            *since = (index <= stage as usize).then(|| since.unwrap_or(now));
        }
        Self {
            version,
            at: now,
            since,
        }
    }

    fn is_fresh(&self, now: Instant) -> bool {
        now.since(self.at) <= TRUE_FOR
    }

    /// Returns whether it has told, for long enough, that it is at least at this stage.
    fn has_told(&self, now: Instant, stage: ReleaseStage) -> bool {
        let since = self.since[stage as usize];
        self.is_fresh(now) && since.is_some_and(|since| now.since(since) >= TOLD_FOR)
    }
}

/// The circumstances of the application that the desk is beside.
#[derive(Clone, Copy, Debug)]
pub struct DeskSetup<'k> {
    /// The testers, and how their signatures are verified. Its keys are not used.
    pub trust: Trust<'k>,
    /// Which system this is.
    pub system: SystemId,
    /// The slot of the application that runs.
    pub running: Slot,
    /// As in [`Setup::starts`](crate::Setup::starts).
    pub starts: u8,
    /// As in [`Setup::noise`](crate::Setup::noise), and not that of the bootloader.
    pub noise: [u8; 32],
}

/// The desk of one system, with its program flash and its counter.
#[derive(Debug)]
pub struct BootDesk<'k, F, C> {
    flash: F,
    counter: C,
    trust: Trust<'k>,
    system: SystemId,
    starts: u8,
    tester: Tester,
    /// When the tester was proved.
    proved_at: Option<Instant>,
    has_role_since: Option<Instant>,
    confirmations: u8,
    /// The counter was raised, or cannot be.
    is_counter_raised: bool,
    /// The bootloader that started this application works.
    is_loader_approved: bool,
    /// `None` until it is read from the flash.
    release: Option<Release>,
    /// What the other system told last.
    peer: Option<Peer>,
    /// When the last question was answered.
    answered: Option<Instant>,
    /// The slot of the application that runs.
    running: Slot,
    told: Option<Instant>,
    /// The release is given up as soon as the vehicle does not need this system.
    gives_up: bool,
    /// The last poll asked core 0 to leave for that.
    asked: bool,
}

impl<'k, F: NorFlash, C: MonotonicCounter> BootDesk<'k, F, C> {
    /// Creates the desk when the application starts. Reads the log if the system knows testers.
    pub fn new(mut flash: F, counter: C, setup: DeskSetup<'k>, now: Instant) -> Self {
        let wrong = match setup.trust.testers {
            [] => None,
            _ => wrong_testers(&mut flash),
        };
        Self {
            flash,
            counter,
            trust: setup.trust,
            system: setup.system,
            starts: setup.starts,
            tester: Tester::new(setup.noise, wrong.unwrap_or_default(), now),
            proved_at: None,
            has_role_since: None,
            confirmations: 0,
            is_counter_raised: false,
            is_loader_approved: false,
            release: None,
            peer: None,
            answered: None,
            running: setup.running,
            told: None,
            gives_up: false,
            asked: false,
        }
    }

    /// Returns the flash.
    pub const fn flash(&self) -> &F {
        &self.flash
    }

    /// Returns the flash and the counter.
    pub fn into_parts(self) -> (F, C) {
        (self.flash, self.counter)
    }

    /// Reads from the flash which release runs.
    fn read_release(&mut self) -> Option<Release> {
        let store = EnvironmentStore::load(&mut self.flash)?;
        let Environment { active, trial, .. } = *store.get();
        // What the flash did not record, or a reset loop, may have booted something else.
        let runs = |trial: &Trial| {
            let selection = trial.selection.over(active);
            trial.executed && selection.application == Some(self.running)
        };
        let trial = trial.filter(runs);
        let application = ImageTarget::Application(self.running);
        let manifest = manifest_at(&mut self.flash, application)?;
        let stage = match trial {
            None => ReleaseStage::Approved,
            Some(Trial { ready: true, .. }) => ReleaseStage::Ready,
            Some(_) => ReleaseStage::Trial,
        };
        let is_new = trial.is_some_and(|trial| trial.selection.application.is_some());
        Some(Release {
            version: manifest.version,
            stage,
            paired: manifest.paired && is_new,
            security_counter: manifest.security_counter,
        })
    }

    /// Returns whether the other system runs this version too, and has told that it is at least at
    /// this stage.
    fn peer_is_at(&self, now: Instant, version: u32, stage: ReleaseStage) -> bool {
        self.peer
            .is_some_and(|peer| peer.version == version && peer.has_told(now, stage))
    }

    /// Returns whether the other system runs an approved release of another version.
    fn peer_has_another(&self, now: Instant, version: u32) -> bool {
        self.peer.is_some_and(|peer| {
            peer.version != version && peer.has_told(now, ReleaseStage::Approved)
        })
    }

    /// Takes the next step of the release, if it is due. What the flash does not take is tried
    /// again.
    fn advance(&mut self, now: Instant, has_proved: bool) -> Result<(), FlashFault> {
        let Some(release) = self.release else {
            self.release = self.read_release();
            return Ok(());
        };
        if self.gives_up {
            return Ok(());
        }
        if has_proved && !self.is_loader_approved {
            bootloader_works(&mut self.flash)?;
            self.is_loader_approved = true;
        }
        let version = release.version;
        let stage = match release.stage {
            ReleaseStage::Trial if has_proved && release.paired => ReleaseStage::Works,
            ReleaseStage::Trial if has_proved => self.approve()?,
            ReleaseStage::Works if self.peer_is_at(now, version, ReleaseStage::Works) => {
                self.set_ready(true)?;
                ReleaseStage::Ready
            }
            ReleaseStage::Ready if self.peer_is_at(now, version, ReleaseStage::Ready) => {
                self.approve()?
            }
            ReleaseStage::Ready if self.peer_has_another(now, version) => {
                self.give_up()?;
                ReleaseStage::Trial
            }
            ReleaseStage::Approved => {
                // If power is lost here, the next start raises it.
                let strict = self.trust.mode == TrustMode::Strict;
                if strict && !core::mem::replace(&mut self.is_counter_raised, true) {
                    let _not_raised = self.counter.raise(release.security_counter.into());
                }
                ReleaseStage::Approved
            }
            stage => stage,
        };
        self.release = Some(Release { stage, ..release });
        Ok(())
    }

    fn approve(&mut self) -> Result<ReleaseStage, FlashFault> {
        approve(&mut self.flash)?;
        Ok(ReleaseStage::Approved)
    }

    fn set_ready(&mut self, ready: bool) -> Result<(), FlashFault> {
        let mut store = EnvironmentStore::load(&mut self.flash).ok_or(FlashFault)?;
        let mut environment = *store.get();
        match &mut environment.trial {
            Some(trial) if trial.ready != ready => trial.ready = ready,
            _ => return Ok(()),
        }
        store.write(&mut self.flash, environment)
    }

    /// Lets the next start roll the release back, and this system leave for that.
    fn give_up(&mut self) -> Result<(), FlashFault> {
        self.set_ready(false)?;
        self.gives_up = true;
        if let Some(release) = &mut self.release {
            release.stage = ReleaseStage::Trial;
        }
        Ok(())
    }

    /// Returns whether who asks may do what changes this system.
    fn may_program(&self, now: Instant) -> bool {
        let is_fresh = self
            .proved_at
            .is_some_and(|at| now.since(at) <= HOST_SILENCE);
        self.trust.testers.is_empty() || is_fresh
    }

    fn prove(&mut self, now: Instant, part: u8, bytes: [u8; 5]) -> Option<Answer> {
        let place = (now, self.system);
        let judged = self.tester.on_proof(place, part, bytes, &self.trust)?;
        let (event, answer) = judged.outcome();
        self.proved_at = (judged == Judged::Right).then_some(now);
        let _unlogged = append(&mut self.flash, event, self.tester.wrong().into());
        Some(answer)
    }

    fn on_request(&mut self, now: Instant, request: HostRequest<'_>) -> Option<DeskAction> {
        let answer = match request {
            HostRequest::Connect { .. } if self.may_program(now) => {
                return Some(DeskAction::Leave(ResetRequest::Download));
            }
            HostRequest::RollBack { .. } if self.may_program(now) => {
                // Who has told that it is ready may not give up alone: the other one may approve.
                let is_trial = self.release?.stage < ReleaseStage::Ready;
                // If the flash does not take it, the tester asks again.
                return (is_trial && self.give_up().is_ok())
                    .then_some(DeskAction::Leave(ResetRequest::Software));
            }
            HostRequest::Connect { .. } | HostRequest::RollBack { .. } => {
                Some(Answer::Refused(Refusal::Tester))
            }
            HostRequest::Challenge { key, part, .. } => self.tester.on_challenge(now, key, part),
            HostRequest::Proof { part, bytes, .. } => self.prove(now, part, bytes),
            HostRequest::Info { .. }
                if self
                    .answered
                    .is_some_and(|at| now.since(at) < ANSWERS_EVERY) =>
            {
                None
            }
            HostRequest::Info { question, .. } => {
                self.answered = Some(now);
                let store = EnvironmentStore::load(&mut self.flash)?;
                info::answer(&mut self.flash, store.get(), self.starts, question)
            }
            HostRequest::Offer { .. } | HostRequest::GoBack { .. } | HostRequest::Data(_) => None,
        };
        answer.and_then(Answer::frame).map(DeskAction::Send)
    }
}

/// Returns the system that a request names.
const fn named(request: &HostRequest<'_>) -> Option<SystemId> {
    match *request {
        HostRequest::Connect { system, .. }
        | HostRequest::Challenge { system, .. }
        | HostRequest::Proof { system, .. }
        | HostRequest::Info { system, .. }
        | HostRequest::RollBack { system } => system,
        HostRequest::Offer { .. } | HostRequest::GoBack { .. } | HostRequest::Data(_) => None,
    }
}

impl<F: NorFlash, C: MonotonicCounter> TesterDesk for BootDesk<'_, F, C> {
    fn hear(&mut self, now: Instant, frame: &CanFrame) -> Option<DeskAction> {
        match frame.id() {
            TO_LOADER => {
                let request = HostRequest::decode(frame.data());
                // A request that names no system is for a bootloader.
                let is_ours = named(&request) == Some(self.system);
                is_ours.then(|| self.on_request(now, request)).flatten()
            }
            RELEASES => {
                if let Some(Answer::Release {
                    system,
                    stage,
                    version,
                }) = Answer::decode(frame.data())
                    && system != self.system
                {
                    let before = self.peer.filter(|peer| peer.is_fresh(now));
                    let before = before.filter(|peer| peer.version == version);
                    self.peer = Some(Peer::told(before, now, stage, version));
                }
                None
            }
            _ => None,
        }
    }

    fn poll(&mut self, now: Instant, has_role: bool) -> Option<DeskAction> {
        let since = self.has_role_since.get_or_insert(now);
        let has_proved = has_role && now.since(*since) >= PROVES_ITSELF;
        if !has_role {
            self.has_role_since = None;
        }
        if has_proved && self.confirmations < CONFIRMATIONS {
            (self.confirmations, self.starts) = (self.confirmations + 1, 1);
            return Some(DeskAction::ConfirmStart);
        }
        if self.told.is_some_and(|told| now.since(told) < TELLS_EVERY) {
            return None;
        }
        self.told = Some(now);
        let _again = self.advance(now, has_proved);
        let release = self.release?;
        // A master first hands over. Until it leaves it tells what it still runs.
        self.asked = self.gives_up && !self.asked;
        if self.asked {
            return Some(DeskAction::Leave(ResetRequest::Software));
        }
        let told = Answer::Release {
            system: self.system,
            stage: release.stage,
            version: release.version,
        };
        told.frame().map(DeskAction::Send)
    }
}
