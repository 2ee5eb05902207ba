//! Runs a test in separate processes: this program starts itself again as the launcher of the run,
//! and the launcher starts it as supplies and vehicle.

use std::ffi::OsString;
use std::io::Read as _;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use tandem_board_host::{
    LaunchError, LaunchPlan, Launcher, ProcessArgs, Schedule, UdpPlace, isolation,
};

/// First argument of this program as a launcher. The case, the folder and the place follow it.
pub(crate) const LAUNCH: &str = "launch";
/// Exit status of a launcher that could not prepare its run.
pub(crate) const REFUSED: u8 = 4;

/// Starts this program as the launcher of a run. `place` is `own` or `shared`.
pub(crate) fn start_launcher(case: &str, folder: &Path, place: &str) -> Child {
    let program = std::env::current_exe().expect("own path");
    launcher(&program, case, folder, place)
        .spawn()
        .expect("launcher")
}

/// Returns the command that starts the launcher of a run; `program` is this program or a copy.
pub(crate) fn launcher(program: &Path, case: &str, folder: &Path, place: &str) -> Command {
    let mut command = Command::new(program);
    command.args([LAUNCH, case]).arg(folder).arg(place);
    command.stdin(Stdio::null());
    command.stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

/// Waits until a run has ended. Returns the messages of its processes, as an error if the run
/// failed or did not end within `patience`.
pub(crate) fn finish(mut launcher: Child, patience: Duration) -> Result<String, String> {
    // Read continuously, because a full pipe would stop the launcher.
    let mut pipe = launcher.stderr.take().expect("a pipe");
    let reader = thread::spawn(move || {
        let mut said = vec![];
        let _ = pipe.read_to_end(&mut said);
        String::from_utf8_lossy(&said).into_owned()
    });
    let deadline = Instant::now() + patience;
    let status = loop {
        match launcher.try_wait() {
            Ok(Some(status)) => break Some(status),
            Ok(None) if Instant::now() < deadline => thread::sleep(Duration::from_millis(2)),
            _ => break None,
        }
    };
    if status.is_none() {
        let _ = launcher.kill();
        let _ = launcher.wait();
    }
    let said = reader.join().expect("the reader");
    match status {
        Some(status) if status.success() => Ok(said),
        Some(status) => Err(format!("{status}\n{said}")),
        None => Err(format!("hangs\n{said}")),
    }
}

/// Does the work of the launcher of a case.
pub(crate) fn launch(
    argv: &[OsString],
    network: Option<UdpPlace>,
    claims_realtime: impl Fn(&str) -> bool,
) -> ExitCode {
    let (name, folder, place) = (&argv[0], Path::new(&argv[1]), &argv[2]);
    let place = if place == "own" {
        isolation::enter()
    } else {
        isolation::enter_shared()
    };
    let prepared = place
        .map_err(LaunchError::from)
        .and_then(Launcher::prepare_in);
    let mut launcher = match prepared {
        Ok(launcher) => launcher,
        Err(error) => {
            eprintln!("{error}");
            return ExitCode::from(REFUSED);
        }
    };
    let plan = LaunchPlan {
        schedule: Schedule {
            realtime: name.to_str().is_some_and(claims_realtime),
            ..Schedule::default()
        },
        flash: [folder.join("dflash-A"), folder.join("dflash-B")],
        network,
        extra: vec![name.clone(), folder.into()],
    };
    launcher.start(&plan, &again).expect("start");
    let ended = launcher.wait();
    let leftovers = launcher.finish();
    if leftovers.count() > 0 {
        eprintln!("left behind: {leftovers:?}");
        return ExitCode::from(3);
    }
    match ended.vehicle {
        Some(status) if status.success() => ExitCode::SUCCESS,
        status => {
            eprintln!("the vehicle ended with {status:?}");
            ExitCode::FAILURE
        }
    }
}

/// Returns the command that starts a process of the run.
pub(crate) fn again(args: &ProcessArgs) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("own path"));
    command.args(args.to_argv());
    command
}

/// Ends the vehicle, and thus the run, after `patience`.
pub(crate) fn watch(patience: Duration) {
    thread::spawn(move || {
        thread::sleep(patience);
        eprintln!("the vehicle hangs");
        std::process::exit(9);
    });
}
