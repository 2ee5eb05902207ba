//! The bootloader from the reset to the jump. T-BOOT-1, T-BOOT-2, U-3, U-4, E-4

mod own_update;

use own_update::approve_bootloader;
pub use own_update::bootloader_works;

use crate::download::Ground;
use crate::environment::{Environment, EnvironmentStore, Selection, Trial};
use crate::flash_access::{FlashFault, body_crc, is_intact, manifest_at, read, read_manifest};
use crate::info;
use crate::log::{LogEvent, append, wrong_testers};
use crate::manifest::{MANIFEST_BYTES, Manifest};
use crate::map::{Bank, FlashRegion, ImageTarget, Slot};
use crate::protocol::{Answer, HostRequest, Refusal, TO_LOADER};
use crate::session::Session;
use crate::tester::{Judged, Tester};
use crate::trust::{Trust, TrustMode};
use embedded_storage::nor_flash::NorFlash;
use tandem_board::{CanFrame, CoreId, Duration, Instant, ResetCause, SystemId};

/// How long a host may connect after power-on: short compared with the start limit of the pair
/// (2.5 s), so both systems still find each other; long enough for four requests, one every 5 ms.
pub const CONNECT_WINDOW: Duration = Duration::from_ms(20);
/// How long the loader waits for a host if the application requested a download, and how long a
/// connected host may be silent.
pub const HOST_SILENCE: Duration = Duration::from_ms(10_000);
/// How long a connected host that has not proved itself keeps the loader from booting.
const PROVES_WITHIN: Duration = Duration::from_ms(2_000);
/// How long a host may request the last answer of a download again.
const FAREWELL: Duration = Duration::from_ms(50);

/// Eight starts of which none worked are a reset loop: the next eight try the other slot, the eight
/// after these the first one again. The redundancy of an application would have ended it before.
const LOOP: u8 = 8;

/// The circumstances of this start.
#[derive(Clone, Copy, Debug)]
pub struct Setup<'k> {
    /// The trusted keys, and the mode.
    pub trust: Trust<'k>,
    /// Which system this is.
    pub system: SystemId,
    /// The bank of the running bootloader.
    pub bank: Bank,
    /// Why the system was reset.
    pub cause: ResetCause,
    /// Starts since power-on, or since one of them worked, this one included: see
    /// [`Supply::starts`](tandem_board::Supply::starts).
    pub starts: u8,
    /// The value of the board's [`MonotonicCounter`](tandem_board::MonotonicCounter), or 0.
    pub counter: u32,
    /// Bytes that differ at each start: of a random number generator, if the board has one.
    pub noise: [u8; 32],
}

/// When a host may connect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Entry {
    /// Never: the loader boots.
    Never,
    /// Until this time; then the loader boots.
    Until(Instant),
    /// At any time: nothing can boot.
    Always,
}

/// The entry rule of T-BOOT-1. A host may connect for [`CONNECT_WINDOW`] after power-on, and for
/// [`HOST_SILENCE`] after an orderly reset by which the application requested it; the application
/// does so only at standstill or as standby. No host may connect after an abnormal reset: a
/// failover must not wait.
const fn entry(setup: &Setup<'_>, now: Instant) -> Entry {
    match setup.cause {
        ResetCause::PowerOn => Entry::Until(after(now, CONNECT_WINDOW)),
        ResetCause::Download => Entry::Until(after(now, HOST_SILENCE)),
        ResetCause::Software
        | ResetCause::Watchdog
        | ResetCause::Trap
        | ResetCause::ErrorPin
        | ResetCause::Undervoltage => Entry::Never,
    }
}

const fn after(now: Instant, span: Duration) -> Instant {
    Instant::from_ns(now.as_ns() + span.as_ns())
}

/// The application to start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Launch {
    /// The application's slot.
    pub application: Slot,
    /// The configuration's slot, if there is one.
    pub configuration: Option<Slot>,
    /// Version of the application.
    pub version: u32,
    /// Entry of each core, as an offset in the flash. Core 0 jumps and then releases the others.
    pub entries: [Option<u32>; CoreId::COUNT],
}

/// The next action of the board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Next {
    /// Pass on each received frame, and call again at this time or earlier.
    Wait(Instant),
    /// Send this frame, then call again at once.
    Send(CanFrame),
    /// Clean up (T-BOOT-7: clear RAM, reset the CAN module, disable interrupts), then jump.
    Jump(Launch),
    /// Clean up as before a jump, then start the bootloader in this bank.
    StartBank(Bank),
    /// Request an orderly reset.
    Reset,
}

/// The bootloader over one flash.
#[derive(Debug)]
pub struct Loader<'k, F> {
    flash: F,
    setup: Setup<'k>,
    ground: Ground<'k>,
    session: Session,
    began: Instant,
    entry: Entry,
    answer: Option<CanFrame>,
    /// The final action, after the loader has decided.
    verdict: Option<Next>,
    refusal_logged: bool,
    /// Whether a frame was processed since the last [`Loader::next`].
    was_busy: bool,
}

impl<'k, F: NorFlash> Loader<'k, F> {
    /// Reads the boot environment, repairs it after a loss of power, rolls back an image that did
    /// not approve itself, and takes the next step of an update of the bootloader. What the flash
    /// does not record is not done, or is done again at the next start.
    #[inline(never)]
    pub fn start(mut flash: F, setup: Setup<'k>, now: Instant) -> Self {
        let loaded = EnvironmentStore::load(&mut flash);
        // To read the whole log takes long, so a usual start does not.
        let reads_log = loaded.is_none() || !setup.trust.testers.is_empty();
        let wrong_testers = if reads_log {
            wrong_testers(&mut flash)
        } else {
            None
        };
        let mut store = match loaded.clone() {
            Some(store) => store,
            None => EnvironmentStore::new(rebuild(&mut flash, &setup, wrong_testers.is_none())),
        };
        // Worn-out sectors must not prevent booting.
        let settled = store.settle(&mut flash);
        let _full = store.make_room(&mut flash);
        if loaded.is_none() && settled.is_ok() {
            let _ = append(&mut flash, LogEvent::EnvironmentRebuilt, 0);
        }
        let tester = Tester::new(setup.noise, wrong_testers.unwrap_or_default(), now);
        let running = read(&mut flash, FlashRegion::Bank(setup.bank).range().start).ok();
        let mut loader = Self {
            flash,
            setup,
            ground: Ground {
                trust: setup.trust,
                store,
                keep: Selection::default(),
                running,
                tester,
                counter: setup.counter,
            },
            session: Session::default(),
            began: now,
            entry: entry(&setup, now),
            answer: None,
            verdict: None,
            refusal_logged: false,
            was_busy: false,
        };
        loader.verdict = loader.continue_update();
        if loader.verdict.is_none() {
            loader.roll_back();
            loader.choose_active();
        }
        loader
    }

    /// Returns the next action.
    pub fn next(&mut self, now: Instant) -> Next {
        if core::mem::take(&mut self.was_busy) {
            // The loader does not read CAN while the flash is busy: that time does not count as
            // silence of the host.
            self.session.excuse(now);
        }
        if let Some(frame) = self.answer.take() {
            return Next::Send(frame);
        }
        if let Some(verdict) = self.verdict {
            return verdict;
        }
        if let Some(deadline) = self.session.deadline()
            && now >= deadline
        {
            self.answer = self.session.on_silence(now).frame();
            return self.next(now);
        }
        let session_ends = match self.entry {
            _ if self.session.has_ended() => Some(self.session.progressed() + FAREWELL),
            _ if self.session.is_open() => Some(self.session_ends()),
            Entry::Never => Some(now),
            Entry::Until(moment) => Some(moment),
            Entry::Always => None,
        };
        match session_ends {
            Some(moment) if now >= moment => {
                let verdict = if self.session.is_finished() || self.session.is_open() {
                    Some(Next::Reset)
                } else {
                    self.boot()
                };
                (self.verdict, self.session) = (verdict, Session::default());
                self.entry = Entry::Always;
                self.next(now)
            }
            ends => {
                let silence = self.session.deadline().unwrap_or(Instant::NEVER);
                Next::Wait(ends.unwrap_or(Instant::NEVER).min(silence))
            }
        }
    }

    /// Returns when the loader boots although a host is connected: after a silence of the host, or
    /// if it has not proved itself in time, unless nothing can boot.
    fn session_ends(&self) -> Instant {
        let silent = self.session.progressed() + HOST_SILENCE;
        let may_program = self.ground.tester.may_program(&self.setup.trust);
        match self.entry {
            Entry::Never | Entry::Until(_) if !may_program => {
                silent.min(self.began + PROVES_WITHIN)
            }
            _ => silent,
        }
    }

    /// Processes a frame from the bus. Call [`Loader::next`] before the next frame.
    #[inline(never)]
    pub fn on_frame(&mut self, now: Instant, frame: &CanFrame) {
        if frame.id() != TO_LOADER || self.verdict.is_some() {
            return;
        }
        let answer = match HostRequest::decode(frame.data()) {
            HostRequest::Connect { system, resume } if self.is_for_us(system) => {
                // A connection that goes on keeps its proof.
                if !(resume && self.session.is_open()) {
                    self.ground.tester.leave();
                }
                self.session.connect(now, resume)
            }
            // A request to another system, or to an application.
            HostRequest::Connect { .. } | HostRequest::RollBack { .. } => None,
            HostRequest::Challenge { system, .. }
            | HostRequest::Proof { system, .. }
            | HostRequest::Info { system, .. }
                if !self.answers(system) =>
            {
                None
            }
            HostRequest::Challenge { key, part, .. } => {
                self.ground.tester.on_challenge(now, key, part)
            }
            HostRequest::Proof { part, bytes, .. } => self.prove(now, part, bytes),
            HostRequest::Info { question, .. } => {
                let environment = self.ground.store.get();
                info::answer(&mut self.flash, environment, self.setup.starts, question)
            }
            request => {
                let (flash, ground) = (&mut self.flash, &mut self.ground);
                self.session.on_request(now, request, flash, ground)
            }
        };
        self.was_busy = self.session.take_progress();
        if self.was_busy {
            // A host has heard this bootloader. If that cannot be written, an application that runs
            // approves it.
            let _unwritten = approve_bootloader(&mut self.flash, &mut self.ground.store);
        }
        match self.session.refusal() {
            // Without a proof nothing on the bus fills the log.
            Some(refusal) if !self.refusal_logged && refusal != Refusal::Tester => {
                self.refusal_logged = true;
                // The host receives its answer even if the log fails.
                let _ = append(&mut self.flash, LogEvent::DownloadRefused, refusal as u32);
            }
            Some(_) => {}
            None => self.refusal_logged = false,
        }
        self.answer = answer.and_then(Answer::frame);
    }

    /// Returns whether a request is for this loader: it names this system, or the host that is
    /// connected asks.
    #[inline(never)]
    fn answers(&self, system: Option<SystemId>) -> bool {
        system.map_or(self.session.is_open(), |system| system == self.setup.system)
    }

    /// Takes a part of a tester's signature.
    #[inline(never)]
    fn prove(&mut self, now: Instant, part: u8, bytes: [u8; 5]) -> Option<Answer> {
        let trust = self.setup.trust;
        let place = (now, self.setup.system);
        let tester = &mut self.ground.tester;
        let judged = tester.on_proof(place, part, bytes, &trust)?;
        let wrong = tester.wrong();
        if judged == Judged::Right {
            self.session.progress(now);
        }
        let (event, answer) = judged.outcome();
        self.log(event, wrong.into());
        Some(answer)
    }

    /// Returns whether to answer a request. Both loaders receive a request that names no system. At
    /// power-on only A answers it. A loader that waits for a requested download, or because nothing
    /// can boot, also answers it, because the other loader does not wait then.
    fn is_for_us(&self, system: Option<SystemId>) -> bool {
        let asked = self.setup.cause == ResetCause::Download;
        let alone = asked || self.entry == Entry::Always;
        system.map_or(alone || self.setup.system == SystemId::A, |system| {
            system == self.setup.system
        })
    }

    /// Returns the flash.
    pub const fn flash(&self) -> &F {
        &self.flash
    }

    /// Ends the loader and returns the flash.
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// Forgets an image on trial that was started and did not approve itself before this start. U-3
    fn roll_back(&mut self) {
        let environment = *self.ground.store.get();
        let has_failed = |trial: Trial| trial.executed && (!trial.ready || self.loops());
        if environment.trial.is_some_and(has_failed) {
            self.forget_trial(LogEvent::RolledBack);
        }
    }

    /// Returns whether the starts before did not work, so that the other slot is tried.
    const fn loops(&self) -> bool {
        self.setup.starts.saturating_sub(1) / LOOP % 2 == 1
    }

    fn forget_trial(&mut self, event: LogEvent) {
        // If it cannot be written, the next start forgets the trial again.
        let _unwritten = self.write(Environment {
            trial: None,
            ..*self.ground.store.get()
        });
        self.log(event, 0);
    }

    /// Determines the active slots that can boot; no download may touch them. If an active image is
    /// damaged, the other slot becomes active.
    fn choose_active(&mut self) {
        let mut environment = *self.ground.store.get();
        let active = environment.active;
        let loops = self.loops();
        if loops && self.setup.starts % LOOP == 1 {
            self.log(LogEvent::ResetLoop, self.setup.starts.into());
        }
        let first = match loops {
            true => active.application.map(Slot::other),
            false => active.application,
        };
        let keep = Selection {
            application: self.first_whole(first, ImageTarget::Application),
            configuration: self.first_whole(active.configuration, ImageTarget::Configuration),
        };
        self.ground.keep = keep;
        environment.active = keep.over(active);
        // A reset loop changes only what this start boots.
        if environment.active != active && !loops {
            // If it cannot be written, the next start chooses again.
            let _unwritten = self.write(environment);
            self.log(LogEvent::SlotDamaged, 0);
        }
    }

    /// Returns this slot or the other one, if that can boot.
    fn first_whole(
        &mut self,
        first: Option<Slot>,
        target: fn(Slot) -> ImageTarget,
    ) -> Option<Slot> {
        let mut order = first.into_iter().chain(first.map(Slot::other));
        order.find(|slot| self.can_boot(target(*slot)))
    }

    fn can_boot(&mut self, target: ImageTarget) -> bool {
        let image = inspect(&mut self.flash, &self.setup.trust, target);
        let permits = |image: &Image| {
            let counter = image.security_counter;
            self.ground.counter_permits(target.kind(), counter)
        };
        let image = image.filter(permits);
        if let Some(Image {
            authentic: false, ..
        }) = image
        {
            let strict = self.setup.trust.mode == TrustMode::Strict;
            let event = if strict {
                LogEvent::RefusedUntrusted
            } else {
                LogEvent::StartedUntrusted
            };
            self.log(event, target.kind() as u32);
            return !strict;
        }
        image.is_some()
    }

    /// Boot-load mode: starts the image on trial if it is intact, otherwise the active one. Returns
    /// `None` if nothing can boot; the loader then waits for a download.
    #[inline(never)]
    fn boot(&mut self) -> Option<Next> {
        let environment = *self.ground.store.get();
        let mut selection = self.ground.keep;
        if let Some(Trial { selection: new, .. }) = environment.trial {
            let application = new.application.map(ImageTarget::Application);
            let configuration = new.configuration.map(ImageTarget::Configuration);
            let mut targets = application.into_iter().chain(configuration);
            let started = Environment {
                trial: environment.trial.map(|trial| Trial {
                    executed: true,
                    ..trial
                }),
                ..environment
            };
            let together = new.over(selection);
            if !targets.all(|target| self.can_boot(target))
                || !self.ground.fit(&mut self.flash, together)
            {
                self.forget_trial(LogEvent::SlotDamaged);
            } else if self.write(started).is_err() {
                // Without this record it could not be rolled back.
                self.log(LogEvent::NotRecorded, 0);
            } else {
                selection = together;
            }
        }
        let Some(application) = selection.application else {
            return self.last_resort();
        };
        self.launch(application, selection.configuration)
    }

    fn launch(&mut self, application: Slot, configuration: Option<Slot>) -> Option<Next> {
        let manifest = manifest_at(&mut self.flash, ImageTarget::Application(application))?;
        let place = FlashRegion::Target(ImageTarget::Application(application))
            .range()
            .start;
        let entry = |entry: u32| (entry > 0).then_some(place + entry);
        Some(Next::Jump(Launch {
            application,
            configuration,
            version: manifest.version,
            entries: manifest.entries.map(entry),
        }))
    }

    /// In monitor mode, starts a damaged image if no other can boot. E-4
    fn last_resort(&mut self) -> Option<Next> {
        if self.setup.trust.mode == TrustMode::Strict {
            return None;
        }
        let slot = self.ground.store.get().active.application?;
        self.log(LogEvent::StartedUntrusted, slot as u32);
        self.launch(slot, self.ground.keep.configuration)
    }

    fn write(&mut self, environment: Environment) -> Result<(), FlashFault> {
        self.ground.store.write(&mut self.flash, environment)
    }

    /// Adds an entry to the log. Ignores errors, because the log must not prevent booting.
    fn log(&mut self, event: LogEvent, value: u32) {
        let _ = append(&mut self.flash, event, value);
    }
}

/// An image with the right digests.
struct Image {
    version: u32,
    security_counter: u8,
    authentic: bool,
}

/// Returns the image in a place; `None` if it is missing or damaged. A key that was retired after
/// the download is still accepted here, so that an approved image remains as fallback.
fn inspect(flash: &mut impl NorFlash, trust: &Trust<'_>, target: ImageTarget) -> Option<Image> {
    let mut bytes = [0; MANIFEST_BYTES];
    let manifest = read_manifest(flash, target, &mut bytes)?;
    let place = FlashRegion::Target(target).range().start;
    let whole = is_intact(flash, place, &manifest) == Ok(true)
        && (target != ImageTarget::Staging
            || body_crc(flash, place, manifest.length) == Ok(manifest.crc));
    whole.then(|| Image {
        version: manifest.version,
        security_counter: manifest.security_counter,
        authentic: trust.is_authentic(&bytes, 0),
    })
}

/// Derives a boot environment from the slots: of two intact images the older one is active and the
/// newer one on trial. Used if the controller is new or has lost both copies. What was refused is
/// then not known: a controller that has lost it refuses all that is older than its images, or not
/// signed by the newest key. A new controller has logged nothing.
#[inline(never)]
fn rebuild(flash: &mut impl NorFlash, setup: &Setup<'_>, is_new: bool) -> Environment {
    let mut environment = Environment::default();
    if !is_new {
        environment.lowest_key = setup.trust.keys.len().saturating_sub(1) as u8;
    }
    let versions = &mut environment.versions;
    let mut authentic = true;
    let mut find = |kind: fn(Slot) -> ImageTarget| {
        let mut version = |slot| {
            let image = inspect(flash, &setup.trust, kind(slot))?;
            let taken = image.authentic || setup.trust.mode == TrustMode::Monitor;
            authentic &= image.authentic;
            if image.authentic {
                let lowest = &mut versions[kind(slot).kind() as usize];
                *lowest = image.version.max(*lowest);
            }
            taken.then_some((image.version, slot))
        };
        match [version(Slot::A), version(Slot::B)] {
            [Some(a), Some(b)] if a.0 <= b.0 => (Some(a.1), Some(b.1)),
            [Some(a), Some(b)] => (Some(b.1), Some(a.1)),
            [a, b] => (a.or(b).map(|(_, slot)| slot), None),
        }
    };
    let (application, newer_application) = find(ImageTarget::Application);
    let (configuration, newer_configuration) = find(ImageTarget::Configuration);
    environment.active = Selection {
        application,
        configuration,
    };
    let newer = Selection {
        application: newer_application,
        configuration: newer_configuration,
    };
    environment.trial = (newer != Selection::default()).then_some(Trial {
        selection: newer,
        executed: false,
        ready: false,
        authentic,
    });
    environment
}

fn raise_to_active(flash: &mut impl NorFlash, environment: &mut Environment) {
    let Selection {
        application,
        configuration,
    } = environment.active;
    let application = application.map(ImageTarget::Application);
    for target in application
        .into_iter()
        .chain(configuration.map(ImageTarget::Configuration))
    {
        if let Some(manifest) = manifest_at(flash, target) {
            raise(environment, &manifest);
        }
    }
}

/// Raises the lowest accepted version and key to those of an approved image.
fn raise(environment: &mut Environment, manifest: &Manifest) {
    let version = &mut environment.versions[manifest.kind as usize];
    *version = manifest.version.max(*version);
    environment.lowest_key = manifest.lowest_key.max(environment.lowest_key);
}

/// Approves the running application and its configuration: from now on they boot, and older
/// versions are refused. Does nothing if nothing is on trial. U-3
///
/// The application calls it in task context on one core, once it works. Blocks while the flash is
/// busy.
///
/// # Errors
/// [`FlashFault`] if the flash cannot be read or written; try again.
pub fn approve(flash: &mut impl NorFlash) -> Result<(), FlashFault> {
    let Some(mut store) = EnvironmentStore::load(flash) else {
        return Err(FlashFault);
    };
    let mut environment = *store.get();
    let Some(Trial {
        selection,
        executed: true,
        authentic,
        ..
    }) = environment.trial
    else {
        return Ok(());
    };
    environment.active = selection.over(environment.active);
    environment.trial = None;
    if authentic {
        raise_to_active(flash, &mut environment);
    }
    store.write(flash, environment)?;
    let _ = append(flash, LogEvent::Approved, environment.versions[0]);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trust::ed25519;

    /// T-BOOT-1: tests the whole table of the entry rule.
    #[test]
    fn a_host_may_connect_at_power_on_or_on_request_only() {
        use ResetCause::{Download, PowerOn, Software, Trap, Watchdog};
        let now = Instant::from_ns(5);
        for (cause, expected) in [
            (PowerOn, Some(CONNECT_WINDOW)),
            (Software, None),
            (Watchdog, None),
            (Trap, None),
            (Download, Some(HOST_SILENCE)),
        ] {
            let setup = Setup {
                trust: Trust {
                    keys: &[],
                    testers: &[],
                    mode: TrustMode::Strict,
                    verify: ed25519,
                },
                system: SystemId::A,
                bank: Bank::Primary,
                cause,
                starts: 1,
                counter: 0,
                noise: [0; 32],
            };
            let expected = expected.map_or(Entry::Never, |span| Entry::Until(now + span));
            assert_eq!(entry(&setup, now), expected, "{cause:?}");
        }
    }
}
