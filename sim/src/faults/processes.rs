//! Sequences of one fault for real processes and emulated machines: drawn from a seed, or each
//! fault at each phase of the control cycle.

use super::fault::{Fault, Kind, Way};
use super::plan::{Draw, Group, PHASES, Sequence};
use tandem_board::{CoreId, Duration, Line, ResetCause, SystemId};
use tandem_board_sim::Wire;

/// What processes suffer. The parameter of a kind that stands here once is drawn.
const KINDS: [Kind; 34] = {
    use CoreId as C;
    use Kind as K;
    const BEAT_1: Wire = Wire::Line(Line::Heartbeat1);
    const BEAT_2: Wire = Wire::Line(Line::Heartbeat2);
    [
        K::PowerLoss,
        K::BrownOut(0),
        K::Reset(ResetCause::Software),
        K::CoreDies(C::CONTROL),
        K::CoreDies(C::PERCEPTION),
        K::CoreDies(C::PLANNING),
        K::CoreHangs(C::CONTROL),
        K::CoreHangs(C::PERCEPTION),
        K::CoreHangs(C::PLANNING),
        K::Hang(0),
        K::SupplyHangs(0),
        K::Scribble,
        K::FlashLost,
        K::Cut(BEAT_1),
        K::Cut(BEAT_2),
        K::Cut(Wire::Line(Line::Start)),
        K::Cut(Wire::Level),
        K::Cut(Wire::Link),
        K::Cut(Wire::Can),
        K::Flap(BEAT_1, 5),
        K::Flap(Wire::Level, 5),
        K::Flap(Wire::Link, 30),
        K::Flap(Wire::Can, 60),
        K::LevelLow,
        K::LevelGlitch(300),
        K::StrayBeats(3),
        K::StraySync,
        K::Mute,
        K::Deaf,
        K::LosesSent(10),
        K::LosesHeard(10),
        K::Late(3),
        K::VehicleHangs(0),
        K::LauncherHangs(0),
    ]
};
/// The time after the last fault until all is mended, without what the fault lasts, ms.
const AFTERWARDS_MS: u64 = 300;

/// What suffers the faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Victim {
    /// Processes of this machine.
    Processes,
    /// Emulated machines with firmware.
    Machines,
}

impl Victim {
    /// Whether it can suffer this kind of fault.
    #[must_use]
    pub const fn suffers(self, kind: Kind) -> bool {
        match self {
            Self::Processes => kind.is_for_processes(),
            Self::Machines => kind.is_for_machines(),
        }
    }

    fn kinds(self) -> impl Iterator<Item = Kind> + Clone {
        KINDS.into_iter().filter(move |kind| self.suffers(*kind))
    }

    /// How many sequences the matrix has: each fault, of the master and of the standby, at each
    /// phase.
    #[must_use]
    pub fn cells(self) -> u64 {
        self.kinds().count() as u64 * 2 * PHASES
    }

    /// The `number`-th sequence of this seed: one fault of the master, which is A here, or of the
    /// standby, at its beginning.
    #[must_use]
    pub fn drawn(self, seed: u64, number: u64) -> Sequence {
        let mut draw = Draw::new(seed ^ number.wrapping_mul(0xD1B5_4A32_D192_ED03));
        let kinds = self.kinds();
        let at = draw.below(kinds.clone().count() as u64);
        let kind = kinds.clone().nth(at as usize).unwrap_or(Kind::PowerLoss);
        // Most can happen to a master.
        let of = if draw.below(3) < 2 {
            SystemId::A
        } else {
            SystemId::B
        };
        sequence(number, kind, of, &mut draw)
    }

    /// A cell of the matrix, and when in the control cycle its fault begins; `None` from
    /// [`Victim::cells`] on.
    #[must_use]
    pub fn cell(self, number: u64) -> Option<(Sequence, Duration)> {
        let (fault, phase) = (number / PHASES, number % PHASES);
        let kind = self.kinds().nth((fault / 2) as usize)?;
        let of = SystemId::ALL[(fault % 2) as usize];
        let phase = Duration::from_us(phase * (10_000 / PHASES));
        Some((sequence(number, kind, of, &mut Draw::new(number)), phase))
    }
}

fn sequence(number: u64, kind: Kind, of: SystemId, draw: &mut Draw) -> Sequence {
    let short_ms = (5 + draw.below(195)) as u16;
    let kind = match kind {
        Kind::BrownOut(_) => Kind::BrownOut(short_ms),
        Kind::Hang(_) => Kind::Hang(short_ms),
        Kind::SupplyHangs(_) => Kind::SupplyHangs(short_ms),
        Kind::VehicleHangs(_) => Kind::VehicleHangs(short_ms),
        Kind::LauncherHangs(_) => Kind::LauncherHangs(short_ms),
        kind => kind,
    };
    let lasts = match kind {
        // Stopped for good: the watchdog ends it. Or continued before or after that.
        Kind::CoreHangs(_) if draw.below(2) == 0 => None,
        Kind::CoreHangs(_) => Some(Duration::from_ms(short_ms.into())),
        _ => Some(Duration::from_ms(20 + draw.below(600))),
    };
    let longest = lasts.map_or(Duration::from_ms(500), |lasts| {
        lasts.max(Duration::from_ms(short_ms.into()))
    });
    Sequence {
        group: Group::File,
        number,
        faults: vec![Fault {
            kind,
            way: Way::From(of),
            at: Duration::ZERO,
            lasts,
        }],
        from_power_on: false,
        span: longest + Duration::from_ms(AFTERWARDS_MS),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The generator reaches every fault of the matrix for both systems, the same each time, and
    /// draws nothing that processes cannot suffer or a file cannot hold.
    #[test]
    fn drawn_sequences_repeat_and_cover_the_matrix() {
        for victim in [Victim::Processes, Victim::Machines] {
            let mut missing: Vec<(String, Way)> = (0..victim.cells())
                .step_by(PHASES as usize)
                .filter_map(|number| victim.cell(number))
                .map(|(cell, _)| (cell.faults[0].kind.label(), cell.faults[0].way))
                .collect();
            for number in 0..2_000 {
                let sequence = victim.drawn(977, number);
                let fault = sequence.faults[0];
                assert!(victim.suffers(fault.kind), "{fault}");
                assert_eq!(victim.drawn(977, number).faults, sequence.faults);
                let text = sequence.to_toml().expect("TOML");
                let read = Sequence::from_toml(&text, 0).expect("what was written can be read");
                assert_eq!(read.faults, sequence.faults, "{text}");
                missing.retain(|(label, way)| (label, way) != (&fault.kind.label(), &fault.way));
            }
            assert!(missing.is_empty(), "never drawn: {missing:?}");
            assert!(victim.cell(victim.cells()).is_none());
            assert_ne!(victim.drawn(1, 0).faults, victim.drawn(2, 0).faults);
        }
    }
}
