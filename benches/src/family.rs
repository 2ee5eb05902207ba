//! Whose work a case measures, by its name.

use crate::result::Row;

/// Whose work a case measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Family {
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

/// First parts of the names of those that are neither floor nor Tandem.
const PEERS: [(&str, Family); 13] = [
    ("iceoryx2", Family::Iceoryx2),
    ("crossbeam", Family::Threads),
    ("rtrb", Family::Threads),
    ("std", Family::Threads),
    ("pipe", Family::System),
    ("unix-socket", Family::System),
    ("message-queue", Family::System),
    ("eventfd", Family::System),
    ("ddsperf", Family::System),
    ("pthread", Family::System),
    ("malloc", Family::System),
    ("fork", Family::System),
    ("linux", Family::System),
];

impl Family {
    /// All, in the order of legends.
    pub const ALL: [Self; 5] = [
        Self::Floor,
        Self::Tandem,
        Self::Iceoryx2,
        Self::Threads,
        Self::System,
    ];

    /// That of a row.
    #[must_use]
    pub fn of(row: &Row) -> Self {
        // In `rtos` a floor is one of the tick alone, and peers are named after what they do.
        if row.is_floor() || row.case().ends_with("-floor") {
            return Self::Floor;
        }
        if row.case().ends_with("-posix-port") {
            return Self::System;
        }
        let known = PEERS.iter().find(|(name, _)| row.case().starts_with(name));
        known.map_or(Self::Tandem, |(_, family)| *family)
    }

    /// As it stands in legends.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Floor => "floor",
            Self::Tandem => "Tandem",
            Self::Iceoryx2 => "iceoryx2",
            Self::Threads => "libraries between threads",
            Self::System => "the system's own means",
        }
    }

    /// Class of its marks on the page.
    #[must_use]
    pub const fn class(self) -> &'static str {
        match self {
            Self::Floor => "floor",
            Self::Tandem => "tandem",
            Self::Iceoryx2 => "iceoryx2",
            Self::Threads => "threads",
            Self::System => "system",
        }
    }

    /// Whether it is what one would use instead.
    #[must_use]
    pub const fn is_peer(self) -> bool {
        !matches!(self, Self::Floor | Self::Tandem)
    }
}

/// The three that a group is summed up by.
#[derive(Clone, Copy, Debug)]
pub struct Headline<'a> {
    /// The floor.
    pub floor: Option<&'a Row>,
    /// Tandem's first case.
    pub tandem: &'a Row,
    /// The peer with the smallest median. `eventfd` is a bare mechanism and no peer.
    pub peer: Option<&'a Row>,
}

impl<'a> Headline<'a> {
    /// Of these rows of one group; `None` if Tandem has none.
    #[must_use]
    pub fn of(rows: &[&'a Row]) -> Option<Self> {
        let peers = rows
            .iter()
            .filter(|row| Family::of(row).is_peer() && row.case() != "eventfd");
        Some(Self {
            floor: rows.iter().find(|row| row.is_floor()).copied(),
            tandem: rows.iter().find(|row| Family::of(row) == Family::Tandem)?,
            peer: peers.min_by(|a, b| a.p50_ns.total_cmp(&b.p50_ns)).copied(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::row;

    #[test]
    fn a_name_says_whose_work_it_is() {
        for (name, family) in [
            ("spin/floor", Family::Floor),
            ("spin/tandem-channel", Family::Tandem),
            ("throughput/fifo-8B", Family::Tandem),
            ("sleep/iceoryx2-event-tuned", Family::Iceoryx2),
            ("throughput/rtrb-8B", Family::Threads),
            ("lock/pthread-robust", Family::System),
            ("rtos/tick-floor", Family::Floor),
            ("rtos/tick", Family::Tandem),
            ("rtos/tick-posix-port", Family::System),
        ] {
            assert_eq!(Family::of(&row(name, 80.0)), family, "{name}");
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
        let rows: Vec<&Row> = rows.iter().collect();
        let headline = Headline::of(&rows).unwrap();
        assert_eq!(headline.tandem.name, "sleep/tandem");
        assert_eq!(headline.peer.unwrap().name, "sleep/iceoryx2-event");
        assert!(Headline::of(&rows[..1]).is_none());
    }
}
