//! Faults from a TOML file, and to one.
//!
//! ```toml
//! from-power-on = false   # else in dual operation, A driving
//! mended-at-ms = 500.0    # when everything works again
//!
//! [[fault]]
//! what = "loses-sent"     # see `What`
//! of = "a"                # "a", "b" or "both"; of a wire: who sends on it
//! at-ms = 12.5
//! lasts-ms = 100.0        # without it: until everything works again
//! amount = 10             # unit and range by kind
//! ```

use super::fault::{Fault, Kind, Way};
use super::plan::{Group, Sequence};
use serde::{Deserialize, Serialize};
use std::fmt;
use tandem_board::{CoreId, Duration, Line, ResetCause, SystemId};
use tandem_board_sim::Wire;

/// The longest time in a file: ten minutes.
const LONGEST_MS: f64 = 600_000.0;
/// The most faults in a file.
const MOST: usize = 1_000;

/// Why a file holds no faults that can be tried.
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
struct File {
    #[serde(default)]
    from_power_on: bool,
    mended_at_ms: f64,
    fault: Vec<Entry>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Entry {
    what: What,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    wire: Option<WireName>,
    of: Of,
    at_ms: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    lasts_ms: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    amount: Option<i64>,
}

/// What fails; the comment says what `amount` is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum What {
    /// Needs `wire`.
    Cut,
    /// Needs `wire`; ms with and without contact, 1 to 1000.
    Flap,
    LevelLow,
    /// µs, 1 to 65535.
    LevelGlitch,
    /// Edges, 1 to 255.
    StrayBeats,
    StraySync,
    Mute,
    Deaf,
    /// Percent, 1 to 100.
    LosesSent,
    /// Percent, 1 to 100.
    LosesHeard,
    /// ms, 1 to 1000.
    Late,
    PowerLoss,
    /// ms, 1 to 60000.
    BrownOut,
    ResetByWatchdog,
    ResetBySoftware,
    ResetByTrap,
    /// ms, 1 to 60000.
    Hang,
    /// The core, 0 to 2.
    CoreDies,
    /// The core, 0 to 2.
    CoreHangs,
    /// ms, 1 to 60000. Processes only.
    SupplyHangs,
    /// ms, 1 to 60000. Processes only.
    VehicleHangs,
    /// ms, 1 to 60000. Processes only.
    LauncherHangs,
    Scribble,
    /// ms, 1 to 255.
    Slow,
    /// Parts in a thousand, -900 to 5000.
    Clock,
    /// ms, -10000 to 10000.
    ClockJumps,
    WrongResults,
    FlashHangs,
    FlashLost,
    Poison,
    VehicleSilent,
}

#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum WireName {
    Start,
    #[serde(rename = "heartbeat-1")]
    Heartbeat1,
    #[serde(rename = "heartbeat-2")]
    Heartbeat2,
    Level,
    Link,
    Can,
}

#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Of {
    A,
    B,
    Both,
}

/// Each wire with its name.
const WIRES: [(WireName, Wire); 6] = [
    (WireName::Start, Wire::Line(Line::Start)),
    (WireName::Heartbeat1, Wire::Line(Line::Heartbeat1)),
    (WireName::Heartbeat2, Wire::Line(Line::Heartbeat2)),
    (WireName::Level, Wire::Level),
    (WireName::Link, Wire::Link),
    (WireName::Can, Wire::Can),
];
/// Each way with its name.
const WAYS: [(Of, Way); 3] = [
    (Of::A, Way::From(SystemId::A)),
    (Of::B, Way::From(SystemId::B)),
    (Of::Both, Way::Both),
];

impl Entry {
    fn kind(&self) -> Result<Kind, String> {
        Ok(match self.what {
            What::Cut => Kind::Cut(self.wire()?),
            What::Flap => Kind::Flap(self.wire()?, self.amount(1..=1_000, "ms")?),
            What::LevelLow => Kind::LevelLow,
            What::LevelGlitch => Kind::LevelGlitch(self.amount(1..=65_535, "µs")?),
            What::StrayBeats => Kind::StrayBeats(self.amount(1..=255, "edges")?),
            What::StraySync => Kind::StraySync,
            What::Mute => Kind::Mute,
            What::Deaf => Kind::Deaf,
            What::LosesSent => Kind::LosesSent(self.amount(1..=100, "percent")?),
            What::LosesHeard => Kind::LosesHeard(self.amount(1..=100, "percent")?),
            What::Late => Kind::Late(self.amount(1..=1_000, "ms")?),
            What::PowerLoss => Kind::PowerLoss,
            What::BrownOut => Kind::BrownOut(self.amount(1..=60_000, "ms")?),
            What::ResetByWatchdog => Kind::Reset(ResetCause::Watchdog),
            What::ResetBySoftware => Kind::Reset(ResetCause::Software),
            What::ResetByTrap => Kind::Reset(ResetCause::Trap),
            What::Hang => Kind::Hang(self.amount(1..=60_000, "ms")?),
            What::CoreDies => Kind::CoreDies(self.core()?),
            What::CoreHangs => Kind::CoreHangs(self.core()?),
            What::SupplyHangs => Kind::SupplyHangs(self.amount(1..=60_000, "ms")?),
            What::VehicleHangs => Kind::VehicleHangs(self.amount(1..=60_000, "ms")?),
            What::LauncherHangs => Kind::LauncherHangs(self.amount(1..=60_000, "ms")?),
            What::Scribble => Kind::Scribble,
            What::Slow => Kind::Slow(self.amount(1..=255, "ms")?),
            What::Clock => Kind::Clock(self.amount(-900..=5_000, "parts in a thousand")?),
            What::ClockJumps => Kind::ClockJumps(self.amount(-10_000..=10_000, "ms")?),
            What::WrongResults => Kind::WrongResults,
            What::FlashHangs => Kind::FlashHangs,
            What::FlashLost => Kind::FlashLost,
            What::Poison => Kind::Poison,
            What::VehicleSilent => Kind::VehicleSilent,
        })
    }

    fn core(&self) -> Result<CoreId, String> {
        CoreId::new(self.amount(0..=2, "the core")?).ok_or_else(|| "no such core".into())
    }

    fn wire(&self) -> Result<Wire, String> {
        let named = WIRES.iter().find(|(name, _)| Some(*name) == self.wire);
        let wire = named.map(|(_, wire)| *wire);
        wire.ok_or_else(|| "needs `wire`: start, heartbeat-1, heartbeat-2, level, link, can".into())
    }

    fn amount<T: TryFrom<i64>>(
        &self,
        range: std::ops::RangeInclusive<i64>,
        unit: &str,
    ) -> Result<T, String> {
        let (least, most) = (*range.start(), *range.end());
        let amount = self.amount.filter(|amount| range.contains(amount));
        amount
            .and_then(|amount| T::try_from(amount).ok())
            .ok_or_else(|| format!("needs `amount`, {least} to {most} ({unit})"))
    }

    fn fault(&self) -> Result<Fault, String> {
        let kind = self.kind()?;
        if self.wire.is_some() && !matches!(kind, Kind::Cut(_) | Kind::Flap(..)) {
            return Err("has no `wire`".into());
        }
        let with_amount = amount_of(kind).is_some();
        if self.amount.is_some() && !with_amount {
            return Err("has no `amount`".into());
        }
        let way = WAYS.iter().find(|(name, _)| *name == self.of);
        Ok(Fault {
            kind,
            way: way.map_or(Way::Both, |(_, way)| *way),
            at: time(self.at_ms)?,
            lasts: self.lasts_ms.map(time).transpose()?,
        })
    }

    fn of(fault: &Fault) -> Self {
        let (what, wire) = match fault.kind {
            Kind::Cut(wire) => (What::Cut, Some(wire)),
            Kind::Flap(wire, _) => (What::Flap, Some(wire)),
            Kind::LevelLow => (What::LevelLow, None),
            Kind::LevelGlitch(_) => (What::LevelGlitch, None),
            Kind::StrayBeats(_) => (What::StrayBeats, None),
            Kind::StraySync => (What::StraySync, None),
            Kind::Mute => (What::Mute, None),
            Kind::Deaf => (What::Deaf, None),
            Kind::LosesSent(_) => (What::LosesSent, None),
            Kind::LosesHeard(_) => (What::LosesHeard, None),
            Kind::Late(_) => (What::Late, None),
            Kind::PowerLoss => (What::PowerLoss, None),
            Kind::BrownOut(_) => (What::BrownOut, None),
            Kind::Reset(ResetCause::Watchdog) => (What::ResetByWatchdog, None),
            Kind::Reset(ResetCause::Trap) => (What::ResetByTrap, None),
            Kind::Reset(_) => (What::ResetBySoftware, None),
            Kind::Hang(_) => (What::Hang, None),
            Kind::CoreDies(_) => (What::CoreDies, None),
            Kind::CoreHangs(_) => (What::CoreHangs, None),
            Kind::SupplyHangs(_) => (What::SupplyHangs, None),
            Kind::VehicleHangs(_) => (What::VehicleHangs, None),
            Kind::LauncherHangs(_) => (What::LauncherHangs, None),
            Kind::Scribble => (What::Scribble, None),
            Kind::Slow(_) => (What::Slow, None),
            Kind::Clock(_) => (What::Clock, None),
            Kind::ClockJumps(_) => (What::ClockJumps, None),
            Kind::WrongResults => (What::WrongResults, None),
            Kind::FlashHangs => (What::FlashHangs, None),
            Kind::FlashLost => (What::FlashLost, None),
            Kind::Poison => (What::Poison, None),
            Kind::VehicleSilent => (What::VehicleSilent, None),
        };
        let wire = WIRES.iter().find(|(_, it)| Some(*it) == wire);
        let way = WAYS.iter().find(|(_, way)| *way == fault.way);
        Self {
            what,
            wire: wire.map(|(name, _)| *name),
            of: way.map_or(Of::Both, |(of, _)| *of),
            at_ms: fault.at.as_ms_f64(),
            lasts_ms: fault.lasts.map(Duration::as_ms_f64),
            amount: amount_of(fault.kind),
        }
    }
}

const fn amount_of(kind: Kind) -> Option<i64> {
    match kind {
        Kind::Flap(_, amount)
        | Kind::LevelGlitch(amount)
        | Kind::Late(amount)
        | Kind::BrownOut(amount)
        | Kind::SupplyHangs(amount)
        | Kind::VehicleHangs(amount)
        | Kind::LauncherHangs(amount)
        | Kind::Hang(amount) => Some(amount as i64),
        Kind::StrayBeats(amount)
        | Kind::LosesSent(amount)
        | Kind::LosesHeard(amount)
        | Kind::Slow(amount) => Some(amount as i64),
        Kind::Clock(amount) | Kind::ClockJumps(amount) => Some(amount as i64),
        Kind::CoreDies(core) | Kind::CoreHangs(core) => Some(core.index() as i64),
        _ => None,
    }
}

/// A word of the file as it is written there.
fn word(value: impl Serialize) -> String {
    let value = toml::Value::try_from(value).ok();
    let text = value.as_ref().and_then(toml::Value::as_str);
    text.unwrap_or_default().to_owned()
}

impl Kind {
    /// The labels of all that the simulator can do, each once.
    #[must_use]
    pub fn labels() -> Vec<String> {
        let all = Self::OF_ONE_SYSTEM.iter().chain(&Self::FURTHER);
        let all = all.chain(&Self::OF_BOTH).map(|kind| kind.label());
        let mut labels: Vec<String> = all.collect();
        labels.sort_unstable();
        labels.dedup();
        labels
    }

    /// What fails, by the words of a file; `core-dies 0` and `cut can`, and no other amounts.
    #[must_use]
    pub fn label(self) -> String {
        let entry = Entry::of(&Fault {
            kind: self,
            way: Way::Both,
            at: Duration::ZERO,
            lasts: None,
        });
        let what = word(entry.what);
        match (self, entry.wire) {
            (Self::CoreDies(core) | Self::CoreHangs(core), _) => format!("{what} {}", core.index()),
            (_, Some(wire)) => format!("{what} {}", word(wire)),
            _ => what,
        }
    }
}

/// A time of the file, to the nearest nanosecond.
fn time(ms: f64) -> Result<Duration, String> {
    if !(0.0..=LONGEST_MS).contains(&ms) {
        return Err(format!("{ms} ms: times are 0 to {LONGEST_MS} ms"));
    }
    Ok(Duration::from_ns((ms * 1e6).round() as u64))
}

impl Sequence {
    /// The faults of a file; `number` is the seed of what the machine draws.
    ///
    /// # Errors
    /// If the text is no TOML, has an unknown word, or a value out of range; the message names it.
    pub fn from_toml(text: &str, number: u64) -> Result<Self, FileError> {
        let file: File = toml::from_str(text).map_err(|error| FileError(error.to_string()))?;
        if file.fault.len() > MOST {
            return Err(FileError(format!("more than {MOST} faults")));
        }
        let fault = |(index, entry): (usize, &Entry)| {
            let named = |why| FileError(format!("fault {} ({:?}): {why}", index + 1, entry.what));
            entry.fault().map_err(named)
        };
        Ok(Self {
            group: Group::File,
            number,
            faults: file
                .fault
                .iter()
                .enumerate()
                .map(fault)
                .collect::<Result<_, _>>()?,
            from_power_on: file.from_power_on,
            span: time(file.mended_at_ms)
                .map_err(|why| FileError(format!("mended-at-ms: {why}")))?,
        })
    }

    /// The file of these faults.
    ///
    /// # Errors
    /// None is known; the writer of TOML can refuse.
    pub fn to_toml(&self) -> Result<String, FileError> {
        let file = File {
            from_power_on: self.from_power_on,
            mended_at_ms: self.span.as_ms_f64(),
            fault: self.faults.iter().map(Entry::of).collect(),
        };
        toml::to_string(&file).map_err(|error| FileError(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::faults::Row;

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

    /// The bound of a file is that of the groups whose faults it has.
    #[test]
    fn a_file_has_a_bound_if_a_table_has_it() {
        let of = |of: &str, what: &str| format!("[[fault]]\nof = \"{of}\"\nat-ms = 1.0\n{what}\n");
        let slow = of("a", "what = \"clock\"\namount = -500");
        let cut = of("both", "what = \"cut\"\nwire = \"link\"");
        let hang = of("both", "what = \"hang\"\namount = 9");
        let ms = Duration::from_ms;
        for (faults, row) in [
            (of("both", "what = \"power-loss\""), None),
            (of("a", "what = \"power-loss\""), Some(Row::Power)),
            (hang, Some(Row::Stall(ms(9)))),
            (cut.clone(), Some(Row::None)),
            (slow + &cut, Some(Row::Refused(ms(20)))),
        ] {
            let text = format!("mended-at-ms = 100.0\n{faults}");
            let sequence = Sequence::from_toml(&text, 0).expect("faults");
            let bound = sequence.bound(&tandem_redundancy::Config::rt());
            assert_eq!(bound.map(|(row, _)| row), row, "{text}");
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
                "fault 1 (Mute): -1 ms",
            ),
            (
                &one("what = \"cut\"\nof = \"a\"\nat-ms = 1.0"),
                "fault 1 (Cut): needs `wire`",
            ),
            (
                &one("what = \"flap\"\nwire = \"can\"\namount = 0\nof = \"a\"\nat-ms = 1.0"),
                "needs `amount`, 1 to 1000 (ms)",
            ),
            (
                &one("what = \"mute\"\namount = 3\nof = \"a\"\nat-ms = 1.0"),
                "has no `amount`",
            ),
            (
                &one("what = \"mute\"\nwhen = 3\nof = \"a\"\nat-ms = 1.0"),
                "unknown field `when`",
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
