//! The start protocol between two systems. T-RED-2

use crate::model::{Pair, RESET_US, STEP_US, us};
use tandem_board::SystemId::{self, A, B};
use tandem_board::{Edge, Line};
use tandem_redundancy::{Config, Mode, Phase, RedundancyEvent, SystemState};

const PROFILES: [Config; 2] = [Config::rt(), Config::desktop()];

fn other(id: SystemId, first: SystemId, offset_us: u64) -> u64 {
    if id == first { 0 } else { offset_us }
}

/// Switches `first` on, and the other `offset_us` later.
fn power_on(pair: &mut Pair, first: SystemId, offset_us: u64) {
    pair.power_on(first);
    let until = pair.now_us + other(first.peer(), first, offset_us);
    while pair.now_us < until {
        pair.run_until(10_000, |pair| pair.now_us >= until);
    }
    pair.power_on(first.peer());
}

fn drivers(pair: &Pair) -> Vec<SystemId> {
    SystemId::ALL
        .into_iter()
        .filter(|&id| pair.phase(id).is_some_and(Phase::is_driving))
        .collect()
}

/// T-RED-2: for any phase between the two starts within the time limit, the system initialised as
/// master leads, the other follows on its sync edge, and their times differ by less than 2 ms
/// (thesis: 572 us).
#[test]
fn starts_at_any_phase_within_the_time_limit() {
    let mut worst = 0;
    for config in PROFILES {
        let limit = us(config.start_limit);
        let offsets = [
            0, 100, 300, 900, 1_000, 4_900, 5_000, 5_100, 17_300, 100_000,
        ]
        .into_iter()
        .chain([limit / 2, limit - 20_000, limit - 10_000]);
        for offset in offsets {
            for first in [A, B] {
                for master in [A, B] {
                    let mut pair = Pair::new(config, offset + 1);
                    for id in [A, B] {
                        let is_master = id == master;
                        let factory = SystemState::factory(id);
                        pair.systems[id.index()].flash = Some(SystemState {
                            is_master,
                            ..factory
                        });
                    }
                    power_on(&mut pair, first, offset);
                    pair.run_ms(200);
                    let what = format!("{first} first by {offset} us, {master} master");
                    assert_eq!(pair.phase(master), Some(Phase::Master), "{what}");
                    assert_eq!(pair.phase(master.peer()), Some(Phase::Standby), "{what}");
                    assert_eq!(pair.synchronised.len(), 2, "{what}");
                    let skew = pair.synchronised[1].0 - pair.synchronised[0].0;
                    assert!(skew < 2_000, "{what}: {skew} us");
                    worst = worst.max(skew);
                    assert!(
                        pair.fenced.is_empty() && pair.changes_of_driver() == 0,
                        "{what}"
                    );
                    let standby = pair.systems[master.peer().index()]
                        .machine
                        .as_ref()
                        .unwrap();
                    assert_eq!(standby.mode(), Mode::L3, "{what}");
                    for id in [A, B] {
                        assert!(!pair.state(id).cpsys_failure, "{what}");
                    }
                }
            }
        }
    }
    println!("times differ by {worst} us at most after sync (thesis: 572 us)");
}

/// T-RED-2: if no system answers, cpsys_failure is set and the system drives degraded. A system
/// that starts later becomes its standby, and the failure is cleared (T-RED-4), but dual operation
/// waits for the next power cycle.
#[test]
fn alone_after_the_time_limit_and_joined_by_a_late_one() {
    for config in PROFILES {
        for first in [A, B] {
            let mut pair = Pair::new(config, 3);
            pair.power_on(first);
            let took = pair.run_until(5_000, |pair| !drivers(pair).is_empty());
            assert!(took >= us(config.start_limit));
            let longest = us(config.start_limit) + 3 * us(config.stagger) + RESET_US;
            assert!(took <= longest + 2_000, "{took}");
            assert_eq!(pair.phase(first), Some(Phase::DegradedMaster));
            assert!(pair.state(first).cpsys_failure);

            pair.run_ms(500);
            pair.power_on(first.peer());
            let took = pair.run_until(100, |pair| pair.phase(first.peer()) == Some(Phase::Standby));
            println!("late one is standby {took} us after power-on");
            pair.run_ms(us(config.recover_after) / 1_000 + 300);
            assert!(!pair.state(first).cpsys_failure);
            assert_eq!(drivers(&pair), [first]);
            assert!(pair.takeovers(0).is_empty() && pair.fenced.is_empty());
            assert_eq!(pair.changes_of_driver(), 0);

            // The next power cycle is dual operation again.
            pair.power_off(A);
            pair.power_off(B);
            pair.run_ms(50);
            power_on(&mut pair, A, 7_000);
            pair.run_ms(300);
            assert_eq!(pair.phase(first), Some(Phase::Master));
            assert_eq!(pair.phase(first.peer()), Some(Phase::Standby));
        }
    }
}

/// T-RED-2, T-RED-9: even if both records claim master, or neither does, or a flash is lost, one
/// system is master, and the other never sends a control frame.
#[test]
fn contradicting_records_lead_to_one_master() {
    for config in PROFILES {
        for offset in [0, 300, 1_000, 3_100, 8_000, 50_000] {
            for first in [A, B] {
                for claims in [[true, true], [false, false]] {
                    for lost in [[false; 2], [true, false], [false, true], [true; 2]] {
                        let mut pair = Pair::new(config, offset);
                        for id in [A, B] {
                            let system = &mut pair.systems[id.index()];
                            let is_master = claims[id.index()];
                            let factory = SystemState::factory(id);
                            system.flash = Some(SystemState {
                                is_master,
                                ..factory
                            });
                            system.flash_lost = lost[id.index()];
                        }
                        power_on(&mut pair, first, offset);
                        pair.run_ms(400);
                        let what = format!("{first} first by {offset} us, {claims:?} {lost:?}");
                        let [driver] = drivers(&pair)[..] else {
                            panic!("{what}: {:?}", pair.phases())
                        };
                        assert_eq!(pair.phase(driver), Some(Phase::Master), "{what}");
                        assert_eq!(pair.phase(driver.peer()), Some(Phase::Standby), "{what}");
                        assert_eq!(pair.changes_of_driver(), 0, "{what}");
                        assert!(pair.fenced.is_empty(), "{what}");
                        let reported = pair
                            .events
                            .iter()
                            .any(|(.., event)| *event == RedundancyEvent::StateLost);
                        assert_eq!(reported, lost != [false; 2]);
                        if claims == [true, true] || lost != [false; 2] {
                            continue;
                        }
                        assert_eq!(driver, A, "{what}: A wins among equals");
                    }
                }
            }
        }
    }
}

/// T-RED-2, T-RED-9: the start line is cut in one direction or both: because of the heartbeats
/// there is still only one master. If the heartbeat lines are cut too, CAN has the same effect.
#[test]
fn start_line_cut() {
    for config in PROFILES {
        for offset in [0, 1_000, 15_000, 45_000, 100_000] {
            for first in [A, B] {
                for start in [[true, false], [false, true], [true, true]] {
                    for beats_cut in [false, true] {
                        let mut pair = Pair::new(config, offset + 5);
                        pair.cuts.start = start;
                        pair.cuts.beats = [[beats_cut; 2]; 2];
                        power_on(&mut pair, first, offset);
                        pair.run_ms(us(config.start_limit) / 1_000 + 500);
                        let what = format!("{first} first by {offset}, {start:?} {beats_cut}");
                        let drivers = drivers(&pair);
                        assert_eq!(drivers.len(), 1, "{what}: {:?}", pair.phases());
                        assert_eq!(
                            pair.phase(drivers[0].peer()),
                            Some(Phase::Standby),
                            "{what}"
                        );
                        assert!(pair.changes_of_driver() <= 1, "{what}");
                    }
                }
            }
        }
    }
}

/// T-RED-7: each system has recorded the other as failed in the last run: both listen, one drives,
/// and the other joins it.
#[test]
fn both_take_the_other_for_failed() {
    for config in PROFILES {
        for (offset, start_cut) in [0, 500, 5_000, 30_000, 70_000]
            .into_iter()
            .flat_map(|offset| [(offset, false), (offset, true)])
        {
            for first in [A, B] {
                let mut pair = Pair::new(config, 11);
                pair.cuts.start = [start_cut; 2];
                pair.cuts.level = [start_cut; 2];
                for id in [A, B] {
                    let factory = SystemState::factory(id);
                    let state = SystemState {
                        cpsys_failure: true,
                        is_master: true,
                        ..factory
                    };
                    pair.systems[id.index()].flash = Some(state);
                }
                power_on(&mut pair, first, offset);
                pair.run_ms(200);
                assert_eq!(
                    drivers(&pair).len(),
                    1,
                    "{first} {offset}: {:?}",
                    pair.phases()
                );
                assert_eq!(pair.changes_of_driver(), 0);
            }
        }
    }
}

/// T-RED-9: a system that lost its flash claims to be master in a term that the vehicle, which kept
/// running, refuses. The other has stored the higher term and reports it.
#[test]
fn a_master_with_a_forgotten_term_is_reported() {
    let mut pair = Pair::dual(Config::rt(), 3);
    // In each start A drives before it hears the vehicle.
    pair.vehicle_pauses = true;
    for flash_lost in [false, false, false, true] {
        pair.power_off(A);
        pair.power_off(B);
        pair.run_ms(20);
        pair.systems[A.index()].flash_lost = flash_lost;
        pair.power_on(A);
        pair.power_on(B);
        pair.run_ms(30);
    }
    assert!(!pair.fenced.is_empty(), "the test must have provoked it");
    pair.vehicle_pauses = false;
    pair.run_ms(300);
    assert_eq!(pair.phases(), [Some(Phase::Master), Some(Phase::Standby)]);
    let gap = pair.longest_gap_us(pair.now_us - 150_000);
    assert!(gap < 25_000, "{gap}");
}

/// T-RED-2: an edge on the start line that no system has sent, at any moment of the start, does not
/// prevent dual operation, no matter how much later the other system is switched on.
#[test]
fn a_stray_edge_on_the_start_line_does_not_cost_dual_operation() {
    for config in [Config::chip(), Config::rt(), Config::desktop()] {
        for later_ms in [0, 12, 40, 150] {
            for stray_ms in (0..20).chain([later_ms + 3, later_ms + 5, later_ms + 7]) {
                let ways = [A, B].into_iter().flat_map(|to| [(to, false), (to, true)]);
                let edges = [Edge::Rising, Edge::Falling];
                let cases = ways.flat_map(|way| edges.map(|edge| (way, edge)));
                for ((to, link_cut), edge) in cases {
                    let mut pair = Pair::new(config, stray_ms + later_ms);
                    pair.cuts.link = link_cut;
                    pair.power_on(to);
                    let stray_us = RESET_US + stray_ms * 1_000;
                    let end_us = (later_ms + 200) * 1_000;
                    while pair.now_us < end_us {
                        if pair.now_us == later_ms * 1_000 {
                            pair.power_on(to.peer());
                        }
                        if pair.now_us == stray_us {
                            pair.edge(to.peer(), Line::Start, edge);
                        }
                        pair.run_us(STEP_US);
                    }
                    let what = format!(
                        "{edge:?} to {to} {stray_ms} ms after its start, the other {later_ms} ms later, \
                         link cut {link_cut}"
                    );
                    let mut phases = pair.phases();
                    phases.sort_by_key(|phase| *phase != Some(Phase::Master));
                    let dual = [Phase::Master, Phase::Standby].map(Some);
                    assert_eq!(phases, dual, "{what}: {:?}", pair.events);
                    assert_eq!(pair.changes_of_driver(), 0, "{what}");
                }
            }
        }
    }
}

/// T-RED-2: if stray sync edges repeat and there is no other system, a system drives alone when its
/// time limit is over.
#[test]
fn stray_sync_edges_without_an_end_keep_no_system_from_driving() {
    for period_ms in [1, 3, 10, 30, 100] {
        for first in [A, B] {
            let config = Config::rt();
            let mut pair = Pair::new(config, period_ms);
            pair.power_on(first);
            let limit_ms = us(config.start_limit + config.stagger.times(3)) / 1_000;
            for ms in 0..limit_ms + 50 {
                if ms % period_ms == 0 {
                    pair.edge(first.peer(), Line::Start, Edge::Falling);
                }
                pair.run_ms(1);
            }
            assert_eq!(drivers(&pair), [first], "each {period_ms} ms");
        }
    }
}

/// T-RED-9: the connections of a master end right after its first frame, which its standby has not
/// heard. The vehicle's echo shows that there was one, so the standby detects its absence in time.
#[test]
fn a_master_that_ends_after_its_first_frame_is_missed() {
    for config in PROFILES {
        for after_us in (0..12_000).step_by(500) {
            let mut pair = Pair::new(config, after_us + 1);
            pair.cuts.deaf_to_each_other = true;
            pair.power_on(A);
            pair.power_on(B);
            pair.run_until(10_000, |pair| !pair.accepted.is_empty());
            pair.run_us(after_us);
            let from = pair.now_us;
            pair.cuts.can[drivers(&pair)[0].index()] = true;
            pair.cuts.link = true;
            pair.run_ms(500);
            let gap = pair.longest_gap_us(from);
            assert!(
                gap <= us(config.gap_bound_mute()) + 1_500,
                "{after_us}: {gap}"
            );
        }
    }
}
