//! Samples as bytes: what is written and read in each representation, and what is refused.
#![allow(clippy::unwrap_used)]

mod samples;

use proptest::prelude::*;
use samples::{Any, any_sample, bytes, hex};
use tandem_bus::e2e::Check;
use tandem_shm::Corrupt;
use tandem_topics::{
    BrakeRequest, CanFrame, CdrError, Gear, LateralControl, LongitudinalControl, ParkingBrake,
    PowerControl, TopicType,
};

const POWER: PowerControl = PowerControl {
    crc: 0x1234,
    counter: 0x56,
    target_speed: 13.5,
    acceleration: -2.0,
    distance: 100.25,
    target_gear: Gear::Drive,
};
/// `POWER` in the four representations; XCDR2 differs by its identifier only.
const POWER_BYTES: [&str; 4] = [
    "0001 0000  3412 56 00  00005841 000000c0 0080c842 02000000",
    "0000 0000  1234 56 00  41580000 c0000000 42c88000 00000002",
    "0007 0000  3412 56 00  00005841 000000c0 0080c842 02000000",
    "0006 0000  1234 56 00  41580000 c0000000 42c88000 00000002",
];

/// D-3
#[test]
fn a_sample_has_these_bytes_in_each_representation() {
    assert_eq!(POWER.encode().unwrap().to_vec(), bytes(POWER_BYTES[0]));
    for payload in POWER_BYTES {
        assert_eq!(
            PowerControl::decode(&bytes(payload)),
            Ok(POWER),
            "{payload}"
        );
    }
    let lateral = LateralControl {
        crc: 0x1234,
        counter: 0x56,
        enable: true,
        road_wheel_angle: -0.25,
    };
    let longitudinal = LongitudinalControl {
        crc: 0x1234,
        counter: 0x56,
        enable: true,
        brake_torque: 1500.0,
        speed: 8.0,
    };
    let parking = ParkingBrake {
        crc: 0x1234,
        counter: 0x56,
        request: BrakeRequest::Release,
    };
    for (sample, payload) in [
        (
            Any::LateralControl(lateral),
            "0001 0000  3412 56 01 000080be",
        ),
        (
            Any::LongitudinalControl(longitudinal),
            "0001 0000  3412 56 01 0080bb44 00000041",
        ),
        (Any::ParkingBrake(parking), "0001 0000  3412 56 00 02000000"),
    ] {
        assert_eq!(
            hex(&sample.encode().unwrap()),
            hex(&bytes(payload)),
            "{sample:?}"
        );
    }
}

/// A frame of CAN takes 71 bytes, and one byte of padding that the options count. D-2
#[test]
fn a_can_frame_has_71_bytes_and_one_of_padding() {
    let mut frame = CanFrame {
        id: 0x9234_5678,
        period_ms: 10,
        length: 64,
        ..CanFrame::default()
    };
    frame.data = std::array::from_fn(|index| index as u8 + 1);
    let payload = frame.encode().unwrap();
    assert_eq!(payload.len(), CanFrame::PAYLOAD_LEN);
    assert_eq!(payload[..4], [0, 1, 0, 1]);
    assert_eq!(payload[4..11], [0x78, 0x56, 0x34, 0x92, 10, 0, 64]);
    assert_eq!(payload[11..75], frame.data);
    assert_eq!(payload[75], 0);
    assert_eq!(CanFrame::decode(&payload), Ok(frame));
}

/// The lengths of all payloads are multiples of four.
#[test]
fn the_payloads_have_these_lengths() {
    let lengths = [
        CanFrame::PAYLOAD_LEN,
        PowerControl::PAYLOAD_LEN,
        LateralControl::PAYLOAD_LEN,
        LongitudinalControl::PAYLOAD_LEN,
        ParkingBrake::PAYLOAD_LEN,
    ];
    assert_eq!(lengths, [76, 24, 12, 16, 12]);
}

#[test]
fn other_representations_are_refused() {
    let mut payload = POWER.encode().unwrap();
    for id in 0..=u16::MAX {
        payload[..2].copy_from_slice(&id.to_be_bytes());
        let is_read = PowerControl::decode(&payload) != Err(CdrError::Representation(id));
        assert_eq!(is_read, [0, 1, 6, 7].contains(&id), "{id:#06x}");
    }
}

#[test]
fn a_payload_that_ends_too_early_is_refused() {
    for payload in POWER_BYTES.map(bytes) {
        for len in 0..payload.len() {
            let decoded = PowerControl::decode(&payload[..len]);
            assert_eq!(decoded, Err(CdrError::TooShort), "{len} bytes");
        }
    }
}

/// A payload may end with up to three bytes that are not zero, whether the options count them or
/// not. Bytes that the options count are not read as members.
#[test]
fn up_to_three_bytes_of_padding_are_ignored() {
    for (options, padding, decoded) in [
        (0, 0, Ok(POWER)),
        (0, 3, Ok(POWER)),
        (0, 4, Err(CdrError::TooLong)),
        (0, 50, Err(CdrError::TooLong)),
        (1, 0, Err(CdrError::TooShort)),
        (1, 1, Ok(POWER)),
        (3, 2, Err(CdrError::TooShort)),
        (3, 3, Ok(POWER)),
        (3, 4, Err(CdrError::TooLong)),
        // The other bits of the options have no meaning.
        (0xFC, 3, Ok(POWER)),
    ] {
        let mut payload = bytes(POWER_BYTES[0]);
        payload[2..4].copy_from_slice(&[0xFF, options]);
        payload.extend(vec![0xA5; padding]);
        let found = PowerControl::decode(&payload);
        assert_eq!(found, decoded, "{options} in the options, {padding} bytes");
    }
}

/// What stands between the members has no meaning either.
#[test]
fn the_contents_of_padding_between_members_are_ignored() {
    let mut payload = bytes(POWER_BYTES[0]);
    payload[7] = 0xFF;
    assert_eq!(PowerControl::decode(&payload), Ok(POWER));
}

/// Replaces four bytes of a good payload.
fn with(payload: &[u8], at: usize, number: u32) -> Vec<u8> {
    let mut payload = payload.to_vec();
    payload[at..at + 4].copy_from_slice(&number.to_le_bytes());
    payload
}

#[test]
fn a_value_out_of_range_is_refused() {
    let power = bytes(POWER_BYTES[0]);
    let above = 327.67_f32.next_up();
    for (at, name, number) in [
        (8, "target_speed", (-0.1_f32).to_bits()),
        (8, "target_speed", above.to_bits()),
        (8, "target_speed", f32::NAN.to_bits()),
        (8, "target_speed", f32::INFINITY.to_bits()),
        (12, "acceleration", (-32.768_f32).next_down().to_bits()),
        (12, "acceleration", f32::NEG_INFINITY.to_bits()),
        (16, "distance", 6553.5_f32.next_up().to_bits()),
        (20, "target_gear", 3),
        (20, "target_gear", u32::MAX),
        (20, "target_gear", 0x0200_0000),
    ] {
        let decoded = PowerControl::decode(&with(&power, at, number));
        assert_eq!(
            decoded,
            Err(CdrError::InvalidMember(name)),
            "{number:#010x}"
        );
    }
    let limits = with(
        &with(&power, 8, 327.67_f32.to_bits()),
        12,
        (-32.768_f32).to_bits(),
    );
    assert!(PowerControl::decode(&limits).is_ok());

    let lateral = bytes("0001 0000  0000 00 00 00000000");
    for byte in 0..=u8::MAX {
        let decoded = LateralControl::decode(&with(&lateral, 4, u32::from(byte) << 24));
        match decoded {
            Ok(sample) => assert_eq!(u8::from(sample.enable), byte),
            Err(error) => assert_eq!((error, byte > 1), (CdrError::InvalidMember("enable"), true)),
        }
    }
    for length in 0..=u8::MAX {
        let mut payload = CanFrame::default().encode().unwrap();
        payload[10] = length;
        let decoded = CanFrame::decode(&payload).map(|frame| frame.length);
        let invalid = Err(CdrError::InvalidMember("length"));
        assert_eq!(decoded, if length > 64 { invalid } else { Ok(length) });
    }
}

/// A sample that no receiver would read is not written, and not protected either.
#[test]
fn a_value_out_of_range_is_not_written() {
    let invalid = Err(CdrError::InvalidMember("target_speed"));
    for target_speed in [-1.0, 400.0, f32::NAN, f32::INFINITY] {
        let mut sample = PowerControl {
            target_speed,
            ..POWER
        };
        assert_eq!(sample.encode().map(|_| ()), invalid);
        assert_eq!(Any::PowerControl(sample).through_words(), Err(Corrupt));
        assert_eq!(sample.protect(1), invalid);
        assert_eq!((sample.crc, sample.counter), (POWER.crc, POWER.counter));
        assert_eq!(sample.check(&mut PowerControl::checker()), Check::CrcError);
    }
}

/// The CRC was computed by Python: `binascii.crc_hqx(body[2:] + b"\x01\x80", 0xFFFF)`.
#[test]
fn the_crc_covers_the_body_and_the_data_id() {
    let mut sample = POWER;
    sample.protect(7).unwrap();
    assert_eq!((sample.crc, sample.counter), (0xB743, 7));
    assert_eq!(
        PowerControl {
            crc: POWER.crc,
            counter: POWER.counter,
            ..sample
        },
        POWER
    );
}

/// The checker judges repetitions, losses and damage like that of the vehicle bus. D-3
#[test]
fn a_repeated_lost_or_damaged_sample_is_noticed() {
    let mut checker = ParkingBrake::checker();
    let mut sample = ParkingBrake {
        request: BrakeRequest::Apply,
        ..ParkingBrake::default()
    };
    for (counter, expected) in [
        (255, Check::Initial),
        (0, Check::Ok),
        (0, Check::Repeated),
        (3, Check::OkSomeLost(2)),
        (100, Check::WrongSequence),
    ] {
        sample.protect(counter).unwrap();
        assert_eq!(sample.check(&mut checker), expected, "{counter}");
    }
    sample.protect(101).unwrap();
    let damaged = ParkingBrake {
        request: BrakeRequest::Release,
        ..sample
    };
    assert_eq!(damaged.check(&mut checker), Check::CrcError);
    assert_eq!(sample.check(&mut checker), Check::Ok);
}

/// A sample of one type is no sample of another type of the same layout.
#[test]
fn a_sample_of_another_type_has_a_wrong_crc() {
    let mut brake = ParkingBrake::default();
    brake.protect(0).unwrap();
    let lateral = LateralControl::decode(&brake.encode().unwrap()).unwrap();
    assert_eq!(
        lateral.check(&mut LateralControl::checker()),
        Check::CrcError
    );
    assert_eq!(brake.check(&mut ParkingBrake::checker()), Check::Initial);
}

/// The representation in which a protected sample arrives, and what its padding holds, do not
/// matter.
#[test]
fn a_protected_sample_passes_in_each_representation() {
    let mut sample = POWER;
    sample.protect(9).unwrap();
    let [crc_low, crc_high] = sample.crc.to_le_bytes();
    for payload in POWER_BYTES {
        let mut payload = bytes(payload);
        let is_little_endian = payload[1] & 1 == 1;
        let crc = if is_little_endian {
            [crc_low, crc_high]
        } else {
            [crc_high, crc_low]
        };
        payload[4..6].copy_from_slice(&crc);
        payload[6] = 9;
        payload[7] = 0xEE;
        let read = PowerControl::decode(&payload).unwrap();
        assert_eq!(
            read.check(&mut PowerControl::checker()),
            Check::Initial,
            "{payload:02x?}"
        );
    }
}

proptest! {
    /// D-2, D-3
    #[test]
    fn what_is_written_is_read_again(sample in any_sample()) {
        let payload = sample.encode().unwrap();
        prop_assert_eq!(Any::decode(sample.type_name(), &payload), Ok(sample));
        prop_assert_eq!(sample.through_words(), Ok(sample));
    }

    /// Damage of up to two bytes of a protected sample is refused, or its CRC is wrong.
    #[test]
    fn two_wrong_bytes_are_noticed(
        sample in any_sample(), counter: u8, at: prop::sample::Index, damage in 1_u16..
    ) {
        let mut sample = sample;
        sample.protect(counter).unwrap();
        let mut payload = sample.encode().unwrap();
        // Behind the representation and the CRC.
        let at = 6 + at.index(payload.len() - 7);
        for (byte, damage) in payload[at..].iter_mut().zip(damage.to_be_bytes()) {
            *byte ^= damage;
        }
        if let Ok(read) = Any::decode(sample.type_name(), &payload) {
            prop_assert!(read == sample || !read.is_protected());
        }
    }

    /// No bytes make the decoder panic. What it reads can be written.
    #[test]
    fn any_bytes_are_read_or_refused(
        name in prop::sample::select(&samples::TYPES[..]),
        id in prop::sample::select(&[0_u8, 1, 6, 7][..]),
        body in prop::collection::vec(prop_oneof![Just(0_u8), any::<u8>()], 0..90),
    ) {
        let _ = Any::decode(name, &body);
        let payload = [&[0, id, 0, 0], &body[..]].concat();
        if let Ok(sample) = Any::decode(name, &payload) {
            let written = sample.encode().unwrap();
            prop_assert!(written.len().abs_diff(payload.len()) < 4);
            prop_assert_eq!(Any::decode(name, &written), Ok(sample));
        }
    }
}
