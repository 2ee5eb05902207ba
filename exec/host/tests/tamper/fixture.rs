//! A platform of real programs with a loader and libraries of its own, and another build of each.

use std::collections::BTreeMap;
use std::fs::{self, File, Permissions};
use std::io::Read as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use tandem_boot_host::SigningKey;
use tandem_exec_host::trust::{Platform, TrustError, TrustedCommand, sign};

/// A program that has not ended after this time is killed, and the case has failed.
const WATCHDOG: Duration = Duration::from_secs(60);

pub(crate) const KEY: SigningKey = SigningKey {
    number: 1,
    seed: [7; 32],
};
/// A key that the anchor has, but as a retired one.
pub(crate) const RETIRED: SigningKey = SigningKey {
    number: 0,
    seed: [8; 32],
};
pub(crate) const MANIFEST: &str = "platform.toml";
pub(crate) const LIST: &str = "platform.toml.parts";
pub(crate) const ANCHOR: &str = "anchor.toml";
/// Each file of the platform with code in it, and the program that needs it.
pub(crate) const CODE: [(&str, &str); 8] = [
    ("bin/dynamic", "bin/dynamic"),
    ("bin/static", "bin/static"),
    ("bin/script", "bin/script"),
    ("bin/interpreter", "bin/script"),
    ("lib/ld.so", "bin/dynamic"),
    ("lib/libfirst.so", "bin/dynamic"),
    ("lib/libsecond.so", "bin/dynamic"),
    ("lib/libc.so.6", "bin/dynamic"),
];
const PROGRAMS: [&str; 3] = ["bin/dynamic", "bin/static", "bin/script"];

/// What became of an attempt to start a program.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// The check refused it, with this reason.
    Refused(String),
    /// It ran, and this is its output.
    Ran(String),
    /// It started, and crashed or hung.
    Failed(String),
}

/// The platform in a folder of its own.
pub(crate) struct Fixture {
    folder: tempfile::TempDir,
    /// All files of the platform, as they were signed.
    pub(crate) good: BTreeMap<String, Vec<u8>>,
    /// Files with the same names and another behaviour.
    pub(crate) evil: BTreeMap<String, Vec<u8>>,
}

impl Fixture {
    pub(crate) fn new() -> Self {
        let folder = tempfile::Builder::new()
            .prefix("tamper-")
            .tempdir()
            .unwrap();
        let mut it = Self {
            folder,
            good: BTreeMap::new(),
            evil: BTreeMap::new(),
        };
        for place in ["", "evil"] {
            for folder in ["bin", "lib"] {
                fs::create_dir_all(it.path(place).join(folder)).unwrap();
            }
        }
        it.copy_system();
        it.compile("good", "");
        it.compile("evil", "evil");
        let interpreter = it.path("bin/interpreter").display().to_string();
        for (token, place) in [("good", ""), ("evil", "evil/")] {
            let text = format!("#!{interpreter} -x\n{token} script\n");
            it.write(&format!("{place}bin/script"), text.as_bytes());
        }
        let manifest = PROGRAMS.map(|program| format!("[[process]]\nprogram = \"{program}\"\n"));
        it.write(MANIFEST, manifest.concat().as_bytes());
        it.write(ANCHOR, anchor("strict").as_bytes());
        it.sign();
        for (name, _) in CODE {
            it.evil.insert(
                name.to_owned(),
                fs::read(it.path("evil").join(name)).unwrap(),
            );
        }
        let all = CODE
            .iter()
            .map(|(name, _)| *name)
            .chain([MANIFEST, LIST, ANCHOR]);
        it.good = all.map(|name| (name.to_owned(), it.read(name))).collect();
        it
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub(crate) fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    /// Puts a new file in the place of an old one.
    pub(crate) fn write(&self, name: &str, bytes: &[u8]) {
        let fresh = self.path("fresh");
        fs::write(&fresh, bytes).unwrap();
        fs::set_permissions(&fresh, Permissions::from_mode(0o755)).unwrap();
        fs::rename(fresh, self.path(name)).unwrap();
    }

    pub(crate) fn restore(&self, name: &str) {
        self.write(name, &self.good[name]);
    }

    /// Copies the loader and the C library that this test uses.
    fn copy_system(&self) {
        let maps = fs::read_to_string("/proc/self/maps").unwrap();
        let mapped = |prefix: &str| {
            let mut paths = maps
                .lines()
                .filter_map(|line| line.split_once('/').map(|it| it.1));
            let is_it = |path: &&str| path.rsplit('/').next().unwrap().starts_with(prefix);
            fs::read(format!("/{}", paths.rfind(is_it).expect(prefix))).unwrap()
        };
        let libc = mapped("libc.so");
        self.write("lib/ld.so", &mapped("ld-"));
        self.write("lib/libc.so.6", &libc);
        let text = b"Operation not permitted";
        let at = libc
            .windows(text.len())
            .position(|bytes| bytes == text)
            .unwrap();
        let mut evil = libc;
        evil[at..at + text.len()].copy_from_slice(b"evil-libc not permitted");
        self.write("evil/lib/libc.so.6", &evil);
    }

    /// Compiles all programs and libraries with this text in their output.
    fn compile(&self, token: &str, place: &str) {
        let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tamper/programs");
        let lib = self.path("lib");
        let cc = |output: &str, source: &str, further: &[&str]| {
            let mut cc = Command::new("cc");
            cc.arg("-O1").arg(format!("-DTOKEN=\"{token}\"")).arg("-o");
            cc.arg(self.path(place).join(output))
                .arg(sources.join(source))
                .args(further);
            assert!(cc.status().expect("cc").success(), "{cc:?}");
        };
        let folder = format!("-L{}", lib.display());
        let link = format!("-Wl,-rpath-link,{}", lib.display());
        let loader = format!("-Wl,--dynamic-linker,{}", lib.join("ld.so").display());
        let origin = "-Wl,-rpath,$ORIGIN/../lib";
        let second = ["-shared", "-fPIC", "-nostdlib", "-Wl,-soname,libsecond.so"];
        cc("lib/libsecond.so", "second.c", &second);
        let first = [
            "-shared",
            "-fPIC",
            "-Wl,-soname,libfirst.so",
            origin,
            &folder,
            "-lsecond",
        ];
        cc("lib/libfirst.so", "first.c", &first);
        cc(
            "bin/dynamic",
            "dynamic.c",
            &[origin, &loader, &folder, &link, "-lfirst"],
        );
        cc("bin/interpreter", "interpreter.c", &[origin, &loader]);
        cc("bin/static", "static.c", &["-static"]);
        if !place.is_empty() {
            let fake = fs::read(self.path(place).join("bin/static")).unwrap();
            self.write("evil/lib/ld.so", &fake);
        }
    }

    /// Signs the platform as it is.
    pub(crate) fn sign(&self) {
        let programs = PROGRAMS.map(PathBuf::from);
        let signature = |message: &[u8]| KEY.sign(message);
        let parts = sign(&self.path(MANIFEST), &programs, 5, KEY.number, signature).unwrap();
        assert_eq!(parts.len(), CODE.len() + 1, "{parts:?}");
    }

    pub(crate) fn open(&self) -> Result<Platform, TrustError> {
        Platform::open(&self.path(MANIFEST), Some(&self.path(ANCHOR)))
    }

    /// Tries to start a program. `between` happens after all checks.
    pub(crate) fn attempt(&self, program: &str, between: impl FnOnce()) -> Outcome {
        let platform = self.open();
        let command = platform.and_then(|platform| platform.command(Path::new(program)));
        between();
        match command {
            Err(error) => Outcome::Refused(error.to_string()),
            Ok(command) => self.run(command),
        }
    }

    /// Runs a command to its end.
    pub(crate) fn run(&self, mut command: TrustedCommand) -> Outcome {
        let output = tempfile::tempfile().unwrap();
        command.command.stdin(Stdio::null()).stderr(Stdio::null());
        command.command.stdout(output.try_clone().unwrap());
        let mut child = match start(&mut command) {
            Ok(child) => child,
            Err(error) => return Outcome::Failed(error.to_string()),
        };
        let begun = Instant::now();
        let status = loop {
            match child.try_wait().unwrap() {
                Some(status) => break status,
                None if begun.elapsed() > WATCHDOG => {
                    child.kill().unwrap();
                    child.wait().unwrap();
                    return Outcome::Failed("hangs".into());
                }
                None => std::thread::sleep(Duration::from_micros(300)),
            }
        };
        let mut text = String::new();
        let path = format!("/proc/self/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&output));
        File::open(path).unwrap().read_to_string(&mut text).unwrap();
        match status.success() {
            true => Outcome::Ran(text),
            false => Outcome::Failed(format!("{status}: {text}")),
        }
    }

    /// What a program prints if each byte of it is the signed one.
    pub(crate) fn expected(&self, program: &str) -> Outcome {
        let path = self.path(program).display().to_string();
        let script = || String::from_utf8(self.good["bin/script"].clone()).unwrap();
        Outcome::Ran(match program {
            "bin/dynamic" => {
                format!("good-dynamic good-first good-second 1 0 {path}, Operation not permitted\n")
            }
            "bin/static" => format!("good-static 1 {path}\n"),
            _ => format!("good-interpreter -x {}", script()),
        })
    }
}

/// Returns the text of an anchor.
pub(crate) fn anchor(mode: &str) -> String {
    let keys = [RETIRED, KEY].map(|key| {
        let digits = key.public().map(|byte| format!("{byte:02x}"));
        format!("\"{}\"", digits.concat())
    });
    let keys = keys.join(", ");
    format!("mode = \"{mode}\"\nlowest-key = 1\nlowest-counter = 5\nkeys = [{keys}]\n")
}

/// Starts a command as the launcher does: the process inherits the descriptors.
pub(crate) fn start(command: &mut TrustedCommand) -> std::io::Result<Child> {
    for descriptor in &command.keep {
        rustix::io::fcntl_setfd(descriptor, rustix::io::FdFlags::empty())?;
    }
    command.command.spawn()
}
