//! The conditions under which the power level of the other system counts.

use super::{Bench, CONFIG, sound};
use tandem_board::SystemId;
use tandem_redundancy::{Actions, Phase, RedundancyEvent, Role, Term};

/// T-RED-9: a level line is broken if it is low while a heartbeat, a control frame, a report or the
/// vehicle shows that the other system runs. It is reported once, and ignored until it has been
/// high for long enough. Each sign alone is enough.
#[test]
fn a_level_that_a_sign_of_life_contradicts_is_not_believed() {
    for sign in 0..4 {
        let mut bench = Bench::standby();
        // The other signs are tested without heartbeats.
        let beats = sign == 0;
        let silence = if beats { 0 } else { 10 };
        for _ in 0..silence {
            let _ = bench.control(16);
            let _ = bench.poll();
        }
        bench.snapshot.peer_powered = false;
        let mut events = Vec::new();
        let reported = |events: &mut Vec<RedundancyEvent>, actions: Actions| {
            let broken = |it: &RedundancyEvent| matches!(it, RedundancyEvent::LevelBroken(_));
            events.extend(actions.events().filter(broken));
        };
        for _ in 0..15 {
            if beats {
                bench.snapshot.beats = bench.snapshot.beats.map(|count| count.wrapping_add(1));
            }
            let term = Term::from_bits(16);
            let report = sound(Role::Master, term);
            match sign {
                1 => reported(&mut events, bench.control(16)),
                2 => reported(&mut events, bench.linked(report)),
                3 => reported(&mut events, bench.obeyed(term, 0)),
                _ => {}
            }
            reported(&mut events, bench.poll());
            assert_eq!(bench.machine.phase(), Phase::Standby, "sign {sign}");
        }
        bench.snapshot.peer_powered = true;
        let (mut back_after, recover_ms) = (None, CONFIG.recover_after.as_us() / 1_000);
        for ms in 0..=recover_ms {
            bench.snapshot.beats = bench.snapshot.beats.map(|count| count.wrapping_add(1));
            reported(&mut events, bench.poll());
            back_after = back_after.or((events.len() == 2).then_some(ms));
        }
        let expected = [
            RedundancyEvent::LevelBroken(true),
            RedundancyEvent::LevelBroken(false),
        ];
        assert_eq!(events, expected, "sign {sign}");
        assert_eq!(back_after, Some(recover_ms), "sign {sign}");
    }
}

/// T-RED-9: a heartbeat that is counted a poll after the level fell may be from before the fall. A
/// later one contradicts the level.
#[test]
fn a_heartbeat_later_than_a_poll_after_the_fall_contradicts_the_level() {
    for (polls, expected) in [(1, false), (2, true), (3, true)] {
        let mut bench = Bench::standby();
        bench.snapshot.peer_powered = false;
        let mut reported = Vec::new();
        for poll in 0..=polls {
            let beat = u32::from(poll == polls);
            bench.snapshot.beats = bench.snapshot.beats.map(|count| count.wrapping_add(beat));
            reported.extend(bench.poll().events());
        }
        let is_reported = reported.contains(&RedundancyEvent::LevelBroken(true));
        assert_eq!(is_reported, expected, "after {polls} polls");
    }
}

/// T-RED-9: a system that takes over has power: a line that is low counts as broken at once, not
/// only after its limit. A high line does not count as broken.
#[test]
fn a_takeover_contradicts_a_low_level_at_once() {
    for powered in [false, true] {
        let mut bench = Bench::master();
        bench.snapshot.peer_powered = powered;
        let _ = bench.poll();
        let term = bench.machine.term().above(1, SystemId::B).unwrap();
        let reported: Vec<RedundancyEvent> = bench.control(term.bits()).events().collect();
        let broken = reported.contains(&RedundancyEvent::LevelBroken(true));
        assert_eq!(broken, !powered, "{reported:?}");
    }
}

/// T-RED-9: without a sign of life a low level counts after its limit, and not before.
#[test]
fn a_low_level_without_a_heartbeat_is_believed_within_its_limit() {
    // A short reset ends before the missing heartbeat is detected: the level is high again.
    for stays_low in [true, false] {
        let mut bench = Bench::standby();
        for _ in 0..100 {
            let _ = bench.control(16);
            bench.run_with_beats(1);
        }
        bench.snapshot.peer_powered = false;
        let _ = bench.poll();
        let fell = bench.now;
        bench.snapshot.peer_powered = !stays_low;
        while bench.machine.phase() == Phase::Standby {
            let _ = bench.poll();
        }
        let took = bench.now.since(fell);
        let limit = CONFIG.level_limit();
        assert!(
            took >= limit && took <= limit + CONFIG.poll_interval,
            "{took:?}"
        );
    }
}
