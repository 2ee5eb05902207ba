//! A system leaves, or hands over its role, without a pause of control. T-BOOT-1

use super::{Bench, CONFIG, sound};
use tandem_board::{Duration, SystemId};
use tandem_redundancy::{Input, Mode, PeerReport, Phase, Role, Term};

/// T-BOOT-1: a standby may leave only while every witness says that the master drives.
#[test]
fn a_standby_may_leave_only_a_master_that_drives() {
    let relieved = Bench::master();
    let term = relieved.machine.highest_term().above(1, SystemId::B);
    let sound = sound(Role::Master, term.unwrap());
    let stops = PeerReport {
        mode: Mode::SafeStop,
        ..sound
    };
    let starts = PeerReport {
        role: Role::Starting,
        ..sound
    };
    let (own, of_master) = (relieved.machine.term(), sound.term);
    let hold_down_ms = CONFIG.hold_down.as_ms_f64() as u64;
    for (what, report, obeyed, beats, age_ms, since_ms, expected) in [
        ("sound", sound, of_master, true, 0, hold_down_ms, true),
        (
            "just relieved",
            sound,
            of_master,
            true,
            0,
            hold_down_ms - 40,
            false,
        ),
        (
            "stops the vehicle",
            stops,
            of_master,
            true,
            0,
            hold_down_ms,
            false,
        ),
        (
            "does not drive",
            starts,
            of_master,
            true,
            0,
            hold_down_ms,
            false,
        ),
        ("is not obeyed", sound, own, true, 0, hold_down_ms, false),
        (
            "no heartbeats",
            sound,
            of_master,
            false,
            0,
            hold_down_ms,
            false,
        ),
        (
            "late frames",
            sound,
            of_master,
            true,
            14,
            hold_down_ms,
            false,
        ),
    ] {
        let mut bench = Bench::master();
        let _ = bench.control(of_master.bits());
        for _ in 0..since_ms / 10 {
            if age_ms == 0 {
                let _ = bench.control(of_master.bits());
            }
            bench.run_with_beats(5);
            for _ in 0..5 {
                bench.snapshot.beats = bench.snapshot.beats.map(|count| count + u32::from(beats));
                let _ = bench.poll();
            }
            let _ = bench.linked(report);
            let _ = bench.obeyed(obeyed, age_ms);
        }
        assert_eq!(bench.machine.phase(), Phase::Standby, "{what}");
        assert_eq!(bench.machine.may_leave(bench.now), expected, "{what}");
    }
    let driving = Bench::master();
    assert!(!driving.machine.may_leave(driving.now), "a master");
}

/// T-BOOT-1: a heartbeat or a control frame may be late by the jitter, but not later.
#[test]
fn a_standby_may_leave_while_no_sign_of_the_master_is_late() {
    let ms = |span: Duration| span.as_us() / 1_000;
    let beat_ms = ms(CONFIG.heartbeat_period + CONFIG.heartbeat_jitter);
    let frame_ms = ms(CONFIG.control_period + CONFIG.heartbeat_jitter);
    for (beat_ms, frame_ms, expected) in [
        (beat_ms, frame_ms, true),
        (beat_ms + 1, frame_ms, false),
        (beat_ms, frame_ms + 1, false),
    ] {
        let mut bench = Bench::standby();
        let term = Term::from_bits(16);
        for left_ms in (0..20).rev() {
            bench.snapshot.beats[0] += u32::from(left_ms >= beat_ms);
            let _ = bench.poll();
            if left_ms >= frame_ms {
                let _ = bench.control(term.bits());
            }
            let _ = bench.obeyed(term, frame_ms.saturating_sub(left_ms));
        }
        let _ = bench.linked(sound(Role::Master, term));
        assert_eq!(bench.machine.may_leave(bench.now), expected);
    }
}

/// T-BOOT-1: a master that is asked to hand over resigns over the link and continues to drive.
#[test]
fn a_master_that_is_asked_offers_its_role() {
    let mut bench = Bench::master();
    assert_eq!(bench.machine.report().mode, Mode::L3);
    let _ = bench.on(Input::HandOver);
    assert_eq!(bench.machine.report().mode, Mode::SafeStop);
    assert_eq!(bench.machine.mode(), Mode::L3);
    assert!(bench.machine.may_transmit(bench.now));
    bench.run_with_beats(CONFIG.report_limit.as_ms_f64() as u64 - 1);
    assert_eq!(bench.machine.report().mode, Mode::SafeStop);
    bench.run_with_beats(1);
    assert_eq!(bench.machine.report().mode, Mode::L3, "not for ever");
    assert_eq!(bench.machine.phase(), Phase::Master);
}
