//! The controller's participant under forged and damaged datagrams, in virtual time. What they do
//! must end: it hears the SoC again, and sends no more than they ask for.
#![allow(clippy::unwrap_used)]

mod hostile;

use hostile::*;
use proptest::prelude::*;
use tandem_topics::endpoints::{INPUTS, OUTPUTS, controller_prefix};
use tandem_topics::{Destination, Durability, Endpoint, Locator, Participant, Qos, Reliability};

/// Counts that are far ahead, and are not those of the SoC, do not keep its own from counting: what
/// is lost afterwards is repaired.
#[test]
fn a_wrong_count_does_not_end_the_repair() {
    for ahead in [100, 1 << 30, i32::MAX as u32, 1 << 31, u32::MAX - 10] {
        let mut world = World::new();
        assert!(world.works());
        world.forge(&[
            heartbeat(POWER_WRITER, world.written, world.written, ahead),
            acknack(CAN_READER, CAN_WRITER, 1, (0, 0), ahead),
            acknack(PUBLICATIONS_READER, PUBLICATIONS_WRITER, 1, (0, 0), ahead),
        ]);
        world.run(5_000);
        for lost in 0..2 {
            world.is_cut[lost] = true;
            world.write();
            world.is_cut[lost] = false;
            world.run(1_000);
        }
        let all: Vec<u32> = (1..=world.written).collect();
        assert_eq!(world.taken[0], all, "{ahead}");
        assert_eq!(world.taken[1], all, "{ahead}");
    }
}

/// The last number of all, in a GAP.
#[test]
fn a_gap_at_the_end_of_all_numbers_is_read() {
    let mut world = World::new();
    world.forge(&[gap(POWER_WRITER, 1, u32::MAX - 1, (32, u32::MAX))]);
    world.run(10);
}

/// Numbers that the SoC never had, in each kind of message of its writers and readers.
#[test]
fn wrong_numbers_do_not_deafen() {
    const MOST: u32 = u32::MAX - 1;
    for far in [1_000, 1 << 20, 1 << 31, MOST - 2, MOST] {
        for start in [false, true] {
            for (name, forged) in [
                ("data", data(POWER_WRITER, far, b"forged")),
                ("heartbeat", heartbeat(POWER_WRITER, far, far, 1 << 20)),
                ("last", heartbeat(POWER_WRITER, 1, far, 1 << 20)),
                ("none", heartbeat(POWER_WRITER, far, far - 1, 1 << 20)),
                ("gap", gap(POWER_WRITER, 1, far, (0, 0))),
                ("gaps", gap(POWER_WRITER, 1, far, (32, u32::MAX))),
                ("lists", gap(PUBLICATIONS_WRITER, 1, far, (32, u32::MAX))),
                ("list", heartbeat(PUBLICATIONS_WRITER, far, far, 1 << 20)),
                (
                    "has",
                    acknack(
                        PUBLICATIONS_READER,
                        SUBSCRIPTIONS_WRITER,
                        far,
                        (32, u32::MAX),
                        9,
                    ),
                ),
                (
                    "acks",
                    acknack(CAN_READER, CAN_WRITER, far, (32, u32::MAX), 1 << 20),
                ),
            ] {
                let mut world = if start {
                    World::unwritten()
                } else {
                    World::new()
                };
                world.forge(&[forged]);
                world.run(HEALS_MS);
                assert!(world.works(), "{name} {far} {start}");
            }
        }
    }
}

/// A writer without guarantee: one sample with a wrong number does not silence it.
#[test]
fn a_wrong_number_does_not_silence_a_writer_without_guarantee() {
    const BEST_EFFORT: Qos = Qos {
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 3,
    };
    static INPUT: [Endpoint; 1] = [Endpoint {
        qos: BEST_EFFORT,
        ..INPUTS[0]
    }];
    let mut mcu = Participant::<0, 1, 3, 0, 24>::new(MCU, place(0), &[], &INPUT);
    let (now, mut sent) = (hostile::START, Sent::default());
    mcu.hear(
        now,
        &message(SOC, &[participant(SOC, place(1), 10)]),
        &mut sent,
    );
    let offer = endpoint(SOC, PUBLICATIONS_WRITER, (POWER_WRITER, 1), &INPUT[0]);
    mcu.hear(now, &message(SOC, &[offer]), &mut sent);
    let mut hears = |number| {
        mcu.hear(
            now,
            &message(SOC, &[data(POWER_WRITER, number, b"abcd")]),
            &mut sent,
        );
        mcu.take(0).is_some()
    };
    assert!((1..=100).all(&mut hears));
    assert!(!hears(99), "it is late");
    assert!(hears(1 << 30));
    assert!((101..=200).all(&mut hears));
}

/// A reader of depth 3 holds what arrived behind a loss. It must have room for the lost one, if the
/// writer has more history than that, or if there are two of them.
#[test]
fn what_is_held_back_leaves_room_for_what_is_missing() {
    for two in [false, true] {
        let mut mcu = Mcu::new(MCU, place(0), &OUTPUTS, &INPUTS);
        let (now, mut sent) = (hostile::START, Sent::default());
        let socs = [SOC, prefix(2, 0)];
        for soc in socs {
            let hello = participant(soc, place(1), 10);
            let offer = endpoint(soc, PUBLICATIONS_WRITER, (POWER_WRITER, 1), &INPUTS[0]);
            for part in [hello, offer, data(POWER_WRITER, 1, b"1")] {
                mcu.hear(now, &message(soc, &[part]), &mut sent);
            }
            assert!(mcu.take(0).is_some());
        }
        // Each writer loses its second sample, and keeps all that was not taken.
        let mut next = [2_u8; 2];
        for round in 0..4 {
            for (which, soc) in socs.into_iter().enumerate().take(1 + usize::from(two)) {
                let first = next[which].max(if round == 0 { 3 } else { 2 });
                for number in first..=12 {
                    let part = data(POWER_WRITER, number.into(), &[number; 4]);
                    mcu.hear(now, &message(soc, &[part]), &mut sent);
                    while let Some(sample) = mcu.take(0) {
                        let which = usize::from(sample.writer.prefix != SOC);
                        assert_eq!(sample.payload(), [next[which]; 4]);
                        next[which] += 1;
                    }
                }
            }
        }
        assert_eq!(next, [13, if two { 13 } else { 2 }]);
    }
}

/// Participants without end fill the places. Those that nothing of the controller fits give way at
/// once, the others when they have been silent for as long as the longest lease that is believed.
#[test]
fn strangers_do_not_keep_the_soc_out() {
    for fits in [false, true] {
        let mut world = World::alone();
        for start in 0..60 {
            let forged = prefix(9, start);
            let offer = endpoint(forged, PUBLICATIONS_WRITER, (POWER_WRITER, 1), &INPUTS[0]);
            let asks = endpoint(forged, SUBSCRIPTIONS_WRITER, (CAN_READER, 1), &OUTPUTS[0]);
            let parts = [participant(forged, place(9), u32::MAX), offer, asks];
            world.hear(&message(forged, if fits { &parts } else { &parts[..1] }));
            world.run(100);
        }
        world.is_cut = [false; 2];
        world.run(if fits { 100_000 + HEALS_MS } else { HEALS_MS });
        assert!(world.works(), "{fits}");
    }
}

/// A domain with more participants than places: those that have nothing for the controller come
/// back with each of their announcements, and the SoC is heard all the time.
#[test]
fn a_crowd_does_not_disturb() {
    let mut world = World::alone();
    world.is_cut = [false; 2];
    let mut heard = 0;
    for round in 0..300u32 {
        let other = prefix(9, (round % 8) as u8);
        world.hear(&message(other, &[participant(other, place(9), 10)]));
        world.write();
        world.run(100);
        heard = world.taken[0].len();
    }
    assert!(heard > 200, "{heard}");
    assert!(world.works());
}

/// A writer tells of samples that it does not give: the reader asks for them, but not for ever.
#[test]
fn a_writer_that_does_not_answer_is_left_alone() {
    let mut world = World::new();
    assert!(world.works());
    world.is_cut[0] = true;
    world.forge(&[heartbeat(POWER_WRITER, 1, world.written + 2, 1 << 20)]);
    world.run(1_000);
    world.sent.clear();
    world.run(5_000);
    // Announcements and heartbeats.
    assert!(world.sent.len() < 100, "{}", world.sent.len());
}

/// One datagram makes the controller send a bounded number of them, and only to who announced it.
#[test]
fn one_datagram_does_not_become_a_flood() {
    const FULL: usize = 1_472;
    let each_in_turn: [fn(u32, u32) -> Vec<u8>; 5] = [
        |count, _| {
            acknack(
                PUBLICATIONS_READER,
                SUBSCRIPTIONS_WRITER,
                1,
                (32, u32::MAX),
                count,
            )
        },
        |count, last| acknack(CAN_READER, CAN_WRITER, last - 2, (32, u32::MAX), count),
        |count, _| heartbeat(POWER_WRITER, 1, 1_000_000, count),
        |count, _| heartbeat(PUBLICATIONS_WRITER, 1, 1_000_000, count),
        |_, _| ends(SOC),
    ];
    for (which, part) in each_in_turn.into_iter().enumerate() {
        let mut world = World::new();
        assert!(world.works());
        let mut bytes = message(SOC, &[]);
        let mut count = 1 << 20;
        while bytes.len() + part(count, world.written).len() <= FULL {
            bytes.extend(part(count, world.written));
            count += 1;
        }
        world.sent.clear();
        world.hear(&bytes);
        let to: Vec<_> = world.sent.iter().map(|(to, _)| *to).collect();
        assert!(to.iter().all(|to| *to == Destination::At(place(1))));
        println!(
            "attack {which}: {} parts, {} datagrams",
            count - (1 << 20),
            to.len()
        );
        assert!(to.len() <= 260, "attack {which}: {}", to.len());
    }
}

/// The locator of a participant that is known moves: what is sent goes there until its next
/// announcement, and not any longer.
#[test]
fn a_forged_locator_is_corrected() {
    let mut world = World::new();
    let elsewhere = Locator {
        address: [8, 8, 8, 8],
        port: 53,
    };
    world.forge(&[participant(SOC, elsewhere, 3_600)]);
    world.run(1_500);
    world.sent.clear();
    assert!(world.works());
    assert!(
        world
            .sent
            .iter()
            .all(|(to, _)| *to != Destination::At(elsewhere))
    );
}
