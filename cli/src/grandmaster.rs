//! The grandmaster of time: a process that all clocks of a network follow, by gPTP. S-2
//!
//! `tandem run --grandmaster` starts one beside the run; `tandem grandmaster` is one for any run on
//! its network. A run goes on without it: the clocks that followed it are in holdover.

use std::ffi::OsString;
use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use serde::{Deserialize, Serialize};
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board_host::clock;
use tandem_board_udp::UdpPlace;
use tandem_timesync::{Arbitrary, Scale, Tai};

use crate::args::{GrandmasterArgs, GrandmasterScale};
use crate::companion::{self, Companion, CompanionKind};
use crate::failure::Failure;
use crate::gptp::Grandmaster;
use crate::topics;

const KIND: CompanionKind = CompanionKind {
    command: "grandmaster",
    whose: "the grandmaster",
    causes: "the vehicle's time goes on without it",
};
/// The longest wait before the end is seen.
const TURN: tandem_board::Duration = tandem_board::Duration::from_ms(20);
/// How far TAI is ahead of UTC, since 2017.
const LEAP_SECONDS: u64 = 37;

/// What the process leaves.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
struct GrandmasterRecord {
    /// By how much its time is later than the clock of the machine, ns.
    ahead_ns: u64,
}

/// The grandmaster of a run that has ended.
#[derive(Clone, Debug, Default)]
pub struct GrandmasterEnd {
    /// By how much its time was later than the run's clock, ns; `None` if it has never begun.
    pub ahead_ns: Option<u64>,
    /// How its process ended before the run did; `None` if it did not.
    pub died: Option<String>,
}

/// The grandmaster's process, as seen by `tandem run`. Dropping it ends the process.
pub(crate) struct GrandmasterProcess {
    leaves: PathBuf,
    process: Companion,
}

impl GrandmasterProcess {
    /// Starts the process. Also returns its id.
    ///
    /// # Errors
    /// If the process does not start.
    pub(crate) fn start(
        scale: GrandmasterScale,
        place: UdpPlace,
        leaves: PathBuf,
        realtime: bool,
    ) -> anyhow::Result<(Self, u32)> {
        let mut words: Vec<OsString> = vec![
            format!("--domain={}", place.domain()).into(),
            format!("--interface={}", place.interface()).into(),
            format!("--scale={scale}").into(),
            "--leaves".into(),
            leaves.clone().into(),
        ];
        words.extend(realtime.then(|| "--realtime".into()));
        let (process, pid) = Companion::start(KIND, &leaves, words)?;
        Ok((Self { leaves, process }, pid))
    }

    /// Ends the process. Kills it if it does not end.
    pub(crate) fn end(mut self) -> GrandmasterEnd {
        let died = self.process.end();
        let record = fs::read(&self.leaves).ok();
        let record = record.and_then(|text| serde_json::from_slice(&text).ok());
        GrandmasterEnd {
            ahead_ns: record.map(|it: GrandmasterRecord| it.ahead_ns),
            died,
        }
    }
}

/// Runs the process, until the run ends or until Ctrl-C.
///
/// # Errors
/// [`Failure::Usage`] if its sockets cannot be opened; [`Failure::Run`] if its file fails.
pub fn run(args: &GrandmasterArgs) -> Result<(), Failure> {
    let place = UdpPlace::new(args.domain, args.interface).map_err(Failure::usage)?;
    match args.scale {
        GrandmasterScale::Arbitrary => give::<Arbitrary>(args, place, 0),
        GrandmasterScale::Tai => {
            // Once: a clock of the machine that is set later leaps alone.
            let ([at, _], utc_ns) = clock::with_utc().context("the machine's clocks")?;
            let tai_ns = utc_ns + LEAP_SECONDS * 1_000_000_000;
            give::<Tai>(args, place, tai_ns.saturating_sub(at.as_ns()))
        }
    }
}

fn give<S: Scale>(args: &GrandmasterArgs, place: UdpPlace, ahead_ns: u64) -> Result<(), Failure> {
    let over = match &args.leaves {
        Some(leaves) => {
            let record = serde_json::to_vec(&GrandmasterRecord { ahead_ns })?;
            fs::write(leaves, record).with_context(|| leaves.display().to_string())?;
            companion::begin(args.realtime)?
        }
        None => {
            // A message that waits between its stamp and its sending has a wrong stamp.
            companion::claim_realtime();
            until_signal()?
        }
    };
    let opened = Grandmaster::<S>::open(place, ahead_ns);
    let mut grandmaster = opened.map_err(|error| topics::no_participant(place, &error))?;
    if args.leaves.is_none() {
        let (domain, interface) = (place.domain(), place.interface());
        let text = format!("gives {} in domain {domain} on {interface}\n", S::NAME);
        crate::print(&text)?;
    }
    let begin = Instant::now();
    let span = args.duration.map(Duration::from_secs_f64);
    let mut others = false;
    while !over.load(Ordering::Relaxed) && span.is_none_or(|span| begin.elapsed() < span) {
        grandmaster.turn(clock::now() + TURN);
        if grandmaster.others() > 0 && !std::mem::replace(&mut others, true) {
            eprintln!("another grandmaster is in the domain: each clock follows one of both");
        }
    }
    Ok(())
}

/// Returns what becomes true at Ctrl-C.
fn until_signal() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("Ctrl-C")?;
    }
    Ok(stop)
}
