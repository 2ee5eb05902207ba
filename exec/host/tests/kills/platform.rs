//! The programs of the platform: this test's own program, in modes.

use std::fs::OpenOptions;
use std::io::Write as _;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::time::Duration as Span;

use rustix::process::{Signal, set_parent_process_death_signal};
use signal_hook::consts::SIGTERM;
use signal_hook::low_level::pipe;
use tandem_board::Duration;
use tandem_board_host::process_report;
use tandem_board_host::{RunName, clock};
use tandem_exec::client::{Activated, Standing};
use tandem_exec::master::Config;
use tandem_exec::message::{Activation, ClientId};
use tandem_exec_client::sync::{SyncClient, SyncMaster, SyncPlace};
use tandem_exec_host::launcher::{self, GuardEnd, GuardPlan, NOTHING_STARTED, ProcessLauncher};

/// Redundant clients, candidates for the master.
pub(crate) const CLIENTS: usize = 3;
pub(crate) const CANDIDATES: usize = 2;
/// Name of the shared memory.
pub(crate) const PLACE: &str = "kills";

const CONFIG: Config = Config {
    clients: CLIENTS,
    quorum: 2,
    candidates: CANDIDATES,
    period: Duration::from_ms(5),
    lead: Duration::from_ms(1),
    // A client that is frozen for less time is waited for.
    wait: Duration::from_ms(20),
    // Longer than two clients together are frozen or need for a restart.
    patience: Duration::from_ms(3_000),
    takeover: Duration::from_ms(3),
};
/// A client without an answer for this time ends, and is restarted.
const GIVE_UP: Duration = Duration::from_ms(5_000);

/// One activation, as a client writes it to its log: words of 8 bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Record {
    pub(crate) client: u64,
    pub(crate) process: u64,
    pub(crate) cycle: u64,
    pub(crate) activation_ns: u64,
    pub(crate) woken_ns: u64,
    pub(crate) code: u64,
    /// 0: its outputs do not count yet, 1: they count, 2: excluded.
    pub(crate) standing: u64,
    pub(crate) safe_state: u64,
    pub(crate) random: u64,
    pub(crate) output: u64,
    pub(crate) agreed: u64,
}

impl Record {
    pub(crate) const BYTES: usize = 11 * 8;

    fn words(&self) -> [u64; 11] {
        [
            self.client,
            self.process,
            self.cycle,
            self.activation_ns,
            self.woken_ns,
            self.code,
            self.standing,
            self.safe_state,
            self.random,
            self.output,
            self.agreed,
        ]
    }

    /// Returns the records of a log. A process is killed between two writes, never within one.
    pub(crate) fn read_all(bytes: &[u8]) -> Vec<Self> {
        let records = bytes.chunks_exact(Self::BYTES).map(|bytes| {
            let word = |at: usize| {
                let bytes = &bytes[at * 8..][..8];
                u64::from_le_bytes(bytes.try_into().expect("8 bytes"))
            };
            Self {
                client: word(0),
                process: word(1),
                cycle: word(2),
                activation_ns: word(3),
                woken_ns: word(4),
                code: word(5),
                standing: word(6),
                safe_state: word(7),
                random: word(8),
                output: word(9),
                agreed: word(10),
            }
        });
        records.collect()
    }
}

/// What a client computes in a cycle.
pub(crate) fn output_of(cycle: u64, activation_ns: u64, random: u64) -> u64 {
    (cycle.rotate_left(17) ^ activation_ns)
        .wrapping_mul(random | 1)
        .max(1)
}

/// Runs this program in the mode that its arguments name: `MODE RUN …`. `None`: it is the test.
pub(crate) fn run_mode() -> Option<ExitCode> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let result = match words[..] {
        ["guardian", run, manifest] => guardian(&run.parse().ok()?, manifest.as_ref()),
        ["launcher", _, manifest] => return Some(launcher(manifest.as_ref())),
        ["client", run, id, log] => client(&run.parse().ok()?, id.parse().ok()?, log),
        ["master", run, id] => master(&run.parse().ok()?, id.parse().ok()?),
        ["tree", run] => tree(run),
        ["leaf", _] => leaf(),
        ["clean", run] => clean(run),
        _ => return None,
    };
    Some(match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(why) => {
            eprintln!("{words:?}: {why}");
            ExitCode::FAILURE
        }
    })
}

type Done = Result<(), Box<dyn std::error::Error>>;

fn stops() -> std::io::Result<UnixStream> {
    let (read, write) = UnixStream::pair()?;
    pipe::register(SIGTERM, write)?;
    Ok(read)
}

/// Owns the shared memory. If it dies, the post-clean-up removes that.
fn guardian(run: &RunName, manifest: &Path) -> Done {
    // Also if the test is killed, nothing stays.
    set_parent_process_death_signal(Some(Signal::TERM))?;
    SyncPlace::create(run, PLACE)?;
    let mut command = Command::new("/proc/self/exe");
    command.args(["launcher", run.as_str()]).arg(manifest);
    let plan = GuardPlan {
        manifest: manifest.to_owned(),
        ..GuardPlan::default()
    };
    match launcher::guard(command, &plan, &stops()?, &mut |_| ())? {
        GuardEnd::Done => clean(run.as_str()),
        GuardEnd::NothingStarted => Err("nothing was started".into()),
        GuardEnd::CleanedUp(why, failed) => Err(format!("{why}; {failed:?}").into()),
    }
}

fn launcher(manifest: &Path) -> ExitCode {
    let opened = ProcessLauncher::open(manifest, None);
    let ran = opened
        .map_err(|error| error.to_string())
        .and_then(|launcher| {
            let stops = stops().map_err(|error| error.to_string())?;
            Ok(launcher.run(stops, true, &mut |told| println!("{told}")))
        });
    match ran {
        Ok(Ok(())) => ExitCode::SUCCESS,
        Ok(Err(error)) => launcher::give_up(&error).into(),
        Err(why) => {
            eprintln!("{why}");
            ExitCode::from(NOTHING_STARTED)
        }
    }
}

fn client(run: &RunName, id: usize, log: &str) -> Done {
    let place = SyncPlace::open(run, PLACE)?;
    let id = ClientId::new(id).ok_or("no such client")?;
    let mut log = OpenOptions::new().append(true).create(true).open(log)?;
    let mut client = SyncClient::attach(place, id)?;
    process_report::ready()?;
    let mut output = 0;
    loop {
        let activated = client.wait_for_activation(output, GIVE_UP)?;
        let record = compute(&mut client, id, &activated);
        output = record.output;
        let bytes: Vec<u8> = record
            .words()
            .into_iter()
            .flat_map(u64::to_le_bytes)
            .collect();
        log.write_all(&bytes)?;
        if activated.code == Activation::Terminate || record.standing == 2 {
            return Err("it was told to end".into());
        }
    }
}

fn compute(client: &mut SyncClient, id: ClientId, activated: &Activated) -> Record {
    let woken_ns = clock::now().as_ns();
    let activation_ns = client.client().activation_time().as_ns();
    let random = client.client().random();
    let cycle = activated.cycle;
    let runs = activated.code == Activation::Run;
    Record {
        client: id.index() as u64,
        process: std::process::id().into(),
        cycle,
        activation_ns,
        woken_ns,
        code: activated.code as u64,
        standing: match activated.standing {
            Standing::Joining => 0,
            Standing::Member => 1,
            Standing::Excluded => 2,
        },
        safe_state: activated.is_safe_state.into(),
        random,
        output: if runs {
            output_of(cycle, activation_ns, random)
        } else {
            0
        },
        agreed: activated.agreed,
    }
}

fn master(run: &RunName, id: usize) -> Done {
    let place = SyncPlace::open(run, PLACE)?;
    let id = ClientId::new(id).ok_or("no such candidate")?;
    let mut master = SyncMaster::attach(place, CONFIG, id)?;
    process_report::ready()?;
    master.run(|_| (), || false);
    Err("all clients terminated".into())
}

/// Starts a process in a group of its own, which does not end by itself when this one does.
fn tree(run: &str) -> Done {
    let this = std::env::current_exe()?;
    let mut child = Command::new(this)
        .args(["leaf", run])
        .process_group(0)
        .spawn()?;
    process_report::ready()?;
    child.wait()?;
    Ok(())
}

fn leaf() -> Done {
    loop {
        std::thread::sleep(Span::from_secs(60));
    }
}

/// The post-clean-up: removes the shared memory.
pub(crate) fn clean(run: &str) -> Done {
    for entry in std::fs::read_dir("/dev/shm")? {
        let entry = entry?;
        if entry.file_name().to_string_lossy().contains(run) {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}
