//! `tandem boot-demo`: a download over CAN to an empty controller, its start, and the frames of its
//! three cores. T-BOOT-8

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail, ensure};
use tandem_board::{CanFrame, CanId, CoreId, Duration, Instant, SystemId, VehiclePort};
use tandem_board_host::{HostVehiclePort, Launcher, Plan, Schedule, VehicleArgs};
use tandem_board_qemu::{BootFrom, EmulatedWorld};
use tandem_boot::{FIRST_ID, Slot};
use tandem_boot_host::{FlashFile, Sender, SigningKey, ToDo, records};

use crate::args::{BootDemoArgs, DemoBoard};
use crate::boot::{self, ProgramFlash};
use crate::emulated;
use crate::files::RunFiles;
use crate::run::this_program;
use crate::run_config::{Profile, RunConfig};
use crate::three_frames::NAME;

/// The controller under test; the other one has an empty flash and waits.
const SYSTEM: SystemId = SystemId::A;
/// Records under way.
const WINDOW: u8 = 16;
/// Frames in a millisecond: what a bus of 500 kbit/s carries.
const FRAMES_PER_MS: usize = 3;
/// Download and start take seconds.
const PATIENCE: Duration = Duration::from_ms(120_000);

/// Plays it; what to print.
///
/// # Errors
/// If the board cannot be started, the download is refused, or a frame does not come.
pub(crate) fn run(args: &BootDemoArgs) -> anyhow::Result<String> {
    let key = boot::new_key()?;
    match args.board {
        DemoBoard::Host => on_host(&key),
        DemoBoard::Qemu => on_qemu(args, &key),
    }
}

fn on_host(key: &SigningKey) -> anyhow::Result<String> {
    let mut launcher = Launcher::prepare()?;
    let files = RunFiles::of(launcher.isolation().run());
    let lines = records(NAME, &[&boot::application(NAME, Slot::A, 1, key)]);
    let demo = [files.update(SYSTEM), files.updated()];
    boot::write_lines(&demo[0], &lines)?;
    let flashes = SystemId::ALL.map(|system| files.program_flash(system));
    let config = RunConfig {
        scenario: String::new(),
        seed: 0,
        duration_s: 0.0,
        profile: Profile::Desktop,
        reintegrate: false,
        program_flash: Some(ProgramFlash::empty(flashes, key)?),
        update: None,
        demo: Some(demo.clone()),
    };
    let plan = Plan {
        schedule: Schedule::default(),
        flash: SystemId::ALL.map(|system| files.flash(system)),
        extra: config.to_extra()?,
    };
    launcher.start(&plan, &|args| this_program(args))?;
    let ended = launcher.wait();
    let told = fs::read_to_string(&demo[1]);
    launcher.finish();
    ensure!(!ended.interrupted, "ended early");
    told.map_err(|_| anyhow!("the vehicle has seen no application"))
}

/// The vehicle's part on the host.
///
/// # Errors
/// As [`download`], or if the run is over.
pub(crate) fn play(args: &VehicleArgs, [lines, told]: &[PathBuf; 2]) -> anyhow::Result<()> {
    let mut port =
        HostVehiclePort::attach(args).context("the vehicle cannot connect to the run")?;
    let text = fs::read_to_string(lines).with_context(|| lines.display().to_string())?;
    let lines = text.split_inclusive('\n').map(str::to_owned).collect();
    let shown = download(&mut port, lines);
    port.set_ignition(false);
    fs::write(told, shown?).with_context(|| told.display().to_string())
}

fn on_qemu(args: &BootDemoArgs, key: &SigningKey) -> anyhow::Result<String> {
    let image = |name: &str| {
        let chosen = args.images.as_ref().map(|folder| folder.join(name));
        emulated::image(name, chosen.as_deref())
    };
    let (bootloader, application) = (image("bootloader")?, image("slot-frames")?);
    let elf = fs::read(&application).with_context(|| application.display().to_string())?;
    let lines = records(NAME, &[&boot::of_elf(&elf, 1, key)?]);
    let folder = tempfile::tempdir().context("a folder for the program flash")?;
    let flash = folder.path().join("A.pflash");
    FlashFile::open(&flash).with_context(|| flash.display().to_string())?;
    let mut world = emulated_system(&bootloader, flash, key)?;
    download(&mut world, lines).with_context(|| world.log())
}

fn emulated_system(
    bootloader: &Path,
    flash: PathBuf,
    key: &SigningKey,
) -> anyhow::Result<EmulatedWorld> {
    let from = BootFrom {
        flash,
        public: key.public(),
    };
    Ok(EmulatedWorld::start_booting(
        bootloader,
        false,
        &[(SYSTEM, from)],
    )?)
}

/// Downloads to an empty controller, and waits for a frame of each core; what came.
///
/// # Errors
/// If the board fails, the download is refused, or a frame does not come.
fn download<P>(port: &mut P, lines: Vec<String>) -> anyhow::Result<String>
where
    P: VehiclePort<Error: std::error::Error + Send + Sync + 'static>,
{
    let count = lines.len();
    let mut sender = Sender::new(lines, Some(SYSTEM), WINDOW);
    let mut accepted = None;
    let mut came: [Option<(Instant, CanFrame)>; CoreId::COUNT] = [None; CoreId::COUNT];
    port.set_ignition(true);
    let begin = port.now();
    while came.iter().any(Option::is_none) {
        port.tick()?;
        let now = port.now();
        ensure!(
            now.since(begin) < PATIENCE,
            "not all cores send: {came:?}, records {:?}",
            sender.progress()
        );
        ensure!(!port.stop_requested(), "ended early");
        port.transmitted(&mut |system, core, sent| {
            sender.on_frame(now, &sent.frame);
            let id = CanId::Standard(FIRST_ID + core.index() as u16);
            if system == SYSTEM && sent.frame.id() == id {
                came[core.index()].get_or_insert((now, sent.frame));
            }
        });
        port.drain_trace(&mut |_| {});
        for _ in 0..FRAMES_PER_MS {
            match sender.next(now) {
                ToDo::Send(frame) => {
                    port.broadcast(&frame);
                }
                ToDo::Wait(_) => break,
                ToDo::Done => {
                    accepted.get_or_insert(now);
                    break;
                }
                ToDo::Refused(refusal) => bail!("the bootloader refuses the file: {refusal:?}"),
                ToDo::Silent => bail!("the bootloader does not answer"),
            }
        }
        port.ring_receivers();
    }
    let accepted = accepted.context("an application runs that was not downloaded")?;
    let ms = |from: Instant, to: Instant| to.since(from).as_ms_f64();
    let mut shown = format!(
        "downloaded {count} records in {:.0} ms to {SYSTEM}\n",
        ms(begin, accepted)
    );
    for (core, (at, frame)) in CoreId::ALL.into_iter().zip(came.into_iter().flatten()) {
        let CanId::Standard(id) = frame.id() else {
            continue;
        };
        // Writing to a string does not fail.
        let _ = writeln!(
            shown,
            "{:8.1} ms  core {core}  {id:03X}#{:02X}",
            ms(accepted, at),
            frame.data()[0]
        );
    }
    Ok(shown)
}
