//! Tests of systems that start through their bootloaders, as processes on this machine.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use tandem_boot::{EnvironmentStore, Slot};
use tandem_boot_host::FlashFile;
use tandem_processes::boot;

/// Longer than any run of these tests takes on a busy machine.
const WATCHDOG: Duration = Duration::from_secs(180);

fn tandem() -> Command {
    Command::new(env!("CARGO_BIN_EXE_tandem"))
}

/// A run that is killed when its test ends.
struct Run(Child);

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Run {
    /// Polls `look` until it returns a value, and returns that value.
    fn until<T>(&mut self, what: &str, mut look: impl FnMut() -> Option<T>) -> T {
        let begin = Instant::now();
        loop {
            if let Some(found) = look() {
                return found;
            }
            assert!(begin.elapsed() < WATCHDOG, "{what}");
            assert!(
                self.0.try_wait().unwrap().is_none(),
                "the run ended: {what}"
            );
            sleep(Duration::from_millis(20));
        }
    }
}

/// Returns the process of core 0 of a system, in the run that `launcher` started.
fn core_0(system: &str, launcher: u32) -> Option<String> {
    let listed = tandem().arg("ps").output().unwrap();
    let listed = String::from_utf8(listed.stdout).unwrap();
    let process = |line: &str| {
        let [pid, kind, of, core, .., run] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            return None;
        };
        let is_it = (kind, of, core) == ("core", system, "0");
        let ours = run.starts_with(&format!("tandem-{launcher}-"));
        (is_it && ours).then(|| pid.to_owned())
    };
    listed.lines().find_map(process)
}

/// T-BOOT-8: an application downloaded to an empty controller starts, and its three cores send.
#[test]
fn three_cores_send_what_was_downloaded() {
    let output = tandem().arg("boot-demo").output().unwrap();
    let shown = String::from_utf8(output.stdout).unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    for frame in ["700#00", "701#01", "702#02"] {
        assert!(shown.contains(frame), "{frame} did not come: {shown}{said}");
    }
}

/// Returns the active slot of a controller, its version, and whether an image is on trial; `None`
/// before the first start.
fn boots(flash: &Path) -> Option<(Option<Slot>, u32, bool)> {
    let mut flash = FlashFile::open(flash).unwrap();
    let environment = *EnvironmentStore::load(&mut flash)?.get();
    let slot = environment.active.application;
    Some((slot, environment.versions[0], environment.trial.is_some()))
}

/// U-1, U-3, U-5, T-BOOT-1: each system is updated while the other system drives, and approves its
/// new image. The standby is updated first, and then the master, which hands over.
#[test]
fn both_systems_are_updated_while_they_drive() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = tandem();
    command
        .args(["run", "--scenario", "free-lane", "--reintegrate", "--quiet"])
        // The run lasts as long as the test waits: a stalled machine delays dual operation.
        .args(["--duration", &WATCHDOG.as_secs().to_string()])
        .args(["--update", "2", "--program-flash"])
        // This folder does not exist yet.
        .arg(folder.path().join("flash"))
        .arg("--out")
        .arg(folder.path().join("report"))
        .stdout(Stdio::null())
        .stderr(Stdio::null());
    let mut run = Run(command.spawn().unwrap());
    let launcher = run.0.id();
    let is_updated = |system: &str| {
        let flash = folder.path().join(format!("flash/{system}.pflash"));
        boots(&flash) == Some((Some(Slot::B), 2, false))
    };
    // The files of the flashes are complete when core 0 of A has started.
    run.until("core 0 of A starts", || core_0("A", launcher));
    // The standby is updated first. On a busy machine either system may be the standby.
    let first = run.until("the standby approves its image", || {
        ["A", "B"].into_iter().find(|system| is_updated(system))
    });
    let second = if first == "A" { "B" } else { "A" };
    run.until("the other approves its image", || {
        is_updated(second).then_some(())
    });
    let end = Command::new("kill")
        .args(["-INT", &launcher.to_string()])
        .status();
    assert!(end.unwrap().success());
    run.0.wait().unwrap();
}

/// U-5: an update that the bootloader refuses is given up: the run ends non-zero and says why, both
/// systems keep their release, and one of them drives all the time.
#[test]
fn an_update_that_is_refused_fails_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let output = tandem()
        .args(["run", "--scenario", "free-lane", "--reintegrate"])
        .args(["--duration", "8", "--update", "0", "--program-flash"])
        .arg(folder.path().join("flash"))
        .arg("--out")
        .arg(folder.path().join("report"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("refuses it: Downgrade"), "{said}");
    for system in ["A", "B"] {
        let flash = folder.path().join(format!("flash/{system}.pflash"));
        assert_eq!(boots(&flash), Some((Some(Slot::A), 1, false)), "{system}");
    }
}

/// U-3, U-5: if the second system refuses the update, the first one, which already runs it, gets
/// its old release back. The run ends non-zero and names both releases.
#[test]
fn if_one_system_refuses_the_other_goes_back() {
    let folder = tempfile::tempdir().unwrap();
    let flash = folder.path().join("flash");
    std::fs::create_dir(&flash).unwrap();
    let key = boot::key_in(&flash.join("key.der")).unwrap();
    let newer = boot::application(boot::CONTROLLER, Slot::A, 5, &key);
    let a = FlashFile::open(&flash.join("A.pflash")).unwrap();
    a.load(newer.place(), &newer.bytes).unwrap();
    let output = tandem()
        .args(["run", "--scenario", "free-lane", "--reintegrate"])
        .args(["--duration", "23", "--update", "3", "--program-flash"])
        .arg(&flash)
        .arg("--out")
        .arg(folder.path().join("report"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    for line in [
        "B runs release 3, on trial, works",
        "A has not taken the update: the bootloader refuses it: Downgrade",
        "the systems have different releases: A 5, B 1",
    ] {
        assert!(said.contains(line), "{line}: {said}");
    }
    for (system, release) in [("A", 5), ("B", 1)] {
        let flash = flash.join(format!("{system}.pflash"));
        assert_eq!(
            boots(&flash),
            Some((Some(Slot::A), release, false)),
            "{system}"
        );
    }
}

/// A run whose bus has no way to other programs does not start. It leaves nothing, and
/// says what to do.
#[test]
fn a_bus_without_a_route_is_a_clear_error() {
    let isolated = Command::new("unshare").args(["-rn", "true"]).output();
    if !isolated.is_ok_and(|output| output.status.success()) {
        eprintln!("a_bus_without_a_route_is_a_clear_error: skipped: no `unshare -rn`");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let output = Command::new("unshare")
        .args(["-rn", env!("CARGO_BIN_EXE_tandem")])
        .args(["run", "--can", "udp", "--scenario", "free-lane"])
        .args(["--program-flash", "flash", "--out", "report"])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("ip route add 224.0.0.0/4 dev lo"), "{said}");
    assert_eq!(folder.path().read_dir().unwrap().count(), 0);
}

/// U-2, U-3, T-BOOT-1: a foreign tester, written from `docs/boot.md` alone, updates both systems of
/// a driving vehicle over python-can; one with a wrong key changes nothing.
#[test]
fn a_foreign_tester_updates_a_driving_vehicle() {
    let needed = [
        "unshare -rn true",
        "ip -V",
        "openssl version",
        "objcopy --version",
        "python3 -c 'import can, msgpack'",
    ];
    for tool in needed {
        let output = Command::new("sh").args(["-c", tool]).output();
        if !output.is_ok_and(|output| output.status.success()) {
            eprintln!("a_foreign_tester_updates_a_driving_vehicle: skipped: no `{tool}`");
            return;
        }
    }
    let folder = tempfile::tempdir().unwrap();
    let script = r#"
        set -e
        ip link set lo up multicast on
        ip route add 224.0.0.0/4 dev lo
        "$TANDEM" run --can udp --reintegrate --program-flash flash --scenario free-lane \
            --duration 30 --out report > run.txt 2>&1 &
        until test -s flash/tester.der; do sleep 0.1; done
        sleep 4
        openssl genpkey -algorithm ed25519 -outform DER -out other.der
        update() { timeout 90 python3 "$CLIENT" --key flash/key.der "$@" 2>&1; }
        update --release 2 --tester-key other.der || echo "status $?"
        update --release 2 --tester-key flash/tester.der
        wait
        cat run.txt
    "#;
    let client = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../boot/host/examples/update_a_vehicle.py"
    );
    let output = Command::new("unshare")
        .args(["-rn", "bash", "-c", script])
        .env("TANDEM", env!("CARGO_BIN_EXE_tandem"))
        .env("CLIENT", client)
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}{errors}");
    for line in [
        "does not accept this tester's key",
        "status 1",
        "system A runs release 2, approved",
        "system B runs release 2, approved",
    ] {
        assert!(said.contains(line), "{line}: {said}{errors}");
    }
    for system in ["A", "B"] {
        let flash = folder.path().join(format!("flash/{system}.pflash"));
        assert_eq!(boots(&flash), Some((Some(Slot::B), 2, false)), "{system}");
    }
}
