//! From the same frames, the driving functions compute bit-identical outputs as firmware and on
//! this machine. Needs QEMU and the images, so only `cargo xtask firmware test` runs it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::path::PathBuf;
use std::process::{Command, Stdio};

use recording::{DRIVE_MS, record};
use tandem_board_qemu::ImageMachine;
use tandem_golden::play;

#[path = "../../../tests/golden/recording.rs"]
mod recording;

/// Address from which the image reads the frames; see link.x.
const RECORDING_AT: u32 = 0x8100_0000;
/// Address of the strap that contains the length of the recording.
const LENGTH_AT: u32 = 0x8090_0004;

/// The image of each board.
const IMAGES: [&str; 2] = ["golden-replay", "rv64-golden-replay"];

/// Returns a board's result for these frames.
fn as_firmware(image: &str, recording: &[u32]) -> String {
    let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    let folder = tempfile::tempdir().unwrap();
    let words = [&[recording.len() as u32], recording].concat();
    let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    let file = folder.path().join("recording");
    std::fs::write(&file, bytes).unwrap();
    let loader = format!(
        "loader,file={},addr={RECORDING_AT:#x},force-raw=on",
        file.display()
    );
    let image = PathBuf::from(images).join(image);
    let emulator = ImageMachine::of(&image).unwrap().command();
    let output = Command::new("timeout")
        .arg("120")
        .arg(emulator.get_program())
        .args(emulator.get_args())
        .args([
            "-display", "none", "-monitor", "none", "-serial", "stdio", "-device", &loader,
        ])
        .args([
            "-device",
            &format!("loader,addr={LENGTH_AT:#x},data={DRIVE_MS},data-len=4"),
        ])
        .args(["-icount", "shift=0,sleep=off", "-kernel"])
        .arg(image)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let log = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{}: {log}", output.status);
    log
}

#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn outputs_of_the_functions_are_bit_identical_on_host_and_firmware() {
    for scenario in ["cut-in", "hard-braking"] {
        let recording = record(scenario);
        let here = play(&recording, DRIVE_MS);
        assert!(here.cycles > 250, "{here:?}");
        for image in IMAGES {
            let there = as_firmware(image, &recording);
            println!("{scenario}: {} words\n{here:?}\n{there}", recording.len());
            assert_eq!(
                there.lines().next(),
                Some(format!("{here:?}").as_str()),
                "{scenario}, {image}"
            );
        }
        // Wrong bits in ten frames, some of which the functions read, change the digest: so the
        // comparison can fail.
        let mut other = recording;
        let middle = other.len() / 2 / 20 * 20;
        for frame in other[middle..].chunks_mut(20).take(10) {
            frame[3] ^= 1;
            frame[5] ^= 1 << 9;
        }
        assert_ne!(play(&other, DRIVE_MS), here);
    }
}
