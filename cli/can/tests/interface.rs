//! A run on a SocketCAN interface: in a user-mode Linux, because many kernels have no vcan. Skipped
//! without its programs; with `TANDEM_REQUIRE_UML=1` they are required.
#![allow(
    clippy::unwrap_used,
    reason = "a test ends where something is not as it must be"
)]

use std::collections::HashSet;
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

/// What the machine needs, from the Debian packages user-mode-linux, can-utils, kmod and iproute2.
const NEEDED: [&str; 5] = ["linux.uml", "candump", "cansend", "insmod", "ip"];

fn is_missing(program: &&str) -> bool {
    let folders = ["/usr/bin", "/usr/sbin", "/bin", "/sbin"];
    !folders
        .iter()
        .any(|it| Path::new(it).join(program).exists())
}

/// Returns id and data of each frame: a frame of CAN FD without the digit of its flags.
fn frames(log: &str) -> Vec<(String, bool, String)> {
    let frame = |line: &str| {
        let (id, data) = line.split_whitespace().nth(2)?.split_once('#')?;
        Some(match data.strip_prefix('#') {
            Some(flagged) => (id.to_owned(), true, flagged.get(1..)?.to_owned()),
            None => (id.to_owned(), false, data.to_owned()),
        })
    };
    let read: Option<Vec<_>> = log.lines().map(frame).collect();
    read.unwrap()
}

/// U-2: other programs hear the frames of a run on an interface, and what they send is on its bus:
/// classic frames and those of CAN FD, with short and long ids. An interface that cannot be used is
/// refused with what to do, and nothing is left behind.
#[test]
fn the_bus_of_a_run_is_on_an_interface() {
    let missing: Vec<&str> = NEEDED.into_iter().filter(is_missing).collect();
    if !missing.is_empty() {
        let required = std::env::var_os("TANDEM_REQUIRE_UML").is_some_and(|it| it == "1");
        assert!(!required, "missing: {missing:?}");
        eprintln!("the_bus_of_a_run_is_on_an_interface: skipped: no {missing:?}");
        return;
    }
    // Here `tandem` does not ask cargo to build the other program.
    let folder = tempfile::tempdir().unwrap();
    let built = Path::new(env!("CARGO_BIN_EXE_tandem-can"));
    for name in ["tandem", "tandem-can"] {
        let from = built.with_file_name(name);
        fs::copy(&from, folder.path().join(name))
            .unwrap_or_else(|error| panic!("{}: {error}", from.display()));
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/machine.sh");
    let machine = Command::new("timeout")
        .args(["--kill-after=10", "300", "linux.uml", "mem=768M"])
        .args(["rootfstype=hostfs", "rootflags=/", "rw", "con=null"])
        .arg("con0=fd:0,fd:1")
        .arg(format!("init={script}"))
        // What follows are arguments of the script.
        .arg("--")
        .arg(folder.path())
        .current_dir(folder.path())
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let read = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap_or_default();
    let said = read("said.txt");
    let console = String::from_utf8_lossy(&machine.stdout);
    let all = format!("{said}\n{console}");
    let mut rest = said.as_str();
    for words in [
        "--can vcan0: there is no such interface; `ip link add vcan0 type vcan`",
        "status 2",
        "--can lo: it is no CAN interface",
        "status 2",
        "--can vcan0: it is down; `ip link set vcan0 up`",
        "status 2",
        "--can vcan0: it does not carry CAN FD; `ip link set vcan0 mtu 72`",
        "status 2\n",
    ] {
        let at = rest.find(words).unwrap_or_else(|| panic!("{words}: {all}"));
        rest = &rest[at + words.len()..];
    }
    // Nothing was created, and the bridge has ended with its run.
    assert!(!rest.starts_with("report"), "{all}");
    assert!(rest.trim_end().ends_with("\n0"), "{all}");
    let (heard, run) = (frames(&read("vcan0.log")), frames(&read("run.log")));
    let on_bus: HashSet<_> = run.iter().collect();
    let own = |of: &[(String, bool, String)]| of.iter().filter(|it| it.0 == "0A8").count();
    assert!(own(&heard) > 50, "{} of {}: {all}", own(&heard), own(&run));
    let strange: Vec<_> = heard
        .iter()
        .filter(|it| !on_bus.contains(it) && !it.2.starts_with('R'))
        .collect();
    assert!(strange.is_empty(), "{strange:?}");
    for (id, is_fd, data) in [
        ("7A1", true, "00112233445566778899AABB"),
        ("1ABCDEF0", false, "DEADBEEF"),
    ] {
        let frame = (id.to_owned(), is_fd, data.to_owned());
        assert!(on_bus.contains(&frame), "{frame:?}: {all}");
    }
    assert!(run.iter().all(|it| it.0 != "7A2"), "a remote frame passed");
    eprintln!("{} of {} frames heard on vcan0", heard.len(), run.len());
}
