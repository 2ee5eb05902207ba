//! The ADAS computer of a run (`tandem run --soc`): a process that parks the vehicle over DDS.
//!
//! If the process dies, the controller stops the vehicle by itself.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use tandem_board_host::clock;
use tandem_board_udp::UdpPlace;
use tandem_record::log::VehicleRecord;
use tandem_record::{Entry, RunLog};
use tandem_topics_host::approach::{Approach, ApproachPhase};
use tandem_topics_host::soc::Soc;

use crate::args::SocArgs;
use crate::companion::{self, Companion, CompanionKind};
use crate::failure::Failure;
use crate::gptp::Follower;
use crate::topics::{self, IdFigures};

const KIND: CompanionKind = CompanionKind {
    command: "soc",
    whose: "the SoC",
    causes: "the controller stops the vehicle",
};
/// Interval at which it records its time.
const TELLS_EVERY: Duration = Duration::from_millis(100);
/// Interval at which the process writes what it has heard.
const SAVES_EVERY: Duration = Duration::from_millis(500);

/// A change of the phase of parking.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct PhaseRecord {
    /// Time on the clock of the run, ns.
    at_ns: u64,
    phase: String,
    driven_m: f32,
}

/// The phases so far.
#[derive(Clone, Debug, Default)]
struct Phases(Vec<PhaseRecord>, Option<ApproachPhase>);

impl Phases {
    /// Notes the phase at this time. Returns whether it has changed.
    fn note(&mut self, now: tandem_board::Instant, soc: &Soc) -> bool {
        let Self(phases, last) = self;
        let phase = soc.approach().phase();
        let has_changed = last.replace(phase) != Some(phase);
        if has_changed {
            phases.push(PhaseRecord {
                at_ns: now.as_ns(),
                phase: phase.to_string(),
                driven_m: soc.approach().driven(),
            });
        }
        has_changed
    }
}

/// What the process writes into its file.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct SocRecord {
    way_m: f32,
    driven_m: f32,
    is_parked: bool,
    phases: Vec<PhaseRecord>,
    ids: Vec<IdFigures>,
}

impl SocRecord {
    fn of(soc: &Soc, way_m: f32, phases: &Phases) -> Self {
        let approach = soc.approach();
        let reports = soc.gateway().reports();
        Self {
            way_m,
            driven_m: approach.driven(),
            is_parked: approach.phase() == ApproachPhase::Parked,
            phases: phases.0.clone(),
            ids: reports
                .map(|(id, report)| IdFigures::of(soc.now(), id, report))
                .collect(),
        }
    }

    /// Replaces the file atomically, so that the run never reads half of it.
    fn write(&self, path: &Path) -> anyhow::Result<()> {
        let next = path.with_extension("next");
        let shown = || path.display().to_string();
        fs::write(&next, serde_json::to_vec(self)?).with_context(shown)?;
        fs::rename(&next, path).with_context(shown)
    }
}

/// How the SoC of a run has ended.
#[derive(Clone, Debug, Default)]
pub struct SocEnd {
    /// What it left.
    pub record: SocRecord,
    /// How its process ended before the run did; `None` if it did not.
    pub died: Option<String>,
}

impl SocEnd {
    /// Returns why the vehicle was not parked; `None` if it was.
    pub fn not_parked(&self) -> Option<String> {
        let record = &self.record;
        let phase = record.phases.last();
        match (&self.died, phase) {
            _ if record.is_parked => None,
            (Some(died), _) => Some(format!(
                "its process ended ({died}), {:.2} m driven",
                record.driven_m
            )),
            (None, Some(last)) => Some(format!(
                "{}, {:.2} of {} m driven",
                last.phase, record.driven_m, record.way_m
            )),
            (None, None) => Some("its process left no record".to_owned()),
        }
    }
}

/// A change of the phase of parking, in `metrics.json`.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct PhaseFigures {
    /// Scenario time, s.
    pub(crate) at_s: f64,
    /// The phase, in words.
    pub(crate) phase: String,
    /// Way driven until then, m.
    pub(crate) driven_m: f32,
}

/// The section `soc` of `metrics.json`.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct SocFigures {
    /// The vehicle was parked.
    pub(crate) parked: bool,
    /// Why not.
    pub(crate) not_parked: Option<String>,
    /// Way that was to be driven, m.
    pub(crate) way_m: f32,
    /// Way that was driven while the function parked, m.
    pub(crate) driven_m: f32,
    /// Frames that neither system has published.
    pub(crate) lost: u64,
    /// The phases, in order.
    pub(crate) phases: Vec<PhaseFigures>,
    /// What the SoC heard, by id of the frame.
    pub(crate) ids: Vec<IdFigures>,
}

impl SocFigures {
    pub(crate) fn of(end: &SocEnd, log: &RunLog) -> Self {
        let SocRecord {
            way_m,
            driven_m,
            is_parked,
            phases,
            ids,
        } = &end.record;
        let phases = phases.iter().map(|it| PhaseFigures {
            at_s: log.seconds(it.at_ns),
            phase: it.phase.clone(),
            driven_m: it.driven_m,
        });
        Self {
            parked: *is_parked,
            not_parked: end.not_parked(),
            way_m: *way_m,
            driven_m: *driven_m,
            lost: ids.iter().map(|id| id.lost).sum(),
            phases: phases.collect(),
            ids: ids.clone(),
        }
    }
}

/// The SoC's process, as seen by `tandem run`. Dropping it ends the process.
pub(crate) struct SocProcess {
    leaves: PathBuf,
    process: Companion,
}

impl SocProcess {
    /// Starts the process, with these arguments. Also returns its id.
    ///
    /// # Errors
    /// If the process does not start.
    pub(crate) fn start(args: SocArgs) -> anyhow::Result<(Self, u32)> {
        let SocArgs {
            park,
            place,
            leaves,
            times,
            realtime,
        } = args;
        let mut words: Vec<OsString> = vec![
            format!("--park={park}").into(),
            format!("--place={place}").into(),
            "--leaves".into(),
            leaves.clone().into(),
            "--times".into(),
            times.into(),
        ];
        words.extend(realtime.then(|| "--realtime".into()));
        let (process, pid) = Companion::start(KIND, &leaves, words)?;
        Ok((Self { leaves, process }, pid))
    }

    /// Ends the process. Kills it if it does not end. Returns what it left.
    pub(crate) fn end(mut self) -> SocEnd {
        let died = self.process.end();
        let record = fs::read(&self.leaves).ok();
        let record = record.and_then(|text| serde_json::from_slice(&text).ok());
        SocEnd {
            record: record.unwrap_or_default(),
            died,
        }
    }
}

/// Runs the SoC's process, until SIGTERM.
///
/// # Errors
/// [`Failure::Usage`] if no participant can be opened; [`Failure::Run`] if its sockets or its file
/// fail.
pub fn run(args: &SocArgs) -> Result<(), Failure> {
    let is_over = companion::begin(args.realtime)?;
    let mut soc = topics::open_soc(args.place, None, Approach::new(args.park))?;
    let mut time = SocClock::open(args)?;
    let mut phases = Phases::default();
    let mut saved: Option<Instant> = None;
    while !is_over.load(Ordering::Relaxed) {
        topics::turn_soc(&mut soc)?;
        time.turn()?;
        let has_changed = phases.note(clock::now(), &soc);
        if has_changed || saved.is_none_or(|saved| saved.elapsed() > SAVES_EVERY) {
            saved = Some(Instant::now());
            SocRecord::of(&soc, args.park, &phases).write(&args.leaves)?;
        }
    }
    SocRecord::of(&soc, args.park, &phases).write(&args.leaves)?;
    Ok(())
}

/// The SoC's time: it follows the grandmaster, and records how well. S-1
struct SocClock {
    follower: Follower,
    records: File,
    told: Instant,
}

impl SocClock {
    fn open(args: &SocArgs) -> Result<Self, Failure> {
        let follower = Follower::open(args.place);
        let records = File::create(&args.times);
        Ok(Self {
            follower: follower.map_err(|error| topics::no_participant(args.place, &error))?,
            records: records.with_context(|| args.times.display().to_string())?,
            told: Instant::now(),
        })
    }

    fn turn(&mut self) -> anyhow::Result<()> {
        self.follower.turn();
        if self.told.elapsed() < TELLS_EVERY {
            return Ok(());
        }
        self.told = Instant::now();
        let entry = Entry::from(VehicleRecord::SocTime(self.follower.state()));
        let mut bytes = vec![];
        entry.write(&mut bytes)?;
        self.records.write_all(&bytes).context("the SoC's time")
    }
}

/// The SoC of emulated systems: part of the run's process, because it has their time.
#[derive(Debug)]
pub struct EmulatedSoc {
    soc: Soc,
    way_m: f32,
    phases: Phases,
}

impl EmulatedSoc {
    /// Opens its participant. It parks after `way_m`.
    ///
    /// # Errors
    /// [`Failure::Usage`] if no participant can be opened.
    pub fn open(place: UdpPlace, way_m: f32) -> Result<Self, Failure> {
        Ok(Self {
            soc: topics::open_soc(place, None, Approach::new(way_m))?,
            way_m,
            phases: Phases::default(),
        })
    }

    /// Does what is due at this time of the systems; to be called every millisecond of it.
    pub fn turn_at(&mut self, now: tandem_board::Instant) {
        // The sockets fail only at a signal, which ends the run.
        let _interrupted = self.soc.turn_at(now);
        self.phases.note(now, &self.soc);
    }

    /// Returns how it has ended.
    #[must_use]
    pub fn end(&self) -> SocEnd {
        SocEnd {
            record: SocRecord::of(&self.soc, self.way_m, &self.phases),
            died: None,
        }
    }
}
