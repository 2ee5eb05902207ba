//! The judge of a campaign: what must hold under any faults on any board.

use crate::entry::Fault;
use crate::kind::Kind;
use crate::sequence::{Group, Sequence};
use tandem_board::Line;
use tandem_peripherals::network::Wire;
use tandem_record::verdict::{Finding, Rule};
use tandem_vehicle::gate::Acceptance;
use tandem_vehicle::mastership::Mastership;

/// The number of changes of the driver that one fault explains: to the other system and back.
const CHANGES_OF_A_FAULT: usize = 2;

/// What a campaign observed during a sequence of faults.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'e> {
    /// The faults.
    pub faults: &'e [Fault],
    /// The control frames that took effect, in order.
    pub acted: &'e [Acceptance],
    /// The number of changes of the driver that only the faults can explain.
    pub changes: usize,
    /// The number of collisions that the vehicle caused.
    pub collisions: usize,
}

impl Observed<'_> {
    /// Returns the rules that are broken.
    #[must_use]
    pub fn findings(&self) -> Vec<Finding> {
        let mut mastership = Mastership::default();
        for frame in self.acted {
            mastership.accept(frame.at_ns, frame.system, frame.term);
        }
        let is_old = |pair: &&[Acceptance]| {
            let same = pair[0].term == pair[1].term;
            pair[1].term < pair[0].term || (same && pair[0].system != pair[1].system)
        };
        let old_terms = self.acted.windows(2).filter(is_old).count();
        // A frame that kills core 1 of both systems is a fault in each of them.
        let hits = |fault: &Fault| 1 + usize::from(fault.kind == Kind::Poison);
        let most_changes = CHANGES_OF_A_FAULT * self.faults.iter().map(hits).sum::<usize>() + 1;
        // Two faults together may end a mastership that neither fault alone would end.
        let spared = matches!(self.faults, [one] if one.spares_the_master());
        let needless = if spared { self.changes } else { 0 };
        let figures = [
            (Rule::OldTerm, old_terms as f64, 0.0),
            (
                Rule::TwoMasters,
                mastership.two_masters_ns() as f64 * 1e-6,
                0.0,
            ),
            (Rule::Changes, self.changes as f64, most_changes as f64),
            (Rule::Needless, needless as f64, 0.0),
            (Rule::Collision, self.collisions as f64, 0.0),
        ];
        let broken = figures.into_iter().filter(|(_, is, most)| is > most);
        let words = |rule: Rule, is, most| format!("{}: {is}, at most {most}", rule.row().words);
        broken
            .map(|(rule, is, most)| Finding::new(rule, [is, most], words(rule, is, most)))
            .collect()
    }
}

/// An excuse of a wrong value holds up to this offset from the lane, m.
const EXCUSED_ASIDE_M: f64 = 2.0;

/// Returns why a wrong value may break this rule with this offset from the lane, m; `None` if it
/// must not. Both reasons are of a system that is alone: nobody else can drive.
fn known_of_values(sequence: &Sequence, rule: Rule, aside_m: f64) -> Option<&'static str> {
    let setting = sequence.setting.filter(|setting| setting.is_alone)?;
    let excused = matches!(rule, Rule::OffLane | Rule::Collision | Rule::TooClose);
    if !excused || aside_m > EXCUSED_ASIDE_M {
        return None;
    }
    match sequence.faults.first()?.kind {
        Kind::WrongValue(wrong) if wrong.signal.is_sent() => {
            Some("the output of the only system is wrong, and is corrected as far as echoes tell")
        }
        Kind::Forged(forged) => {
            let own = ["ControlA", "ControlB"][setting.driver.index()];
            (forged.frame.info().name == own)
                .then_some("another node sends in the name of the only system that drives")
        }
        _ => None,
    }
}

/// Returns why these faults may break this rule (`docs/redundancy.md`); `None` if they must not.
/// `aside_m`: the largest offset from the lane, if there is a vehicle.
#[must_use]
pub fn known(sequence: &Sequence, rule: Rule, aside_m: Option<f64>) -> Option<&'static str> {
    if sequence.group == Group::Values {
        return known_of_values(sequence, rule, aside_m.unwrap_or(f64::INFINITY));
    }
    let only = |is: fn(&Kind) -> bool| matches!(&sequence.faults[..], [one] if is(&one.kind));
    let start_line = |kind: &Kind| {
        let start = Wire::Line(Line::Start);
        matches!(kind, Kind::Flap { wire, .. } if *wire == start)
    };
    match rule {
        Rule::Changes if sequence.spoils_frames_of_both() => {
            Some("frames of both systems are lost or wrong, so each relieves the other rightly")
        }
        // With a vehicle, core 1 needs longer to see its lane, so no system relieves the other.
        Rule::Stopped | Rule::Changes | Rule::Gap
            if aside_m.is_none() && only(|kind| *kind == Kind::Poison) =>
        {
            Some("one frame kills core 1 of both systems again and again: none sees its lane")
        }
        Rule::Needless if sequence.from_power_on && only(start_line) => {
            Some("both systems start at the same time, and the newer term drives after 1 ms")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::amount::just;
    use crate::entry::Way;
    use tandem_board::Duration;
    use tandem_vehicle::gate::Ruling;

    const fn frame(at_ms: u64, system: u8, term: u32) -> Acceptance {
        Acceptance {
            at_ns: at_ms * 1_000_000,
            system,
            term,
            ruling: Ruling::Accepted,
        }
    }

    const fn fault(kind: Kind, way: Way) -> Fault {
        Fault {
            kind,
            way,
            at: Duration::ZERO,
            lasts: None,
        }
    }

    /// Tests each rule with the smallest violation, and with a case that only just complies.
    #[test]
    fn each_rule_finds_what_breaks_it() {
        // B takes over from A.
        let one = [frame(0, 0, 2), frame(10, 0, 2), frame(24, 1, 3)];
        let power_loss = [fault(Kind::PowerLoss, Way::A)];
        let stray = [fault(Kind::StrayBeats(just(3)), Way::A)];
        let poison = [fault(Kind::Poison, Way::A)];
        let sound = Observed {
            faults: &power_loss,
            acted: &one,
            changes: 1,
            collisions: 0,
        };
        let rules = |observed: Observed<'_>| -> Vec<Rule> {
            let findings = observed.findings();
            findings.iter().map(|finding| finding.rule).collect()
        };
        assert_eq!(rules(sound), []);
        let back_to = |system, term| [one[0], one[1], one[2], frame(34, system, term)];
        for (acted, broken) in [
            // A frame of A's term, which ended when B took over.
            (back_to(0, 2), vec![Rule::OldTerm, Rule::TwoMasters]),
            // One term belongs to both.
            (back_to(0, 3), vec![Rule::OldTerm]),
            (back_to(0, 4), vec![]),
        ] {
            let acted = &acted;
            assert_eq!(rules(Observed { acted, ..sound }), broken, "{acted:?}");
        }
        for (faults, changes, broken) in [
            (&power_loss[..], 3, vec![]),
            (&power_loss, 4, vec![Rule::Changes]),
            (&poison, 5, vec![]),
            (&poison, 6, vec![Rule::Changes]),
            (&[], 1, vec![]),
            (&[], 2, vec![Rule::Changes]),
            (&stray, 0, vec![]),
            (&stray, 1, vec![Rule::Needless]),
        ] {
            let observed = Observed {
                faults,
                changes,
                ..sound
            };
            assert_eq!(rules(observed), broken, "{faults:?} {changes}");
        }
        let collisions = 1;
        let collided = Observed {
            collisions,
            ..sound
        };
        assert_eq!(rules(collided), [Rule::Collision]);
    }
}
