//! Finds the provider of the mechanism that a case measures, from the name of the case.

use crate::result::{Row, floor_of};
use tandem_page::chart::Style;
use tandem_page::svg::Color;

/// The provider of a measured mechanism, in the order of legends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Provider {
    /// The hardware or the kernel alone: no mechanism can be faster.
    Floor,
    Tandem,
    Iceoryx2,
    /// A library between the threads of one process.
    Threads,
    /// Part of the system: the kernel, the C library, or an installed program.
    System,
}

/// How a provider's results are drawn.
pub(crate) struct Look {
    pub(crate) name: &'static str,
    pub(crate) color: Color,
    pub(crate) style: Style,
}

const DASHED: Style = Style::Dashed(1.7, "7 3");
const DOTTED: Style = Style::Dashed(1.7, "2.5 2.5");

/// Prefixes of the names of mechanisms of the system, and of libraries between threads.
const SYSTEM: [&str; 7] = [
    "ddsperf",
    "eventfd",
    "io-uring",
    "pipe",
    "pthread",
    "seqlock",
    "unix-socket",
];
/// Ends of the names of cases that have a peer each, such as `tick-posix-port` beside `tick`.
const PEERS: [&str; 5] = ["-posix-port", "-s6", "-runit", "-systemd", "-rayon"];
const THREADS: [&str; 2] = ["rtrb", "triple-buffer"];

impl Provider {
    /// The provider of a row.
    pub(crate) fn of(row: &Row) -> Self {
        let begins = |names: &[&str]| names.iter().any(|name| row.case().starts_with(name));
        match row.case() {
            // Some cases have their own floor; in `rtos` they also have a peer: `tick-posix-port`.
            case if case == "floor" || case.ends_with("-floor") => Self::Floor,
            case if PEERS.iter().any(|end| case.ends_with(end)) || begins(&SYSTEM) => Self::System,
            _ if begins(&THREADS) => Self::Threads,
            _ if begins(&["iceoryx2"]) => Self::Iceoryx2,
            _ => Self::Tandem,
        }
    }

    /// Returns the name in legends, the colour of the marks, and how the curves are drawn.
    pub(crate) const fn look(self) -> Look {
        let (name, color, style) = match self {
            Self::Floor => ("floor", Color::FLOOR, Style::Line(2.0)),
            Self::Tandem => ("Tandem", Color::TANDEM, Style::Line(1.7)),
            Self::Iceoryx2 => ("iceoryx2", Color::ICEORYX2, Style::Line(1.7)),
            Self::Threads => ("libraries between threads", Color::THREADS, DASHED),
            Self::System => ("the system's own means", Color::SYSTEM, DOTTED),
        };
        Look { name, color, style }
    }

    /// Returns whether it is an alternative to Tandem.
    pub(crate) const fn is_peer(self) -> bool {
        !matches!(self, Self::Floor | Self::Tandem)
    }
}

/// The three rows that summarise a group.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Headline<'a> {
    pub(crate) floor: Option<&'a Row>,
    /// Tandem's first case.
    pub(crate) tandem: &'a Row,
    /// The peer with the smallest median.
    pub(crate) peer: Option<&'a Row>,
}

impl<'a> Headline<'a> {
    /// Chooses from these rows of one group; `None` if Tandem has no row.
    pub(crate) fn of(rows: &'a [Row]) -> Option<Self> {
        let is_ours = |row: &&Row| Provider::of(row) == Provider::Tandem;
        let tandem = rows.iter().find(is_ours)?;
        let is_peer = |row: &&Row| Provider::of(row).is_peer();
        // Each case of `rtos` has its own peer, such as `tick-posix-port`.
        let own = format!("{}-", tandem.case());
        let is_own = |row: &&Row| row.case().starts_with(&own);
        let peers = || rows.iter().filter(is_peer);
        let best = peers().min_by(|a, b| a.p50_ns.total_cmp(&b.p50_ns));
        Some(Self {
            floor: floor_of(rows, &tandem.name, |row| row.name.clone()),
            tandem,
            peer: peers().find(is_own).or(best),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::row;

    #[test]
    fn a_name_says_whose_work_it_is() {
        for (name, provider) in [
            ("spin/floor", Provider::Floor),
            ("spin/tandem-channel", Provider::Tandem),
            ("throughput/fifo-8B", Provider::Tandem),
            ("sleep/iceoryx2-event-tuned", Provider::Iceoryx2),
            ("throughput/rtrb-8B", Provider::Threads),
            ("lock/pthread-robust", Provider::System),
            ("topics/udp-floor", Provider::Floor),
            ("topics/ddsperf", Provider::System),
            ("topics/shm", Provider::Tandem),
            ("rtos/tick-floor", Provider::Floor),
            ("rtos/tick", Provider::Tandem),
            ("rtos/tick-posix-port", Provider::System),
            ("exec/ready-10", Provider::Tandem),
            ("exec/ready-10-s6", Provider::System),
            ("exec/skew-floor", Provider::Floor),
        ] {
            assert_eq!(Provider::of(&row(name, 80.0)), provider, "{name}");
        }
    }

    #[test]
    fn a_group_is_summed_up_by_floor_tandem_and_the_best_peer_or_its_own() {
        for (group, cases, [floor, tandem, peer]) in [
            (
                "sleep",
                [
                    ("floor", 20.0),
                    ("tandem", 22.0),
                    ("eventfd", 21.0),
                    ("pipe", 30.0),
                ],
                [0, 1, 2],
            ),
            (
                "rtos",
                [
                    ("switch-posix-port", 1.0),
                    ("tick-floor", 20.0),
                    ("tick", 22.0),
                    ("tick-posix-port", 50.0),
                ],
                [1, 2, 3],
            ),
        ] {
            let rows = cases.map(|(case, p50_ns)| row(&format!("{group}/{case}"), p50_ns));
            let headline = Headline::of(&rows).unwrap();
            assert_eq!(headline.floor, Some(&rows[floor]));
            assert_eq!(
                (headline.tandem, headline.peer),
                (&rows[tandem], Some(&rows[peer]))
            );
            assert!(Headline::of(&rows[..tandem]).is_none());
        }
    }
}
