//! Reads faults from a TOML file, and writes them to one.
//!
//! ```toml
//! from-power-on = false   # otherwise in dual operation; A drives
//! mended-at-ms = 500.0    # when everything works again
//!
//! [[fault]]
//! what = "loses-sent"     # see `Kind`
//! of = "a"                # "a", "b" or "both"; of a wire: the system that sends on it
//! at-ms = 12.5
//! lasts-ms = 100.0        # without it: until everything works again
//! amount = 10             # unit and range by kind
//! ```

use crate::entry::Fault;
use crate::kind::Kind;
use crate::sequence::{Group, Sequence};
use crate::words::ms;
use serde::{Deserialize, Serialize};
use std::fmt;
use tandem_board::Duration;
use tandem_peripherals::network::Wire;
use toml::{Spanned, Table, Value};

/// The largest number of faults in a file.
const MOST: usize = 1_000;

/// The reason why a file contains no usable faults.
#[derive(Debug, PartialEq, Eq)]
pub struct FileError(String);

impl fmt::Display for FileError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.trim_end())
    }
}

impl std::error::Error for FileError {}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct File<F> {
    #[serde(default)]
    from_power_on: bool,
    #[serde(with = "ms")]
    mended_at_ms: Duration,
    fault: Vec<F>,
}

/// Reads one entry.
fn fault(given: Table) -> Result<Fault, String> {
    let what = given.get("what").and_then(Value::as_str);
    let what = what.unwrap_or_default().to_owned();
    let fault: Fault = given.clone().try_into().map_err(|error: toml::de::Error| {
        let sample = Kind::samples().find(|kind| kind.word() == what);
        let keys = sample.map_or(String::new(), |kind| format!("; `{what}` {}", keys(kind)));
        format!("{}{keys}", error.to_string().trim_end().replace('\n', " "))
    })?;
    let written = Table::try_from(fault).unwrap_or_default();
    match given.keys().find(|key| !written.contains_key(*key)) {
        Some(key) => Err(format!("`{what}` has no `{key}`")),
        None => Ok(fault),
    }
}

/// Returns the keys of this kind and their values, in words.
fn keys(kind: Kind) -> String {
    let mut keys = Vec::new();
    if let Kind::Cut { .. } | Kind::Flap { .. } = kind {
        keys.push(format!("`wire`: {}", Wire::ALL.map(Wire::name).join(", ")));
    }
    keys.extend(kind.own_keys());
    keys.extend(kind.amount().map(|it| format!("`amount`: {it}")));
    match keys.len() {
        0 => "has no further keys".to_owned(),
        _ => format!("needs {}", keys.join("; ")),
    }
}

impl Sequence {
    /// Returns the faults of a file. `number` is the seed of all random numbers of the machine.
    ///
    /// # Errors
    /// If the text is not TOML, or has an unknown word or a value out of range. The message names
    /// the line, the key and the permitted values.
    pub fn from_toml(text: &str, number: u64) -> Result<Self, FileError> {
        let file: File<Spanned<Table>> =
            toml::from_str(text).map_err(|error| FileError(error.to_string()))?;
        if file.fault.len() > MOST {
            return Err(FileError(format!("more than {MOST} faults")));
        }
        let read = |(index, given): (usize, Spanned<Table>)| {
            let before = text.get(..given.span().start).unwrap_or_default();
            let (line, place) = (before.matches('\n').count() + 1, index + 1);
            let error = |why| FileError(format!("line {line}, fault {place}: {why}"));
            fault(given.into_inner()).map_err(error)
        };
        let faults = file.fault.into_iter().enumerate().map(read);
        Ok(Self {
            group: Group::File,
            number,
            faults: faults.collect::<Result<_, _>>()?,
            from_power_on: file.from_power_on,
            span: file.mended_at_ms,
            setting: None,
        })
    }

    /// Returns the text of a file with these faults.
    ///
    /// # Errors
    /// If the TOML writer fails; no case is known.
    pub fn to_toml(&self) -> Result<String, FileError> {
        let file = File {
            from_power_on: self.from_power_on,
            mended_at_ms: self.span,
            fault: self.faults.clone(),
        };
        toml::to_string(&file).map_err(|error| FileError(error.to_string()))
    }
}
#[cfg(test)]
mod tests {
    use super::*;
    use crate::loss::Loss;

    #[test]
    fn every_sequence_survives_the_file() {
        let numbers = (0..40).map(|number| Group::Swarm.sequence(number));
        let singles = Group::Single.count().unwrap_or(0);
        let singles = (0..singles).step_by(20).map(|n| Group::Single.sequence(n));
        for sequence in numbers.chain(singles) {
            let text = sequence.to_toml().expect("TOML");
            let read = Sequence::from_toml(&text, 0).expect("what was written can be read");
            assert_eq!(read.faults, sequence.faults, "{text}");
            assert_eq!(read.span, sequence.span);
            assert_eq!(read.from_power_on, sequence.from_power_on);
        }
    }

    /// A file has a bound if the numbered sequences with the same faults have one.
    #[test]
    fn a_file_has_a_bound_if_a_table_has_it() {
        let of = |of: &str, what: &str| format!("[[fault]]\nof = \"{of}\"\nat-ms = 1.0\n{what}\n");
        let slow = of("a", "what = \"clock\"\namount = -500");
        let cut = of("both", "what = \"cut\"\nwire = \"link\"");
        let hang = of("both", "what = \"hang\"\namount = 9");
        let ms = Duration::from_ms;
        for (faults, row) in [
            (of("both", "what = \"power-loss\""), None),
            (of("a", "what = \"power-loss\""), Some(Loss::Power)),
            (hang, Some(Loss::Stall(ms(9)))),
            (cut.clone(), Some(Loss::None)),
            (slow + &cut, Some(Loss::Refused(ms(20)))),
        ] {
            let text = format!("mended-at-ms = 100.0\n{faults}");
            let sequence = Sequence::from_toml(&text, 0).expect("faults");
            let bound = sequence.bound(&tandem_record::verdict::Limits::RT);
            assert_eq!(bound.map(|(loss, _)| loss), row, "{text}");
        }
    }

    #[test]
    fn what_cannot_be_tried_is_refused_with_the_reason() {
        let one = |fault: &str| format!("mended-at-ms = 100.0\n[[fault]]\n{fault}\n");
        let cases = [
            ("nonsense", "expected"),
            ("fault = []", "mended-at-ms"),
            ("mended-at-ms = 1e9\nfault = []", "times are 0 to 600000 ms"),
            ("mended-at-ms = nan\nfault = []", "times are 0 to 600000 ms"),
            (
                &one("what = \"explodes\"\nof = \"a\"\nat-ms = 1.0"),
                "unknown variant",
            ),
            (
                &one("what = \"mute\"\nof = \"c\"\nat-ms = 1.0"),
                "unknown variant",
            ),
            (
                &one("what = \"mute\"\nof = \"a\"\nat-ms = -1.0"),
                "line 2, fault 1: -1 ms",
            ),
            (
                &one("what = \"cut\"\nof = \"a\"\nat-ms = 1.0"),
                "missing field `wire`; `cut` needs `wire`: start, heartbeat-1",
            ),
            (
                &one("what = \"flap\"\nwire = \"can\"\namount = 0\nof = \"a\"\nat-ms = 1.0"),
                "`amount`: 1 to 1000 (ms)",
            ),
            (
                &one("what = \"mute\"\namount = 3\nof = \"a\"\nat-ms = 1.0"),
                "`mute` has no `amount`",
            ),
            (
                &one("what = \"deaf-to\"\nframe = \"Radar\"\ncore = 1\nof = \"a\"\nat-ms = 1.0"),
                "there is no frame `Radar`; `deaf-to` needs `frame`",
            ),
            (
                &one(
                    "what = \"deaf-to\"\nframe = \"EgoMotion\"\ncore = 2\nof = \"a\"\nat-ms = 1.0",
                ),
                "core 2 hears no frames",
            ),
            (
                &one(
                    "what = \"forged\"\nframe = \"GateEcho\"\nfield = \"Role\"\nvalue = 1\nof = \"a\"\nat-ms = 1.0",
                ),
                "`GateEcho` has no `Role`, only Counter, Refused, Term",
            ),
            (
                &one(
                    "what = \"wrong-value\"\nsignal = \"trajectory\"\ncore = 1\nhow = \"nan\"\nof = \"a\"\nat-ms = 1.0",
                ),
                "`trajectory` is not on core 1, only on [2]",
            ),
            (
                &one(
                    "what = \"wrong-value\"\nsignal = \"yaw-rate\"\ncore = 1\nhow = \"late-ms\"\nof = \"a\"\nat-ms = 1.0",
                ),
                "`late-ms` is 1 to 5000 ms",
            ),
            (
                &one("what = \"mute\"\nwhen = 3\nof = \"a\"\nat-ms = 1.0"),
                "`mute` has no `when`",
            ),
        ];
        for (text, reason) in cases {
            let refused = Sequence::from_toml(text, 0)
                .err()
                .map(|error| error.to_string());
            let refused = refused.expect(text);
            assert!(refused.contains(reason), "{text}: {refused}");
        }
    }
}
