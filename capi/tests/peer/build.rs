//! Compiles the peer in C as a user would, with header, static library and the system's compiler.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use tempfile::TempDir;

const STRICT: [&str; 4] = ["-Wall", "-Wextra", "-Werror", "-pedantic"];

fn room() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the static library that cargo built with this test: the newest in the same folder.
fn library() -> PathBuf {
    let exe = std::env::current_exe().unwrap();
    let beside = std::fs::read_dir(exe.parent().unwrap()).unwrap();
    let of_ours = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("libtandem_capi") && name.ends_with(".a")
    };
    let mut found: Vec<PathBuf> = beside.map(|entry| entry.unwrap().path()).collect();
    found.retain(of_ours);
    let age = |path: &PathBuf| path.metadata().and_then(|data| data.modified()).unwrap();
    found.into_iter().max_by_key(age).unwrap()
}

fn compiled(compiler: &str, arguments: &[&str], paths: &[&Path]) {
    let mut command = Command::new(compiler);
    command
        .args(arguments)
        .args(STRICT)
        .arg("-I")
        .arg(room().join("include"))
        .args(paths);
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}\n{said}");
}

/// Compiles a source of this room, and links it with the library.
fn linked(source: &str, program: &Path) {
    let (source, library) = (room().join(source), library());
    let mut paths: Vec<&Path> = vec![&source, Path::new("-o"), program, &library];
    paths.extend(["-lpthread", "-ldl", "-lm", "-lgcc_s"].map(Path::new));
    compiled("cc", &["-std=c99", "-O2"], &paths);
}

/// Compiles the example of the docs, and returns what it prints.
pub(crate) fn output_of_the_example() -> String {
    let place = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let folder = TempDir::with_prefix_in("tandem-capi-", place).unwrap();
    let program = folder.path().join("two_cores");
    linked("examples/two_cores.c", &program);
    let output = Command::new(program).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// Compiles the peer once for each test process, and returns its path, which is always the same.
pub(crate) fn peer() -> &'static Path {
    static PEER: LazyLock<PathBuf> = LazyLock::new(|| {
        let place = Path::new(env!("CARGO_TARGET_TMPDIR"));
        let folder = TempDir::with_prefix_in("tandem-capi-", place).unwrap();
        let program = folder.path().join("peer");
        linked("tests/peer/peer.c", &program);
        // A rename replaces the file atomically: other test processes may be starting it.
        let peer = place.join("tandem-capi-peer");
        std::fs::rename(&program, &peer).unwrap();
        peer
    });
    &PEER
}

/// Checks that the header compiles as C++, too. Without a C++ compiler it prints a note instead.
pub(crate) fn compiles_as_cpp() {
    if Command::new("c++").arg("--version").output().is_err() {
        eprintln!("no C++ compiler: the header was not tried with one");
        return;
    }
    let header = room().join("tests/peer/layout.h");
    compiled(
        "c++",
        &["-std=c++11", "-fsyntax-only", "-x", "c++"],
        &[&header],
    );
}
