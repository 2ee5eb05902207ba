//! The candump log format, written and read.

use proptest::prelude::*;
use tandem_bus::candump::{BIT_RATE_SWITCH, Id, ParseError, Record, TooLong};

#[test]
fn writes_what_candump_writes() {
    let fd = Record::new(
        "vcan0",
        Id::Standard(0x0A0),
        Some(BIT_RATE_SWITCH),
        &[0x1A, 0x2B, 0xC3],
    );
    let line = fd.unwrap().at_us(1_436_509_052_249_713).to_string();
    assert_eq!(line, "(1436509052.249713) vcan0 0A0##11A2BC3");

    let classic = Record::new("can1", Id::Extended(0x0CFF_0127), None, &[0xE2, 0x30]).unwrap();
    assert_eq!(
        classic.at_us(12_000_345).to_string(),
        "(0000000012.000345) can1 0CFF0127#E230"
    );
}

#[test]
fn reads_what_candump_writes() {
    let record = Record::parse("(1436509052.249713) vcan0 044#2a366c2bba\n").unwrap();
    assert_eq!((record.seconds, record.micros), (1_436_509_052, 249_713));
    assert_eq!(record.interface, "vcan0");
    assert_eq!(record.id, Id::Standard(0x44));
    assert_eq!(record.fd_flags, None);
    assert_eq!(record.data(), [0x2A, 0x36, 0x6C, 0x2B, 0xBA]);

    // With the direction that `candump -x` adds.
    let record = Record::parse(" (0.000001) can0 1FFFFFFF##7 T").unwrap();
    assert_eq!(record.id, Id::Extended(0x1FFF_FFFF));
    assert_eq!(record.fd_flags, Some(7));
    assert_eq!(record.data(), []);
}

#[test]
fn says_which_part_of_a_line_is_wrong() {
    use ParseError::{Data, Id, Interface, Remote, Timestamp, Trailing};
    for (line, error) in [
        ("", Timestamp),
        ("1.000000 vcan0 123#00", Timestamp),
        ("(1) vcan0 123#00", Timestamp),
        ("(1.5) vcan0 123#00", Timestamp),
        ("(.000000) vcan0 123#00", Timestamp),
        ("(1.+00000) vcan0 123#00", Timestamp),
        ("(99999999999999999999.000000) vcan0 123#00", Timestamp),
        ("(1.000000)", Interface),
        ("(1.000000) vcan0", Id),
        ("(1.000000) vcan0 12300", Id),
        ("(1.000000) vcan0 12#00", Id),
        ("(1.000000) vcan0 +12#00", Id),
        ("(1.000000) vcan0 800#00", Id),
        ("(1.000000) vcan0 20000000#00", Id),
        ("(1.000000) vcan0 123#0", Data),
        ("(1.000000) vcan0 123#0é", Data),
        ("(1.000000) vcan0 123#+1", Data),
        ("(1.000000) vcan0 123##", Data),
        ("(1.000000) vcan0 123##g00", Data),
        ("(1.000000) vcan0 123##é00", Data),
        ("(1.000000) vcan0 123#001122334455667788", Data),
        ("(1.000000) vcan0 123#R", Remote),
        ("(1.000000) vcan0 123#R8", Remote),
        ("(1.000000) vcan0 123#00 X", Trailing),
        ("(1.000000) vcan0 123#00 R T", Trailing),
    ] {
        assert_eq!(Record::parse(line), Err(error), "{line}");
    }
}

#[test]
fn a_frame_carries_8_bytes_or_64() {
    let id = Id::Standard(1);
    assert!(Record::new("c", id, None, &[0; 8]).is_ok());
    assert_eq!(Record::new("c", id, None, &[0; 9]), Err(TooLong));
    assert!(Record::new("c", id, Some(0), &[0; 64]).is_ok());
    assert_eq!(Record::new("c", id, Some(0), &[0; 65]), Err(TooLong));
}

proptest! {
    #[test]
    fn every_record_comes_back(
        us in 0..u64::MAX,
        interface in "[a-z]{1,8}[0-9]{0,2}",
        id in prop_oneof![
            (0..=0x7FF_u16).prop_map(Id::Standard),
            (0..=0x1FFF_FFFF_u32).prop_map(Id::Extended),
        ],
        fd_flags in prop::option::of(0..=0xF_u8),
        data in prop::collection::vec(any::<u8>(), 0..=64),
    ) {
        let data = if fd_flags.is_some() { &data[..] } else { &data[..data.len().min(8)] };
        let record = Record::new(&interface, id, fd_flags, data).unwrap().at_us(us);
        let line = record.to_string();
        prop_assert_eq!(Record::parse(&line), Ok(record));
    }

    #[test]
    fn any_text_is_read_without_a_panic(text: String) {
        let _ = Record::parse(&text);
    }

    #[test]
    fn text_like_a_line_is_read_without_a_panic(
        text in r"\(?[0-9]{0,22}\.?[0-9]{0,8}\)? [a-z]{0,3} [0-9A-Fa-fé]{0,9}#{0,3}[0-9A-Fé]{0,140}"
    ) {
        let _ = Record::parse(&text);
    }
}
