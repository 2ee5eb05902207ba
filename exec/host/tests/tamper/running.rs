//! What runs: sealed pages, one copy for all, no foreign environment; monitor mode; costs.

use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::fs;
use std::io::Read as _;
use std::os::unix::fs::MetadataExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use tandem_exec_host::trust::{Platform, TrustedCommand, sign};

use crate::fixture::{ANCHOR, Fixture, KEY, LIST, MANIFEST, Outcome, anchor, start};

/// A process that waits for the end of its input.
struct Waiting(Child);

impl Waiting {
    /// Starts a program and waits for its first line.
    fn start(mut command: TrustedCommand) -> Self {
        command.command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut it = Self(start(&mut command).unwrap());
        let mut byte = [0];
        while byte != *b"\n" {
            it.0.stdout.as_mut().unwrap().read_exact(&mut byte).unwrap();
        }
        it
    }

    /// Returns its executable mappings: the device with the inode, and the name.
    fn executable(&self) -> BTreeSet<(String, String)> {
        let maps = fs::read_to_string(format!("/proc/{}/maps", self.0.id())).unwrap();
        let lines = maps
            .lines()
            .map(|line| line.split_whitespace().collect::<Vec<_>>());
        let lines = lines.filter(|words| words[1].contains('x'));
        lines
            .map(|words| (format!("{} {}", words[3], words[4]), words[5..].join(" ")))
            .collect()
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// E-4: each executable page is of a sealed copy, and two processes share one copy of each part.
#[test]
fn all_code_is_of_sealed_copies() {
    let fixture = Fixture::new();
    let platform = fixture.open().unwrap();
    let command = || platform.command(Path::new("bin/dynamic")).unwrap();
    let both = [Waiting::start(command()), Waiting::start(command())];
    let [first, second] = both.each_ref().map(Waiting::executable);
    let kernel = ["[vdso]", "[vsyscall]"];
    let code = |all: BTreeSet<(String, String)>| {
        let all = all
            .into_iter()
            .filter(|(_, name)| !kernel.contains(&name.as_str()));
        all.collect::<Vec<_>>()
    };
    let (first, second) = (code(first), code(second));
    assert_eq!(first, second, "two copies");
    assert_eq!(first.len(), 5, "{first:?}");
    for name in [
        "dynamic",
        "ld.so",
        "libfirst.so",
        "libsecond.so",
        "libc.so.6",
    ] {
        let name = format!("/memfd:{name} (deleted)");
        assert!(
            first.iter().any(|(_, it)| *it == name),
            "{name} in {first:?}"
        );
    }
}

/// E-4: the environment of the launcher does not reach a process, and no variable of the manifest
/// makes the loader read an unchecked file.
#[test]
fn no_variable_brings_other_code() {
    let fixture = Fixture::new();
    let platform = fixture.open().unwrap();
    let mut command = platform.command(Path::new("bin/dynamic")).unwrap();
    assert_eq!(command.command.get_envs().count(), 0);
    for name in [
        "LD_PRELOAD",
        "LD_AUDIT",
        "LD_LIBRARY_PATH",
        "GCONV_PATH",
        "BASH_ENV",
        "PYTHONPATH",
        "GCONV_PATH=evil:",
    ] {
        let refused = command
            .set(name, OsStr::new("evil"))
            .unwrap_err()
            .to_string();
        assert!(
            refused.starts_with("IntegrityOrAuthenticityCheckFailed"),
            "{refused}"
        );
    }
    command.set("NOTIFY_SOCKET", OsStr::new("@socket")).unwrap();
    let Outcome::Ran(text) = fixture.run(command) else {
        panic!("does not run");
    };
    assert!(
        text.starts_with("good-dynamic good-first good-second 1 1 "),
        "{text}"
    );
}

/// E-4: a process of another user runs the copies too.
#[test]
fn another_user_runs_checked_code() {
    if !rustix::process::geteuid().is_root() {
        println!("not root: cannot start a process of another user");
        return;
    }
    let fixture = Fixture::new();
    let platform = fixture.open().unwrap();
    for program in ["bin/dynamic", "bin/static", "bin/script"] {
        let mut command = platform.command(Path::new(program)).unwrap();
        command.command.uid(65534).gid(65534);
        assert_eq!(fixture.run(command), fixture.expected(program));
    }
}

/// E-4: monitor mode starts a changed file as it is, and says why; without an anchor all starts.
#[test]
fn monitor_warns_and_starts() {
    let fixture = Fixture::new();
    fixture.write(ANCHOR, anchor("monitor").as_bytes());
    let start = |platform: &Platform, program: &str| {
        let mut command = platform.command(Path::new(program)).unwrap();
        let warning = command.warning.take();
        (fixture.run(command), warning)
    };
    let platform = fixture.open().unwrap();
    assert!(platform.warning().is_none());
    assert_eq!(
        start(&platform, "bin/static"),
        (fixture.expected("bin/static"), None)
    );
    fixture.write("bin/static", &fixture.evil["bin/static"]);
    fixture.write("lib/libfirst.so", &fixture.evil["lib/libfirst.so"]);
    let platform = fixture.open().unwrap();
    for (program, part) in [("bin/static", "bin/static"), ("bin/dynamic", "libfirst.so")] {
        let (outcome, warning) = start(&platform, program);
        assert!(
            matches!(&outcome, Outcome::Ran(text) if text.contains("evil-")),
            "{outcome:?}"
        );
        let expected = format!("IntegrityOrAuthenticityCheckFailed: {part}: ");
        assert!(
            warning.as_ref().is_some_and(|it| it.starts_with(&expected)),
            "{warning:?}"
        );
    }
    fs::remove_file(fixture.path(LIST)).unwrap();
    let platform = fixture.open().unwrap();
    assert!(platform.warning().unwrap().to_string().contains(LIST));
    assert!(matches!(
        start(&platform, "bin/static"),
        (Outcome::Ran(_), Some(_))
    ));
    let platform = Platform::open(&fixture.path(MANIFEST), None).unwrap();
    assert!(matches!(
        start(&platform, "bin/static"),
        (Outcome::Ran(_), None)
    ));
    assert_eq!(platform.manifest(), fixture.good[MANIFEST]);
}

/// E-4: a signature of OpenSSL is accepted, and OpenSSL accepts ours.
#[test]
fn openssl_makes_and_verifies_signatures() {
    let fixture = Fixture::new();
    let list = String::from_utf8(fixture.good[LIST].clone()).unwrap();
    let (text, line) = list.split_at(list.rfind("# signature ").unwrap());
    let digits = line.trim_end().rsplit(' ').next().unwrap();
    let byte = |pair: &[u8; 2]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    let ours: Vec<u8> = digits.as_bytes().as_chunks().0.iter().map(byte).collect();
    let path = |name: &str| fixture.path(name).display().to_string();
    // RFC 8410: the header of a private key, then the key.
    let header = *b"\x30\x2e\x02\x01\x00\x30\x05\x06\x03\x2b\x65\x70\x04\x22\x04\x20";
    fs::write(path("key.der"), [&header[..], &KEY.seed].concat()).unwrap();
    fs::write(path("text"), text).unwrap();
    fs::write(path("ours"), &ours).unwrap();
    let openssl = |words: &[&str]| {
        let files = [
            "-rawin",
            "-in",
            &path("text"),
            "-inkey",
            &path("key.der"),
            "-keyform",
            "DER",
        ];
        let mut command = Command::new("openssl");
        command
            .arg("pkeyutl")
            .args(words)
            .args(files)
            .output()
            .expect("openssl")
    };
    let verified = openssl(&["-verify", "-sigfile", &path("ours")]);
    assert!(verified.status.success(), "{verified:?}");
    let theirs = openssl(&["-sign"]).stdout;
    assert_eq!(theirs, ours, "Ed25519 has one signature for each message");
    let mut wrong = ours;
    wrong[5] ^= 1;
    fs::write(path("ours"), wrong).unwrap();
    assert!(
        !openssl(&["-verify", "-sigfile", &path("ours")])
            .status
            .success()
    );
    let theirs = theirs
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect::<String>();
    let number = KEY.number;
    fixture.write(
        LIST,
        format!("{text}# signature {number} {theirs}\n").as_bytes(),
    );
    assert_eq!(
        fixture.attempt("bin/static", || {}),
        fixture.expected("bin/static")
    );
}

/// Returns the loader of this program.
fn parts_loader() -> PathBuf {
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    let mut paths = maps
        .lines()
        .filter_map(|line| line.find('/').map(|at| &line[at..]));
    paths
        .rfind(|path| path.contains("/ld-"))
        .expect("a loader")
        .into()
}

/// E-4: the system's own programs are found with all their libraries, and run.
#[test]
fn programs_of_the_system_run() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("m.toml"), "").unwrap();
    // A loader would start whatever its arguments name, and `env` what the search path names.
    fs::write(path("script"), "#!/usr/bin/env sh\n").unwrap();
    for no_program in [parts_loader(), path("script")] {
        let refused = sign(&path("m.toml"), &[no_program], 0, 0, |bytes| {
            KEY.sign(bytes)
        });
        assert!(refused.is_err(), "{refused:?}");
    }
    let programs = ["/bin/sh", "/usr/bin/openssl"].map(PathBuf::from);
    let parts = sign(&path("m.toml"), &programs, 0, 0, |bytes| KEY.sign(bytes)).unwrap();
    assert!(
        parts
            .iter()
            .any(|part| part.name.starts_with("libcrypto.so")),
        "{parts:?}"
    );
    let key = KEY.public().map(|byte| format!("{byte:02x}")).concat();
    fs::write(
        path("a.toml"),
        format!("mode = \"strict\"\nkeys = [\"{key}\"]\n"),
    )
    .unwrap();
    let platform = Platform::open(&path("m.toml"), Some(&path("a.toml"))).unwrap();
    for (program, words) in [
        ("/bin/sh", &["-c", ":"][..]),
        ("/usr/bin/openssl", &["version"]),
    ] {
        let mut command = platform.command(Path::new(program)).unwrap();
        command.command.args(words).stdout(Stdio::null());
        let status = start(&mut command).unwrap().wait().unwrap();
        assert!(status.success(), "{program}: {status}");
    }
}

/// Prints what a check costs, and what ten processes cost in memory.
pub(crate) fn print_costs() {
    let fixture = Fixture::new();
    let size: u64 = fixture.good.values().map(|bytes| bytes.len() as u64).sum();
    let mut times = Vec::new();
    for _ in 0..20 {
        let platform = fixture.open().unwrap();
        let begun = Instant::now();
        for program in ["bin/dynamic", "bin/static", "bin/script"] {
            platform.command(Path::new(program)).unwrap();
        }
        times.push(begun.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    let megabytes = size as f64 / 1e6;
    println!(
        "check of {megabytes:.2} MB: least {:.2} ms a MB, p50 {:.2} ms a MB ({} runs)",
        times[0] / megabytes,
        times[times.len() / 2] / megabytes,
        times.len()
    );
    let platform = fixture.open().unwrap();
    let commands = (0..10).map(|_| platform.command(Path::new("bin/dynamic")).unwrap());
    let commands: Vec<TrustedCommand> = commands.collect();
    let copies = commands.iter().flat_map(|command| &command.keep);
    let copies = copies.map(|copy| {
        let file = fs::File::from(copy.try_clone().unwrap())
            .metadata()
            .unwrap();
        (file.ino(), file.blocks() * 512)
    });
    let copies: BTreeSet<(u64, u64)> = copies.collect();
    let bytes: u64 = copies.iter().map(|(_, bytes)| bytes).sum();
    let processes: Vec<Waiting> = commands.into_iter().map(Waiting::start).collect();
    println!(
        "{} processes share {} copies of {:.2} MB in total",
        processes.len(),
        copies.len(),
        bytes as f64 / 1e6
    );
}
