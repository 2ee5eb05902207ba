//! Who provides what a case measures, by its name.

use crate::result::{Row, floor_of};
use tandem_page::chart::Style;
use tandem_page::svg::Color;

/// Who provides what a case measures; in the order of legends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Provider {
    /// The hardware's or the kernel's alone: what nothing can beat.
    Floor,
    /// Tandem's.
    Tandem,
    /// iceoryx2's.
    Iceoryx2,
    /// That of a library between the threads of one process.
    Threads,
    /// The system's: the kernel, the C library, or a program that was installed.
    System,
}

/// How what a provider provides is shown.
pub(crate) struct Look {
    pub(crate) name: &'static str,
    pub(crate) color: Color,
    pub(crate) style: Style,
}

/// First parts of the names of those that are neither floor nor Tandem.
const PEERS: [(&str, Provider); 9] = [
    ("iceoryx2", Provider::Iceoryx2),
    ("rtrb", Provider::Threads),
    ("triple-buffer", Provider::Threads),
    ("seqlock", Provider::System),
    ("io-uring", Provider::System),
    ("pipe", Provider::System),
    ("unix-socket", Provider::System),
    ("eventfd", Provider::System),
    ("pthread", Provider::System),
];

impl Provider {
    /// That of a row.
    pub(crate) fn of(row: &Row) -> Self {
        // In `rtos` a floor is one of the tick alone, and peers are named after what they do.
        if row.is_floor() || row.case().ends_with("-floor") {
            return Self::Floor;
        }
        if row.case().ends_with("-posix-port") {
            return Self::System;
        }
        let known = PEERS.iter().find(|(name, _)| row.case().starts_with(name));
        known.map_or(Self::Tandem, |(_, provider)| *provider)
    }

    /// Its name in legends, the colour of its marks, and how its curves are drawn.
    pub(crate) const fn look(self) -> Look {
        let (name, color, style) = match self {
            Self::Floor => ("floor", Color::FLOOR, Style::Line(2.0)),
            Self::Tandem => ("Tandem", Color::TANDEM, Style::Line(1.7)),
            Self::Iceoryx2 => ("iceoryx2", Color::ICEORYX2, Style::Line(1.7)),
            Self::Threads => (
                "libraries between threads",
                Color::THREADS,
                Style::Dashed(1.7, "7 3"),
            ),
            Self::System => (
                "the system's own means",
                Color::SYSTEM,
                Style::Dashed(1.7, "2.5 2.5"),
            ),
        };
        Look { name, color, style }
    }

    /// Whether it is what one would use instead.
    pub(crate) const fn is_peer(self) -> bool {
        !matches!(self, Self::Floor | Self::Tandem)
    }
}

/// The three that a group is summed up by.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Headline<'a> {
    /// The floor.
    pub(crate) floor: Option<&'a Row>,
    /// Tandem's first case.
    pub(crate) tandem: &'a Row,
    /// The peer with the smallest median.
    pub(crate) peer: Option<&'a Row>,
}

impl<'a> Headline<'a> {
    /// Of these rows of one group; `None` if Tandem has none.
    pub(crate) fn of(rows: &'a [Row]) -> Option<Self> {
        let tandem = rows
            .iter()
            .find(|row| Provider::of(row) == Provider::Tandem)?;
        let is_peer = |row: &&Row| Provider::of(row).is_peer();
        // In `rtos` a case has a peer of its own: `tick-posix-port`.
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
            ("rtos/tick-floor", Provider::Floor),
            ("rtos/tick", Provider::Tandem),
            ("rtos/tick-posix-port", Provider::System),
        ] {
            assert_eq!(Provider::of(&row(name, 80.0)), provider, "{name}");
        }
    }

    #[test]
    fn a_group_is_summed_up_by_floor_tandem_and_the_best_peer() {
        let rows = [
            row("sleep/floor", 20.0),
            row("sleep/tandem", 22.0),
            row("sleep/eventfd", 21.0),
            row("sleep/pipe", 30.0),
            row("sleep/iceoryx2-event", 25.0),
        ];
        let headline = Headline::of(&rows).unwrap();
        assert_eq!(headline.tandem.name, "sleep/tandem");
        assert_eq!(headline.peer.unwrap().name, "sleep/eventfd");
        assert!(Headline::of(&rows[..1]).is_none());
    }

    #[test]
    fn what_has_a_floor_and_a_peer_of_its_own_is_summed_up_by_these() {
        let rows = [
            row("rtos/tick-floor", 20.0),
            row("rtos/tick", 22.0),
            row("rtos/tick-posix-port", 50.0),
            row("rtos/switch-posix-port", 1.0),
        ];
        let headline = Headline::of(&rows).unwrap();
        assert_eq!(headline.floor.unwrap().name, "rtos/tick-floor");
        assert_eq!(headline.peer.unwrap().name, "rtos/tick-posix-port");
    }
}
