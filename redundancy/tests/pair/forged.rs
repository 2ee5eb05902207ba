//! Words with a right protection and a wrong term: one of them decides nothing. T-RED-9

use crate::model::{Pair, us};
use tandem_board::SystemId::{self, A, B};
use tandem_board::{Duration, Instant, ResetCause};
use tandem_redundancy::{
    Ability, Config, ControlHeader, FailureMode, Input, LinkReport, Mode, ObeyedTerm, PeerReport,
    Phase, Role, SystemState, Term,
};

/// Longest time on the bus, plus the grid of the model.
const BUS_US: u64 = 1_500;
/// Numbers that are no terms, and terms that no rule explains.
const FAR: [u32; 7] = [
    0xFFFF_FFFF,
    0xFFFF_FFFE,
    0x7FFF_FFFE,
    0x7FFF_FFFF,
    Term::LAST.bits(),
    Term::LAST_UNEXPLAINED.bits(),
    9_000,
];

/// A kind of word that can be forged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Word {
    Control,
    /// A control frame with a wrong counter.
    Stale,
    Status(Role),
    Link(Role),
    /// An echo that says that a frame of this term was accepted so many milliseconds ago.
    Echo(u64),
}

const WORDS: [Word; 12] = [
    Word::Control,
    Word::Stale,
    Word::Status(Role::Starting),
    Word::Status(Role::Master),
    Word::Status(Role::Standby),
    Word::Status(Role::Suspended),
    Word::Link(Role::Starting),
    Word::Link(Role::Master),
    Word::Link(Role::Standby),
    Word::Link(Role::Suspended),
    Word::Echo(0),
    Word::Echo(900),
];

/// Where the systems are when the word arrives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Around {
    Dual,
    /// This system drives, and the other one is off.
    Alone(SystemId),
}

impl Around {
    fn pair(self, config: Config, seed: u64) -> Pair {
        let mut pair = Pair::dual(config, seed);
        if let Self::Alone(id) = self {
            pair.power_off(id.peer());
        }
        pair.run_ms(300 + seed);
        pair
    }
}

/// Returns a master's header. The lowest bit of its term names the sender, or it is implausible.
fn header(system: SystemId, bits: u32) -> ControlHeader {
    ControlHeader {
        system,
        term: Term::from_bits(bits & !1 | system.index() as u32),
        role: Role::Master,
        mode: Mode::L3,
    }
}

/// Gives the word to a system. The name of its sender is that of the other system.
pub(crate) fn forge(pair: &mut Pair, to: SystemId, word: Word, bits: u32) {
    let peer = to.peer();
    let header = header(peer, bits);
    let report = |role| PeerReport {
        role,
        mode: Mode::L3,
        term: if role == Role::Master {
            header.term
        } else {
            Term::from_bits(bits)
        },
        can_alive: true,
        ability: Ability::All,
    };
    let origin_us = [1_000_000, 77_000_000_000_u64][peer.index()];
    let input = match word {
        Word::Control => Input::ControlFrame(header),
        Word::Stale => Input::StaleFrame(header),
        Word::Status(role) => Input::StatusFrame(report(role)),
        Word::Link(role) => Input::LinkReport(LinkReport {
            report: report(role),
            start: 1,
            sent_us: (pair.now_us + origin_us) as u32,
        }),
        Word::Echo(age_ms) => Input::VehicleTerm(ObeyedTerm {
            term: Term::from_bits(bits),
            age: Duration::from_ms(age_ms),
            sent: None,
        }),
    };
    pair.systems[to.index()].forged.push(input);
}

fn profiles() -> [Config; 2] {
    [Config::chip(), Config::rt()].map(|config| Config {
        reintegrate: true,
        ..config
    })
}

/// T-RED-9: no word with a far term costs a control frame or a role, whichever system hears it and
/// whether the other one runs. Afterwards the standby takes over within the bound.
#[test]
fn one_word_with_a_far_term_changes_nothing() {
    let mut tried = 0;
    for config in profiles() {
        for around in [Around::Dual, Around::Alone(A), Around::Alone(B)] {
            for word in WORDS {
                for (seed, bits) in (1..).zip(FAR) {
                    for hearers in [&[A][..], &[B], &[A, B]] {
                        let mut pair = around.pair(config, seed);
                        let (from, before) = (pair.now_us, pair.phases());
                        for to in hearers {
                            forge(&mut pair, *to, word, bits);
                        }
                        pair.run_ms(400);
                        let what = format!("{around:?} {word:?} {bits:x} to {hearers:?}");
                        let gap = pair.longest_gap_us(from);
                        assert!(gap <= us(config.control_period) + 2_000, "{what}: {gap} us");
                        assert_eq!(pair.phases(), before, "{what}");
                        if around == Around::Dual {
                            let from = pair.now_us;
                            pair.power_off(A);
                            pair.run_ms(100);
                            let gap = pair.longest_gap_us(from);
                            let bound = us(config.gap_bound()) + BUS_US;
                            assert!(gap <= bound, "{what}, then A off: {gap} us");
                        }
                        tried += 1;
                    }
                }
            }
        }
    }
    println!("{tried} words");
}

/// T-RED-9: a word with a term that the rules explain may change the driver. It costs no more than
/// a mute master, and afterwards one system drives and the other one stands by.
#[test]
fn one_word_with_a_near_term_costs_no_more_than_a_mute_master() {
    let mut longest = vec![];
    for config in profiles() {
        for around in [Around::Dual, Around::Alone(A), Around::Alone(B)] {
            for word in WORDS {
                let mut worst = 0;
                for (seed, above) in (1..).zip([1, 2, 3, 41, 2_000, 4_095, 1, 2, 3, 1, 2, 3]) {
                    for (hearers, on_bus) in
                        [(&[A][..], false), (&[B], false), (&[A], true), (&[B], true)]
                    {
                        let mut pair = around.pair(config, seed);
                        let from = pair.now_us;
                        let term = pair.accepted.last().unwrap().term.bits() + above;
                        for to in hearers {
                            forge(&mut pair, *to, word, term);
                        }
                        // On the bus, the vehicle hears the frame too.
                        if on_bus && word == Word::Control {
                            let heard = header(hearers[0].peer(), term);
                            pair.vehicle_hears(heard);
                        }
                        pair.run_ms(2_500);
                        let what = format!("{around:?} {word:?} +{above} to {hearers:?}");
                        let gap = pair.longest_gap_us(from);
                        worst = worst.max(gap);
                        let bound = us(config.gap_bound_mute()) + BUS_US;
                        assert!(gap <= bound, "{what}: {gap} us of {bound} us");
                        let phases = pair.phases();
                        let drivers = phases.iter().flatten().filter(|it| it.is_driving());
                        assert_eq!(drivers.count(), 1, "{what}: {phases:?}");
                        let standby = phases.contains(&Some(Phase::Standby));
                        assert_eq!(standby, around == Around::Dual, "{what}: {phases:?}");
                    }
                }
                longest.push((around, word, worst));
            }
        }
    }
    for (around, word, worst) in longest {
        println!("{around:?} {word:?}: {worst} us");
    }
}

/// T-RED-9: the same far word again and again from one source changes nothing either, except ten
/// echoes to a master, which then takes a higher term.
#[test]
fn one_witness_that_repeats_itself_is_still_one() {
    for config in profiles() {
        for word in WORDS {
            let mut pair = Around::Dual.pair(config, 3);
            let (from, before) = (pair.now_us, pair.phases());
            for _ in 0..200 {
                for to in [A, B] {
                    forge(&mut pair, to, word, 1_000_001);
                }
                pair.run_ms(5);
            }
            let gap = pair.longest_gap_us(from);
            assert!(
                gap <= us(config.control_period) + 2_000,
                "{word:?}: {gap} us"
            );
            assert_eq!(pair.phases(), before, "{word:?}");
        }
    }
}

/// T-RED-9: the vehicle obeys a term far above all that the systems know: a system that drives
/// learns it from ten echoes. With its record lost it learns it from two.
#[test]
fn a_vehicle_far_ahead_is_followed() {
    for config in profiles() {
        for (lost, bound_ms) in [(false, 150), (true, 30)] {
            let mut pair = Around::Alone(A).pair(config, 5);
            let far = header(B, 5 << 20);
            if lost {
                pair.power_off(A);
            } else {
                pair.reset(A, ResetCause::Watchdog);
            }
            pair.accepted.clear();
            for _ in 0..5 {
                pair.vehicle_hears(far);
            }
            let from = pair.now_us;
            pair.systems[A.index()].flash_lost = lost;
            pair.run_ms(100);
            pair.power_on(A);
            pair.run_ms(400 + config.start_limit.as_us() / 1_000);
            let started = pair.events.iter().find_map(|&(at, id, event)| {
                let drives = matches!(event, tandem_redundancy::RedundancyEvent::Phase { to, .. }
                    if to.is_driving());
                (drives && id == A && at > from).then_some(at)
            });
            let accepted = pair.accepted.iter().find(|seen| seen.term > far.term);
            let after_us = accepted.unwrap().at_us - started.unwrap();
            println!("record lost {lost}: {after_us} us after the start");
            assert!(after_us <= bound_ms * 1_000, "{lost}: {after_us} us");
        }
    }
}

/// T-RED-9: a standby whose known term is far too high does not depose its master, and takes over
/// in a term that the vehicle accepts.
#[test]
fn a_standby_with_an_inflated_term_learns_that_of_its_master() {
    for config in profiles() {
        for bits in [9_001, 1_000_000, Term::LAST_UNEXPLAINED.bits()] {
            let mut pair = Around::Dual.pair(config, 7);
            let term = pair.accepted.last().unwrap().term;
            pair.power_off(B);
            pair.run_ms(30);
            pair.systems[B.index()].flash = Some(SystemState {
                term: Term::from_bits(bits),
                ..SystemState::factory(B)
            });
            let from = pair.now_us;
            pair.power_on(B);
            pair.run_ms(3_000);
            let phases = pair.phases();
            assert_eq!(
                phases,
                [Some(Phase::Master), Some(Phase::Standby)],
                "{bits}"
            );
            assert_eq!(pair.state(B).term, term, "{bits}");
            assert!(pair.longest_gap_us(from) <= us(config.control_period) + 2_000);
            let from = pair.now_us;
            pair.power_off(A);
            pair.run_ms(100);
            let gap = pair.longest_gap_us(from);
            assert!(gap <= us(config.gap_bound()) + BUS_US, "{bits}: {gap} us");
        }
    }
}

/// T-RED-9: records with a term near the end, in both systems, and with the failure that followed
/// from it, are healed by the next start.
#[test]
fn poisoned_records_are_healed_by_the_next_start() {
    for config in profiles() {
        for bits in [
            u32::MAX,
            u32::MAX - 1,
            Term::LAST.bits(),
            Term::LAST.bits() + 1,
        ] {
            for sys_failure in [false, true] {
                let mut pair = Pair::new(config, 5);
                for id in SystemId::ALL {
                    let mode = [FailureMode::None, FailureMode::TermsExhausted];
                    pair.systems[id.index()].flash = Some(SystemState {
                        term: Term::from_bits(bits),
                        sys_failure,
                        failure_mode: mode[usize::from(sys_failure)],
                        ..SystemState::factory(id)
                    });
                    pair.power_on(id);
                }
                pair.run_ms(300);
                let phases = pair.phases();
                assert_eq!(
                    phases,
                    [Some(Phase::Master), Some(Phase::Standby)],
                    "{bits:x}"
                );
                assert!(pair.longest_gap_us(200_000) <= 12_000);
                for id in SystemId::ALL {
                    assert!(!pair.state(id).sys_failure && pair.state(id).term.bits() < 9_000);
                }
            }
        }
    }
}

/// T-RED-9: a report over the link whose time is far ahead silences the link for a second at most.
#[test]
fn a_report_from_the_future_silences_the_link_for_a_second() {
    for ahead_ms in [500, 5_000, 1_000_000] {
        let mut pair = Around::Dual.pair(Config::rt(), 3);
        let report = PeerReport {
            role: Role::Master,
            mode: Mode::L3,
            term: pair.state(A).term,
            can_alive: true,
            ability: Ability::All,
        };
        let sent_us = (pair.now_us + 1_000_000 + ahead_ms * 1_000) as u32;
        let start = 1;
        let forged = LinkReport {
            report,
            start,
            sent_us,
        };
        pair.systems[B.index()]
            .forged
            .push(Input::LinkReport(forged));
        pair.run_ms(1_100);
        let machine = pair.systems[B.index()].machine.as_ref().unwrap();
        let now = Instant::from_ns((pair.now_us + 77_000_000_000) * 1_000);
        assert!(
            machine.may_leave(now),
            "{ahead_ms} ms: B hears that A drives"
        );
    }
}
