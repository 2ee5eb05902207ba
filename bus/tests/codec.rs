//! Tests encoding and decoding with the ranges and steps of the DBC.
#![allow(clippy::unwrap_used)]

mod frames;

use std::collections::BTreeSet;

use proptest::prelude::*;
use tandem_bus::e2e::HEADER_LEN;
use tandem_bus::{
    CameraLanes, Control, FRAMES, FrameError, FrameInfo, FrameReceiver, Message, SensorId, TimeSync,
};

/// Every signal of the DBC, and no other, is part of its message.
#[test]
fn every_signal_is_part_of_its_message() {
    for frame in FRAMES {
        let message = Message::decode(u32::from(frame.id), &blank(frame)).unwrap();
        assert_eq!(message.id(), frame.id);
        let names: BTreeSet<_> = frames::values(&message).iter().map(|it| it.0).collect();
        let in_dbc = frames::signals(frame.id).map(|signal| signal.name.as_str());
        assert_eq!(names, in_dbc.collect(), "{}", frame.name);
    }
}

/// Returns the bytes of a frame in which every signal is 0 except `System`, the sender.
fn blank(frame: FrameInfo) -> Vec<u8> {
    let mut data = vec![0; frame.len];
    let mut signals = frames::signals(frame.id);
    if let Some(system) = signals.find(|signal| signal.name == "System") {
        let of_b = u8::from(frame.name.ends_with('B'));
        data[system.start_bit as usize / 8] |= of_b << (system.start_bit % 8);
    }
    data
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    /// Values that a frame can hold are unchanged by a round trip.
    #[test]
    fn values_come_back(message in frames::message(), counter: u8) {
        let frame = message.encode(counter);
        prop_assert_eq!(frame.id, message.id());
        prop_assert!(frame.bytes[frame.len..].iter().all(|b| *b == 0));
        let back = Message::decode(u32::from(frame.id), frame.data()).unwrap();
        prop_assert_eq!(back.id(), message.id());
        prop_assert_eq!(frames::values(&back), frames::values(&message));
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
        Err(FrameError::InvalidSignal("Mode"))
    );
    assert_eq!(
        control(0, |b| b[3] |= 1 << 5),
        Err(FrameError::InvalidSignal("System"))
    );
    assert_eq!(
        control(1, |b| b[3] = 0),
        Err(FrameError::InvalidSignal("System"))
    );

    let mut data = [0; 8];
    data[3] = 33;
    let id = u32::from(SensorId::CameraFront.header_id());
    assert_eq!(
        Message::decode(id, &data),
        Err(FrameError::InvalidSignal("ObjectCount"))
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
                Err(FrameError::WrongLength)
            );
        }
        let extended_twin = u32::from(frame.id) + 0x1_0000;
        assert_eq!(
            Message::decode(extended_twin, &[0; 64][..frame.len]),
            Err(FrameError::UnknownId)
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

/// Each signal of each frame is altered alone, and the frame stays valid.
#[test]
fn one_signal_is_altered_alone() {
    for frame in FRAMES {
        let good = blank(frame);
        let content = if frame.has_e2e { HEADER_LEN.. } else { 0.. };
        let Ok(message) = Message::decode(frame.id.into(), &good) else {
            continue;
        };
        let mut names = vec![];
        message.values(|name, value| names.push((name, value)));
        for (name, before) in names {
            let mut data = good.clone();
            let altered = Message::alter(frame.id.into(), &mut data, name, |value| {
                assert_eq!(value as f32, before as f32, "{name}");
                1.0
            });
            assert_eq!(altered, Ok(()), "{name}");
            let check = tandem_bus::e2e::Checker::new(frame.id).check(&data);
            assert_eq!(check.is_accepted(), frame.has_e2e);
            if let Ok(message) = Message::decode(frame.id.into(), &data) {
                message.values(|other, value| {
                    let is_one = (0.5..=1.05).contains(&value) || value < 0.5 && value > 0.0;
                    assert!(other != name || is_one, "{name}: {value}");
                });
            }
            let _ = Message::alter(frame.id.into(), &mut data, name, |_| before);
            assert_eq!(data[content.clone()], good[content.clone()], "{name}");
            assert_eq!(
                Message::alter(frame.id.into(), &mut data, name, |_| f64::NAN),
                Ok(())
            );
            let is_all_ones = data[content.clone()] == good[content.clone()];
            assert!(!is_all_ones || name == "System", "{name}");
        }
        let mut data = good;
        let unknown = Message::alter(frame.id.into(), &mut data, "Nothing", |it| it);
        assert_eq!(unknown, Err(FrameError::UnknownSignal));
    }
    let unknown = Message::alter(0x7FF, &mut [0; 8], "Term", |it| it);
    assert_eq!(unknown, Err(FrameError::UnknownId));
    let short = Message::alter(0x0A0, &mut [0; 8], "Term", |it| it);
    assert_eq!(short, Err(FrameError::WrongLength));
}

/// S-4: the frames of time are those of AUTOSAR's layout, byte for byte, with no header before it.
#[test]
fn frames_of_time_have_the_layout_of_their_protocol() {
    let bytes = [0x28, 0x5A, 0xC7, 0b0000_0110, 0x12, 0x34, 0x56, 0x78];
    for (system, id) in (0..).zip(TimeSync::IDS) {
        let time_sync = TimeSync {
            message_type: 0x28,
            crc8: 0x5A,
            sequence_counter: 7,
            domain: 12,
            overflow: 2,
            to_sub_domain: true,
            reserved: 0,
            time: 0x1234_5678,
        };
        let message = Message::TimeSync { system, time_sync };
        assert_eq!(message.encode(99).data(), bytes);
        let mut receiver = FrameReceiver::new();
        for _again in 0..2 {
            assert_eq!(receiver.receive(id.into(), &bytes), Ok(message));
        }
        assert_eq!(receiver.lost(), 0);
    }
}

/// A code is found by its number, and no other number is one.
#[test]
fn codes_are_found_by_their_numbers() {
    use tandem_bus::{AbilityCode, ModeCode, RoleCode};
    for raw in 0..=u8::MAX {
        let role = RoleCode::from_raw(raw);
        assert_eq!(role.map(|role| role as u8), (raw < 4).then_some(raw));
        let mode = ModeCode::from_raw(raw);
        assert_eq!(mode.map(|mode| mode as u8), (raw < 5).then_some(raw));
    }
    assert_eq!(RoleCode::from_raw(1), Some(RoleCode::Master));
    assert_eq!(AbilityCode::from_raw(3), Some(AbilityCode::None));
}
