//! The guardian: a watchdog process above the launcher. It is the one that cleans up (E-5).
//!
//! The launcher's standard input leads to the guardian. The launcher sends a line at least every
//! half second. Silence, the end of the launcher, or its exit status 70 begin the clean-up.

use std::io::{self, Read as _};
use std::os::fd::{AsFd as _, OwnedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use rustix::io::Errno;
use rustix::process::{Signal, getpid, set_child_subreaper};
use tandem_board::Duration;
use tandem_board_host::control_group::ControlGroup;
use tandem_board_host::socket::LineStream;
use tandem_board_host::spawn::{self, Watched};
use tandem_board_host::{clock, descendants};

use super::clean_up::CleanUp;

/// The shortest time of the watchdog: below, a busy machine would end a launcher that works.
const SHORTEST: Duration = Duration::from_ms(100);
/// The longest line of the launcher, bytes: it holds the commands of the clean-up.
const LONGEST: usize = 4 << 20;
/// The exit status of a launcher that gives up.
pub const GIVES_UP: u8 = 70;
/// The exit status of a launcher that has started nothing.
pub const NOTHING_STARTED: u8 = 2;

/// What the guardian watches, and what it runs.
#[derive(Clone, Debug, Default)]
pub struct GuardPlan {
    /// The manifest.
    pub manifest: PathBuf,
    /// The trust anchor.
    pub anchor: Option<PathBuf>,
    /// Pre-clean-up in place of the manifest's: it runs also if that cannot be read.
    pub before: Vec<String>,
    /// Post-clean-up in place of the manifest's.
    pub after: Vec<String>,
}

/// How it has ended.
#[derive(Debug)]
pub enum GuardEnd {
    /// The launcher has ended as it was asked to.
    Done,
    /// The launcher has started nothing; it has said why.
    NothingStarted,
    /// The unrecoverable state: why, and what of the clean-up has failed.
    CleanedUp(String, Vec<String>),
}

/// In the launcher: sends a line to the guardian. Returns whether the guardian lives.
pub(super) fn send(line: &str) -> bool {
    // A guardian that is suspended reads later: its silence is no end.
    let sent = rustix::io::write(io::stdin(), format!("{line}\n").as_bytes());
    !matches!(sent, Err(Errno::PIPE | Errno::CONNRESET))
}

/// Starts the launcher by this command, which must run [`super::ProcessLauncher::run`]. Watches it
/// until it has ended, and cleans up if need be. Bytes from `stops` are signals that the launcher
/// gets, too. `warn` is told what the machine does not grant.
///
/// # Errors
/// If the system does not permit to start or to watch it.
pub fn guard(
    mut launcher: Command,
    plan: &GuardPlan,
    stops: &UnixStream,
    warn: &mut dyn FnMut(&str),
) -> io::Result<GuardEnd> {
    set_child_subreaper(Some(getpid()))?;
    stops.set_nonblocking(true)?;
    let (ours, theirs) = UnixStream::pair()?;
    theirs.set_nonblocking(true)?;
    launcher.stdin(Stdio::from(OwnedFd::from(theirs)));
    let mut child = launcher.process_group(0).spawn()?;
    drop(launcher);
    let watched = Watched::new(child.id()).ok_or(io::ErrorKind::NotFound)?;
    let mut lines = LineStream::new(ours)?;
    let mut clean_up = CleanUp::default();
    clean_up.safe_state.before.clone_from(&plan.before);
    clean_up.safe_state.after.clone_from(&plan.after);
    let (mut last, mut is_silent) = (clock::now(), false);
    loop {
        let ended = child.try_wait()?;
        while let Ok(line) = lines.line(LONGEST) {
            if let Ok(begun) = serde_json::from_str(&line) {
                clean_up = begin(plan, begun, child.id(), warn);
            }
            last = clock::now();
        }
        let watchdog = clean_up.safe_state.watchdog.max(SHORTEST);
        if let Some(status) = ended {
            let why = match status.code() {
                Some(0) => {
                    clean_up.group.iter().for_each(ControlGroup::remove);
                    return Ok(GuardEnd::Done);
                }
                Some(code) if code == i32::from(NOTHING_STARTED) => {
                    clean_up.run();
                    return Ok(GuardEnd::NothingStarted);
                }
                Some(code) if code == i32::from(GIVES_UP) => "the launcher has given up".to_owned(),
                _ if is_silent => {
                    let ms = watchdog.as_us() / 1_000;
                    format!("the launcher was silent for {ms} ms")
                }
                _ => format!("the launcher has ended ({status})"),
            };
            return Ok(GuardEnd::CleanedUp(why, clean_up.run()));
        }
        let until = last + watchdog;
        if clock::now() > until {
            is_silent = true;
            // Fails if it has just ended.
            let _ = child.kill();
            child.wait()?;
            continue;
        }
        let fds = [watched.fd(), lines.as_fd(), stops.as_fd()];
        // A failure needs no handling: the loop looks at everything anyway.
        let _ = clock::wait_for(fds, until.since(clock::now()) + Duration::from_ns(1));
        let mut bytes = [0; 16];
        for _ in 0..(&mut &*stops).read(&mut bytes).unwrap_or(0) {
            spawn::signal(child.id(), Signal::TERM);
        }
    }
}

/// Returns the clean-up of a launcher that has begun, and takes the launcher into a control group.
fn begin(plan: &GuardPlan, begun: CleanUp, launcher: u32, warn: &mut dyn FnMut(&str)) -> CleanUp {
    // Beside the start of the processes: a move takes 5 to 15 ms, in which the kernel waits.
    let group = begun.name.as_deref().and_then(ControlGroup::make);
    let group = group.filter(|it| it.take(|| descendants::living(&[launcher])));
    if group.is_none() {
        warn("no control group (cgroup v2) is granted: process groups and /proc take its place");
    }
    let mut clean_up = CleanUp { group, ..begun };
    if plan.before.is_empty() && plan.after.is_empty() {
        let manifest = plan.manifest.canonicalize();
        let manifest = manifest.unwrap_or(plan.manifest.clone());
        clean_up.files = Some((manifest, plan.anchor.clone()));
    } else {
        clean_up.safe_state.before.clone_from(&plan.before);
        clean_up.safe_state.after.clone_from(&plan.after);
    }
    clean_up
}
