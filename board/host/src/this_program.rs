//! Starts the running program again, also if a loader started it from a sealed copy in memory.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::os::unix::ffi::OsStringExt as _;
use std::process::Command;

/// The kernel's path of the running program. If a loader was started explicitly, it is the
/// loader.
const RUNNING: &str = "/proc/self/exe";

/// Returns the command that starts the running program again, even if its file has been replaced.
///
/// A platform that checks its programs starts them as `LOADER --argv0 NAME … /proc/self/fd/N`, from
/// descriptors that its processes inherit. The command begins with the same words.
#[must_use]
pub fn this_program() -> Command {
    let argv = command_line("self").unwrap_or_default();
    let of_loader = loader_words(&argv).saturating_sub(1);
    let mut command = Command::new(RUNNING);
    command.args(argv.into_iter().skip(1).take(of_loader));
    command
}

/// Returns the command line of a process.
pub(crate) fn command_line(pid: &str) -> Option<Vec<OsString>> {
    let text = fs::read(format!("/proc/{pid}/cmdline")).ok()?;
    let text = text.strip_suffix(&[0]).unwrap_or(&text);
    let words = text.split(|byte| *byte == 0);
    Some(
        words
            .map(|word| OsString::from_vec(word.to_vec()))
            .collect(),
    )
}

/// Returns how many words of a command line precede the program's own arguments because a loader
/// starts the program; 0 if the kernel starts it.
pub(crate) fn loader_words(argv: &[OsString]) -> usize {
    let is = |at: usize, word: &str| argv.get(at).is_some_and(|it| it == OsStr::new(word));
    if !is(1, "--argv0") {
        return 0;
    }
    let mut at = 3;
    at += usize::from(is(at, "--inhibit-cache"));
    at += 2 * usize::from(is(at, "--preload"));
    let is_copy = |word: &OsString| word.to_string_lossy().starts_with("/proc/self/fd/");
    match argv.get(at).is_some_and(is_copy) {
        true => at + 1,
        false => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(line: &str) -> usize {
        loader_words(&line.split(' ').map(OsString::from).collect::<Vec<_>>())
    }

    /// E-4: the words of the loader are no arguments of the program.
    #[test]
    fn the_words_of_a_loader_are_recognised() {
        let copy = "/proc/self/fd/";
        assert_eq!(words("tandem __core"), 0);
        assert_eq!(words("tandem --argv0 x y"), 0);
        assert_eq!(words(&format!("tandem --argv0 tandem {copy}6 __core")), 4);
        let all = format!("{copy}5 --argv0 tandem --inhibit-cache --preload {copy}7 {copy}6");
        assert_eq!(words(&all), 7);
        assert_eq!(words(&format!("{all} run --argv0 {copy}6")), 7);
        assert_eq!(
            words(&format!("{copy}5 --argv0 tandem --preload {copy}7")),
            0
        );
    }
}
