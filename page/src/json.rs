//! The option `--json [FILE]`: one meaning for all commands.
//!
//! Without FILE, stdout has the JSON and nothing else. With FILE, the JSON goes there, and stdout
//! keeps the text for people. A command that fails before it has a result leaves FILE as it was.

use std::ffi::OsString;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use crate::output::{OutputError, OutputFile, STDOUT, distinct};

/// The option, as it stands on a command line.
const OPTION: &str = "--json";
/// A word behind the option is FILE if it ends so.
const SUFFIX: &str = ".json";

/// The option `--json [FILE]` of a command.
#[derive(Args, Clone, Debug, Default, PartialEq, Eq)]
pub struct JsonOption {
    /// Print JSON on stdout instead of the text; with =FILE: write it there, beside the text
    ///
    /// `--json FILE` means the same as `--json=FILE` if FILE ends in .json, or is a path with a
    /// slash at which there is nothing, or an empty file, or JSON. Another word behind `--json`
    /// is an argument of its own. docs/json.md describes the document of each command.
    #[arg(
        long,
        value_name = "FILE",
        num_args = 0..=1,
        require_equals = true,
        default_missing_value = STDOUT,
        global = true
    )]
    json: Option<PathBuf>,
}

impl JsonOption {
    /// Returns whether the option is there.
    #[must_use]
    pub const fn is_given(&self) -> bool {
        self.json.is_some()
    }

    /// Returns the word that gives another process of this program the same option.
    #[must_use]
    pub fn word(&self) -> Option<OsString> {
        let path = self.json.as_deref()?;
        let mut word = OsString::from(format!("{OPTION}="));
        word.push(path);
        Some(word)
    }

    /// Checks that FILE can be written, and changes nothing.
    ///
    /// # Errors
    /// [`OutputError`] names the obstacle.
    pub fn check(&self) -> Result<JsonOutput, OutputError> {
        let (output, []) = self.check_with([])?;
        Ok(output)
    }

    /// Checks FILE, and the file of each other option that names one. Changes nothing.
    ///
    /// # Errors
    /// [`OutputError`] names the obstacle, such as two options for one file.
    pub fn check_with<const N: usize>(
        &self,
        others: [(&'static str, Option<&Path>); N],
    ) -> Result<(JsonOutput, [Option<OutputFile>; N]), OutputError> {
        let others = OutputFile::check_all(others)?;
        let own = self.json.as_deref();
        let own = own
            .map(|path| OutputFile::check(OPTION, path))
            .transpose()?;
        distinct(&others.iter().flatten().chain(&own).collect::<Vec<_>>())?;
        Ok((JsonOutput(own), others))
    }
}

/// A checked `--json [FILE]`: where a command's JSON goes.
#[derive(Debug, Default)]
pub struct JsonOutput(Option<OutputFile>);

impl JsonOutput {
    /// Returns whether stdout has the JSON. Then the command prints nothing else there.
    #[must_use]
    pub fn takes_stdout(&self) -> bool {
        self.0.as_ref().is_some_and(OutputFile::is_stdout)
    }

    /// Writes the document to FILE, if there is one. Returns what stdout gets: the document or the
    /// text.
    ///
    /// # Errors
    /// [`OutputError`], such as a full disk.
    #[must_use = "the caller prints it"]
    pub fn write(
        self,
        document: &impl Serialize,
        text: impl FnOnce() -> String,
    ) -> Result<String, OutputError> {
        let Some(place) = self.0 else {
            return Ok(text());
        };
        let json = serde_json::to_string_pretty(document);
        let json = json.map_err(|error| place.error(&error))? + "\n";
        if place.is_stdout() {
            return Ok(json);
        }
        place.write(&json)?;
        Ok(text())
    }

    /// Returns a place for documents that follow one another, one a line.
    #[must_use]
    pub fn lines(self) -> JsonLines {
        JsonLines {
            place: self.0,
            kept: String::new(),
        }
    }
}

/// Where the documents of a command go that prints one a line.
#[derive(Debug)]
pub struct JsonLines {
    place: Option<OutputFile>,
    /// Lines for FILE.
    kept: String,
}

impl JsonLines {
    /// Takes a document. Returns the line that stdout gets at once: the document or the text.
    ///
    /// # Errors
    /// [`OutputError`] if the document has no form in JSON.
    #[must_use = "the caller prints it"]
    pub fn line(
        &mut self,
        document: &impl Serialize,
        text: impl FnOnce() -> String,
    ) -> Result<String, OutputError> {
        let Some(place) = &self.place else {
            return Ok(text());
        };
        let json = serde_json::to_string(document);
        let json = json.map_err(|error| place.error(&error))? + "\n";
        if place.is_stdout() {
            return Ok(json);
        }
        self.kept += &json;
        Ok(text())
    }

    /// Writes FILE, if there is one. Call it when the command ends.
    ///
    /// # Errors
    /// [`OutputError`], such as a full disk.
    pub fn finish(&mut self) -> Result<(), OutputError> {
        match self.place.take_if(|place| !place.is_stdout()) {
            Some(place) => place.write(&self.kept),
            None => Ok(()),
        }
    }
}

/// Returns whether a word behind the option is FILE, and not another argument. A path is FILE only
/// if nothing would be lost by writing there: a folder and a manifest are arguments.
fn is_file(word: &OsString) -> bool {
    if word == STDOUT || word.as_encoded_bytes().ends_with(SUFFIX.as_bytes()) {
        return true;
    }
    let path = Path::new(word);
    if !word.as_encoded_bytes().contains(&b'/') {
        return false;
    }
    let Ok(about) = path.metadata() else {
        return path.parent().is_some_and(Path::is_dir);
    };
    // A device has no content; a file that cannot be read is not taken.
    !about.is_dir() && (!about.is_file() || about.len() == 0 || begins_as_json(path))
}

fn begins_as_json(path: &Path) -> bool {
    let mut first = [0];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut first));
    read.is_ok() && matches!(first, [b'{' | b'['])
}

/// Joins `--json` and a FILE behind it to one word, which clap can tell from other arguments.
pub(crate) fn joined(words: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut all: Vec<OsString> = Vec::new();
    let mut is_over = false;
    for word in words {
        match all.last_mut() {
            Some(last) if !is_over && last == OPTION && is_file(&word) => {
                last.push("=");
                last.push(word);
            }
            _ => {
                // What follows belongs to another program.
                is_over |= word == "--";
                all.push(word);
            }
        }
    }
    all
}

/// Returns what to tell the user of a wrong command line in which an argument follows `--json`:
/// perhaps it was meant as FILE.
pub(crate) fn hint(words: &[OsString]) -> Option<String> {
    let is_it =
        |pair: &&[OsString]| pair[0] == OPTION && !pair[1].as_encoded_bytes().starts_with(b"-");
    let pair = words.windows(2).find(is_it)?;
    let word = pair[1].display();
    Some(format!(
        "{OPTION} {word}: for a file of this name write {OPTION}={word}"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        json: JsonOption,
        places: Vec<String>,
    }

    fn parsed(line: &str) -> (Option<String>, String) {
        let words = line.split(' ').map(OsString::from);
        let line = Line::try_parse_from(joined(words)).unwrap();
        let file = line.json.json.map(|path| path.display().to_string());
        (file, line.places.join(" "))
    }

    /// The option never takes an argument for its FILE, nor loses a FILE.
    #[test]
    fn a_file_is_told_from_an_argument() {
        for (line, file, places) in [
            ("x", None, ""),
            ("x --json", Some("-"), ""),
            ("x --json DIR", Some("-"), "DIR"),
            ("x DIR --json", Some("-"), "DIR"),
            ("x --json a.json DIR", Some("a.json"), "DIR"),
            ("x DIR --json b/a.json", Some("b/a.json"), "DIR"),
            ("x --json=DIR", Some("DIR"), ""),
            ("x --json -", Some("-"), ""),
            ("x --json -- a.json", Some("-"), "a.json"),
            ("x -- --json a.json", None, "--json a.json"),
            ("x a.json b.json", None, "a.json b.json"),
        ] {
            let expected = (file.map(str::to_owned), places.to_owned());
            assert_eq!(parsed(line), expected, "{line}");
        }
    }

    /// A path with a slash is FILE if nothing is lost by writing there.
    #[test]
    fn a_path_is_a_file_if_it_has_nothing_else() {
        let root = tempfile::tempdir().unwrap();
        let path = |name: &str| root.path().join(name).display().to_string();
        for (name, content, is_file) in [
            ("new", None, true),
            ("empty", Some(""), true),
            ("again", Some("[1]"), true),
            ("m.toml", Some("name = 1"), false),
            ("no/new", None, false),
        ] {
            if let Some(content) = content {
                std::fs::write(path(name), content).unwrap();
            }
            let (file, places) = parsed(&format!("x --json {}", path(name)));
            let expected = if is_file {
                path(name)
            } else {
                STDOUT.to_owned()
            };
            assert_eq!(file, Some(expected), "{name}");
            assert_eq!(places.is_empty(), is_file, "{name}");
        }
        let folder = root.path().display().to_string();
        assert_eq!(
            parsed(&format!("x --json {folder}/")).1,
            format!("{folder}/")
        );
        assert_eq!(parsed("x --json /dev/null").0.as_deref(), Some("/dev/null"));
    }

    #[test]
    fn a_word_that_is_no_file_is_explained() {
        let hint = |line: &str| hint(&joined(line.split(' ').map(OsString::from)));
        let told = "--json out: for a file of this name write --json=out";
        assert_eq!(hint("x DIR --json out").as_deref(), Some(told));
        for line in [
            "x --json",
            "x --json out.json",
            "x --json --quiet",
            "x json out",
        ] {
            assert_eq!(hint(line), None, "{line}");
        }
    }

    fn option(path: &Path) -> JsonOption {
        let json = Some(path.to_owned());
        JsonOption { json }
    }

    #[test]
    fn the_document_goes_to_one_place() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a.json");
        let text = || "text".to_owned();
        let of = |option: &JsonOption| option.check().unwrap().write(&[1], text).unwrap();
        assert_eq!(of(&JsonOption::default()), "text");
        assert_eq!(of(&option(Path::new(STDOUT))), "[\n  1\n]\n");
        assert_eq!(of(&option(&path)), "text");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "[\n  1\n]\n");
        let of = |option: &JsonOption| {
            let mut lines = option.check().unwrap().lines();
            let shown = [1, 2].map(|it| lines.line(&it, text).unwrap());
            lines.finish().unwrap();
            shown.concat()
        };
        assert_eq!(of(&JsonOption::default()), "texttext");
        assert_eq!(of(&option(Path::new(STDOUT))), "1\n2\n");
        assert_eq!(of(&option(&path)), "texttext");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "1\n2\n");
    }

    #[test]
    fn no_other_option_has_the_same_file() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a");
        let error = option(&path)
            .check_with([("--svg", Some(&*path))])
            .unwrap_err();
        assert!(error.to_string().contains("--svg goes to the same file"));
    }
}
