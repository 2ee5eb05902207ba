//! The controller's participant under forged and damaged datagrams, in virtual time. What they do
//! must end: it hears the SoC again, and sends no more than they ask for.
#![allow(clippy::unwrap_used)]

mod hostile;

use hostile::*;
use proptest::prelude::*;
use tandem_board::{NetworkAddress, Recipient};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, controller_prefix};
use tandem_topics::{Durability, Endpoint, Participant, Qos, Reliability};

/// The datagrams of the SoC do not arrive for longer than its lease, and those of the controller
/// do: only one of both forgets the other one.
#[test]
fn a_link_that_fails_in_one_direction_comes_back() {
    for cut in [0, 1] {
        let mut world = World::new();
        assert!(world.works());
        world.is_cut[cut] = true;
        world.run(15_000);
        world.is_cut[cut] = false;
        world.run(HEALS_MS);
        assert!(world.works(), "cut {cut}");
    }
}

/// Who is not the SoC says that it has ended.
#[test]
fn a_forged_end_is_healed() {
    let mut world = World::new();
    world.forge(&[ends(SOC)]);
    world.run(HEALS_MS);
    assert!(world.works());
}

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

/// Returns a participant that hears a writer of the SoC without guarantee.
fn without_guarantee() -> Participant<0, 1, 3, 0, 24> {
    const BEST_EFFORT: Qos = Qos {
        reliability: Reliability::BestEffort,
        durability: Durability::Volatile,
        depth: 3,
    };
    static INPUT: [Endpoint; 1] = [Endpoint {
        qos: BEST_EFFORT,
        ..INPUTS[0]
    }];
    let mut mcu = Participant::new(MCU, place(0), &[], &INPUT);
    let offer = endpoint(SOC, PUBLICATIONS_WRITER, (POWER_WRITER, 1), &INPUT[0]);
    for part in [participant(SOC, place(1), 10), offer] {
        mcu.hear(START, &message(SOC, &[part]), &mut Sent::default());
    }
    mcu
}

/// A writer without guarantee: one sample with a wrong number does not silence it.
#[test]
fn a_wrong_number_does_not_silence_a_writer_without_guarantee() {
    let (mut mcu, mut sent) = (without_guarantee(), Sent::default());
    let mut hears = |number| {
        let part = data(POWER_WRITER, number, b"abcd");
        mcu.hear(START, &message(SOC, &[part]), &mut sent);
        mcu.take(0).is_some()
    };
    assert!((1..=100).all(&mut hears));
    assert!(!hears(99), "it is late");
    assert!(hears(1 << 30));
    assert!((101..=200).all(&mut hears));
}

/// A sample with a wrong number that was not taken is dropped when the writer goes on below it. It
/// does not come later, behind newer ones, and holds no place.
#[test]
fn what_a_wrong_number_leaves_is_dropped() {
    let mut mcu = without_guarantee();
    let mut hear = |number: u32| {
        let part = data(POWER_WRITER, number, &number.to_le_bytes());
        mcu.hear(START, &message(SOC, &[part]), &mut Sent::default());
        mcu.clone()
    };
    let _untaken = hear(150);
    let mut taken = Vec::new();
    for number in 1..=200 {
        // Three of them have room: nothing is replaced if the wrong one has left.
        let mut after = hear(number);
        let newest = std::iter::from_fn(|| after.take(0)).last();
        let newest = newest.map(|sample| sample.payload().to_vec());
        taken.push(newest);
    }
    let right = (1..=200u32).map(|number| Some(number.to_le_bytes().to_vec()));
    assert!(taken.into_iter().eq(right));
    assert_eq!(mcu.reader_counts(0).replaced, 197);
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
        assert!(to.iter().all(|to| *to == Recipient::One(place(1))));
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
    let elsewhere = NetworkAddress {
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
            .all(|(to, _)| *to != Recipient::One(elsewhere))
    );
}

/// Any name of a system that starts replaces the one before: the true one comes back.
#[test]
fn a_forged_restart_of_a_system_is_healed() {
    let mut world = World::new();
    let forged = controller_prefix(0, [1; 5]);
    let parts = [participant(forged, place(9), 10)];
    let mut sent = Sent::default();
    world
        .soc
        .hear(world.now, &message(forged, &parts), &mut sent);
    world.run(HEALS_MS);
    assert!(world.works());
}

/// One damaged datagram of the SoC, whatever the bit, costs a time and not the connection.
#[test]
fn a_damaged_bit_is_healed() {
    let mut run = World::alone();
    run.is_cut = [false; 2];
    let mut count = 0;
    run.change = Some(Box::new(|_, _| {}));
    run.run(500);
    for _ in 0..4 {
        run.write();
        run.run(20);
    }
    let lengths: Vec<usize> = run.heard.iter().map(Vec::len).collect();
    assert!(lengths.len() > 10);
    for (which, length) in lengths.into_iter().enumerate() {
        // Every eleventh bit: each of the eight of a byte, and each byte, is met.
        for bit in (which % 11..length * 8).step_by(11) {
            let mut world = World::alone();
            world.is_cut = [false; 2];
            world.change = Some(Box::new(move |index, bytes| {
                if index == which && bit / 8 < bytes.len() {
                    bytes[bit / 8] ^= 1 << (bit % 8);
                }
            }));
            world.run(500);
            for _ in 0..4 {
                world.write();
                world.run(20);
            }
            world.run(HEALS_MS);
            assert!(
                world.works() || world.works(),
                "datagram {which}, bit {bit}"
            );
            count += 1;
        }
    }
    assert!(count > 1_000, "{count}");
}

fn number() -> impl Strategy<Value = u32> {
    prop_oneof![
        0..40u32,
        (0..40u32).prop_map(|it| u32::MAX - it),
        (0..32u32, 0..3u32).prop_map(|(bit, less)| (1u32 << bit).wrapping_sub(less)),
        any::<u32>(),
    ]
}

fn forged() -> impl Strategy<Value = Vec<u8>> {
    let writer = prop::sample::select(vec![
        POWER_WRITER,
        [0, 0, 2, 3],
        CAN_WRITER,
        PUBLICATIONS_WRITER,
        SUBSCRIPTIONS_WRITER,
    ]);
    let set = (0..=256u32, number());
    (
        0..6u8,
        writer,
        (number(), number(), number()),
        set,
        0..30usize,
    )
        .prop_map(|(kind, writer, (a, b, count), set, length)| match kind {
            0 => data(writer, a, &vec![b as u8; length]),
            1 => heartbeat(writer, a, b, count),
            2 => gap(writer, a, b, set),
            3 => acknack(CAN_READER, writer, a, set, count),
            4 => participant(SOC, place((a % 3) as usize), count),
            _ => endpoint(
                SOC,
                PUBLICATIONS_WRITER,
                (writer, a),
                &INPUTS[(b % 4) as usize],
            ),
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// Whatever is said in the name of the SoC: the participant does not panic, and hears the SoC
    /// when that has ended.
    #[test]
    fn what_is_forged_is_healed(
        forged in prop::collection::vec((forged(), 0..200u64), 1..30),
        unwritten in any::<bool>(),
    ) {
        let mut world = if unwritten { World::unwritten() } else { World::new() };
        for (part, ms) in &forged {
            world.forge(std::slice::from_ref(part));
            world.run(*ms);
            world.write();
        }
        // A lease that was forged, and the time of healing.
        world.run(100_000 + HEALS_MS);
        // A forged sample whose turn comes now stands in the way of one true one.
        prop_assert!(world.works() || world.works());
    }
}
