//! What hostile or unlucky processes do to a launcher: none of it ends the platform, or keeps it
//! from ending.

use std::io::{Read as _, Write as _};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::os::unix::process::CommandExt as _;
use std::process::Command;

use rustix::process::Signal;

use crate::rig::{Rig, is_alive, process, signal, target};

pub(crate) const ALL: &[(&str, fn())] = &[
    ("connections_of_another_user", connections_of_another_user),
    ("no_target_after_a_stop", no_target_after_a_stop),
    ("first_thread_has_ended", first_thread_has_ended),
    ("process_that_left_its_group", process_that_left_its_group),
    ("reports_during_slow_starts", reports_during_slow_starts),
    ("restarts_without_a_pause", restarts_without_a_pause),
    (
        "requests_that_wait_are_limited",
        requests_that_wait_are_limited,
    ),
    ("manifest_behind_a_link", manifest_behind_a_link),
];

/// Says that it is ready, and ends its first thread by the system call `exit`, number 60 or 93.
/// What is left of it ignores SIGTERM.
const HEADLESS: &str = r#"#!/bin/sh
exec python3 -c '
import ctypes, os, platform, signal, socket, threading, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
threading.Thread(target=lambda: time.sleep(600)).start()
open("pid", "w").write(f"{os.getpid()}\n")
name = "\0" + os.environ["NOTIFY_SOCKET"][1:]
socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(b"READY=1", name)
ctypes.CDLL(None).syscall(93 if platform.machine() == "aarch64" else 60, 0)
'
"#;

fn head(more: &str) -> String {
    format!("version = 1\ninitial = \"all\"\n{more}\n")
}

fn all_ready(rig: &Rig) {
    rig.wait_until("all ready", |rig| {
        !rig.events(&["all: all ready"]).is_empty()
    });
}

/// Another user connects again and again: each is refused, and nothing else happens.
fn connections_of_another_user() {
    if !rustix::process::geteuid().is_root() {
        return eprintln!("skipped: needs root to become another user");
    }
    let safe_state = "[safe-state]\nwatchdog = \"2s\"\n";
    let mut rig = Rig::start(&[
        head(""),
        safe_state.to_owned(),
        process("calm", &["say:STATUS=calm", "ready", "pause"], ""),
        target("all", &["calm"]),
    ]);
    all_ready(&rig);
    let name = control_socket(rig.launcher_pid());
    let flood = || {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args(["flood", &name]).uid(65_534).spawn().unwrap()
    };
    let mut floods: Vec<_> = (0..3).map(|_| flood()).collect();
    std::thread::sleep(std::time::Duration::from_secs(5));
    floods.iter_mut().for_each(|it| {
        it.kill().unwrap();
        it.wait().unwrap();
    });
    assert!(rig.events(&["calm: started"]).len() == 1 && rig.ask("ps").contains("calm"));
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
}

/// Returns the abstract name of the socket on which the launcher takes requests.
fn control_socket(launcher: i32) -> String {
    let own = std::fs::read_dir(format!("/proc/{launcher}/fd")).unwrap();
    let own: Vec<_> = own
        .flatten()
        .filter_map(|it| it.path().read_link().ok())
        .collect();
    let sockets = std::fs::read_to_string("/proc/net/unix").unwrap();
    let mut found = sockets.lines().filter_map(|line| {
        let (inode, name) = line.split_whitespace().nth(6).zip(line.split_once(" @"))?;
        let is_own = own.contains(&format!("socket:[{inode}]").into());
        (is_own && name.1.ends_with("-control")).then(|| name.1.to_owned())
    });
    found.next().expect("its socket")
}

/// In the process of another user: connects for ever.
pub(crate) fn flood(name: &str) -> ! {
    let address = SocketAddr::from_abstract_name(name).unwrap();
    loop {
        let _ = UnixStream::connect_addr(&address);
    }
}

/// Once all is to end, a request for a run target starts nothing.
fn no_target_after_a_stop() {
    let mut rig = Rig::start(&[
        head(""),
        process("slow", &["catch-term:termed"], "stop-within = \"50s\""),
        target("all", &["slow"]),
    ]);
    all_ready(&rig);
    rig.stop();
    rig.wait_for("termed");
    assert_eq!(rig.ask("target all"), "all ends");
    assert!(rig.ask("ps").contains("\"reached\":false"));
    // The second request does not wait for it.
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
    assert_eq!(rig.events(&["slow: started"]).len(), 1);
}

/// A process whose first thread has ended looks like a zombie, and is none: the clean-up kills it.
fn first_thread_has_ended() {
    let mut rig = Rig::prepare(&[
        head(""),
        "[safe-state]\nwithin = \"500ms\"\n".to_owned(),
        "[[process]]\nname = \"headless\"\nprogram = \"headless\"\nready-within = \"50s\"\n"
            .to_owned(),
        target("all", &["headless"]),
    ]);
    std::fs::write(rig.path("headless"), HEADLESS).unwrap();
    let may_run = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(rig.path("headless"), may_run).unwrap();
    rig.launch(&[]);
    all_ready(&rig);
    let pid = rig.pids("pid")[0];
    let threads = || std::fs::read_dir(format!("/proc/{pid}/task")).map_or(0, Iterator::count);
    signal(rig.launcher_pid(), Signal::KILL);
    assert_eq!(rig.end().code(), Some(1), "{}", rig.story());
    assert_eq!(threads(), 0, "it runs on");
}

/// A process that has left its process group, and ignores SIGTERM, is killed.
fn process_that_left_its_group() {
    let steps = ["join-group-of-parent", "catch-term:termed"];
    let mut rig = Rig::start(&[
        head(""),
        process("stray", &steps, "stop-within = \"500ms\""),
        target("all", &["stray"]),
    ]);
    all_ready(&rig);
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
    assert!(rig.has("termed"));
}

/// A process that reports in time is not ended because the launcher is busy with starts.
fn reports_during_slow_starts() {
    // Where it is granted, the many that start do not take its CPU: it does report in time.
    let alive = "alive = { every = \"500ms\", least = 2 }\npolicy = \"fifo\"\npriority = 10";
    let others: Vec<String> = (0..150).map(|at| format!("other-{at}")).collect();
    let names: Vec<&str> = others.iter().map(String::as_str).collect();
    let start = |name: &&str| process(name, &["sleep:50"], "ready = \"exit\"");
    let rest: String = names.iter().map(start).collect();
    let mut rig = Rig::start(&[
        head(""),
        process("beats", &["ready", "beat:100000"], alive),
        rest,
        target("all", &["beats"]),
        target("busy", &[&["beats"], &names[..]].concat()),
    ]);
    all_ready(&rig);
    assert_eq!(rig.ask("target busy"), "ok", "{}", rig.story());
    assert!(
        rig.events(&["beats", "alive"]).is_empty(),
        "{}",
        rig.story()
    );
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
}

/// A program that does not start is started again for ever, as the manifest wants: the launcher
/// still hears that all is to end.
fn restarts_without_a_pause() {
    let missing = "[[process]]\nname = \"missing\"\nprogram = \"no-such-program\"\n\
                   restart = { times = 4000000000 }\n";
    let mut rig = Rig::start(&[head(""), missing.to_owned(), target("all", &["missing"])]);
    rig.wait_until("restarts", |rig| rig.events(&["restart 50"]).len() > 1);
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
}

/// Requests for a run target that is not reached wait, but not without a limit: each holds a
/// descriptor.
fn requests_that_wait_are_limited() {
    let mut rig = Rig::start(&[
        head(""),
        process("calm", &["ready", "pause"], ""),
        process("never-ready", &["pause"], ""),
        target("all", &["calm"]),
        target("never", &["calm", "never-ready"]),
    ]);
    all_ready(&rig);
    let address = control_socket(rig.launcher_pid());
    let address = SocketAddr::from_abstract_name(address).unwrap();
    let mut asking: Vec<_> = (0..64)
        .map(|_| UnixStream::connect_addr(&address).unwrap())
        .collect();
    asking
        .iter_mut()
        .for_each(|it| it.write_all(b"target never\n").unwrap());
    assert_eq!(rig.ask("target never"), "busy");
    assert!(rig.ask("ps").contains("calm"));
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
    for mut stream in asking {
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        assert_eq!(answer, "all ends\n");
    }
}

/// The commands of the clean-up are found where the manifest lies, also if a link leads to it.
fn manifest_behind_a_link() {
    let mut rig = Rig::prepare(&[
        head(""),
        process("calm", &["ready", "pause"], ""),
        "[safe-state]\nbefore = [\"./before\"]\n".to_owned(),
        target("all", &["calm"]),
    ]);
    std::fs::write(rig.path("before"), "#!/bin/sh\ntouch ran\n").unwrap();
    let may_run = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    std::fs::set_permissions(rig.path("before"), may_run).unwrap();
    let elsewhere = tempfile::tempdir().unwrap();
    let link = elsewhere.path().join("link.toml");
    std::os::unix::fs::symlink(rig.manifest(), &link).unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    rig.launch_by(command.arg("guardian").arg(&link));
    all_ready(&rig);
    let pid = rig.launcher_pid();
    signal(pid, Signal::KILL);
    assert_eq!(rig.end().code(), Some(1), "{}", rig.story());
    assert!(rig.has("ran") && !is_alive(pid), "{}", rig.story());
}
