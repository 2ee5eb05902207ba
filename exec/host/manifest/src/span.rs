//! Spans of time in the manifest: a number with its unit, as `"250ms"`.

use serde::{Deserialize as _, Deserializer, Serializer, de};
use tandem_board::Duration;

const UNITS: [(&str, u64); 5] = [
    ("ns", 1),
    ("us", 1_000),
    ("ms", 1_000_000),
    ("min", 60_000_000_000),
    ("s", 1_000_000_000),
];

/// Reads a span.
pub(super) fn read<'de, D: Deserializer<'de>>(from: D) -> Result<Duration, D::Error> {
    let text = String::deserialize(from)?;
    parse(&text).ok_or_else(|| {
        let expected = "a whole number with its unit: ns, us, ms, s or min, as \"250ms\"";
        de::Error::invalid_value(de::Unexpected::Str(&text), &expected)
    })
}

/// Writes a span.
pub(super) fn write<S: Serializer>(span: &Duration, to: S) -> Result<S::Ok, S::Error> {
    to.collect_str(&format_args!("{}ns", span.as_ns()))
}

fn parse(text: &str) -> Option<Duration> {
    let (unit, ns) = UNITS.iter().find(|(unit, _)| text.ends_with(unit))?;
    let number: u64 = text.strip_suffix(unit)?.trim().parse().ok()?;
    Some(Duration::from_ns(number.checked_mul(*ns)?))
}

pub(super) const fn second() -> Duration {
    Duration::from_ms(1_000)
}

pub(super) const fn one() -> u32 {
    1
}

pub(super) const fn many() -> u32 {
    u32::MAX
}
