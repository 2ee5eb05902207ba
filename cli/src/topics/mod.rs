//! `tandem topics`: shows what is on the topics between the controller and the SoC, and commands.

mod echo;
mod list;
mod tables;
#[cfg(test)]
mod tests;

use std::fs;
use std::io::{self, Write};
use std::mem;
use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use tandem_board::Channel;
use tandem_board_udp::{UdpChannel, UdpPlace};
use tandem_page::json::JsonOutput;
use tandem_qos_profiles::{Profiles, SOC};
use tandem_topics::Endpoint;
use tandem_topics_host::approach::{Approach, ApproachPhase};
use tandem_topics_host::listing::Listing;
use tandem_topics_host::node::Node;
use tandem_topics_host::soc::{Soc, endpoints};

use crate::args::{ProfileName, TopicsArgs, TopicsCommand, TopicsPlace};
use crate::failure::Failure;
pub(crate) use tables::IdFigures;

/// How long `list` listens, s: participants announce themselves each second.
const LISTS_S: f64 = 3.0;
/// How long `rate`, `age` and `loss` listen, s.
const MEASURES_S: f64 = 5.0;
/// After this time without a sample, `echo` says what may be the reason.
const HINT_AFTER: Duration = Duration::from_secs(5);
/// The longest wait before the end of the time or Ctrl-C is seen.
const TURN: Duration = Duration::from_millis(20);
/// The longest wait of the SoC: a quarter of its shortest period.
const SOC_TURN: Duration = Duration::from_millis(5);

/// Runs the command, and prints to stdout.
///
/// # Errors
/// [`Failure::Usage`] for a wrong name or profile, or if no participant can be opened;
/// [`Failure::NothingHeard`]; [`Failure::Run`] if parking was given up.
pub fn run(args: &TopicsArgs) -> Result<(), Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop)).context("Ctrl-C")?;
    }
    let mut out = Out::new(io::stdout());
    run_to(args, &stop, &mut out)
}

fn run_to(args: &TopicsArgs, stop: &AtomicBool, out: &mut Out<impl Write>) -> Result<(), Failure> {
    let place = &args.place;
    out.json = place.json.check().map_err(Failure::usage)?;
    match args.command.as_ref().unwrap_or(&TopicsCommand::List) {
        TopicsCommand::List => list::run(place, &Watch::new(place, Some(LISTS_S), stop), out),
        TopicsCommand::Echo { name } => echo::run(name, place, &Watch::new(place, None, stop), out),
        TopicsCommand::Rate => tables::run(tables::Table::Rate, place, stop, out),
        TopicsCommand::Age => tables::run(tables::Table::Age, place, stop, out),
        TopicsCommand::Loss => tables::run(tables::Table::Loss, place, stop, out),
        TopicsCommand::Soc { park } => soc(*park, place, &Watch::new(place, None, stop), out),
    }
}

/// How long a command listens.
struct Watch<'a> {
    begin: Instant,
    time: Option<Duration>,
    stop: &'a AtomicBool,
}

impl<'a> Watch<'a> {
    fn new(place: &TopicsPlace, default_s: Option<f64>, stop: &'a AtomicBool) -> Self {
        Self {
            begin: Instant::now(),
            time: place.time_s.or(default_s).map(Duration::from_secs_f64),
            stop,
        }
    }

    fn is_interrupted(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn is_over(&self) -> bool {
        let elapsed = self.begin.elapsed();
        self.is_interrupted() || self.time.is_some_and(|time| elapsed >= time)
    }
}

/// Stdout. A closed pipe ends the output, and is no error.
struct Out<W> {
    to: W,
    json: JsonOutput,
    is_closed: bool,
}

impl<W: Write> Out<W> {
    fn new(to: W) -> Self {
        Self {
            to,
            json: JsonOutput::default(),
            is_closed: false,
        }
    }

    /// Prints a document or its text, once.
    fn document(
        &mut self,
        document: &impl Serialize,
        text: impl FnOnce() -> String,
    ) -> Result<(), Failure> {
        let shown = mem::take(&mut self.json).write(document, text)?;
        self.print(&shown)
    }

    fn print(&mut self, text: &str) -> Result<(), Failure> {
        match self
            .to
            .write_all(text.as_bytes())
            .and_then(|()| self.to.flush())
        {
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => self.is_closed = true,
            result => result.context("stdout")?,
        }
        Ok(())
    }
}

/// A profile of the user's file, or the built-in one.
fn profiles(chosen: Option<&ProfileName>) -> Result<(Profiles, String), Failure> {
    let Some(profile) = chosen else {
        let built_in = Profiles::load(SOC, "soc.xml").map_err(Failure::usage)?;
        return Ok((built_in, "Tandem::Soc".to_owned()));
    };
    let file = profile.file.display().to_string();
    let text = fs::read_to_string(&profile.file).with_context(|| file.clone());
    let text = text.map_err(Failure::Usage)?;
    let profiles = Profiles::load(&text, &file).map_err(Failure::usage)?;
    Ok((profiles, profile.name.clone()))
}

/// Opens a participant with a reader of each of these topics.
fn open<const R: usize>(
    place: &TopicsPlace,
    topics: &[Endpoint; R],
) -> Result<Node<0, R>, Failure> {
    let (profiles, profile) = profiles(place.profile.as_ref())?;
    let inputs = endpoints(topics, |topic| profiles.reader(&profile, topic));
    let inputs = inputs.map_err(Failure::usage)?;
    let at = at(place)?;
    Node::open(at, &[], inputs).map_err(|error| no_participant(at, &error))
}

fn at(place: &TopicsPlace) -> Result<UdpPlace, Failure> {
    UdpPlace::new(place.domain, place.interface).map_err(Failure::usage)
}

/// Says why the sockets of a station cannot be opened.
pub(crate) fn no_participant(at: UdpPlace, error: &io::Error) -> Failure {
    Failure::Usage(why_not(at, error))
}

fn why_not(at: UdpPlace, error: &io::Error) -> anyhow::Error {
    let (domain, interface) = (at.domain(), at.interface());
    let what = match error.kind() {
        io::ErrorKind::InvalidInput => format!("{error}"),
        io::ErrorKind::AddrInUse => {
            "the domain has no room for another participant on this machine".to_owned()
        }
        _ => format!("{error}; is it the address of an interface of this machine?"),
    };
    anyhow!("domain {domain} on {interface}: {what}")
}

/// Lets a participant hear for a while. A signal is no error.
fn turn<const R: usize>(node: &mut Node<0, R>, listing: &mut Listing) -> Result<(), Failure> {
    let own = node.prefix();
    match node.turn_watched(TURN, |datagram| listing.hear(own, datagram)) {
        Err(error) if error.kind() != io::ErrorKind::Interrupted => {
            Err(error).context("the participant's sockets")?;
        }
        _ => {}
    }
    Ok(())
}

/// Says why nothing was heard, and what to do about it.
fn nothing(place: &TopicsPlace, topic: Option<&str>, listing: &Listing) -> String {
    let TopicsPlace {
        domain, interface, ..
    } = place;
    let at = format!("in domain {domain} on {interface}");
    let Some(topic) = topic.filter(|_| listing.participants().next().is_some()) else {
        return format!(
            "nothing was heard {at}: is a controller running (tandem run --soc), with the same \
             --domain and --interface?"
        );
    };
    let writers: Vec<_> = listing.endpoints();
    let writers = writers
        .iter()
        .filter(|one| one.writes && one.topic == topic);
    let writers: Vec<_> = writers.map(|one| one.from.as_str()).collect();
    if writers.is_empty() {
        return format!("no participant {at} writes {topic}: tandem topics lists what there is");
    }
    format!(
        "{} {topic} {at}, and no sample arrived: its two places for readers may be taken, or its \
         quality of service does not fit (tandem topics lists it, --profile changes it)",
        match &writers[..] {
            [one] => format!("{one} writes"),
            all => format!("{} write", all.join(" and ")),
        }
    )
}

/// Checks that this machine can be a participant of a place, and claims the place for a run: the
/// systems of another run would be taken for those of this one.
///
/// # Errors
/// If it cannot be one, or another run is there.
pub(crate) fn claim(at: UdpPlace) -> anyhow::Result<UdpSocket> {
    UdpChannel::open(at, Channel::Topics).map_err(|error| why_not(at, &error))?;
    at.claim().map_err(|error| match error.kind() {
        io::ErrorKind::AddrInUse => anyhow!(
            "domain {} on {}: another run is in it; choose another domain with --domain",
            at.domain(),
            at.interface()
        ),
        _ => why_not(at, &error),
    })
}

/// Opens the SoC's participant, with a profile of the user's file or the built-in one.
///
/// # Errors
/// [`Failure::Usage`] for a wrong profile, or if no participant can be opened.
pub(crate) fn open_soc(
    at: UdpPlace,
    profile: Option<&ProfileName>,
    approach: Approach,
) -> Result<Soc, Failure> {
    let (profiles, profile) = profiles(profile)?;
    let opened = Soc::open(at, (&profiles, &profile), approach);
    opened.map_err(|error| no_participant(at, &error))
}

/// Lets the SoC do what is due. A signal is no error.
///
/// # Errors
/// [`Failure::Run`] if its sockets fail.
pub(crate) fn turn_soc(soc: &mut Soc) -> Result<(), Failure> {
    match soc.turn(SOC_TURN) {
        Err(error) if error.kind() != io::ErrorKind::Interrupted => {
            Err(error).context("the participant's sockets")?
        }
        _ => Ok(()),
    }
}

/// Commands the parking, and prints each phase.
fn soc(
    way: f32,
    place: &TopicsPlace,
    watch: &Watch<'_>,
    out: &mut Out<impl Write>,
) -> Result<(), Failure> {
    let mut soc = open_soc(at(place)?, place.profile.as_ref(), Approach::new(way))?;
    let mut lines = mem::take(&mut out.json).lines();
    let mut told = None;
    while !watch.is_over() && !out.is_closed {
        turn_soc(&mut soc)?;
        let (phase, driven) = (soc.approach().phase(), soc.approach().driven());
        if told.replace(phase) != Some(phase) {
            let time_s = watch.begin.elapsed().as_secs_f64();
            let name = format!("{phase:?}");
            let object = serde_json::json!({
                "time_s": time_s, "phase": name, "driven_m": driven, "way_m": way,
            });
            let text = || format!("{time_s:8.3} s  {driven:5.2} of {way} m  {phase}\n");
            out.print(&lines.line(&object, text)?)?;
        }
    }
    lines.finish()?;
    match soc.approach().phase() {
        ApproachPhase::Parked => Ok(()),
        ApproachPhase::Waiting if soc.gateway().reports().next().is_none() => Err(
            Failure::NothingHeard(nothing(place, None, &Listing::default())),
        ),
        phase => Err(Failure::Run(anyhow!("not parked: {phase}"))),
    }
}
