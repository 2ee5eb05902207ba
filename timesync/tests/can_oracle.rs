//! Time over CAN against a tester in Python, written from the protocol's page.
#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::io::Write as _;
use std::process::{Command, Stdio};

use tandem_board::{Duration, Instant, SystemId};
use tandem_timesync::{
    Arbitrary, CanTimeCrc, CanTimeFrame, CanTimeMaster, CanTimeSlave, GlobalTime,
};

/// Runs the tester on this input and returns what it prints. `None` if Python or a package is
/// missing: the test is skipped; with `TANDEM_REQUIRE_ORACLES=1` it fails.
fn tester(mode: &str, input: &str) -> Option<String> {
    const HINT: &str = "pip install python-can crccheck";
    let mut python = Command::new("python3");
    let import = python.args(["-c", "import can, crccheck"]).output();
    if !import.is_ok_and(|output| output.status.success()) {
        let required = std::env::var_os("TANDEM_REQUIRE_ORACLES").is_some_and(|value| value == "1");
        assert!(!required, "{HINT}");
        let _ = writeln!(std::io::stderr(), "{mode}: skipped: {HINT}");
        return None;
    }
    let file = std::env::temp_dir().join(format!("can-oracle-{mode}-{}", std::process::id()));
    std::fs::write(&file, input).unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/can_oracle.py");
    let output = Command::new("python3")
        .args([script, mode])
        .stdin(std::fs::File::open(&file).unwrap())
        .stderr(Stdio::inherit())
        .output();
    std::fs::remove_file(file).unwrap();
    let output = output.unwrap();
    assert!(output.status.success(), "{mode}: {}", output.status);
    Some(String::from_utf8(output.stdout).unwrap())
}

fn hex(frame: &CanTimeFrame) -> String {
    frame.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// S-4: the tester reads the frames of our master.
#[test]
fn the_tester_reads_our_frames() {
    let (mut input, mut expected) = (String::new(), String::new());
    for (n, system) in [SystemId::A, SystemId::A, SystemId::B, SystemId::B]
        .into_iter()
        .enumerate()
    {
        let is_secured = n % 2 == 1;
        let mut master = CanTimeMaster::new(system, is_secured, Instant::ORIGIN);
        for period in 0..500 {
            let (now, is_to_gateway) = (master.due(), period % 3 == 0);
            let time =
                GlobalTime::<Arbitrary>::from_ns(4_294_960_000_123_456_789 + now.as_ns() * 9);
            let sync = master.poll(now, time).unwrap();
            let (at, time) = (
                now + Duration::from_us(300),
                time.moved(3_999_999_999 % (7 * period + 1)),
            );
            master.on_sent(at, time, is_to_gateway);
            let follow_up = master.poll(master.due(), time).unwrap();
            writeln!(input, "{system} {} {}", hex(&sync), hex(&follow_up)).unwrap();
            let (secured, gateway) = (u8::from(is_secured), u8::from(is_to_gateway));
            writeln!(
                expected,
                "{secured} {} {gateway} {}",
                period % 16,
                time.as_ns()
            )
            .unwrap();
        }
    }
    if let Some(output) = tester("decode", &input) {
        assert!(output == expected, "{output}\nand expected:\n{expected}");
    }
}

/// S-4: our slave says of each frame of the tester what it must.
#[test]
fn our_slave_says_of_each_frame_what_it_must() {
    let Some(script) = tester("script", "") else {
        return;
    };
    let mut slave = CanTimeSlave::<Arbitrary>::new(CanTimeCrc::Validated);
    for (number, line) in script.lines().enumerate() {
        let words: Vec<_> = line.split(' ').collect();
        if let ["new", policy] = words[..] {
            let all = [
                CanTimeCrc::Validated,
                CanTimeCrc::NotValidated,
                CanTimeCrc::Optional,
            ];
            let crc = all.into_iter().find(|crc| format!("{crc:?}") == policy);
            slave = CanTimeSlave::new(crc.unwrap_or(CanTimeCrc::Ignored));
            continue;
        }
        let [at_us, system, frame, answer] = words[..] else {
            panic!("{line}")
        };
        let at = Instant::from_ns(1_000 * at_us.parse::<u64>().unwrap());
        let from = SystemId::ALL[usize::from(system == "B")];
        let byte = |at: usize| u8::from_str_radix(&frame[at..at + 2], 16).unwrap();
        let bytes: Vec<_> = (0..frame.len() / 2).map(|n| byte(2 * n)).collect();
        let ours = match slave.receive(from, at, &bytes) {
            Ok(None) => "wait".to_owned(),
            Ok(Some(time)) => {
                assert_eq!(time.from, from);
                let ns = time.sample.global.as_ns();
                format!("time:{ns}:{}", u8::from(time.is_to_gateway))
            }
            Err(refusal) => format!("{refusal:?}"),
        };
        assert_eq!(ours, answer, "line {}: {line}", number + 1);
    }
}
