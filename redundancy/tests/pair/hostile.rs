//! Sequences of faults with which an assessor caused a loss of control, and the right reactions.
//! T-RED-5, T-RED-6, T-RED-9

use crate::model::{Pair, us};
use tandem_board::ResetCause;
use tandem_board::SystemId::{self, A, B};
use tandem_redundancy::{Config, FailureMode, Mode, Phase, RedundancyEvent};

const PROFILES: [Config; 2] = [Config::rt(), Config::desktop()];
/// Longest time on the bus, plus the grid of the model.
const BUS_US: u64 = 1_500;

fn mode(pair: &Pair, id: SystemId) -> Option<Mode> {
    pair.systems[id.index()]
        .machine
        .as_ref()
        .map(|it| it.mode())
}

/// Checks that the vehicle has obeyed a system since `from_us`, without a gap beyond the bound.
fn check_driven(pair: &Pair, from_us: u64, bound_us: u64, what: &str) {
    let gap = pair.longest_gap_us(from_us);
    assert!(gap <= bound_us, "{what}: gap {gap} us of {bound_us} us");
}

/// Returns the bound of a control cycle without a fault.
fn undisturbed(config: &Config) -> u64 {
    us(config.control_period) + 2_000
}

/// T-RED-5: one input kills core 1 of both systems at once. One system continues to drive, the
/// other resets itself, takes over, and then the first one resets: control is never lost.
#[test]
fn a_poison_input_of_both_takes_no_control() {
    for config in PROFILES {
        for seed in 1..20 {
            let mut pair = Pair::dual(config, seed);
            pair.run_ms(seed);
            let from = pair.now_us;
            for id in [A, B] {
                pair.systems[id.index()].until_reset = Some(FailureMode::PerceptionCore);
            }
            pair.run_ms(1_000);
            check_driven(&pair, from, undisturbed(&config), "poison");
            assert_eq!(
                pair.phases(),
                [Some(Phase::Standby), Some(Phase::DegradedMaster)]
            );
            assert_eq!(mode(&pair, B), Some(Mode::DegradedL2), "B is whole again");
            assert!(pair.fenced.is_empty());
        }
    }
}

/// T-RED-5: the poison input is repeated. One system always drives; eventually it stops the
/// vehicle. After a power cycle without the poison one drives, and the other is its standby.
#[test]
fn a_repeated_poison_input_ends_in_a_safe_stop_and_not_in_silence() {
    for config in PROFILES {
        let mut pair = Pair::dual(config, 3);
        let from = pair.now_us;
        for _ in 0..40 {
            for id in [A, B] {
                pair.systems[id.index()].until_reset = Some(FailureMode::PerceptionCore);
            }
            pair.run_ms(200);
            check_driven(&pair, from, us(config.gap_bound()) + BUS_US, "poison");
        }
        let driver = [A, B]
            .into_iter()
            .find(|&id| pair.phase(id).is_some_and(Phase::is_driving));
        assert_eq!(mode(&pair, driver.unwrap()), Some(Mode::SafeStop));
        for id in [A, B] {
            pair.power_off(id);
        }
        pair.run_ms(50);
        for id in [A, B] {
            pair.power_on(id);
        }
        pair.run_ms(us(config.start_limit) / 1_000 + 500);
        let mut phases = pair.phases();
        phases.sort_by_key(|phase| phase.map(|it| it as u8));
        assert!(
            phases[1].is_some_and(Phase::is_driving) && phases[0] == Some(Phase::Standby),
            "{phases:?}"
        );
    }
}

/// T-RED-5: a system that is alone and crashes repeatedly does not fall silent: it starts in the
/// safe stop. If both have permanent faults, one of them does the same. A healthy one drives.
#[test]
fn a_failed_system_without_a_healthy_peer_starts_into_the_safe_stop() {
    for config in PROFILES {
        let mut pair = Pair::dual(config, 3);
        pair.power_off(B);
        pair.run_ms(100);
        for _ in 0..8 {
            pair.reset(A, ResetCause::Watchdog);
            pair.run_ms(300);
            assert_eq!(pair.phase(A), Some(Phase::DegradedMaster));
        }
        assert_eq!(mode(&pair, A), Some(Mode::SafeStop));
        pair.power_on(B);
        pair.run_ms(1_000);
        assert_eq!(
            pair.phase(B),
            Some(Phase::DegradedMaster),
            "the healthy one"
        );
        assert_eq!(mode(&pair, B), Some(Mode::DegradedL2));
        assert!(pair.systems[A.index()].held);

        for failed in [[true, true], [true, false], [false, true]] {
            for first in [A, B] {
                let mut pair = Pair::new(config, 4);
                for id in [A, B] {
                    let mut state = tandem_redundancy::SystemState::factory(id);
                    if failed[id.index()] {
                        state.sys_failure = true;
                        state.failure_mode = FailureMode::IoModule;
                    }
                    pair.systems[id.index()].flash = Some(state);
                }
                pair.power_on(first);
                pair.run_ms(30);
                pair.power_on(first.peer());
                pair.run_ms(us(config.start_limit) / 1_000 + 1_000);
                let from = pair.now_us;
                pair.run_ms(500);
                let what = format!("{failed:?} {first} first: {:?}", pair.phases());
                check_driven(&pair, from, undisturbed(&config), &what);
                let driving = |id: &SystemId| pair.phase(*id).is_some_and(Phase::is_driving);
                let drivers: Vec<_> = [A, B].into_iter().filter(driving).collect();
                assert_eq!(drivers.len(), 1, "{what}");
                let driver = drivers[0];
                if failed == [true; 2] {
                    assert_eq!(mode(&pair, driver), Some(Mode::SafeStop), "{what}");
                    // The other one is its backup.
                    let from = pair.now_us;
                    pair.power_off(driver);
                    pair.run_ms(200);
                    check_driven(&pair, from, us(config.gap_bound()) + BUS_US, &what);
                    assert_eq!(mode(&pair, driver.peer()), Some(Mode::SafeStop), "{what}");
                } else {
                    assert!(!failed[driver.index()], "{what}");
                }
            }
        }
    }
}

/// T-RED-6: the transmitter of the standby fails: the master detects that it has no backup. It
/// neither keeps the mode for two systems nor resets itself.
#[test]
fn a_standby_that_cannot_transmit_is_noticed() {
    for config in PROFILES {
        let mut pair = Pair::dual(config, 7);
        pair.cuts.can_send[B.index()] = true;
        let took = pair.run_until(1_000, |pair| pair.phase(A) == Some(Phase::DegradedMaster));
        println!("noticed after {took} us");
        assert!(pair.state(A).cpsys_failure);
        let programs = pair.systems[A.index()].programs;
        pair.run_ms(5_000);
        assert!(
            pair.state(A).cpsys_failure,
            "its heartbeats alone are no backup"
        );
        assert_eq!(pair.systems[A.index()].programs, programs);
        let from = pair.now_us;
        pair.systems[A.index()].until_reset = Some(FailureMode::PlanningCore);
        pair.run_ms(500);
        check_driven(&pair, from, undisturbed(&config), "resets itself");
        assert_eq!(pair.phase(A), Some(Phase::DegradedMaster));
        assert_eq!(mode(&pair, A), Some(Mode::SafeStop));
    }
}

/// T-RED-6: the transmitter of one system is dead and the vehicle pauses: no system suspends,
/// because a bus on which only the other system is heard does not count as alive.
#[test]
fn a_pause_of_the_vehicle_suspends_no_system() {
    for config in PROFILES {
        for (pause_ms, mute) in [300, 2_000].into_iter().flat_map(|ms| [(ms, A), (ms, B)]) {
            let mut pair = Pair::dual(config, 7);
            pair.cuts.can_send[mute.index()] = true;
            pair.run_ms(1_000);
            let resets = |pair: &Pair| [A, B].map(|id| pair.state(id).total_resets);
            let before = resets(&pair);
            pair.vehicle_pauses = true;
            pair.run_ms(pause_ms);
            pair.vehicle_pauses = false;
            pair.run_ms(50);
            let from = pair.now_us;
            pair.run_ms(500);
            let what = format!("{mute} mute, {pause_ms} ms: {:?}", pair.phases());
            // Each reset to repair the connection would be one of the four permitted resets.
            assert_eq!(resets(&pair), before, "{what}");
            assert!(
                !pair.systems[A.index()].held && !pair.systems[B.index()].held,
                "{what}"
            );
            check_driven(&pair, from, undisturbed(&config), &what);
            assert!(pair.changes_of_driver() <= 1, "{what}");
        }
    }
}

/// T-RED-6: a CAN connection that is cut for a while suspends no system: the cut-off system tries
/// again. At any phase of the cut the vehicle is without control for no longer than the bound.
#[test]
fn a_short_cut_of_can_suspends_no_system() {
    for config in PROFILES {
        for phase in 0..40 {
            for (cut_ms, id) in [240, 300, 1_000, 3_000]
                .into_iter()
                .flat_map(|ms| [(ms, A), (ms, B)])
            {
                let mut pair = Pair::dual(config, phase + 1);
                pair.run_ms(phase * 3 % 100);
                let from = pair.now_us;
                pair.cuts.can[id.index()] = true;
                pair.run_ms(cut_ms);
                pair.cuts.can[id.index()] = false;
                pair.run_ms(300);
                let what = format!("{id} for {cut_ms} ms, phase {phase}");
                assert!(!pair.systems[id.index()].held, "{what}");
                assert_eq!(pair.phase(id), Some(Phase::Standby), "{what}");
                check_driven(&pair, from, us(config.gap_bound_mute()) + 2 * BUS_US, &what);
            }
        }
    }
}

/// Runs while the level line of each system in `of` is low for half of each period; returns the
/// pair.
fn flapping(config: Config, of: &[SystemId], period_us: u64, seconds: u64) -> Pair {
    let mut pair = Pair::dual(config, 5);
    let until = pair.now_us + seconds * 1_000_000;
    while pair.now_us < until {
        for id in of {
            pair.level_stuck_low[id.index()] = pair.now_us % period_us < period_us / 2;
        }
        pair.run_us(100);
    }
    pair
}

/// T-RED-9: level lines that flap overrule neither heartbeats nor control frames, cause no writes
/// to the flash, and are reported.
#[test]
fn a_level_line_that_flaps_is_broken_and_nothing_else() {
    for config in PROFILES {
        for period_us in [400, 1_000, 4_000, 10_000, 100_000, 700_000] {
            for of in [&[A][..], &[B], &[A, B]] {
                let pair = flapping(config, of, period_us, 5);
                let what = format!("{of:?} every {period_us} us");
                assert_eq!(pair.changes_of_driver(), 0, "{what}");
                assert_eq!(
                    pair.phases(),
                    [Some(Phase::Master), Some(Phase::Standby)],
                    "{what}"
                );
                let programs: u32 = pair.systems.iter().map(|system| system.programs).sum();
                assert!(programs <= 10, "{what}: {programs}");
                for id in of {
                    let reported = |&&(_, at, event): &&(u64, SystemId, RedundancyEvent)| {
                        at == id.peer() && event == RedundancyEvent::LevelBroken(true)
                    };
                    let reported = pair.events.iter().filter(reported).count();
                    let lasts = period_us / 2 > us(config.level_limit()) + 1_000;
                    assert!(
                        reported <= 1 && (reported == 1 || !lasts),
                        "{what}: {reported}"
                    );
                }
            }
        }
    }
}

/// T-RED-9: a glitch of 0.3 ms on a level line changes nothing.
#[test]
fn a_glitch_of_the_level_line_changes_nothing() {
    for config in PROFILES {
        for (of, phase) in [A, B]
            .into_iter()
            .flat_map(|of| (0..20).map(move |n| (of, n)))
        {
            let mut pair = Pair::dual(config, phase + 1);
            pair.run_us(phase * 700);
            pair.level_stuck_low[of.index()] = true;
            pair.run_us(300);
            pair.level_stuck_low[of.index()] = false;
            pair.run_ms(100);
            assert_eq!(pair.phases(), [Some(Phase::Master), Some(Phase::Standby)]);
        }
    }
}

/// T-RED-9: the level line of A is stuck low and B is reset: B listens, and remains standby of A.
#[test]
fn a_level_line_stuck_low_and_a_reset_depose_no_master() {
    for config in PROFILES {
        for cause in [ResetCause::Watchdog, ResetCause::Software] {
            for (beats_cut, start_cut) in [(false, false), (true, false), (true, true)] {
                let mut pair = Pair::dual(config, 5);
                pair.cuts.beats = [[beats_cut; 2]; 2];
                pair.cuts.start = [start_cut; 2];
                pair.run_ms(100);
                pair.level_stuck_low[A.index()] = true;
                pair.run_ms(100);
                pair.reset(B, cause);
                pair.run_ms(500);
                let cut = [beats_cut, start_cut];
                let what = format!(
                    "{cause:?}, heartbeats, start cut {cut:?}: {:?}",
                    pair.phases()
                );
                assert!(pair.phase(A).is_some_and(Phase::is_driving), "{what}");
                assert_eq!(pair.phase(B), Some(Phase::Standby), "{what}");
                assert_eq!(pair.changes_of_driver(), 0, "{what}");
            }
        }
    }
}

/// T-RED-9: one connector with all lines between the systems flaps: the driver changes at most
/// once, and the flash is written only a few times.
#[test]
fn a_connector_that_flaps_changes_the_driver_once() {
    for config in PROFILES {
        for period_us in [
            6_000, 7_300, 9_000, 10_000, 11_000, 13_000, 17_000, 40_000, 200_000,
        ] {
            let mut pair = Pair::dual(config, 5);
            let until = pair.now_us + 10_000_000;
            while pair.now_us < until {
                let out = pair.now_us % period_us < period_us / 2;
                pair.cuts.beats = [[out; 2]; 2];
                pair.cuts.start = [out; 2];
                pair.level_stuck_low = [out; 2];
                pair.run_us(100);
            }
            let changes = pair.changes_of_driver();
            assert!(changes <= 1, "{period_us}: {changes}");
            let programs: u32 = pair.systems.iter().map(|system| system.programs).sum();
            assert!(programs <= 60, "{period_us}: {programs}");
        }
    }
}

/// T-RED-9: a standby that misses frames does not take over from a sound master, with and without
/// heartbeats.
#[test]
fn a_standby_that_misses_frames_deposes_no_sound_master() {
    let mut changes = [0; 4];
    for config in PROFILES {
        for seed in 1..10 {
            for (case, (permille, beats_cut)) in
                [(20, false), (200, false), (20, true), (100, true)]
                    .into_iter()
                    .enumerate()
            {
                let mut pair = Pair::dual(config, seed);
                pair.cuts.beats = [[beats_cut; 2]; 2];
                pair.systems[B.index()].misses_permille = permille;
                pair.run_ms(6_000);
                changes[case] += pair.changes_of_driver();
                let gap = pair.longest_gap_us(0);
                assert!(gap <= us(config.gap_bound()) + BUS_US, "{gap}");
            }
        }
    }
    assert_eq!(changes, [0; 4]);
}

/// T-RED-9: systems that do not hear each other, while the vehicle hears both, do not alternate.
#[test]
fn systems_that_do_not_hear_each_other_do_not_take_turns() {
    for config in PROFILES {
        for (beats_cut, link) in [(false, false), (true, false), (true, true)] {
            let mut pair = Pair::dual(config, 5);
            pair.cuts.deaf_to_each_other = true;
            pair.cuts.beats = [[beats_cut; 2]; 2];
            pair.cuts.link = link;
            pair.run_ms(10_000);
            let what = format!("heartbeats cut {beats_cut}, link cut {link}");
            assert_eq!(pair.changes_of_driver(), 0, "{what}");
            check_driven(&pair, 0, 30_000, &what);
        }
    }
}

/// T-RED-9: the vehicle remains under control if the receiver of one system is dead.
#[test]
fn a_deaf_system_deposes_no_sound_master() {
    for config in PROFILES {
        for (beats_cut, link) in [(false, false), (true, false), (false, true)] {
            let mut pair = Pair::dual(config, 5);
            let from = pair.now_us;
            pair.cuts.can_hear[B.index()] = true;
            pair.cuts.beats = [[beats_cut; 2]; 2];
            pair.cuts.link = link;
            pair.run_ms(5_000);
            let what = format!("heartbeats cut {beats_cut}, link cut {link}");
            assert_eq!(pair.changes_of_driver(), 0, "{what}");
            check_driven(&pair, from, undisturbed(&config), &what);
        }
        // The deaf system does not replace a master that can still stop the vehicle.
        let mut pair = Pair::dual(config, 5);
        pair.cuts.can_hear[B.index()] = true;
        pair.run_ms(100);
        pair.systems[A.index()].until_reset = Some(FailureMode::PlanningCore);
        pair.run_ms(100);
        assert_eq!(pair.changes_of_driver(), 0);
        assert_eq!(mode(&pair, A), Some(Mode::SafeStop));
        // A deaf master gives up its role, because it has no input for driving.
        let mut pair = Pair::dual(config, 5);
        let from = pair.now_us;
        pair.cuts.can_hear[A.index()] = true;
        pair.run_ms(3_000);
        assert_eq!(pair.phase(B), Some(Phase::DegradedMaster));
        check_driven(&pair, from, us(config.gap_bound()) + BUS_US, "A deaf");
        assert_eq!(pair.changes_of_driver(), 1);
    }
}
