//! The tamper matrix: each part damaged before the check, and replaced after it.

use std::fmt::Write as _;
use std::fs::{self, File};
use std::os::unix::fs::{FileExt as _, symlink};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::fixture::{ANCHOR, CODE, Fixture, KEY, LIST, MANIFEST, Outcome};

/// How many cases the matrix has.
#[derive(Clone, Copy)]
struct Extent {
    /// Ranges that cover each part of the code.
    ranges: usize,
    /// One byte of this many is changed in texts, and one bit of this many in headers.
    every: usize,
    /// Starts while a thread replaces the part all the time.
    races: usize,
}

/// A short selection for each build.
const SHORT: Extent = Extent {
    ranges: 3,
    every: 61,
    races: 4,
};
const FULL: Extent = Extent {
    ranges: 16,
    every: 3,
    races: 25,
};
/// The header of an ELF file, and the program header of those at hand.
const HEADER_BITS: usize = 8 * 0x200;

/// The results.
struct Matrix<'f> {
    fixture: &'f Fixture,
    cases: usize,
    refused: usize,
    accepted: Vec<String>,
}

impl Matrix<'_> {
    /// Counts a case. After a replacement the program may also run as it was signed.
    fn count(&mut self, name: String, program: &str, outcome: Outcome, may_run: bool) {
        self.cases += 1;
        match outcome {
            Outcome::Refused(_) => self.refused += 1,
            outcome if may_run && outcome == self.fixture.expected(program) => {}
            outcome => self.accepted.push(format!("{name}: {outcome:?}")),
        }
    }

    /// The undamaged platform must start, or a refusal proves nothing.
    fn control(&self, program: &str) {
        let outcome = self.fixture.attempt(program, || {});
        assert_eq!(outcome, self.fixture.expected(program), "undamaged");
    }

    /// Damages a file, tries to start, repairs the file, and starts.
    fn damaged(&mut self, case: &str, file: &str, program: &str, damage: impl FnOnce(&Path)) {
        let path = self.fixture.path(file);
        damage(&path);
        let outcome = self.fixture.attempt(program, || {});
        self.count(format!("{file}: {case}"), program, outcome, false);
        if path.symlink_metadata().is_ok_and(|it| it.is_dir()) {
            fs::remove_dir(&path).unwrap();
        }
        self.fixture.restore(file);
        self.control(program);
    }

    fn written(&mut self, case: &str, file: &str, program: &str, bytes: &[u8]) {
        let fixture = self.fixture;
        if bytes != fixture.good[file] {
            self.damaged(case, file, program, |_| fixture.write(file, bytes));
        }
    }

    /// Each range of bytes, single bits of the header, and other lengths.
    fn bytes_changed(&mut self, file: &str, program: &str, extent: Extent) {
        let good = self.fixture.good[file].clone();
        let step = good.len().div_ceil(extent.ranges);
        for start in (0..good.len()).step_by(step) {
            let mut bytes = good.clone();
            let end = good.len().min(start + step);
            bytes[start..end].iter_mut().for_each(|byte| *byte ^= 0xFF);
            self.written(&format!("{start}..{end} inverted"), file, program, &bytes);
        }
        for bit in (0..HEADER_BITS.min(8 * good.len())).step_by(extent.every * 16) {
            let mut bytes = good.clone();
            bytes[bit / 8] ^= 1 << (bit % 8);
            self.written(&format!("bit {bit}"), file, program, &bytes);
        }
        self.lengths_changed(file, program);
        self.put_in_place(file, program);
    }

    fn lengths_changed(&mut self, file: &str, program: &str) {
        let good = self.fixture.good[file].clone();
        for length in [0, 1, 64, good.len() / 2, good.len() - 1] {
            let bytes = &good[..length.min(good.len() - 1)];
            self.written(&format!("cut to {length}"), file, program, bytes);
        }
        for further in [&b"\n"[..], &[0], &[0; 4096], &good] {
            let bytes = [&good[..], further].concat();
            self.written(
                &format!("{} bytes longer", further.len()),
                file,
                program,
                &bytes,
            );
        }
    }

    /// What is no plain file.
    fn put_in_place(&mut self, file: &str, program: &str) {
        let same = self.fixture.path("same");
        fs::write(&same, &self.fixture.good[file]).unwrap();
        let gone = |path: &Path| fs::remove_file(path).unwrap();
        self.damaged("missing", file, program, gone);
        self.damaged("a folder", file, program, |path| {
            gone(path);
            fs::create_dir(path).unwrap();
        });
        self.damaged("a pipe", file, program, |path| {
            gone(path);
            let kind = rustix::fs::FileType::Fifo;
            rustix::fs::mknodat(rustix::fs::CWD, path, kind, 0o644.into(), 0).unwrap();
        });
        self.damaged("a link to the same bytes", file, program, |path| {
            gone(path);
            symlink(&same, path).unwrap();
        });
    }

    /// Single bytes of a signed text.
    fn text_changed(&mut self, file: &str, every: usize) {
        let good = self.fixture.good[file].clone();
        for at in (0..good.len()).step_by(every) {
            for bit in [1, 0x20] {
                let mut bytes = good.clone();
                bytes[at] ^= bit;
                self.written(&format!("byte {at} ^ {bit}"), file, "bin/static", &bytes);
            }
        }
        self.lengths_changed(file, "bin/static");
        self.put_in_place(file, "bin/static");
    }

    /// Each digit of the key that signed.
    fn anchor_changed(&mut self) {
        let good = String::from_utf8(self.fixture.good[ANCHOR].clone()).unwrap();
        let key = KEY.public().map(|byte| format!("{byte:02x}")).concat();
        let start = good.find(&key).unwrap();
        for at in start..start + key.len() {
            for bit in [1, 0x20] {
                let mut bytes = good.clone().into_bytes();
                bytes[at] ^= bit;
                self.written(
                    &format!("key, byte {at} ^ {bit}"),
                    ANCHOR,
                    "bin/static",
                    &bytes,
                );
            }
        }
        for at in (0..start + key.len()).step_by(8) {
            let bytes = &good.as_bytes()[..at];
            self.written(&format!("cut to {at}"), ANCHOR, "bin/static", bytes);
        }
    }

    /// Each part in the place of each other, and its other build.
    fn exchanged(&mut self) {
        let fixture = self.fixture;
        for (file, program) in CODE {
            self.written("another build", file, program, &fixture.evil[file]);
            for (other, _) in CODE.iter().filter(|(other, _)| *other != file) {
                self.written(&format!("is {other}"), file, program, &fixture.good[*other]);
                fixture.write(file, &fixture.good[*other]);
                fixture.write(other, &fixture.good[file]);
                let outcome = fixture.attempt(program, || {});
                self.count(
                    format!("{file}: swapped with {other}"),
                    program,
                    outcome,
                    false,
                );
                fixture.restore(file);
                fixture.restore(other);
                self.control(program);
            }
        }
    }

    /// Replaced at three moments, and all the time: the program is refused or runs as signed.
    fn replaced(&mut self, file: &str, program: &str, races: usize) {
        let fixture = self.fixture;
        let evil = &fixture.evil[file];
        let good = &fixture.good[file];
        let in_place = |bytes: &[u8]| {
            let target = File::options()
                .write(true)
                .open(fixture.path(file))
                .unwrap();
            target.write_all_at(bytes, 0).unwrap();
            target.set_len(bytes.len() as u64).unwrap();
        };
        let name = |moment: &str| format!("{file}: replaced {moment}");
        for (how, replace) in [
            ("by a rename", &(|| fixture.write(file, evil)) as &dyn Fn()),
            ("in place", &|| in_place(evil)),
            ("by an empty file", &|| in_place(&[])),
            ("by nothing", &|| {
                fs::remove_file(fixture.path(file)).unwrap()
            }),
        ] {
            let outcome = fixture.attempt(program, replace);
            self.count(
                name(&format!("{how} before the start")),
                program,
                outcome,
                true,
            );
            fixture.restore(file);
            // After the check of the list, before the check of the part.
            let platform = fixture.open().unwrap();
            replace();
            let command = platform.command(Path::new(program));
            let outcome = command.map_or_else(
                |error| Outcome::Refused(error.to_string()),
                |command| fixture.run(command),
            );
            self.count(
                name(&format!("{how} after the list")),
                program,
                outcome,
                false,
            );
            fixture.restore(file);
            // Before a restart.
            let platform = fixture.open().unwrap();
            let first = fixture.run(platform.command(Path::new(program)).unwrap());
            assert_eq!(first, fixture.expected(program));
            replace();
            let again = fixture.run(platform.command(Path::new(program)).unwrap());
            self.count(
                name(&format!("{how} before a restart")),
                program,
                again,
                true,
            );
            fixture.restore(file);
        }
        let is_over = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !is_over.load(Ordering::Relaxed) {
                    in_place(evil);
                    in_place(good);
                }
            });
            for _ in 0..races {
                let outcome = fixture.attempt(program, || {});
                self.count(name("all the time"), program, outcome, true);
            }
            is_over.store(true, Ordering::Relaxed);
        });
        fixture.restore(file);
        self.control(program);
    }
}

/// Runs the matrix. Returns the cases and those that were accepted.
fn run(extent: Extent) -> (usize, Vec<String>) {
    let fixture = Fixture::new();
    let mut matrix = Matrix {
        fixture: &fixture,
        cases: 0,
        refused: 0,
        accepted: Vec::new(),
    };
    for (file, program) in CODE {
        matrix.control(program);
        matrix.bytes_changed(file, program, extent);
        matrix.replaced(file, program, extent.races);
    }
    matrix.text_changed(MANIFEST, extent.every);
    matrix.text_changed(LIST, extent.every);
    if extent.races == FULL.races {
        matrix.anchor_changed();
        matrix.exchanged();
    }
    crate::lists::each(&fixture, |name, outcome| {
        matrix.count(name, "", outcome, false)
    });
    let Matrix {
        cases,
        refused,
        accepted,
        ..
    } = matrix;
    println!(
        "{cases} cases: {refused} refused, {} ran as signed",
        cases - refused - accepted.len()
    );
    (cases, accepted)
}

/// E-4: a selection of the matrix. `cargo xtask campaign tamper` runs all of it.
#[test]
fn a_changed_part_is_refused() {
    let (cases, accepted) = run(SHORT);
    assert!(cases >= 200, "{cases} cases");
    assert!(accepted.is_empty(), "{accepted:#?}");
}

/// E-4: the whole matrix, and what a check costs.
#[test]
#[ignore = "takes minutes: cargo xtask campaign tamper"]
fn every_changed_part_is_refused() {
    let begun = Instant::now();
    let (cases, accepted) = run(FULL);
    println!("{:.1} s", begun.elapsed().as_secs_f64());
    crate::running::print_costs();
    if let Some(path) = std::env::var_os("TANDEM_TAMPER_JSON") {
        let mut text = String::new();
        writeln!(
            text,
            "{{\"cases\": {cases}, \"accepted\": {}}}",
            accepted.len()
        )
        .unwrap();
        fs::write(path, text).unwrap();
    }
    assert!(accepted.is_empty(), "{accepted:#?}");
}
