//! The sample that all peers exchange: a CAN FD frame whose content follows from its number.

/// Name of the topic.
pub(crate) const TOPIC: &str = "vehicle/can";
/// Name of its type.
pub(crate) const TYPE: &str = "tandem::CanFrame";
/// Bytes of data in a frame.
pub(crate) const DATA: usize = 64;
/// The period that each frame states, ms.
pub(crate) const PERIOD_MS: u16 = 10;

/// Returns the data of the frame of this number.
pub(crate) fn data(number: u32) -> [u8; DATA] {
    std::array::from_fn(|index| (number as usize + index) as u8)
}

/// Returns the payload of the frame of this number: XCDR1, little-endian.
pub(crate) fn encode(number: u32) -> Vec<u8> {
    let mut payload = vec![0, 1, 0, 0];
    payload.extend(number.to_le_bytes());
    payload.extend(PERIOD_MS.to_le_bytes());
    payload.push(DATA as u8);
    payload.extend(data(number));
    payload
}

/// Returns the number of the frame in a payload. Up to three bytes of padding may follow the frame.
///
/// # Panics
///
/// If the payload is not the frame of its number.
pub(crate) fn decode(payload: &[u8]) -> u32 {
    let number = u32::from_le_bytes(payload[4..8].try_into().unwrap());
    let expected = encode(number);
    // XCDR1 or XCDR2, which are the same for this type. The last two bits state the padding.
    let is_little = matches!(payload[..2], [0, 1] | [0, 7]);
    let body = &payload[4..expected.len().min(payload.len())];
    let is_padded = payload.len() - 4 - body.len() < 4;
    assert!(
        is_little && body == &expected[4..] && is_padded,
        "{payload:?}"
    );
    number
}
