//! Figures for people: a unit that fits, and only significant digits.

/// Returns the median of these values; `None` without values.
#[must_use]
pub fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let upper = *sorted.get(sorted.len() / 2)?;
    let lower = *sorted.get((sorted.len() - 1) / 2)?;
    Some(f64::midpoint(lower, upper))
}

/// The unit in which a group of times is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeUnit {
    /// Nanoseconds.
    Ns,
    /// Microseconds.
    Us,
    /// Milliseconds.
    Ms,
}

impl TimeUnit {
    /// Returns the unit that suits the median of these times, which are in ns.
    #[must_use]
    pub fn of(times_ns: &[f64]) -> Self {
        match median(times_ns).unwrap_or(0.0) {
            ns if ns < 1e4 => Self::Ns,
            ns if ns < 1e7 => Self::Us,
            _ => Self::Ms,
        }
    }

    /// Returns the unit's symbol.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ns => "ns",
            Self::Us => "µs",
            Self::Ms => "ms",
        }
    }

    /// Returns a time in this unit, without the symbol. A time with more than five digits before
    /// the point is shown in the unit that suits it, with that unit's symbol.
    #[must_use]
    pub fn show(self, ns: f64) -> String {
        let value = match self {
            Self::Ns => ns,
            Self::Us => ns / 1e3,
            Self::Ms => ns / 1e6,
        };
        if value < 1e5 { number(value) } else { time(ns) }
    }
}

/// Returns a time as a number in the unit that suits it, and the unit's symbol.
#[must_use]
pub fn scaled(ns: f64) -> (f64, &'static str) {
    match ns {
        ns if ns < 1e3 => (ns, "ns"),
        ns if ns < 1e6 => (ns / 1e3, "µs"),
        ns if ns < 1e10 => (ns / 1e6, "ms"),
        ns => (ns / 1e9, "s"),
    }
}

/// Returns a time with the unit that suits it.
#[must_use]
pub fn time(ns: f64) -> String {
    let (value, unit) = scaled(ns);
    format!("{} {unit}", number(value))
}

/// Returns a number with about three significant digits: `8.31`, `84.2`, `312`, `25013`.
#[must_use]
pub fn number(value: f64) -> String {
    let decimals = match value.abs() {
        v if v < 9.995 => 2,
        v if v < 99.95 => 1,
        _ => 0,
    };
    format!("{value:.decimals$}")
}

/// Returns a ratio: `1.12`, `15.3`, `240`, `1.62 M`.
#[must_use]
pub fn ratio(ratio: f64) -> String {
    if ratio < 1e4 {
        number(ratio)
    } else {
        count(ratio)
    }
}

/// Returns a large count with a prefix: `12.3 M`.
#[must_use]
pub fn count(value: f64) -> String {
    match value {
        v if v >= 1e9 => format!("{} G", number(v / 1e9)),
        v if v >= 1e6 => format!("{} M", number(v / 1e6)),
        v if v >= 1e4 => format!("{} k", number(v / 1e3)),
        v => format!("{v:.0}"),
    }
}

/// Returns an amount of memory: `4 B`, `64 KiB`, `16 MiB`.
#[must_use]
pub fn bytes(bytes: u64) -> String {
    let value = bytes as f64;
    let short = |value: f64| {
        if value.fract() == 0.0 {
            format!("{value:.0}")
        } else {
            number(value)
        }
    };
    match bytes {
        b if b >= 1 << 20 => format!("{} MiB", short(value / f64::from(1 << 20))),
        b if b >= 1 << 10 => format!("{} KiB", short(value / f64::from(1 << 10))),
        b => format!("{b} B"),
    }
}

/// Formats an additional figure: if its name ends in `, ns`, it is a time.
#[must_use]
pub fn fact(name: &str, value: f64) -> String {
    // Avoids "-0".
    let value = if value == 0.0 { 0.0 } else { value };
    match name.strip_suffix(", ns") {
        Some(name) => format!("{name}: {}", time(value)),
        None if value.fract() == 0.0 => format!("{name}: {}", count(value)),
        None => format!("{name}: {}", number(value)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_median_is_the_middle() {
        assert_eq!(median(&[3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&[4.0, 1.0]), Some(2.5));
        assert_eq!(median(&[]), None);
    }

    #[test]
    fn a_time_has_the_unit_that_fits() {
        let shown = [8.3, 84.24, 312.4, 999.9, 21_300.0, 1.5e6, 5e9].map(time);
        let expected = [
            "8.30 ns", "84.2 ns", "312 ns", "1000 ns", "21.3 µs", "1.50 ms", "5000 ms",
        ];
        assert_eq!(shown, expected);
    }

    #[test]
    fn a_group_has_one_unit() {
        assert_eq!(TimeUnit::of(&[80.0, 90.0, 5e6]), TimeUnit::Ns);
        assert_eq!(TimeUnit::of(&[21e3, 25e3]), TimeUnit::Us);
        assert_eq!(TimeUnit::of(&[]), TimeUnit::Ns);
        assert_eq!(TimeUnit::Us.show(21_345.0), "21.3");
        assert_eq!(TimeUnit::Ns.show(36_003_906.0), "36.0 ms");
    }

    #[test]
    fn amounts_are_written_as_people_say_them() {
        assert_eq!(
            [4, 4096, 1 << 20, 1_600_000].map(bytes),
            ["4 B", "4 KiB", "1 MiB", "1.53 MiB"]
        );
        assert_eq!(
            [12_345_678.0, 950.0, 48_000.0].map(count),
            ["12.3 M", "950", "48.0 k"]
        );
        assert_eq!(fact("naive p99.9, ns", 21_300.0), "naive p99.9: 21.3 µs");
        assert_eq!(fact("reads", -0.0), "reads: 0");
        assert_eq!(
            fact("messages per second", 1e4),
            "messages per second: 10.0 k"
        );
        assert_eq!(
            fact("share of the least served", 0.312),
            "share of the least served: 0.31"
        );
    }
}
