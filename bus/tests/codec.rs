//! Messages to frames and back, against the ranges and steps that the DBC gives.
#![allow(clippy::unwrap_used)]

mod frames;

use std::collections::BTreeSet;
use std::sync::LazyLock;

use can_dbc::{Dbc, MessageId, NumericValue, Signal};
use proptest::prelude::*;
use proptest::strategy::ValueTree;
use tandem_bus::{CameraLanes, Control, DecodeError, FRAMES, Message, SensorHeader, SensorId};

fn dbc() -> &'static Dbc {
    static DBC: LazyLock<Dbc> =
        LazyLock::new(|| Dbc::try_from(include_str!("../dbc/tandem.dbc")).unwrap());
    &DBC
}

fn number(value: NumericValue) -> f64 {
    value.to_string().parse().unwrap()
}

/// The interval in which a value lies after a round trip: limited by the range, and widened by half
/// a step and the precision of an `f32`.
fn expected(signal: &Signal, value: f64) -> (f64, f64) {
    let value = if value.is_nan() { 0.0 } else { value };
    let value = value.clamp(number(signal.min), number(signal.max));
    let slack = signal.factor * 0.5 + value.abs() * 1e-6;
    let slack = if signal.factor == 1.0 { 0.0 } else { slack };
    (value - slack, value + slack)
}

/// The tests know every frame of the DBC and every signal of it.
#[test]
fn the_tests_know_every_signal() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mut seen = BTreeSet::new();
    let dbc = dbc();
    while seen.len() < FRAMES.len() {
        let message = frames::message().new_tree(&mut runner).unwrap().current();
        let id = MessageId::Standard(message.id());
        let in_dbc = dbc.messages.iter().find(|m| m.id == id).unwrap();
        let mut names: Vec<&str> = frames::values(&message)
            .iter()
            .map(|(name, _)| *name)
            .collect();
        names.extend(["Crc", "Counter"]);
        let names: BTreeSet<&str> = names.into_iter().collect();
        assert_eq!(
            names,
            in_dbc.signals.iter().map(|s| s.name.as_str()).collect()
        );
        seen.insert(message.id());
    }
    assert_eq!(seen, FRAMES.iter().map(|frame| frame.id).collect());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// After a round trip every value is within half a step, saturated to its range.
    #[test]
    fn values_come_back(message in frames::message(), counter: u8) {
        let frame = message.encode(counter);
        prop_assert_eq!(frame.id, message.id());
        prop_assert!(frame.bytes[frame.len..].iter().all(|b| *b == 0));
        let back = Message::decode(u32::from(frame.id), frame.data()).unwrap();
        prop_assert_eq!(back.id(), message.id());
        let dbc = dbc();
        let values = frames::values(&message);
        for ((name, value), (_, back)) in values.iter().zip(frames::values(&back)) {
            let signal = dbc.signal_by_name(MessageId::Standard(frame.id), name).unwrap();
            let (low, high) = expected(signal, *value);
            prop_assert!((low..=high).contains(&back), "{}: {} became {}", name, value, back);
        }
        // A value that a frame can hold is unchanged by further round trips.
        prop_assert_eq!(back.encode(counter), frame);
    }

    /// Random bytes are either refused or decoded to values in range.
    #[test]
    fn any_bytes_decode_or_are_refused(
        id in prop_oneof![
            prop::sample::select(&FRAMES[..]).prop_map(|frame| u32::from(frame.id)),
            any::<u32>(),
        ],
        data in prop_oneof![
            prop::collection::vec(any::<u8>(), 8),
            prop::collection::vec(any::<u8>(), 12),
            prop::collection::vec(any::<u8>(), 16),
            prop::collection::vec(any::<u8>(), 32),
            prop::collection::vec(any::<u8>(), 0..70),
        ],
    ) {
        let Ok(message) = Message::decode(id, &data) else { return Ok(()) };
        prop_assert_eq!(u32::from(message.id()), id);
        let again = message.encode(0);
        prop_assert_eq!(Message::decode(id, again.data()), Ok(message));
    }
}

#[test]
fn values_out_of_range_saturate() {
    let encode = |lanes| match Message::decode(
        u32::from(CameraLanes::ID),
        Message::CameraLanes(lanes).encode(0).data(),
    ) {
        Ok(Message::CameraLanes(lanes)) => lanes,
        other => panic!("{other:?}"),
    };
    let lanes = encode(CameraLanes {
        c0: f32::NEG_INFINITY,
        c1: f32::NAN,
        own_end: f32::INFINITY,
        left_end: -1.0,
        speed_limit: f32::INFINITY,
        ..CameraLanes::default()
    });
    assert_eq!(lanes.c0, -32.768);
    assert_eq!(lanes.c1, 0.0);
    assert_eq!(lanes.own_end, CameraLanes::NO_END);
    assert_eq!(lanes.left_end, 0.0);
    assert_eq!(lanes.speed_limit, CameraLanes::NO_SPEED_LIMIT);
}

/// A value that the DBC does not allow is refused; the error names the signal.
#[test]
fn invalid_signals_are_refused() {
    let control = |system, change: fn(&mut [u8])| {
        let mut frame = Message::Control {
            system,
            control: Control::default(),
        }
        .encode(0);
        change(&mut frame.bytes);
        Message::decode(u32::from(frame.id), frame.data())
    };
    assert!(control(1, |_| ()).is_ok());
    assert_eq!(
        control(0, |b| b[3] |= 7 << 2),
        Err(DecodeError::InvalidSignal("Mode"))
    );
    assert_eq!(
        control(0, |b| b[3] |= 1 << 5),
        Err(DecodeError::InvalidSignal("System"))
    );
    assert_eq!(
        control(1, |b| b[3] = 0),
        Err(DecodeError::InvalidSignal("System"))
    );

    let mut data = [0; SensorHeader::LEN];
    data[3] = 33;
    let id = u32::from(SensorId::CameraFront.header_id());
    assert_eq!(
        Message::decode(id, &data),
        Err(DecodeError::InvalidSignal("ObjectCount"))
    );
    data[3] = 32;
    assert!(Message::decode(id, &data).is_ok());
}

#[test]
fn other_lengths_and_ids_are_refused() {
    for frame in FRAMES {
        for len in (0..=64).filter(|len| *len != frame.len) {
            assert_eq!(
                Message::decode(u32::from(frame.id), &[0; 64][..len]),
                Err(DecodeError::WrongLength)
            );
        }
        let extended_twin = u32::from(frame.id) + 0x1_0000;
        assert_eq!(
            Message::decode(extended_twin, &[0; 64][..frame.len]),
            Err(DecodeError::UnknownId)
        );
    }
}

/// A system index that is neither 0 nor 1 saturates like any other value.
#[test]
fn the_system_saturates() {
    let message = Message::Control {
        system: 9,
        control: Control::default(),
    };
    assert_eq!(message.id(), Control::IDS[1]);
    let frame = message.encode(0);
    let decoded = Message::decode(u32::from(frame.id), frame.data());
    assert_eq!(
        decoded,
        Ok(Message::Control {
            system: 1,
            control: Control::default()
        })
    );
}
