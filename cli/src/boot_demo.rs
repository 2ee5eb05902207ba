//! `tandem boot-demo`: downloads an application over CAN to an empty controller, starts it, and
//! shows a frame of each of its three cores. T-BOOT-8

use std::fmt;
use std::fs;
use std::path::PathBuf;

use anyhow::{Context as _, anyhow, bail, ensure};
use serde::{Deserialize, Serialize};
use tandem_board::{CanId, CoreId, Duration, Instant, SystemId, VehiclePort};
use tandem_board_host::{HostVehiclePort, LaunchPlan, Launcher, Schedule, VehicleArgs};
use tandem_boot::{FIRST_ID, Slot};
use tandem_boot_host::{FileSender, ToDo, records};
use tandem_page::json::JsonOutput;
use tandem_processes::boot::{self, ProgramFlashes};
use tandem_processes::files::RunFiles;
use tandem_processes::run_config::{RunConfig, write_lines};

use crate::run::this_program;
pub use tandem_processes::three_frames::NAME;

/// The system that receives the download. The other system has an empty flash and waits.
pub const SYSTEM: SystemId = SystemId::A;
/// Largest number of unacknowledged records.
const WINDOW: u8 = 16;
/// Frames per millisecond on a bus of 500 kbit/s.
const FRAMES_PER_MS: usize = 3;
/// The longest time for download and start. Both together take seconds.
const PATIENCE: Duration = Duration::from_ms(120_000);

/// The result of a download to an empty controller, with the first frames of its three cores.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Downloaded {
    /// Number of S-records in the file.
    pub records: usize,
    /// Time from the ignition to the acknowledgement of the last record, ms on the board's clock.
    pub download_ms: f64,
    /// The first frame of each core, by [`CoreId::index`].
    pub frames: [FirstFrame; CoreId::COUNT],
}

impl Downloaded {
    /// Prints it for people, or as JSON.
    ///
    /// # Errors
    /// If stdout or the file cannot be written.
    pub fn show(&self, json_to: JsonOutput) -> anyhow::Result<()> {
        crate::print(&json_to.write(self, || self.to_string())?)
    }
}

/// The first frame of a core.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct FirstFrame {
    /// Time since the acknowledgement of the last record, ms on the board's clock.
    pub after_ms: f64,
    /// Identifier on CAN.
    pub id: u16,
    /// The only data byte: the number of the core.
    pub core: u8,
}

impl fmt::Display for Downloaded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (records, ms) = (self.records, self.download_ms);
        writeln!(f, "downloaded {records} records in {ms:.0} ms to {SYSTEM}")?;
        for (core, frame) in CoreId::ALL.into_iter().zip(&self.frames) {
            let FirstFrame {
                after_ms,
                id,
                core: sent,
            } = frame;
            writeln!(f, "{after_ms:8.1} ms  core {core}  {id:03X}#{sent:02X}")?;
        }
        Ok(())
    }
}

/// Runs the experiment of T-BOOT-8 with processes: downloads the smallest application to an empty
/// controller, starts it, and waits for a frame of each core.
///
/// # Errors
/// If the board does not start, the download is refused, or a frame does not arrive.
pub fn on_host() -> anyhow::Result<Downloaded> {
    let key = &boot::new_key()?;
    let mut launcher = Launcher::prepare()?;
    let files = RunFiles::of(launcher.isolation().run());
    let lines = records(NAME, &[&boot::application(NAME, Slot::A, 1, key)]);
    let demo = [files.update(SYSTEM), files.updated()];
    write_lines(&demo[0], &lines)?;
    let flashes = SystemId::ALL.map(|system| files.program_flash(system));
    let config = RunConfig {
        program_flash: Some(ProgramFlashes::empty(flashes, key, None)?),
        demo: Some(demo.clone()),
        ..RunConfig::default()
    };
    let plan = LaunchPlan {
        schedule: Schedule::default(),
        flash: SystemId::ALL.map(|system| files.flash(system)),
        network: None,
        extra: config.to_extra()?,
    };
    launcher.start(&plan, &|args| this_program(args))?;
    let ended = launcher.wait();
    let result = fs::read_to_string(&demo[1]);
    launcher.finish();
    ensure!(!ended.interrupted, "ended early");
    let result = result.map_err(|_| anyhow!("the vehicle received no frame of an application"))?;
    Ok(serde_json::from_str(&result)?)
}

/// Runs the vehicle's part on the host. Reads the records from `lines`, and writes `result`.
///
/// # Errors
/// See [`download`]; also if the run has ended.
pub(crate) fn play(args: &VehicleArgs, [lines, result]: &[PathBuf; 2]) -> anyhow::Result<()> {
    let mut port =
        HostVehiclePort::attach(args).context("the vehicle cannot connect to the run")?;
    let text = fs::read_to_string(lines).with_context(|| lines.display().to_string())?;
    let lines = text.split_inclusive('\n').map(str::to_owned).collect();
    let shown = download(&mut port, lines);
    port.set_ignition(false);
    let text = serde_json::to_string(&shown?)?;
    fs::write(result, text).with_context(|| result.display().to_string())
}

/// Downloads to an empty controller, and waits for a frame of each core.
///
/// # Errors
/// If the board fails, the download is refused, or a frame does not arrive.
pub fn download<P>(port: &mut P, lines: Vec<String>) -> anyhow::Result<Downloaded>
where
    P: VehiclePort<Error: std::error::Error + Send + Sync + 'static>,
{
    let count = lines.len();
    let mut sender = FileSender::new(lines, Some(SYSTEM), WINDOW);
    let mut accepted = None;
    let mut first: [Option<(Instant, u16, u8)>; CoreId::COUNT] = [None; CoreId::COUNT];
    port.set_ignition(true);
    let begin = port.now();
    while first.iter().any(Option::is_none) {
        port.tick()?;
        let now = port.now();
        ensure!(
            now.since(begin) < PATIENCE,
            "not all cores send: {first:?}, records {:?}",
            sender.progress()
        );
        ensure!(!port.stop_requested(), "ended early");
        port.transmitted(&mut |system, core, sent| {
            sender.on_frame(now, &sent.frame);
            let id = FIRST_ID + core.index() as u16;
            if let (true, &[number]) = (
                system == SYSTEM && sent.frame.id() == CanId::Standard(id),
                sent.frame.data(),
            ) {
                first[core.index()].get_or_insert((now, id, number));
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
                ToDo::Silent | ToDo::Locked(_) => bail!("the bootloader does not answer"),
            }
        }
        port.ring_receivers();
    }
    let accepted = accepted.context("an application that was not downloaded sends frames")?;
    let ms = |from: Instant, to: Instant| to.since(from).as_ms_f64();
    let frame = |(at, id, core)| FirstFrame {
        after_ms: ms(accepted, at),
        id,
        core,
    };
    let [Some(a), Some(b), Some(c)] = first else {
        bail!("not all cores send: {first:?}");
    };
    Ok(Downloaded {
        records: count,
        download_ms: ms(begin, accepted),
        frames: [a, b, c].map(frame),
    })
}
