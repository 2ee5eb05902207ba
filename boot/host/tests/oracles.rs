//! Compares files and signatures with other programs: srec_cat, bincopy, objcopy, OpenSSL. If a
//! program is missing, its test prints that and passes, unless `TANDEM_REQUIRE_BOOT_ORACLES=1`.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{factory, image, signed};
use proptest::strategy::{Strategy as _, ValueTree as _};
use proptest::test_runner::TestRunner;
use std::fs;
use std::io::Write as _;
use std::path::Path;
use std::process::Command;
use tandem_boot::{SIGNED_BYTES, Slot, Trust, TrustMode, ed25519};
use tandem_boot_host::life::{End, Life, TEST_KEY, TEST_PUBLIC};
use tandem_boot_host::{Content, line, records};

/// Returns whether `program` runs with these arguments. If not, prints that `test` is skipped.
fn have(test: &str, program: &str, arguments: &[&str]) -> bool {
    let output = Command::new(program).args(arguments).output();
    if output.is_ok_and(|output| output.status.success()) {
        return true;
    }
    let required = std::env::var_os("TANDEM_REQUIRE_BOOT_ORACLES").is_some_and(|one| one == "1");
    assert!(
        !required,
        "{test}: {program} {arguments:?} is required and does not work"
    );
    let _ = writeln!(
        std::io::stderr(),
        "{test}: skipped: {program} {arguments:?} does not work"
    );
    false
}

fn run(program: &str, arguments: &[&str]) -> String {
    let output = Command::new(program).args(arguments).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{program} {arguments:?}: {error}");
    String::from_utf8(output.stdout).unwrap()
}

fn path(folder: &Path, name: &str) -> String {
    folder.join(name).to_str().unwrap().to_owned()
}

/// Formats runs of bytes as `srec.py` prints them.
fn summary(content: &Content) -> String {
    let crc = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC);
    let runs = content.runs.iter().map(|(address, bytes)| {
        format!("{address:08X}:{}:{:08X}", bytes.len(), crc.checksum(bytes))
    });
    let text = runs.collect::<Vec<_>>().join(" ");
    if text.is_empty() {
        "empty".into()
    } else {
        text
    }
}

/// Returns 300 files: 150 valid ones, and each again with one changed, lost or added character.
fn files() -> Vec<String> {
    let mut runner = TestRunner::deterministic();
    let mut files = Vec::new();
    let run = (
        1u8..=3,
        0u32..0xF000,
        proptest::collection::vec(proptest::num::u8::ANY, 1..60),
    );
    let runs = proptest::collection::vec(run, 1..5);
    let change = (
        0usize..100,
        proptest::num::usize::ANY,
        proptest::char::range(' ', '~'),
    );
    for _ in 0..150 {
        let runs = runs.new_tree(&mut runner).unwrap().current();
        let mut text = line(0, &[0, 0], b"oracle");
        for (digit, address, data) in runs {
            let address = &address.to_be_bytes()[3 - usize::from(digit)..];
            text += &line(digit, address, &data);
        }
        text += &line(9, &[0, 0], &[]);
        let (kind, place, character) = change.new_tree(&mut runner).unwrap().current();
        let mut changed: Vec<char> = text.chars().collect();
        let place = place % changed.len();
        match kind {
            0..60 => changed[place] = character,
            60..80 => drop(changed.remove(place)),
            _ => changed.insert(place, character),
        }
        files.push(text);
        files.push(changed.into_iter().collect());
    }
    files
}

/// T-BOOT-4: we read the same data from a file as bincopy, and refuse each file that it refuses.
#[test]
fn bincopy_reads_the_same() {
    if !have(
        "bincopy_reads_the_same",
        "python3",
        &["-c", "import bincopy"],
    ) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let files = files();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/oracle/srec.py");
    let mut arguments = vec![script.to_owned()];
    for (index, text) in files.iter().enumerate() {
        let path = path(folder.path(), &format!("{index}.srec"));
        fs::write(&path, text).unwrap();
        arguments.push(path);
    }
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let theirs = run("python3", &arguments);
    let (mut same, mut refused) = (0, 0);
    for (text, theirs) in files.iter().zip(theirs.lines()) {
        match (Content::parse(text), theirs) {
            (Ok(ours), theirs) if theirs != "refused" => {
                assert_eq!(summary(&ours), theirs, "{text}");
                same += 1;
            }
            (Err(_), "refused") => refused += 1,
            // We are stricter than bincopy: S4, a count or entry with data, blanks inside a line.
            (Err(_), _) => {}
            // bincopy must read every file that we read.
            (Ok(ours), _) => panic!("only we read {text:?}: {ours:?}"),
        }
    }
    assert!(
        same >= 120 && refused >= 60,
        "{same} read, {refused} refused"
    );
}

/// T-BOOT-4: for each width of address we read the files of srec_cat, and it reads ours.
#[test]
fn srec_cat_writes_and_reads_the_same() {
    if !have(
        "srec_cat_writes_and_reads_the_same",
        "srec_cat",
        &["--version"],
    ) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (binary, file) = (
        path(folder.path(), "in.bin"),
        path(folder.path(), "out.srec"),
    );
    let bytes: Vec<u8> = (0..3000u32).map(|at| (at * 31 / 8) as u8).collect();
    fs::write(&binary, &bytes).unwrap();
    for (width, address) in [("2", 0x4000u32), ("3", 0x10_0100), ("4", 0xA010_0100)] {
        for block in ["1", "16", "17", "250"] {
            let address_text = format!("{address:#x}");
            let option = format!("-address-length={width}");
            let length = format!(
                "-line-length={}",
                4 + 2 * width.parse::<usize>().unwrap() + 2 * block.parse::<usize>().unwrap() + 2
            );
            run(
                "srec_cat",
                &[
                    &binary,
                    "-binary",
                    "-offset",
                    &address_text,
                    "-o",
                    &file,
                    "-motorola",
                    &option,
                    &length,
                ],
            );
            let content = Content::parse(&fs::read_to_string(&file).unwrap()).unwrap();
            assert_eq!(
                content.runs,
                [(address, bytes.clone())],
                "width {width}, {block} bytes"
            );
        }
    }
    let image = image(Slot::B, 2, 777);
    fs::write(&file, records("ours", &[&image]).concat()).unwrap();
    let place = format!("-0x{:x}", image.place());
    run(
        "srec_cat",
        &[
            &file,
            "-motorola",
            "-offset",
            &place,
            "-o",
            &binary,
            "-binary",
        ],
    );
    assert_eq!(fs::read(&binary).unwrap(), image.bytes);
}

/// T-BOOT-4, T-BOOT-5: a program that objcopy converted is signed, downloaded and booted.
#[test]
fn a_file_of_objcopy_loads() {
    if !have("a_file_of_objcopy_loads", "objcopy", &["--version"]) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (binary, file) = (
        path(folder.path(), "in.bin"),
        path(folder.path(), "out.srec"),
    );
    let bytes: Vec<u8> = (0..1001u32).map(|at| (at * 13) as u8).collect();
    fs::write(&binary, &bytes).unwrap();
    let address = "--change-section-address=.data=0xA0100100";
    let entry = "--set-start=0xA0100104";
    run(
        "objcopy",
        &[
            "-I",
            "binary",
            "-O",
            "srec",
            "--srec-forceS3",
            address,
            entry,
            &binary,
            &file,
        ],
    );
    let content = Content::parse(&fs::read_to_string(&file).unwrap()).unwrap();
    let image = signed(&content, 2);
    assert_eq!(image.bytes[256..], bytes);
    let mut flash = factory();
    let End::Running(launch) = Life::with_file(&records("o", &[&image]), 0)
        .live(&mut flash)
        .end
    else {
        panic!("not running")
    };
    assert_eq!(launch.entries[0], Some(0x10_0104));
}

/// Builds a key file that OpenSSL reads: the header of RFC 8410, then the 32 bytes of the key.
fn der(prefix: &str, key: &[u8; 32]) -> Vec<u8> {
    let (pairs, _) = prefix.as_bytes().as_chunks::<2>();
    let pair = |pair: &[u8; 2]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    pairs.iter().map(pair).chain(*key).collect()
}

/// E-4: OpenSSL and this crate verify each other's signatures; both refuse a changed manifest.
#[test]
fn openssl_signs_and_verifies_the_same() {
    if !have(
        "openssl_signs_and_verifies_the_same",
        "openssl",
        &["version"],
    ) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name| path(folder.path(), name);
    let (private, public) = (at("private.der"), at("public.der"));
    fs::write(
        &private,
        der("302e020100300506032b657004220420", &TEST_KEY.seed),
    )
    .unwrap();
    fs::write(&public, der("302a300506032b6570032100", &TEST_PUBLIC)).unwrap();
    let (message, signature) = (at("manifest"), at("signature"));
    let image = image(Slot::A, 7, 99);
    fs::write(&message, &image.bytes[..SIGNED_BYTES]).unwrap();
    fs::write(&signature, &image.bytes[SIGNED_BYTES..256]).unwrap();
    let verify = |message: &str| {
        let arguments = [
            "pkeyutl", "-verify", "-rawin", "-pubin", "-keyform", "DER", "-inkey",
        ];
        let files = [&public, "-in", message, "-sigfile", &signature];
        let mut command = Command::new("openssl");
        command
            .args(arguments)
            .args(files)
            .output()
            .unwrap()
            .status
            .success()
    };
    assert!(verify(&message));
    let mut changed = image.bytes[..SIGNED_BYTES].to_vec();
    changed[12] ^= 1;
    let changed_path = at("changed");
    fs::write(&changed_path, &changed).unwrap();
    assert!(!verify(&changed_path));

    let arguments = [
        "pkeyutl", "-sign", "-rawin", "-keyform", "DER", "-inkey", &private, "-in",
    ];
    run(
        "openssl",
        &[&arguments[..], &[&message, "-out", &signature]].concat(),
    );
    let theirs = fs::read(&signature).unwrap();
    let keys = [TEST_PUBLIC];
    let trust = Trust {
        keys: &keys,
        testers: &[],
        mode: TrustMode::Strict,
        verify: ed25519,
    };
    let with = |message: &[u8]| -> [u8; 256] { [message, &theirs].concat().try_into().unwrap() };
    assert!(trust.is_authentic(&with(&image.bytes[..SIGNED_BYTES]), 0));
    assert!(!trust.is_authentic(&with(&changed), 0));
}
