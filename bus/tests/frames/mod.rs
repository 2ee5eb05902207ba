//! Generates any message with any values that the DBC allows, so that new frames are tested too.
#![allow(dead_code, reason = "each test uses a part")]

use std::sync::LazyLock;

use can_dbc::{ByteOrder, Dbc, MessageId, NumericValue, Signal};
use proptest::prelude::*;
use tandem_bus::{FRAMES, FrameInfo, Message};

pub(crate) fn dbc() -> &'static Dbc {
    static DBC: LazyLock<Dbc> =
        LazyLock::new(|| Dbc::try_from(include_str!("../../dbc/tandem.dbc")).unwrap());
    &DBC
}

pub(crate) fn number(value: NumericValue) -> f64 {
    value.to_string().parse().unwrap()
}

/// Returns the signals of a frame, without the end-to-end protection.
pub(crate) fn signals(id: u16) -> impl Iterator<Item = &'static Signal> {
    let messages = &dbc().messages;
    let message = messages.iter().find(|it| it.id == MessageId::Standard(id));
    let signals = message.unwrap().signals.iter();
    signals.filter(|signal| !["Crc", "Counter"].contains(&&*signal.name))
}

/// Returns the raw value that `seed` chooses among those that the DBC allows.
fn raw(frame: &FrameInfo, signal: &Signal, seed: u64) -> i64 {
    if signal.name == "System" {
        return i64::from(frame.name.ends_with('B'));
    }
    let id = MessageId::Standard(frame.id);
    if let Some(table) = dbc().value_descriptions_for_signal(id, &signal.name) {
        return table[seed as usize % table.len()].id;
    }
    let limit = |value| (number(value) / signal.factor).round() as i64;
    let (min, max) = (limit(signal.min), limit(signal.max));
    // Test the limits more often than other values: errors are most likely there.
    match seed % 8 {
        0 => min,
        1 => max,
        _ => min + (seed / 8).wrapping_rem((max - min + 1) as u64) as i64,
    }
}

/// Packs a message bit by bit, decodes it, and asserts that its values are unchanged.
fn packed(frame: &FrameInfo, seeds: &[u64]) -> Message {
    let mut data = vec![0; frame.len];
    for (signal, seed) in signals(frame.id).zip(seeds) {
        let raw = raw(frame, signal, *seed);
        for bit in 0..signal.size as usize {
            let (start, size) = (signal.start_bit as usize, signal.size as usize);
            let at = match signal.byte_order {
                ByteOrder::LittleEndian => start + bit,
                // Whole bytes, the lowest of which is the last.
                ByteOrder::BigEndian => 8 * (start / 8 + size / 8 - 1 - bit / 8) + bit % 8,
            };
            data[at / 8] |= ((raw >> bit & 1) as u8) << (at % 8);
        }
    }
    let message = Message::decode(u32::from(frame.id), &data).unwrap();
    let values = values(&message);
    for (signal, seed) in signals(frame.id).zip(seeds) {
        let sent = raw(frame, signal, *seed) as f64 * signal.factor;
        let (_, read) = values
            .iter()
            .find(|(name, _)| *name == signal.name)
            .unwrap();
        let tolerance = 1e-6 * sent.abs();
        assert!(
            (read - sent).abs() <= tolerance,
            "{}: {sent} is read as {read}",
            signal.name
        );
    }
    message
}

/// Generates any message. Its values are packed by an independent reader of the DBC.
pub(crate) fn message() -> impl Strategy<Value = Message> {
    let frame = prop::sample::select(FRAMES.as_slice());
    // No frame has more signals.
    let seeds = prop::collection::vec(any::<u64>(), 32);
    (frame, seeds).prop_map(|(frame, seeds)| packed(&frame, &seeds))
}

/// Returns a message's physical values by their DBC names; enums and flags as numbers.
pub(crate) fn values(message: &Message) -> Vec<(&'static str, f64)> {
    let mut values = Vec::new();
    message.values(|name, value| values.push((name, value)));
    values
}
