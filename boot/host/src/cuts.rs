//! Losses of power at every point of an update, and the checks afterwards.
//!
//! A *point* is a moment of an erase or program operation in a life, together with the state of
//! the changing bits after the loss of power. The caller supplies a function that runs a life, in
//! a new process or, as a [`Life`], in this process. U-5

use crate::life::{End, Life, LifeOutcome, TEST_KEY};
use crate::{FlashTraits, Image, ReleaseInfo, SimulatedFlash, Tear, records};
use strum::{FromRepr, VariantArray};
use tandem_boot::{
    Bank, Environment, EnvironmentStore, FlashRegion, ImageTarget, Manifest, SIGNED_BYTES, Slot,
    rom_choice,
};

/// The update during which power is lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
pub enum CutScenario {
    /// A download to the free slot, trial, approval.
    Application,
    /// Application and configuration in one file.
    Both,
    /// The rollback of a trial that was not approved.
    Rollback,
    /// A new bootloader is downloaded, installed, tried, approved and sealed.
    Bootloader,
    /// As `Bootloader`, with a new bootloader that crashes.
    CrashingBootloader,
    /// The repair of a damaged primary bank.
    DamagedBootloader,
    /// The recovery after both copies of the environment were lost.
    LostEnvironment,
    /// The download of a file that is refused at its end.
    RefusedFile,
}

/// A defect of the wiring. The sweep must find bricks if it is present.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WiringDefect {
    /// Both slots of the application are the same memory: a download overwrites the active image.
    OneSlot,
    /// Both banks of the bootloader are the same memory: an update overwrites the backup.
    OneBank,
}

/// What is swept.
#[derive(Clone, Copy, Debug)]
pub struct CutCase {
    /// The update.
    pub scenario: CutScenario,
    /// The defect, if bricks are expected.
    pub defect: Option<WiringDefect>,
    /// The type of flash.
    pub traits: FlashTraits,
}

impl CutCase {
    /// An update of a sound controller with a flash that erases to 0xFF and has no ECC.
    #[must_use]
    pub fn plain(scenario: CutScenario) -> Self {
        Self {
            scenario,
            defect: None,
            traits: FlashTraits::default(),
        }
    }
}

/// The plan of one life: its actions, and the loss of power.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LifePlan {
    /// Whether the host sends the scenario's file; otherwise the life is a plain start.
    pub acts: bool,
    /// Seed of the noise in weak bits.
    pub seed: u64,
    /// Ticks until power is lost, and the state of the changing bits.
    pub cut: Option<(u64, Tear)>,
}

/// A scenario with its images.
#[derive(Debug)]
pub struct Stage {
    case: CutCase,
    lines: Vec<String>,
    start: Vec<u8>,
    applications: [Image; 2],
    configurations: [Image; 2],
    bootloaders: [Image; 2],
}

fn release(version: u32, entry: u32) -> ReleaseInfo {
    ReleaseInfo {
        version,
        entries: [entry; 3],
        lowest_key: 0,
        ..ReleaseInfo::default()
    }
}

fn sign(target: ImageTarget, version: u32, len: u32) -> Image {
    let body: Vec<u8> = (0..len).map(|at| (at * 7 + version) as u8).collect();
    Image::sign(target, release(version, 256), &[(256, &body)], &TEST_KEY)
}

impl Stage {
    /// Sets up a scenario with a controller that left the factory and was started once.
    ///
    /// # Panics
    /// If the controller does not boot even without a loss of power.
    #[must_use]
    pub fn new(case: CutCase) -> Self {
        let scenario = case.scenario;
        let applications = [(Slot::A, 1), (Slot::B, 2)];
        let applications =
            applications.map(|(slot, v)| sign(ImageTarget::Application(slot), v, 400));
        let configurations = [(Slot::A, 1), (Slot::B, 2)];
        let configurations =
            configurations.map(|(slot, v)| sign(ImageTarget::Configuration(slot), v, 33));
        let bootloaders = [1, 2].map(|version| sign(ImageTarget::Staging, version, 90));
        let mut flash = SimulatedFlash::new().with_traits(case.traits);
        for bank in [Bank::Primary, Bank::Backup] {
            flash.load(FlashRegion::Bank(bank).range().start, &bootloaders[0].bytes);
        }
        for image in [&applications[0], &configurations[0]] {
            flash.load(image.place(), &image.bytes);
        }
        let wanted: &[&Image] = match scenario {
            CutScenario::Application | CutScenario::Rollback | CutScenario::RefusedFile => {
                &[&applications[1]]
            }
            CutScenario::Both => &[&applications[1], &configurations[1]],
            CutScenario::Bootloader | CutScenario::CrashingBootloader => &[&bootloaders[1]],
            CutScenario::DamagedBootloader | CutScenario::LostEnvironment => &[],
        };
        let mut lines = records("update", wanted);
        if scenario == CutScenario::RefusedFile {
            let address = (applications[1].place() + 256).to_be_bytes();
            let wrong = lines.iter_mut().rfind(|line| line[4..12] == hex(&address));
            assert!(wrong.is_some(), "the body begins there");
            wrong
                .into_iter()
                .for_each(|line| *line = crate::line(3, &address, &[0xEE; 16]));
        }
        let mut stage = Self {
            case,
            lines,
            start: Vec::new(),
            applications,
            configurations,
            bootloaders,
        };
        stage.prepare(&mut flash);
        stage.start = flash.save();
        stage
    }

    fn prepare(&self, flash: &mut SimulatedFlash) {
        let plain = Life::plain();
        assert!(matches!(plain.live(flash).end, End::Running(_)));
        match self.case.scenario {
            CutScenario::Rollback => {
                let unapproved = Life {
                    file: Some((&self.lines, 0)),
                    approves: false,
                    ..plain
                };
                assert!(unapproved.live(flash).downloaded);
            }
            CutScenario::DamagedBootloader => flash.load(0x100, &[0; 64]),
            CutScenario::LostEnvironment => {
                let new = &self.applications[1];
                flash.load(new.place(), &new.bytes);
                for copy in [0, 1] {
                    flash.load(FlashRegion::Environment(copy).range().start, &[0; 0x4000]);
                }
            }
            _ => {}
        }
    }

    /// Returns the flash before the first life.
    #[must_use]
    pub fn start(&self) -> &[u8] {
        &self.start
    }

    /// Returns the file that the host sends; empty if there is no host.
    #[must_use]
    pub fn lines(&self) -> &[String] {
        match self.case.scenario {
            CutScenario::Rollback => &[],
            _ => &self.lines,
        }
    }

    /// Runs one life in this process: see [`live`].
    #[must_use]
    pub fn live(&self, flash: &[u8], step: LifePlan) -> Option<(LifeOutcome, u64, SimulatedFlash)> {
        live(self.case, self.lines(), flash, step)
    }

    /// Describes what is wrong with a controller after a life without a loss of power. Returns
    /// `None` if it runs an old or a new image that is intact and has no weak bit, under an intact
    /// bootloader.
    #[must_use]
    pub fn brick(&self, outcome: &LifeOutcome, flash: &mut SimulatedFlash) -> Option<String> {
        let End::Running(launch) = outcome.end else {
            return Some(format!("{:?}", outcome.end));
        };
        let holds = |flash: &SimulatedFlash, place: u32, images: &[Image; 2]| {
            let firm = |image: &Image| flash.firm(place, image.bytes.len() as u32);
            images
                .iter()
                .any(|image| firm(image).is_some_and(|bytes| bytes == image.bytes))
        };
        let place = |target| FlashRegion::Target(target).range().start;
        let application = place(ImageTarget::Application(launch.application));
        if !holds(flash, application, &self.applications) {
            return Some(format!("runs a damaged image: {launch:?}"));
        }
        let configuration = launch.configuration.map(ImageTarget::Configuration);
        if !configuration.is_some_and(|target| holds(flash, place(target), &self.configurations)) {
            return Some(format!("has lost its configuration: {launch:?}"));
        }
        let Some(bank) = rom_choice(flash) else {
            return Some("no bootloader".into());
        };
        let running = FlashRegion::Bank(bank).range().start;
        if !holds(flash, running, &self.bootloaders) {
            return Some(format!("runs a damaged bootloader from {bank:?}"));
        }
        None
    }
}

/// Runs one life. Returns its outcome, its ticks, and the flash afterwards; `None` if `flash` does
/// not decode.
#[must_use]
pub fn live(
    case: CutCase,
    lines: &[String],
    flash: &[u8],
    step: LifePlan,
) -> Option<(LifeOutcome, u64, SimulatedFlash)> {
    let mut flash = SimulatedFlash::restore(flash)?.with_traits(case.traits);
    if let Some(defect) = case.defect {
        let application = |slot| FlashRegion::Target(ImageTarget::Application(slot)).range();
        let (range, place) = match defect {
            WiringDefect::OneSlot => (application(Slot::B), application(Slot::A).start),
            WiringDefect::OneBank => (FlashRegion::Bank(Bank::Backup).range(), 0),
        };
        flash = flash.with_alias(range, place);
    }
    flash.power_on(step.seed, step.cut);
    let life = Life {
        file: (step.acts && !lines.is_empty()).then_some((lines, 0)),
        new_loader_crashes: case.scenario == CutScenario::CrashingBootloader,
        ..Life::plain()
    };
    let outcome = life.live(&mut flash);
    let ticks = flash.ticks();
    Some((outcome, ticks, flash))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect()
}

/// The result of a sweep.
#[derive(Clone, Debug, Default)]
pub struct Swept {
    /// Number of points at which power was lost.
    pub points: u64,
    /// Number of points with a second loss during the recovery from the first.
    pub double: u64,
    /// Descriptions of the points after which the controller booted no intact image, or accepted
    /// what it refused before.
    pub bricks: Vec<String>,
}

/// Returns what a controller refuses: versions of each kind below these, and keys below the last
/// number; `None` if its environment is lost.
#[must_use]
pub fn floors(flash: &mut SimulatedFlash) -> Option<[u32; 4]> {
    let Environment {
        versions: [application, configuration, bootloader],
        lowest_key,
        ..
    } = *EnvironmentStore::load(flash)?.get();
    let place = FlashRegion::Bank(rom_choice(flash)?).range().start;
    let running = flash.firm(place, SIGNED_BYTES as u32)?;
    let running = Manifest::decode(running.first_chunk()?).ok()?.version;
    Some([
        application,
        configuration,
        bootloader.max(running),
        lowest_key.into(),
    ])
}

/// Describes what is refused no more after a life, if there is any.
fn lowered(before: Option<[u32; 4]>, flash: &mut SimulatedFlash) -> Option<String> {
    let (before, after) = (before?, floors(flash));
    let is_lower = |after: [u32; 4]| before.iter().zip(after).any(|(old, new)| new < *old);
    after
        .is_none_or(is_lower)
        .then(|| format!("refuses less: {before:?}, then {after:?}"))
}

/// The ticks at which power is lost in the first life: every `every`-th, beginning with `from`.
#[derive(Clone, Copy, Debug)]
pub struct TickRange {
    /// The first tick.
    pub from: u64,
    /// The step; 1 for all ticks.
    pub every: u64,
}

/// Sweeps a scenario: power is lost at each of these ticks, and again during the recovery. `live`
/// runs one life, as [`Stage::live`] does.
///
/// # Errors
/// The errors of `live`.
pub fn sweep<E>(
    stage: &Stage,
    which: TickRange,
    mut live: impl FnMut(&[u8], LifePlan) -> Result<(LifeOutcome, u64, SimulatedFlash), E>,
) -> Result<Swept, E> {
    let mut swept = Swept::default();
    let step = |acts, seed, cut| LifePlan { acts, seed, cut };
    let (_, ticks, _) = live(stage.start(), step(true, 0, None))?;
    let (_, _, mut undisturbed) = live(stage.start(), step(false, 0, None))?;
    let before = floors(&mut undisturbed);
    let wrong = |outcome: &LifeOutcome, flash: &mut SimulatedFlash| {
        let brick = stage.brick(outcome, flash);
        brick.or_else(|| lowered(before, flash))
    };
    let ticks = (which.from..ticks).step_by(which.every as usize);
    for (tick, tear) in ticks.flat_map(|tick| Tear::VARIANTS.iter().map(move |tear| (tick, *tear)))
    {
        let (_, _, torn) = live(stage.start(), step(true, tick, Some((tick, tear))))?;
        let torn = torn.save();
        let (outcome, recovery, mut flash) = live(&torn, step(false, tick + 1, None))?;
        swept.points += 1;
        let place = format!("{:?}, {tear:?} at tick {tick}", stage.case.scenario);
        let found = wrong(&outcome, &mut flash).map(|why| format!("{place}: {why}"));
        swept.bricks.extend(found);
        if recovery == 0 {
            continue;
        }
        // Start the same torn flash again and cut that start too: weak bits may read differently.
        let (second_tick, second) = (
            tick * 101 % recovery,
            Tear::VARIANTS[((tick + tear as u64) % 5) as usize],
        );
        let cut = Some((second_tick, second));
        let (_, _, torn) = live(&torn, step(false, tick + 2, cut))?;
        let (outcome, _, mut flash) = live(&torn.save(), step(false, tick + 3, None))?;
        swept.points += 1;
        swept.double += 1;
        let place = format!("{place}, then {second:?} at tick {second_tick}");
        let found = wrong(&outcome, &mut flash).map(|why| format!("{place}: {why}"));
        swept.bricks.extend(found);
    }
    Ok(swept)
}
