//! `tandem run` from sealed copies in memory: all its processes run what was checked. E-4

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use rustix::io::{FdFlags, fcntl_setfd};
use tandem_boot_host::SigningKey;
use tandem_exec_host::trust::{Platform, sign};

use crate::fixture::Fixture;

const KEY: SigningKey = SigningKey {
    number: 0,
    seed: [3; 32],
};

/// Returns the files and copies of which a process has executable pages.
fn code_of(pid: i32) -> Vec<String> {
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap_or_default();
    let words = maps
        .lines()
        .map(|line| line.split_whitespace().collect::<Vec<_>>());
    let words = words.filter(|words| words[1].contains('x') && words.len() > 5);
    let names = words.map(|words| words[5..].join(" "));
    names.filter(|name| !name.starts_with('[')).collect()
}

/// E-4: the supplies, cores and the vehicle of a run start from the copies of its launcher, also
/// through a bootloader, and `tandem ps` still finds them.
#[test]
fn all_processes_of_a_run_are_of_the_checked_copy() {
    let fixture = Fixture::new();
    let [manifest, anchor] = ["platform.toml", "anchor.toml"].map(|it| fixture.folder().join(it));
    fs::write(&manifest, "").unwrap();
    let key = KEY.public().map(|byte| format!("{byte:02x}")).concat();
    fs::write(&anchor, format!("mode = \"strict\"\nkeys = [\"{key}\"]\n")).unwrap();
    let programs = [PathBuf::from(crate::PROGRAM)];
    sign(&manifest, &programs, 0, 0, |message| KEY.sign(message)).unwrap();
    let platform = Platform::open(&manifest, Some(&anchor)).unwrap();
    let start = || {
        let trusted = platform.command(Path::new(crate::PROGRAM)).unwrap();
        for copy in &trusted.keep {
            fcntl_setfd(copy, FdFlags::empty()).unwrap();
        }
        let mut command = trusted.command;
        command.current_dir(fixture.folder()).stdin(Stdio::null());
        command
    };
    let mut run = fixture.run_by(start(), &["--duration", "60"]);
    run.until_dual();
    let processes = run.processes();
    assert_eq!(processes.len(), 9, "{processes:?}");
    let pids = processes.iter().map(|process| process.pid);
    for pid in pids.chain([run.launcher_pid()]) {
        let code = code_of(pid);
        assert!(code.len() > 2, "{code:?}");
        let copies = code.iter().filter(|name| name.starts_with("/memfd:"));
        assert_eq!(copies.count(), code.len(), "{code:?}");
    }
    // A command that another program implements: found beside the file, not beside the copy.
    let mut help = start();
    help.args(["top", "--help"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    let help = help.output().unwrap();
    let said = String::from_utf8_lossy(&help.stderr);
    assert!(!said.contains("memfd"), "{said}");
    run.interrupt();
    run.left_nothing();
}
