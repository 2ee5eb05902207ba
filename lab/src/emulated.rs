//! `tandem run --board qemu`: the controller as firmware in emulated machines, in virtual time.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Instant;

use anyhow::{Context as _, ensure};
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board::SystemId;
use tandem_board_qemu::{
    BootFrom, EmulatedWorld, ImageMachine, LOADER_RAM_AT, MachineOptions, PROGRAM_FLASH_AT,
    WorldLayout,
};
use tandem_boot::{Bank, FlashRegion, ImageTarget};
use tandem_boot_host::{FlashFile, Image, ReleaseInfo, SigningKey, records};

use tandem::args::RunArgs;
use tandem::board_kind::BoardKind;
use tandem::failure::Failure;
use tandem::live::Progress;
use tandem::run::{self, DrivenElsewhere};
use tandem::soc::EmulatedSoc;
use tandem_processes::boot;
use tandem_processes::files::RunFiles;
use tandem_processes::recorder::Recorder;
use tandem_processes::run_config::{RunConfig, UpdateFiles};
use tandem_processes::vehicle;

/// Output folder of `cargo xtask firmware build`, relative to the target folder.
const IMAGES: &str = "firmware/riscv32imac-unknown-none-elf/release";

/// Returns the path of the image to run: `chosen`, or the image with this name that was built.
///
/// # Errors
/// If the file does not exist.
pub(crate) fn image(name: &str, chosen: Option<&Path>) -> anyhow::Result<PathBuf> {
    let image = match chosen {
        Some(image) => image.to_owned(),
        None => std::env::current_exe()
            .context("the path of this program")?
            .ancestors()
            .nth(2)
            .context("this program is not in a build folder: name the image with --firmware")?
            .join(IMAGES)
            .join(name),
    };
    ensure!(
        image.is_file(),
        "there is no image at {}: build it with `cargo xtask firmware build`, or name one with \
         --firmware",
        image.display()
    );
    // The emulator works in another folder, so return an absolute path.
    std::fs::canonicalize(&image).with_context(|| image.display().to_string())
}

/// Signs an application for the emulated board.
///
/// # Errors
/// If the file is not an image for a slot.
pub(crate) fn of_elf(elf: &[u8], version: u32, key: &SigningKey) -> anyhow::Result<Image> {
    let release = ReleaseInfo {
        version,
        paired: true,
        ..ReleaseInfo::default()
    };
    Ok(Image::of_elf(elf, PROGRAM_FLASH_AT, release, key)?)
}

/// Signs a bootloader for the emulated board, as it is staged.
///
/// # Errors
/// If the file is not an image for a bank.
pub(crate) fn bootloader_of_elf(
    elf: &[u8],
    version: u32,
    key: &SigningKey,
) -> anyhow::Result<Image> {
    let release = ReleaseInfo {
        version,
        ..ReleaseInfo::default()
    };
    let staging = FlashRegion::Target(ImageTarget::Staging).range().start;
    Ok(Image::of_elf(elf, LOADER_RAM_AT - staging, release, key)?)
}

/// The images of the controller.
pub(crate) enum Images {
    /// One image that starts without a bootloader.
    Alone(PathBuf),
    /// An image in the slot of each system, and the bootloader that starts it.
    Booting {
        /// The boot ROM.
        rom: PathBuf,
        /// For the banks of the program flash.
        bootloader: PathBuf,
        /// By slot: the factory image, and the update.
        applications: [PathBuf; 2],
    },
}

impl Images {
    /// Returns the images of a run. They include a bootloader, unless both systems share one
    /// machine or the arguments exclude it.
    ///
    /// # Errors
    /// If an image is missing.
    pub(crate) fn of(args: &RunArgs) -> anyhow::Result<Self> {
        if args.firmware.is_some() || args.no_bootloader || args.board == BoardKind::QemuOne {
            return Ok(Self::Alone(image("controller", args.firmware.as_deref())?));
        }
        Ok(Self::Booting {
            rom: image("bootloader", None)?,
            bootloader: image("bank-loader", None)?,
            applications: [
                image("slot-controller", None)?,
                image("slot-controller-b", None)?,
            ],
        })
    }

    /// Returns the machine that the images are built for.
    fn machine(&self) -> anyhow::Result<ImageMachine> {
        let (Self::Alone(image) | Self::Booting { rom: image, .. }) = self;
        ImageMachine::of(image).with_context(|| image.display().to_string())
    }

    /// Starts the machines, with program flashes in `folder`. Also returns the update that the
    /// systems will receive.
    fn start(
        &self,
        layout: WorldLayout,
        args: &RunArgs,
        files: &RunFiles,
        folder: &Path,
    ) -> anyhow::Result<(EmulatedWorld, Option<UpdateFiles>)> {
        let (rom, bootloader, [first, second]) = match self {
            Self::Alone(image) => {
                ensure!(
                    args.update.is_none(),
                    "--update: the systems must start through their bootloaders; use --board qemu \
                     without --firmware"
                );
                let options = MachineOptions {
                    reintegrate: args.reintegrate,
                    ..MachineOptions::default()
                };
                let world = EmulatedWorld::start(image, layout, options)?;
                return Ok((world, None));
            }
            Self::Booting {
                rom,
                bootloader,
                applications,
            } => (rom, bootloader, applications),
        };
        let key = boot::new_key()?;
        let tester = files.tester();
        let public = boot::key_in(&tester)?.public();
        let signed = |application: &Path, release| {
            let elf = std::fs::read(application);
            let elf = elf.with_context(|| application.display().to_string())?;
            of_elf(&elf, release, &key)
        };
        let image = signed(first, 1)?;
        let elf = std::fs::read(bootloader);
        let elf = elf.with_context(|| bootloader.display().to_string())?;
        let loader = bootloader_of_elf(&elf, 1, &key)?;
        let from = SystemId::ALL.map(|system| {
            let from = BootFrom {
                flash: folder.join(format!("{system}.pflash")),
                public: key.public(),
                tester: Some(public),
            };
            (system, from)
        });
        for (_, from) in &from {
            let flash = FlashFile::open(&from.flash).and_then(|flash| {
                for bank in [Bank::Primary, Bank::Backup] {
                    let place = FlashRegion::Bank(bank).range().start;
                    flash.load(place, &loader.bytes)?;
                }
                flash.load(image.place(), &image.bytes)
            });
            flash.with_context(|| from.flash.display().to_string())?;
        }
        let update = match args.update {
            Some(release) => {
                let lines = records(boot::CONTROLLER, &[&signed(second, release)?]);
                Some(UpdateFiles::write(
                    files,
                    [&lines, &lines],
                    release,
                    tester,
                )?)
            }
            None => None,
        };
        let world = EmulatedWorld::start_booting(rom, args.reintegrate, &from)?;
        Ok((world, update))
    }
}

/// Runs `tandem run` on this board.
///
/// # Errors
/// Returns the [`Failure`] whose exit status the command documents.
pub(crate) fn run(args: &RunArgs) -> Result<(), Failure> {
    run::run_elsewhere(args, |config, files| {
        let images = Images::of(args).map_err(Failure::Usage)?;
        drive(args, &images, config, files)
    })
}

/// Drives to the end, or until the user ends the run.
///
/// # Errors
/// If the emulator does not start, hangs or fails, or the network cannot be opened.
fn drive(
    args: &RunArgs,
    images: &Images,
    config: &RunConfig,
    files: &RunFiles,
) -> Result<DrivenElsewhere, Failure> {
    let layout = match args.board {
        BoardKind::QemuOne => WorldLayout::One,
        BoardKind::Host | BoardKind::Qemu => WorldLayout::Two,
    };
    let scenario = config.load_scenario()?;
    let folder = tempfile::tempdir().context("a folder for the program flashes")?;
    let (mut world, update) = images.start(layout, args, files, folder.path())?;
    let config = RunConfig {
        update,
        ..config.clone()
    };
    if !args.quiet {
        for (pid, systems) in world.processes() {
            let names: Vec<_> = systems.iter().map(ToString::to_string).collect();
            eprintln!("emulator of {}: process {pid}", names.join(" and "));
        }
    }
    let soc = connect(args, &mut world)?;
    let recorder = Recorder::create(files)?;
    let begin = Instant::now();
    let progress = (!args.quiet).then(|| Progress::show(files.live(), config.duration_s));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, world.stop_flag()).context("watching for Ctrl-C")?;
    }
    let ended = vehicle::drive(&config, &scenario, &mut world, recorder);
    if let Some(progress) = progress {
        progress.end();
    }
    let ended = ended?;
    if !args.quiet && args.update.is_some() {
        // Show the slot that each system has started, and its approval.
        let log = world.log();
        let of_slots = log.lines().filter(|line| line.contains(" slot"));
        of_slots.for_each(|line| eprintln!("{line}"));
    }
    let machine = images.machine()?;
    let summary = format!(
        "firmware in {}, core 0 {} (QEMU, {machine}): time is the emulator's, an instruction takes \
         1 ns; the run took {:.0} s of this machine's",
        match (layout, images) {
            (WorldLayout::One, _) => "one emulated machine",
            (WorldLayout::Two, Images::Alone(_)) => "two emulated machines",
            (WorldLayout::Two, Images::Booting { .. }) =>
                "two emulated machines, started by their bootloaders",
        },
        match layout == WorldLayout::Two && machine.has_kernel() {
            true => "under FreeRTOS",
            false => "without a kernel",
        },
        begin.elapsed().as_secs_f64()
    );
    Ok(DrivenElsewhere {
        summary,
        ended,
        soc: soc.map(|soc| soc.borrow().end()),
    })
}

/// Connects both systems to the network that the arguments name, and starts the SoC beside them.
fn connect(
    args: &RunArgs,
    world: &mut EmulatedWorld,
) -> Result<Option<Rc<RefCell<EmulatedSoc>>>, Failure> {
    let Some(place) = args.network() else {
        return Ok(None);
    };
    let connected = world.connect_network(place);
    connected
        .with_context(|| format!("no place for both systems at {place}"))
        .map_err(Failure::Usage)?;
    let Some(way) = args.soc else {
        return Ok(None);
    };
    let soc = Rc::new(RefCell::new(EmulatedSoc::open(place, way)?));
    let beside = Rc::clone(&soc);
    world.run_beside(move |now| beside.borrow_mut().turn_at(now));
    Ok(Some(soc))
}
