//! The sequences of the group `values`: each wrong value, deafness and forgery in each setting.

use crate::entry::{Fault, Way};
use crate::kind::Kind;
use crate::sequence::{Group, Sequence};
use crate::setting::DriveSetting;
use crate::value::{DeafTo, Forged, FrameName, How, Real, Signal, WrongValue};
use std::sync::OnceLock;
use tandem_board::{Duration, SystemId};

/// How long each fault lasts: until the end.
const LASTS: Duration = Duration::from_ms(60_000);

/// The amount of each signal's offset, in thousandths of its unit. A drift adds a fifth of it each
/// second.
const fn offset(signal: Signal) -> i64 {
    match signal {
        Signal::LaneOffset => 300,
        Signal::LaneHeading => 50,
        Signal::LaneCurvature => 10,
        Signal::ObjectDistance => 8_000,
        Signal::ObjectSpeed => 5_000,
        Signal::EgoSpeed => 5_000,
        Signal::EgoAcceleration => 20_000,
        Signal::EgoSlip => 50,
        Signal::YawRate => 100,
        Signal::SteeringAngle => 50,
        Signal::CommandSteering => 10,
        Signal::CommandAcceleration => 1_000,
        Signal::Trajectory => 500,
    }
}

fn wrong_values() -> impl Iterator<Item = Kind> {
    let of_signal = |signal: Signal| {
        signal.cores().iter().flat_map(move |core| {
            How::ALL.iter().map(move |how| {
                let amount = match how {
                    How::Offset => offset(signal),
                    How::Drift => offset(signal) / 5,
                    How::Factor => 400,
                    How::LateMs => 500_000,
                    How::Sign | How::Stuck | How::Nan => 0,
                };
                Kind::WrongValue(WrongValue {
                    signal,
                    core: *core,
                    how: *how,
                    amount: Real::thousandths(amount),
                })
            })
        })
    };
    Signal::ALL.iter().copied().flat_map(of_signal)
}

const DEAF: [(&str, u8); 10] = [
    ("EgoMotion", 0),
    ("EgoMotion", 1),
    ("CameraLanes", 0),
    ("CameraLanes", 1),
    ("RadarFrontHeader", 0),
    ("RadarFrontHeader", 1),
    ("CameraFrontHeader", 0),
    ("CameraFrontHeader", 1),
    ("GateEcho", 0),
    ("DriverRequest", 1),
];

/// Returns the faults of values that processes can suffer.
pub(crate) fn of_processes() -> Vec<Kind> {
    kinds()
        .iter()
        .copied()
        .filter(|kind| matches!(kind, Kind::DeafTo(_) | Kind::Forged(_)))
        .collect()
}

/// Forged words. The frames of A are those of the driver if A drives.
const FORGED: [(&str, &str, i64); 18] = [
    ("GateEcho", "Term", 0),
    ("GateEcho", "Term", 0xFFFF_FFFE),
    ("GateEcho", "Term", 0xFFFF_FFFF),
    ("GateEcho", "Term", 40_000),
    ("GateEcho", "SteeringAngle", 0),
    ("GateEcho", "SentAt", 7),
    ("GateEcho", "Refused", 9),
    ("ControlA", "Term", 0xFFFF_FFFE),
    ("ControlA", "Term", 40_000),
    ("ControlB", "Term", 0xFFFF_FFFF),
    ("ControlB", "Role", 1),
    ("StatusA", "Term", 0xFFFF_FFFE),
    ("StatusA", "Ability", 3),
    ("StatusB", "Term", 0xFFFF_FFFF),
    ("StatusB", "Ability", 3),
    ("StatusB", "Role", 1),
    ("StatusA", "Agreement", 2),
    ("StatusB", "Counter", 9),
];

fn kinds() -> &'static [Kind] {
    static KINDS: OnceLock<Vec<Kind>> = OnceLock::new();
    KINDS.get_or_init(|| {
        let deaf = DEAF.iter().filter_map(|(frame, core)| {
            let (frame, core) = (FrameName::of(frame)?, *core);
            Some(Kind::DeafTo(DeafTo { frame, core }))
        });
        let forged = FORGED.iter().filter_map(|(frame, field, value)| {
            let value = Real::thousandths(value * 1_000);
            Forged::of(FrameName::of(frame)?, field, value).map(Kind::Forged)
        });
        wrong_values().chain(deaf).chain(forged).collect()
    })
}

/// Who drives, whether alone, and which system has the fault.
const STATES: [(SystemId, bool, SystemId); 6] = [
    (SystemId::A, false, SystemId::A),
    (SystemId::A, false, SystemId::B),
    (SystemId::B, false, SystemId::B),
    (SystemId::B, false, SystemId::A),
    (SystemId::A, true, SystemId::A),
    (SystemId::B, true, SystemId::B),
];

/// Returns the number of sequences.
pub(crate) fn count() -> u64 {
    (kinds().len() * STATES.len() * DriveSetting::PLACES.len()) as u64
}

/// Returns a sequence by its number.
///
/// # Panics
/// If the number is not below [`count`].
pub(crate) fn sequence(number: u64) -> Sequence {
    let (places, states) = (DriveSetting::PLACES.len(), STATES.len());
    let index = number as usize;
    let (_, road, driven) = DriveSetting::PLACES[index % places];
    let (driver, is_alone, faulty) = STATES[index / places % states];
    let kind = kinds()[index / places / states];
    let way = match kind {
        Kind::Forged(_) => Way::Both,
        _ => Way::from(faulty),
    };
    Sequence {
        group: Group::Values,
        number,
        faults: vec![Fault {
            kind,
            way,
            at: Duration::ZERO,
            lasts: None,
        }],
        from_power_on: false,
        span: LASTS,
        setting: Some(DriveSetting {
            road,
            driver,
            is_alone,
            driven,
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every sequence survives a file, and each fault of the lists exists.
    #[test]
    fn every_fault_exists_and_survives_a_file() {
        let of_signals: usize = Signal::ALL.iter().map(|it| it.cores().len()).sum();
        let expected = of_signals * How::ALL.len() + DEAF.len() + FORGED.len();
        assert_eq!(kinds().len(), expected);
        for number in (0..count()).step_by(STATES.len() * DriveSetting::PLACES.len()) {
            let sequence = sequence(number);
            let text = sequence.to_toml().expect("TOML");
            let read = Sequence::from_toml(&text, 0).expect("what was written can be read");
            assert_eq!(read.faults, sequence.faults, "{text}");
        }
    }
}
