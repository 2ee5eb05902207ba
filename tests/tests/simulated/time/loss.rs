//! What is lost: the grandmaster, the line, the link, frames on the bus.

use crate::time::CONVERGED;
use crate::time::watch::{MS, S, Watch, apart, driving};
use tandem_board::{Duration, Instant, Line, SystemId};
use tandem_board_sim::Wire;
use tandem_cores::trace::Event;
use tandem_peripherals::network::PortFault;
use tandem_sim::grandmaster::{Grandmaster, GrandmasterClock};
use tandem_sim::time_chain::ChainConfig;
use tandem_timesync::TimeStatus;

use SystemId::{A, B};

/// All clocks have converged, and the faults begin.
const BEGINS: Duration = Duration::from_ms(20_000);
const SILENT: PortFault = PortFault {
    lost_out: 1_000,
    lost_in: 0,
    late_out: Duration::ZERO,
    late_in: Duration::ZERO,
};

/// Returns a drive whose clocks have converged.
fn converged(grandmaster: Option<GrandmasterClock>) -> Watch {
    let mut watch = Watch::start(ChainConfig {
        grandmaster,
        ..ChainConfig::default()
    });
    watch.run_for(BEGINS);
    watch
}

/// Returns the reasons why the grandmaster is not followed that a system told, 0 if it is.
fn reasons(watch: &Watch, of: SystemId, from: Instant) -> Vec<u8> {
    let events = watch.chain.drive.events.iter();
    let events = events.filter(|(at, system, ..)| *system == of && *at >= from);
    let reason = |(.., event): &(_, _, _, Event)| match event {
        Event::GrandmasterTime { why } => Some(*why),
        _ => None,
    };
    events.filter_map(reason).collect()
}

/// S-1, S-5: the grandmaster falls silent. The system that drives is in holdover within the
/// time-out, and tells it; the time of all goes on by what was learned. When it is back, it is
/// followed.
#[test]
fn a_silent_grandmaster_is_told_and_the_time_goes_on() {
    let mut watch = converged(Some(GrandmasterClock::RIGHT));
    let from = watch.chain.drive.pair.now();
    watch.chain.grandmasters[0].station.disturb(SILENT);
    watch.run_for(MS(700));
    let status = watch.reading(A).status;
    assert!(status.has(TimeStatus::TIMEOUT) && status.has(TimeStatus::HOLDOVER));
    let status = watch.reading(B).status;
    assert!(status.is_synchronised() && status.has(TimeStatus::SYNC_TO_GATEWAY));
    watch.run_for(S(60));
    // 1 is `Why::Silent`.
    assert_eq!(
        [reasons(&watch, A, from), reasons(&watch, B, from)],
        [[1], [1]]
    );
    for of in [A, B] {
        let reading = watch.reading(of);
        assert!(watch.off(of).abs() <= 20_000, "{of}: {} ns", watch.off(of));
        assert!(
            watch.off(of).unsigned_abs() <= reading.error.as_ns(),
            "{reading:?}"
        );
    }
    let (stamps, own) = watch.chain.stamps(CONVERGED);
    assert!(own == 0 && stamps.iter().all(|it| it.1.abs() <= 25_000));
    watch.chain.grandmasters[0]
        .station
        .disturb(PortFault::default());
    watch.run_for(S(10));
    assert!(watch.reading(A).status.is_synchronised());
    assert_eq!(watch.told(A), watch.told(B), "no leap");
    assert_eq!(watch.told(A).leaps, 0);
    assert!(watch.off(A).abs() <= 1_000 && watch.off(B).abs() <= 2_000);
    watch.assert_drives_well(&[A]);
}

/// S-5: a second grandmaster with another time changes nothing while the first one lives, and is
/// told. When the first dies, the second is followed; its leap is told before.
#[test]
fn a_second_grandmaster_waits_for_the_death_of_the_first() {
    let mut watch = converged(Some(GrandmasterClock::RIGHT));
    let other = GrandmasterClock {
        leapt_ns: 5_000_000_000,
        ..GrandmasterClock::RIGHT
    };
    let join = Grandmaster::join(&mut watch.chain.drive.pair, 2, other);
    watch.chain.grandmasters.push(join);
    watch.run_for(S(10));
    assert_eq!(watch.told(A).leaps + watch.told(B).leaps, 0);
    assert!(watch.off(A).abs() <= 1_000 && watch.off(B).abs() <= 2_000);
    for of in [A, B] {
        let other = |(_, system, _, event): &(_, SystemId, _, Event)| {
            *system == of && matches!(event, Event::OtherGrandmaster { .. })
        };
        assert!(
            watch.chain.drive.events.iter().any(other),
            "{of} does not tell"
        );
    }
    let died = watch.chain.drive.pair.now();
    watch.chain.grandmasters[0].station.disturb(SILENT);
    watch.run_for(S(12));
    assert_eq!(reasons(&watch, A, died).first(), Some(&1), "silent");
    for of in [A, B] {
        let told = watch.told_since(of, died);
        assert_eq!(
            (told.leaps >= 1, told.followed),
            (true, 1),
            "{of}: {told:?}"
        );
        let first = watch
            .chain
            .drive
            .events
            .iter()
            .find(|(at, system, _, event)| {
                *at >= died && *system == of && matches!(event, Event::TimeLeap { .. })
            });
        let (
            ..,
            Event::TimeLeap {
                followed: false,
                by_us,
                ..
            },
        ) = first.unwrap()
        else {
            panic!("{of} follows a leap that it has not told")
        };
        assert!((by_us - 5_000_000).abs() < 100, "{of}: {by_us}");
        assert!((watch.off(of) - 5_000_000_000).abs() <= 20_000, "{of}");
    }
    watch.assert_drives_well(&[A]);
}

/// S-3: a cut line or link costs the standby its pulses, in either direction. It follows the
/// grandmaster; without one, its time goes on and it says so. Nothing else changes.
#[test]
fn a_cut_line_or_link_costs_the_pulses_only() {
    for wire in [Wire::Line(Line::Time), Wire::Link] {
        for (from, has_grandmaster) in [(A, true), (A, false), (B, true)] {
            let what = format!("{wire:?} from {from}, grandmaster {has_grandmaster}");
            let mut watch = converged(has_grandmaster.then_some(GrandmasterClock::RIGHT));
            let line = watch.line_of(A, CONVERGED);
            watch.chain.drive.pair.cut(wire, from);
            watch.run_for(S(10));
            let source = if from == A && has_grandmaster { 1 } else { 2 };
            assert_eq!(watch.source(B), source, "{what}");
            let status = watch.reading(B).status;
            let is_held = from == A && !has_grandmaster;
            assert_eq!(status.has(TimeStatus::HOLDOVER), is_held, "{what}");
            for (at, by) in watch.chain.offsets(B, CONVERGED) {
                let by = apart(by, line(at));
                assert!(by.abs() <= 12_000, "{what}: {by} ns at {at:?}");
            }
            watch.chain.drive.pair.restore(wire, from);
            watch.run_for(S(5));
            assert_eq!(watch.source(B), 2, "{what}");
            assert_eq!(watch.told(B).leaps, 0, "{what}");
            watch.assert_drives_well(&[A]);
        }
    }
}

/// S-4: a system whose frames do not reach the bus for a while; the sensors stamp on in the time
/// that they have, and say so after the time-out.
#[test]
fn sensors_keep_their_time_without_frames() {
    let mut watch = converged(Some(GrandmasterClock::RIGHT));
    assert_eq!(driving(&watch.chain), A);
    let deaf = |_: Instant, frame: tandem_board::CanFrame| {
        let is_time = matches!(frame.id(), tandem_board::CanId::Standard(id)
            if tandem_bus::TimeSync::IDS.contains(&id));
        (!is_time).then_some(frame)
    };
    let core = tandem_board::CoreId::CONTROL;
    watch
        .chain
        .drive
        .pair
        .filter_sent(A, core, Some(Box::new(deaf)));
    watch.run_for(S(20));
    watch.chain.drive.pair.filter_sent(A, core, None);
    watch.run_for(S(10));
    let (stamps, own) = watch.chain.stamps(CONVERGED);
    let farthest = stamps.iter().map(|it| it.1.abs()).max();
    assert!(own == 0 && farthest <= Some(25_000), "{own} {farthest:?}");
    watch.assert_drives_well(&[A]);
}
