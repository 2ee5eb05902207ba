//! Clocks and messages that lie: found where physics allows, and never untold.

use crate::time::CONVERGED;
use crate::time::watch::{MS, S, Watch, apart};
use tandem_board::{CanFrame, CanId, CoreId, Duration, Edge, Instant, Line, SystemId};
use tandem_bus::TimeSync;
use tandem_bus::e2e::protect;
use tandem_cores::Config;
use tandem_cores::trace::Event;
use tandem_peripherals::network::PortFault;
use tandem_sim::grandmaster::{Grandmaster, GrandmasterClock};
use tandem_sim::time_chain::{ChainConfig, Spread, poller};
use tandem_sim::timing::Time;
use tandem_tests::bent::core_with_link;
use tandem_timesync::{Arbitrary, CanTimeMaster, PULSE_WORDS};

use SystemId::{A, B};

/// All clocks have converged, and the lie begins.
const BEGINS: Duration = Duration::from_ms(20_000);

fn converged() -> Watch {
    let mut watch = Watch::start(ChainConfig::default());
    watch.run_for(BEGINS);
    watch
}

/// S-5: the grandmaster's time is set. Up to 1 ms all slew; beyond it the leap is told, then
/// followed by the systems and by the sensors. In between no reader is deceived.
#[test]
fn a_step_of_the_grandmaster_is_slewed_or_told() {
    for (by_ns, leaps) in [
        (300_000, 0),
        (-900_000, 0),
        (1_500_000, 1),
        (-1_500_000, 1),
        (5_000_000_000, 1),
        (-5_000_000_000, 1),
        (400_000_000_000_000, 1),
        (-400_000_000_000_000, 1),
    ] {
        let mut watch = converged();
        watch.chain.grandmasters[0].clock.leapt_ns = by_ns;
        watch.run_for(S(20));
        for of in [A, B] {
            let told = watch.told(of);
            assert_eq!(told.followed, leaps, "{by_ns}: {of}");
            assert_eq!(told.leaps > 0, leaps > 0, "{by_ns}: {of}");
            assert!(
                watch.off(of).abs() <= 10_000,
                "{by_ns}: {of} {}",
                watch.off(of)
            );
            assert!(watch.reading(of).status.is_synchronised(), "{by_ns}: {of}");
        }
        watch.assert_drives_well(&[A]);
    }
}

/// S-5: a grandmaster whose rate is wrong. Within the crystals' limits it is followed, for no clock
/// knows better; beyond, it is refused sample by sample, and what is followed is told or slewed.
#[test]
fn a_rate_of_the_grandmaster_is_followed_within_limits() {
    for (rate_ppb, is_followed) in [(90_000, true), (-90_000, true), (1_000_000, false)] {
        let mut watch = converged();
        let before = watch.chain.grandmasters[0].clock;
        let now = watch.chain.drive.pair.now();
        let so_far = i128::from(now.as_ns()) * i128::from(rate_ppb) / 1_000_000_000;
        watch.chain.grandmasters[0].clock = GrandmasterClock {
            rate_ppb,
            leapt_ns: before.leapt_ns - so_far as i64,
            ..before
        };
        watch.run_for(S(20));
        if is_followed {
            assert!(watch.off(A).abs() <= 5_000, "{rate_ppb}: {}", watch.off(A));
            assert_eq!(watch.told(A).leaps + watch.told(B).leaps, 0);
        } else {
            let reading = watch.reading(A);
            let is_honest = watch.off(A).unsigned_abs() <= reading.error.as_ns();
            assert!(
                is_honest || !reading.status.is_synchronised(),
                "{reading:?}"
            );
        }
        watch.assert_drives_well(&[A]);
    }
}

/// S-1, S-2: a cable that is slower in one direction makes the time wrong by half of that. The
/// standby hears grandmaster and pulses, and tells that they differ. If both cables are alike, no
/// clock knows better.
#[test]
fn an_asymmetric_cable_is_found_by_the_standby() {
    for (systems, is_found) in [(&[A][..], true), (&[A, B][..], false)] {
        let mut watch = Watch::start(ChainConfig::default());
        let fault = PortFault {
            late_in: Duration::from_us(400),
            ..PortFault::default()
        };
        for system in systems {
            watch.chain.drive.pair.disturb_network(*system, fault);
        }
        watch.run_for(S(18));
        let off = watch.off(A).abs();
        assert!((190_000..210_000).contains(&off), "{off}");
        let told = watch.told_since(B, Instant::ORIGIN);
        assert_eq!(told.disagrees > 0, is_found);
        // Both systems have one time, whatever the cables do.
        let skew = Spread::of(watch.chain.skews(CONVERGED)).expect("cycles");
        assert!(skew.max <= 20_000, "{skew:?}");
        watch.assert_drives_well(&[A]);
    }
}

/// S-2: a third station sends in the grandmaster's name, another time. No authentication tells them
/// apart. No reader is deceived untold, and nothing else happens.
#[test]
fn a_forger_of_the_grandmaster_deceives_no_reader_untold() {
    for leapt_ns in [200_000, 50_000_000, -7_000_000_000] {
        let mut watch = converged();
        let clock = GrandmasterClock {
            leapt_ns,
            ..GrandmasterClock::RIGHT
        };
        let forger = Grandmaster::join(&mut watch.chain.drive.pair, 1, clock);
        watch.chain.grandmasters.push(forger);
        watch.run_for(S(20));
        watch.chain.grandmasters.pop();
        watch.run_for(S(20));
        for of in [A, B] {
            assert!(
                watch.off(of).abs() <= 20_000,
                "{leapt_ns}: {of} {}",
                watch.off(of)
            );
        }
        watch.assert_drives_well(&[A]);
    }
}

/// Lets a node beside the systems send this frame of time under a system's id.
fn forge(watch: &Watch, of: SystemId, bytes: &[u8]) {
    let id = CanId::Standard(TimeSync::IDS[of.index()]);
    let frame = CanFrame::new(id, false, bytes).expect("a frame");
    watch.chain.drive.seen.borrow_mut().forged.push(frame);
}

/// S-4: SYNC and FUP of another time, with right CRCs. Under the id of the other system they move
/// no sensor while the one that drives speaks. Under its id nothing tells the two apart: the
/// sensors follow whose counter is ahead. Core 1 refuses such stamps beyond 10 ms, and the vehicle
/// drives on.
#[test]
fn forged_frames_of_time_are_refused_by_the_sensors_or_by_core_1() {
    for of in [A, B] {
        for by_ns in [400_000, 30_000_000_i64, -2_000_000_000] {
            let mut watch = converged();
            let mut forger = CanTimeMaster::new(of, true, Instant::ORIGIN);
            for _ in 0..200 {
                let now = watch.chain.drive.pair.now();
                let time = watch.chain.grandmasters[0].clock.at(now).moved(by_ns);
                let due = forger.due();
                let sync = forger.poll::<Arbitrary>(due, time).expect("a SYNC");
                forge(&watch, of, &sync);
                watch.run_for(MS(6));
                forger.on_sent(due, time, false);
                if let Some(follow_up) = forger.poll(forger.due(), time) {
                    forge(&watch, of, &follow_up);
                }
                watch.run_for(MS(94));
            }
            let until = watch.chain.drive.pair.now();
            watch.run_for(S(15));
            let what = format!("{of} {by_ns}");
            let farthest = |from| {
                let (stamps, own) = watch.chain.stamps(from);
                assert_eq!(own, 0, "{what}");
                stamps
                    .iter()
                    .map(|it| it.1.unsigned_abs())
                    .max()
                    .expect("stamps")
            };
            let moved = if of == A {
                by_ns.unsigned_abs() + 2_000_000
            } else {
                6_000
            };
            assert!(
                farthest(CONVERGED) <= moved,
                "{what}: {}",
                farthest(CONVERGED)
            );
            assert!(
                farthest(until + S(10)) <= 25_000,
                "{what}: {}",
                farthest(until + S(10))
            );
            let events = watch.chain.drive.events.iter();
            let mut events = events.map(|(.., event)| event);
            let is_refused = events.any(
                |event| matches!(event, Event::StampRefused { off_us, .. } if *off_us > 10_000),
            );
            assert_eq!(is_refused, of == A && moved > 10_000_000, "{what}");
            watch.assert_drives_well(&[A]);
        }
    }
}

/// Id of the protection of transfers, and their length with it.
const PULSE: (u16, usize) = (0x0804, 1 + PULSE_WORDS);

/// Returns this datagram with another content, protected again with the counter `counter`.
fn sealed(id: u16, words: &[u32], counter: Option<u8>, alter: impl FnOnce(&mut [u32])) -> Vec<u32> {
    let mut words = words.to_vec();
    alter(&mut words);
    let mut bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    protect(id, counter.unwrap_or(bytes[2]), &mut bytes);
    let (chunks, _) = bytes.as_chunks::<4>();
    chunks
        .iter()
        .map(|chunk| u32::from_le_bytes(*chunk))
        .collect()
}

/// How the transfers of the system that drives are forged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Forgery {
    /// Each tells a time that is later, ns.
    Later(u64),
    /// Each tells another time.
    Random,
    /// Each is sent twice, and the one before again.
    Replayed,
    /// Each has the time of the one before.
    OneBehind,
}

/// S-3: transfers with a right protection and a wrong time. A replayed one, and one of the edge
/// before, are none. A constant lie is followed, told; only the grandmaster contradicts it.
#[test]
fn forged_transfers_deceive_no_reader_untold() {
    for forgery in [
        Forgery::Later(300_000),
        Forgery::Later(3_000_000_000),
        Forgery::Random,
        Forgery::Replayed,
        Forgery::OneBehind,
    ] {
        let config = ChainConfig {
            time: Time::Ideal,
            ..ChainConfig::default()
        };
        let mut watch = Watch::with(config, move |board| {
            use tandem_board::Board as _;
            let identity = board.identity();
            if (identity.system, identity.core) != (A, CoreId::CONTROL) {
                return poller(board, Time::Ideal);
            }
            let mut before: Vec<u32> = vec![];
            let on_send = move |now: Instant, words: &[u32]| {
                let is_transfer = words.len() == PULSE.1;
                if !is_transfer || now < Instant::ORIGIN + BEGINS {
                    return vec![words.to_vec()];
                }
                let last = core::mem::replace(&mut before, words.to_vec());
                let later = |by: u64| {
                    sealed(PULSE.0, words, None, |words| {
                        let time = Instant::from_words([words[2], words[3]]).as_ns() + by;
                        [words[2], words[3]] = Instant::from_ns(time).to_words();
                    })
                };
                match forgery {
                    Forgery::Later(ns) => vec![later(ns)],
                    Forgery::Random => vec![later(now.as_ns().wrapping_mul(0x9E37_79B9) >> 30)],
                    Forgery::Replayed => vec![last.clone(), words.to_vec(), words.to_vec(), last],
                    Forgery::OneBehind if last.is_empty() => vec![],
                    Forgery::OneBehind => vec![sealed(PULSE.0, words, None, |words| {
                        words[2..].copy_from_slice(&last[2..]);
                    })],
                }
            };
            core_with_link(board, Config::rt(), Box::new(on_send))
        });
        watch.run_for(S(50));
        println!("{forgery:?} {:?} {}", watch.told(B), watch.off(B));
        let follows = matches!(forgery, Forgery::Later(_));
        if let Forgery::Later(ns) = forgery {
            assert!(
                (watch.off(B) - ns as i64).abs() <= 20_000,
                "{}",
                watch.off(B)
            );
            assert_eq!(watch.told(B).followed, u32::from(ns > 1_000_000));
        } else {
            assert!(
                watch.off(B).abs() <= 20_000,
                "{forgery:?}: {}",
                watch.off(B)
            );
        }
        assert_eq!(watch.told(B).disagrees > 0, follows, "{forgery:?}");
        assert!(watch.off(A).abs() <= 1_000);
        watch.assert_drives_well(&[A]);
    }
}

/// S-3: stray edges on the line, some times a second or each few milliseconds. The standby takes no
/// wrong time; without good pulses it follows the grandmaster.
#[test]
fn stray_edges_set_no_time() {
    for (every_ms, source) in [(733, 2), (61, 1), (5, 1)] {
        let mut watch = converged();
        let mut ms = 0;
        for n in 0.. {
            if ms > 20_000 {
                break;
            }
            watch
                .chain
                .drive
                .pair
                .stray_edge(B, Line::Time, Edge::Rising);
            let wait = every_ms + n % 7;
            watch.run_for(MS(wait));
            ms += wait;
        }
        assert_eq!(watch.source(B), source, "each {every_ms} ms");
        assert_eq!(watch.told(B).leaps, 0, "each {every_ms} ms");
        for (at, by) in watch.chain.offsets(B, CONVERGED) {
            assert!(by.abs() <= 20_000, "each {every_ms} ms: {by} at {at:?}");
        }
        watch.run_for(S(10));
        assert_eq!(watch.source(B), 2, "each {every_ms} ms");
        watch.assert_drives_well(&[A]);
    }
}

/// S-5: the clock of a system jumps. That system's time is wrong until three samples agree, or
/// told; it recovers within seconds, and no reader is deceived. The other one and the sensors
/// follow.
#[test]
fn a_clock_that_jumps_is_healed() {
    for of in [A, B] {
        for by_ms in [-10_000_i32, -1_000, -7, 7, 1_000, 10_000] {
            let mut watch = converged();
            watch.chain.drive.pair.jump_clock(of, by_ms);
            // The kernel's ticks wait for a clock that has gone back.
            let waits = MS(by_ms.min(0).unsigned_abs().into());
            watch.run_for(waits + S(15));
            let what = format!("{of} by {by_ms} ms");
            for system in [A, B] {
                let (off, reading) = (watch.off(system), watch.reading(system));
                println!("{what}: {system} {off} ns of {:?}", reading.error);
                assert!(
                    off.unsigned_abs() <= reading.error.as_ns(),
                    "{what}: {system}"
                );
                assert!(off.abs() <= 100_000, "{what}: {system}");
                assert!(reading.status.is_synchronised(), "{what}: {system}");
            }
            let (stamps, _) = watch.chain.stamps(Instant::ORIGIN + BEGINS + waits + S(8));
            let farthest = stamps.iter().map(|it| it.1.abs()).max();
            assert!(farthest <= Some(500_000), "{what}: {farthest:?}");
            assert_eq!(watch.violations, [], "{what}");
            assert_eq!(watch.chain.drive.two_masters_ns(), 0, "{what}");
            assert_eq!(watch.chain.drive.gaps_beyond(), [], "{what}");
            assert_eq!(watch.chain.drive.collisions(), 0, "{what}");
        }
    }
}

/// S-5: the clock of a system runs at a wrong rate, within the crystals' limits or far beyond. Its
/// readers are told, or its stated error holds; the others keep the grandmaster's time.
#[test]
fn a_clock_of_wrong_rate_is_told() {
    for of in [A, B] {
        for rate_ppb in [-100_000, 2_000_000, 10_000_000] {
            let mut watch = converged();
            watch.chain.drive.pair.set_clock_rate(of, rate_ppb);
            watch.run_for(S(20));
            let what = format!("{of} at {rate_ppb} ppb");
            for system in [A, B] {
                // None: the clock is too wrong for the watchdog, and the system starts again.
                if watch.conversion(system).is_none() {
                    continue;
                }
                let reading = watch.reading(system);
                let is_right = watch.off(system).unsigned_abs() <= reading.error.as_ns();
                let is_told = !reading.status.is_synchronised();
                println!("{what}: {system} {} ns {reading:?}", watch.off(system));
                assert!(is_right || is_told, "{what}: {system} {reading:?}");
            }
            assert_eq!(watch.violations, [], "{what}");
            assert_eq!(watch.chain.drive.two_masters_ns(), 0, "{what}");
            assert_eq!(watch.chain.drive.gaps_beyond(), [], "{what}");
            assert_eq!(watch.chain.drive.collisions(), 0, "{what}");
        }
    }
}

/// S-4: clocks of sensors that jump, run fast or drift. Each sensor finds the time of the frames
/// again, and says what its stamps are worth; nothing else happens.
#[test]
fn clocks_of_sensors_may_lie() {
    for timing in [
        "radar-front:jump:-50ms@12s",
        "all:jump:9000ms@12s",
        "all:jump:-2ms@12s",
        "all:rate:100ppm",
        "all:drift:2ppm/s",
    ] {
        let mut watch = Watch::start(ChainConfig::default());
        let timing = timing.parse().expect("a timing");
        watch
            .chain
            .drive
            .seen
            .borrow_mut()
            .world
            .set_sensor_timing(&[timing]);
        watch.run_for(S(30));
        let late = Instant::ORIGIN + S(22);
        let (stamps, own) = watch.chain.stamps(late);
        let farthest = stamps.iter().map(|it| it.1.abs()).max();
        assert!(
            own == 0 && farthest <= Some(25_000),
            "{timing}: {own} {farthest:?}"
        );
        let refused = watch.chain.drive.events.iter();
        let refused = refused.filter(|(.., event)| matches!(event, Event::StampRefused { .. }));
        println!("{timing}: {} refused", refused.count());
        watch.assert_drives_well(&[A]);
    }
}

/// S-1: without a grandmaster, a standby that returns takes the time of the system that drives,
/// whatever its own clock shows.
#[test]
fn a_returning_system_takes_the_time_of_the_other() {
    let config = ChainConfig {
        grandmaster: None,
        ..ChainConfig::default()
    };
    let mut watch = Watch::start(config);
    watch.run_for(BEGINS);
    let line = watch.line_of(A, CONVERGED);
    watch.chain.drive.pair.power_off(B);
    watch.run_for(S(2));
    watch.chain.drive.pair.jump_clock(B, 3_600_000);
    watch.chain.drive.pair.power_on(B);
    watch.run_for(S(15));
    for (at, by) in watch.chain.offsets(B, Instant::ORIGIN + S(30)) {
        assert!(apart(by, line(at)).abs() <= 5_000, "{at:?}");
    }
    assert_eq!(watch.told(A).leaps + watch.told(B).leaps, 0);
    watch.assert_drives_well(&[A]);
}
