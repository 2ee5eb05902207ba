//! Failures of one system: detection, takeover, return. T-RED-3 to T-RED-8

use crate::model::{Pair, us};
use tandem_board::SystemId::{A, B};
use tandem_board::{Duration, Instant, ResetCause};
use tandem_redundancy::{Config, Evidence, FailureMode, Mode, Phase};

/// T-RED-8: the master resets itself abnormally; the slave takes over; the master returns as
/// standby; the slave loses its supply; the old master takes over. Runs once with the power level,
/// which shows the loss at once, and once without it, by the heartbeats alone.
#[test]
fn sequence_of_the_thesis() {
    for (name, config) in [("rt", Config::rt()), ("desktop", Config::desktop())] {
        for level_cut in [false, true] {
            let mut pair = Pair::dual(config, 8);
            pair.cuts.level = [level_cut; 2];
            let gap_bound = if level_cut {
                config.gap_bound()
            } else {
                config.gap_bound_power()
            };
            let takeover_bound = if level_cut {
                us(config.takeover_bound())
            } else {
                us(config.level_limit() + config.poll_interval)
            };

            let from = pair.now_us;
            pair.reset(A, ResetCause::Watchdog);
            let took = pair.run_until(100, |p| p.phase(B) == Some(Phase::DegradedMaster));
            println!(
                "{name}, level cut {level_cut}: B takes over after {took} us, bound {takeover_bound}"
            );
            assert!(took <= takeover_bound + 1_000);
            let term = pair.state(B).term;
            pair.run_until(100, |p| p.phase(A) == Some(Phase::Standby));
            pair.run_ms(us(config.recover_after) / 1_000 + 100);
            assert_eq!(
                pair.phases(),
                [Some(Phase::Standby), Some(Phase::DegradedMaster)]
            );
            assert!(!pair.state(B).cpsys_failure, "A has recovered");
            assert_eq!(
                (pair.state(A).abn_resets, pair.state(A).is_master),
                (1, false)
            );
            let gap = pair.longest_gap_us(from);
            println!("  gap {gap} us, bound {} us + bus", us(gap_bound));
            assert!(gap <= us(gap_bound) + 1_500);

            let from = pair.now_us;
            pair.power_off(B);
            let took = pair.run_until(100, |p| p.phase(A) == Some(Phase::DegradedMaster));
            println!("  A takes over after {took} us (thesis: 4.04 ms)");
            assert!(took <= takeover_bound + 1_000);
            assert!(pair.state(A).term > term);
            pair.run_ms(50);
            let gap = pair.longest_gap_us(from);
            println!("  gap {gap} us, bound {} us + bus", us(gap_bound));
            assert!(gap <= us(gap_bound) + 1_500);
            assert!(pair.both_open_max_us == 0 && pair.fenced.is_empty());
            let causes: Vec<_> = pair.takeovers(0).iter().map(|t| t.2.cause).collect();
            let cause = if level_cut {
                Evidence::PeerSilent
            } else {
                Evidence::PeerOff
            };
            assert_eq!(causes, [cause; 2]);
        }
    }
}

fn ms(us: u64) -> u64 {
    us / 1_000
}

/// T-RED-9: a frozen master never sends a frame after the freeze before it has polled. This holds
/// for any length and any phase of the freeze, although the model tries to send first.
#[test]
fn a_thawed_master_stays_silent() {
    for config in [Config::rt(), Config::desktop()] {
        let (mut taken_over, mut kept) = (0, 0);
        for freeze in 1..60 {
            for phase in 0..4 {
                let mut pair = Pair::dual(config, freeze * 4 + phase);
                pair.run_ms(3 * phase);
                let from = pair.now_us;
                pair.freeze_ms(A, freeze);
                pair.run_ms(freeze + 200);
                let what = format!("frozen for {freeze} ms at phase {phase}");
                assert!(pair.fenced.is_empty(), "{what}: {:?}", pair.fenced);
                let gap = pair.longest_gap_us(from);
                let bound = us(config.gap_bound()) + 1_500;
                assert!(gap <= bound, "{what}: gap {gap} us, bound {bound}");
                match pair.phases() {
                    [Some(Phase::Standby), Some(Phase::DegradedMaster)] => taken_over += 1,
                    [Some(Phase::Master), Some(Phase::Standby)] => kept += 1,
                    // A resumes as master or becomes the standby of B; anything else is wrong.
                    other => panic!("{what}: {other:?}"),
                }
                assert_eq!(
                    pair.changes_of_driver(),
                    usize::from(pair.phase(B) != Some(Phase::Standby))
                );
            }
        }
        println!("{taken_over} takeovers, {kept} freezes too short for one");
        assert!(taken_over > 100 && kept > 10);
    }
}

/// T-RED-9: the lease: after a stall the core may not transmit before the next poll.
#[test]
fn no_transmission_on_a_stale_lease() {
    let config = Config::rt();
    let mut pair = Pair::dual(config, 1);
    let machine = pair.systems[A.index()].machine.as_mut().unwrap();
    let polled = Instant::from_ns((pair.now_us + 1_000_000) * 1_000);
    assert!(machine.may_transmit(polled));
    let end = polled + config.lease();
    assert!(
        !machine.may_transmit(end + Duration::from_ms(1)),
        "the last poll was just before"
    );
    assert!(!machine.may_transmit(polled + Duration::from_ms(1_000)));
    let standby = pair.systems[B.index()].machine.as_mut().unwrap();
    assert!(
        !standby.may_transmit(Instant::ORIGIN),
        "the output of a standby is closed"
    );
}

/// T-RED-3: a frozen standby does not count as a failed master: no system takes over, even when the
/// standby resumes with old data. The master degrades and recovers.
#[test]
fn a_thawed_standby_does_not_take_over() {
    for config in [Config::rt(), Config::desktop()] {
        for freeze in [1, 2, 3, 5, 10, 20, 30, 70, 300] {
            let mut pair = Pair::dual(config, freeze);
            let from = pair.now_us;
            pair.freeze_ms(B, freeze);
            pair.run_ms(freeze + ms(us(config.recover_after)) + 100);
            assert!(pair.takeovers(0).is_empty(), "{freeze}");
            assert!(pair.fenced.is_empty() && pair.changes_of_driver() == 0);
            assert!(pair.longest_gap_us(from) <= 12_000);
            let degraded = freeze * 1_000 > us(config.standby_limit) + 3_000;
            let tolerated = freeze * 1_000 + 3_000 < us(config.standby_limit);
            // A master whose standby was silent for longer than `standby_limit` degrades.
            match pair.phase(A) {
                Some(Phase::DegradedMaster) => assert!(!tolerated, "{freeze}"),
                Some(Phase::Master) => assert!(!degraded, "{freeze}"),
                other => panic!("{other:?}"),
            }
            assert!(!pair.state(A).cpsys_failure, "it has recovered");
        }
    }
}

/// T-RED-4: when the other system fails, the flag is set and the master degrades at once. When its
/// heartbeats return, the flag is cleared. With `reintegrate`, dual operation resumes at run time.
#[test]
fn failure_and_return_of_the_standby() {
    for reintegrate in [false, true] {
        let config = Config {
            reintegrate,
            ..Config::rt()
        };
        let mut pair = Pair::dual(config, 4);
        pair.power_off(B);
        let took = pair.run_until(10, |pair| pair.phase(A) == Some(Phase::DegradedMaster));
        let bound = us(config.level_limit() + config.poll_interval);
        assert!(took <= bound + 500, "{took}");
        assert!(pair.state(A).cpsys_failure);
        pair.run_ms(100);
        assert!(
            pair.systems[A.index()].flash.unwrap().cpsys_failure,
            "and it is in flash"
        );
        pair.power_on(B);
        pair.run_ms(ms(us(config.recover_after)) / 2);
        assert!(
            pair.state(A).cpsys_failure,
            "not before it was back for long enough"
        );
        pair.run_ms(ms(us(config.recover_after)) + 100);
        assert!(!pair.state(A).cpsys_failure);
        pair.run_ms(ms(us(config.recover_after)) + 500);
        let expected = if reintegrate {
            Phase::Master
        } else {
            Phase::DegradedMaster
        };
        assert_eq!(pair.phases(), [Some(expected), Some(Phase::Standby)]);
        let mode = pair.systems[B.index()].machine.as_ref().unwrap().mode();
        assert_eq!(
            mode,
            if reintegrate {
                Mode::L3
            } else {
                Mode::DegradedL2
            }
        );
        assert_eq!(pair.changes_of_driver(), 0);
    }
}

/// T-RED-4: a backup that is not heard on CAN is not reintegrated.
#[test]
fn a_backup_without_can_is_not_reintegrated() {
    let config = Config {
        reintegrate: true,
        ..Config::rt()
    };
    let mut pair = Pair::dual(config, 4);
    pair.power_off(B);
    pair.run_ms(50);
    pair.cuts.can[B.index()] = true;
    pair.cuts.link = true;
    pair.power_on(B);
    pair.run_ms(4_000);
    assert_eq!(pair.phase(A), Some(Phase::DegradedMaster));
}

/// T-RED-5: a system that resets abnormally returns as standby as often as the limit allows, then
/// suspends. A power cycle gives it one more attempt. Time without a reset lowers the count.
#[test]
fn too_many_abnormal_resets_suspend() {
    let config = Config::rt();
    let mut pair = Pair::dual(config, 6);
    for n in 1..=config.abnormal_limit {
        pair.reset(B, ResetCause::Trap);
        pair.run_ms(100);
        assert_eq!(pair.phase(B), Some(Phase::Standby));
        assert_eq!(pair.state(B).abn_in_a_row, n);
    }
    let healthy = ms(us(config.healthy_after));
    pair.run_ms(u64::from(config.abnormal_limit) * healthy);
    assert_eq!(pair.state(B).abn_in_a_row, 0, "ran well for long enough");
    // The crashes count even if they are far apart.
    for _ in 0..=config.abnormal_limit {
        pair.run_ms(11_000);
        pair.reset(B, ResetCause::Trap);
        pair.run_ms(100);
    }
    assert!(pair.systems[B.index()].held);
    let state = pair.systems[B.index()].flash.unwrap();
    assert!(state.sys_failure);
    assert_eq!(state.failure_mode, FailureMode::AbnormalResets);
    assert_eq!(state.abn_resets, 2 * u32::from(config.abnormal_limit) + 1);
    pair.power_off(B);
    pair.run_ms(10);
    pair.power_on(B);
    pair.run_ms(100);
    assert_eq!(pair.phase(B), Some(Phase::Standby), "one more attempt");
    pair.reset(B, ResetCause::Trap);
    pair.run_ms(100);
    assert!(pair.systems[B.index()].held, "and only one");
    assert_eq!(pair.phase(A), Some(Phase::DegradedMaster));
    assert_eq!(pair.changes_of_driver(), 0);
}

/// T-RED-9: both systems are frozen for longer than the lease: the master learns from the vehicle
/// that it is still obeyed, and continues.
#[test]
fn both_stand_still_and_the_master_goes_on() {
    for config in [Config::chip(), Config::rt(), Config::desktop()] {
        for seed in 1..20 {
            let mut pair = Pair::dual(config, seed);
            pair.run_ms(seed);
            let from = pair.now_us;
            pair.freeze_ms(A, 20);
            pair.freeze_ms(B, 20);
            pair.run_ms(500);
            assert_eq!(pair.changes_of_driver(), 0, "seed {seed}");
            let gap = pair.longest_gap_us(from);
            assert!(gap <= 20_000 + 10_000 + 3_000, "seed {seed}: gap {gap} us");
        }
    }
}

/// T-RED-6: an output fault of the master sets mode and flag and suspends it; the other takes over.
#[test]
fn an_io_fault_suspends_and_the_other_takes_over() {
    let config = Config::rt();
    let mut pair = Pair::dual(config, 6);
    let from = pair.now_us;
    pair.systems[A.index()].faults.push(FailureMode::IoModule);
    pair.run_ms(100);
    assert!(pair.systems[A.index()].held);
    let state = pair.systems[A.index()].flash.unwrap();
    assert!(state.sys_failure && state.failure_mode == FailureMode::IoModule);
    assert_eq!(pair.phase(B), Some(Phase::DegradedMaster));
    assert!(pair.longest_gap_us(from) <= us(config.gap_bound()));
    assert!(pair.fenced.is_empty());
}

/// T-RED-5: if a compute core does not answer, the system resets and returns as standby of the
/// other. The last system does not reset itself: it stops the vehicle.
#[test]
fn a_dead_compute_core() {
    let config = Config::rt();
    let mut pair = Pair::dual(config, 6);
    let from = pair.now_us;
    pair.systems[A.index()]
        .faults
        .push(FailureMode::PerceptionCore);
    pair.run_ms(2);
    pair.systems[A.index()].faults.clear();
    pair.run_ms(100);
    assert_eq!(
        pair.phases(),
        [Some(Phase::Standby), Some(Phase::DegradedMaster)]
    );
    assert_eq!(pair.state(A).abn_resets, 1);
    assert!(pair.longest_gap_us(from) <= us(config.gap_bound()));

    pair.power_off(A);
    pair.run_ms(50);
    let from = pair.now_us;
    pair.systems[B.index()]
        .faults
        .push(FailureMode::PerceptionCore);
    pair.run_ms(200);
    let machine = pair.systems[B.index()].machine.as_ref().unwrap();
    assert_eq!(
        (machine.phase(), machine.mode()),
        (Phase::DegradedMaster, Mode::SafeStop)
    );
    assert!(pair.longest_gap_us(from) <= 12_000);
}

/// T-RED-6: the CAN connection of one system opens: the other drives. The disconnected system
/// resets itself, because the other reports a live bus, and suspends when no reset has cured it. If
/// the whole bus is dead, no system suspends.
#[test]
fn can_open_circuit() {
    for config in [Config::rt(), Config::desktop()] {
        for cut in [A, B] {
            let mut pair = Pair::dual(config, 5);
            let from = pair.now_us;
            pair.cuts.can[cut.index()] = true;
            let took = pair.run_until(10_000, |pair| pair.systems[cut.index()].held);
            let limit = us(config.can_open_limit);
            assert!(took >= (1 + 2 + 4 + 8) * limit, "{took}");
            let state = pair.systems[cut.index()].flash.unwrap();
            assert!(state.sys_failure && state.failure_mode == FailureMode::CanOpenCircuit);
            assert_eq!(pair.phase(cut.peer()), Some(Phase::DegradedMaster));
            let gap = pair.longest_gap_us(from);
            assert!(gap <= us(config.gap_bound_mute()) + 1_500, "{gap}");
            assert!(pair.fenced.is_empty());
        }
        let mut pair = Pair::dual(config, 5);
        pair.cuts.can = [true; 2];
        pair.run_ms(2_000);
        // A master that does not hear its standby on CAN acts as if it were alone.
        let alone = [Some(Phase::DegradedMaster), Some(Phase::Standby)];
        assert_eq!(pair.phases(), alone);
        pair.cuts.can = [false; 2];
        let from = pair.now_us;
        pair.run_ms(200);
        assert_eq!(pair.phases(), alone);
        assert!(pair.longest_gap_us(from) <= 2_000_000 + 22_000);
        assert_eq!(pair.changes_of_driver(), 0);
    }
}

/// T-RED-9: a level line that is stuck low, against its contract, changes the driver at most once.
#[test]
fn a_level_line_stuck_low_is_not_believed_for_ever() {
    let config = Config::rt();
    for dark in [[true, false], [false, true], [true, true]] {
        let mut pair = Pair::dual(config, 5);
        pair.level_stuck_low = dark;
        pair.run_ms(3_000);
        assert!(
            pair.changes_of_driver() <= 2,
            "{dark:?}: {}",
            pair.changes_of_driver()
        );
        let from = pair.now_us;
        pair.run_ms(1_000);
        assert!(pair.longest_gap_us(from) <= 12_000);
        let driving = pair
            .phases()
            .iter()
            .filter(|p| p.is_some_and(Phase::is_driving))
            .count();
        assert_eq!(driving, 1, "{dark:?} {:?}", pair.phases());
    }
}
