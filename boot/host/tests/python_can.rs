//! A host on python-can, written from docs/boot.md alone, downloads over UDP multicast.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{image, loader};
use std::fs;
use std::io::Write as _;
use std::process::Command;
use std::time::Instant as Clock;
use tandem_board::{Duration, Instant, ResetCause, SystemId};
use tandem_boot::{Loader, Next, Setup, Slot, approve};
use tandem_boot_host::life::TEST_PUBLIC;
use tandem_boot_host::udp_bus::{GROUP, PORT, UdpBus};
use tandem_boot_host::{FileSender, FlashFile, TransferError, records, send_file, serve};

/// Runs `test` of this binary in a separate network namespace, whose loopback carries multicast.
fn in_a_network(test: &str, needs: &str) {
    let works = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output();
        output.is_ok_and(|output| output.status.success())
    };
    let have = works("unshare", &["-rn", "true"]) && works("ip", &["-V"]);
    if !have || !works("python3", &["-c", needs]) {
        let required =
            std::env::var_os("TANDEM_REQUIRE_BOOT_ORACLES").is_some_and(|one| one == "1");
        assert!(
            !required || !have,
            "{test}: python-can with msgpack is required"
        );
        let _ = writeln!(
            std::io::stderr(),
            "{test}: skipped: no unshare, ip or python-can"
        );
        return;
    }
    let network =
        "ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && exec \"$@\"";
    let program = std::env::current_exe().unwrap();
    let status = Command::new("unshare")
        .args(["-rn", "sh", "-c", network, "sh"])
        .arg(program)
        .args(["--exact", test, "--ignored", "--nocapture"])
        .status()
        .unwrap();
    assert!(status.success());
}

/// Creates a flash with bootloader and application 1, or opens the existing one.
fn controller(folder: &tempfile::TempDir) -> FlashFile {
    let path = folder.path().join("flash");
    let is_new = !path.exists();
    let flash = FlashFile::open(&path).unwrap();
    if is_new {
        flash.load(0, &loader(1).bytes).unwrap();
        let first = image(Slot::A, 1, 300);
        flash.load(first.place(), &first.bytes).unwrap();
    }
    flash
}

fn start(flash: &mut FlashFile, cause: ResetCause) -> Next {
    let wire = UdpBus::join(GROUP, PORT).unwrap();
    let keys = [TEST_PUBLIC];
    let setup = Setup {
        cause,
        ..fixture::setup(&keys)
    };
    let clock = Clock::now();
    let mut loader = Loader::start(flash, setup, Instant::ORIGIN);
    serve(&wire, clock, &mut loader).unwrap()
}

/// T-BOOT-3
#[test]
fn a_host_on_python_can_downloads() {
    in_a_network("python_can_inside", "import can, msgpack");
}

#[test]
#[ignore = "started by a_host_on_python_can_downloads, in a network of its own"]
fn python_can_inside() {
    let folder = tempfile::tempdir().unwrap();
    let mut flash = controller(&folder);
    let file = folder.path().join("new.srec");
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/oracle/host.py");
    for (version, expected) in [(2, "accepted\n"), (0, "refused: 7\n")] {
        let slot = if version == 2 { Slot::B } else { Slot::A };
        fs::write(
            &file,
            records("new", &[&image(slot, version, 500)]).concat(),
        )
        .unwrap();
        let mut python = Command::new("python3");
        let python = python
            .arg(script)
            .arg(&file)
            .stdout(std::process::Stdio::piped());
        let python = python.spawn().unwrap();
        let _ = start(&mut flash, ResetCause::Download);
        let output = python.wait_with_output().unwrap();
        assert_eq!(String::from_utf8(output.stdout).unwrap(), expected);
        let Next::Jump(launch) = start(&mut flash, ResetCause::Software) else {
            panic!("does not boot")
        };
        assert_eq!((launch.application, launch.version), (Slot::B, 2));
        approve(&mut flash).unwrap();
    }
}

/// T-BOOT-3: this project's host, with a window, is interrupted half-way and resumes.
#[test]
fn a_broken_connection_is_resumed() {
    in_a_network("resume_inside", "");
}

#[test]
#[ignore = "started by a_broken_connection_is_resumed, in a network of its own"]
fn resume_inside() {
    let folder = tempfile::tempdir().unwrap();
    let mut flash = controller(&folder);
    let new = image(Slot::B, 2, 4000);
    let lines = records("new", &[&new]);
    let half = lines[..lines.len() / 2].to_vec();
    let controller = std::thread::spawn(move || {
        let _ = start(&mut flash, ResetCause::Download);
        start(&mut flash, ResetCause::Software)
    });
    let wire = UdpBus::join(GROUP, PORT).unwrap();
    let within = Duration::from_ms(60_000);
    // This file has no entry record: its sender is done when all records are accepted.
    send_file(
        &wire,
        FileSender::new(half.clone(), None, 1),
        within,
        |_, _| {},
    )
    .unwrap();
    let mut first = None;
    let resumed = FileSender::new(lines, Some(SystemId::A), 16).resuming();
    send_file(&wire, resumed, within, |done, _| {
        if done > 0 {
            first.get_or_insert(done);
        }
    })
    .unwrap();
    assert!(
        first.unwrap() >= half.len() as u32,
        "{first:?} of {}",
        half.len()
    );
    let Next::Jump(launch) = controller.join().unwrap() else {
        panic!("does not boot")
    };
    assert_eq!((launch.application, launch.version), (Slot::B, 2));
}

/// T-BOOT-1: the bootloader does not answer after an abnormal reset or a software reset.
#[test]
fn no_window_after_an_abnormal_reset() {
    in_a_network("abnormal_inside", "");
}

#[test]
#[ignore = "started by no_window_after_an_abnormal_reset, in a network of its own"]
fn abnormal_inside() {
    let folder = tempfile::tempdir().unwrap();
    let mut flash = controller(&folder);
    let host = std::thread::spawn(|| {
        let wire = UdpBus::join(GROUP, PORT).unwrap();
        let host = FileSender::new(records("new", &[&image(Slot::B, 2, 50)]), None, 0);
        send_file(&wire, host, Duration::from_ms(500), |_, _| {})
    });
    for cause in [ResetCause::Watchdog, ResetCause::Trap, ResetCause::Software] {
        assert!(matches!(start(&mut flash, cause), Next::Jump(_)));
    }
    let said = host.join().unwrap();
    assert!(matches!(said, Err(TransferError::NoAnswer(_))), "{said:?}");
}
