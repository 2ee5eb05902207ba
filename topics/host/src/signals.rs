//! Values of the bus with names, units and words, as the DBC has them.

use std::collections::BTreeMap;

use tandem_bus::{DBC, Message};

/// What the DBC says of the signals: of a frame's id and a signal's name.
#[derive(Clone, Debug, Default)]
pub struct SignalTable {
    units: BTreeMap<(u16, &'static str), &'static str>,
    words: BTreeMap<(u16, &'static str), BTreeMap<i64, &'static str>>,
}

/// A signal with its value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SignalValue {
    /// Name in the DBC.
    pub name: &'static str,
    /// Physical value.
    pub value: f64,
    /// Its unit; empty if it has none.
    pub unit: &'static str,
    /// The word that the DBC has for the value.
    pub word: Option<&'static str>,
}

impl SignalTable {
    /// Reads the DBC of the vehicle bus.
    pub fn new() -> Self {
        let mut signals = Self::default();
        let mut id = 0;
        for line in DBC.lines() {
            let mut words = line.split_whitespace();
            match (words.next(), words.next()) {
                (Some("BO_"), Some(number)) => id = number.parse().unwrap_or(0),
                (Some("SG_"), Some(name)) => {
                    // The unit is the only quoted text of such a line.
                    let unit = line.split('"').nth(1).unwrap_or_default();
                    signals.units.insert((id, name), unit);
                }
                (Some("VAL_"), Some(number)) => {
                    let (Ok(id), Some(name)) = (number.parse(), words.next()) else {
                        continue;
                    };
                    signals.words.insert((id, name), value_table(line));
                }
                _ => {}
            }
        }
        signals
    }

    /// Returns the signals of a message, without its protection.
    pub fn of(&self, message: &Message) -> Vec<SignalValue> {
        let id = message.id();
        let mut values = Vec::new();
        message.values(|name, value| {
            let words = self.words.get(&(id, name));
            values.push(SignalValue {
                name,
                value,
                unit: self.units.get(&(id, name)).copied().unwrap_or_default(),
                word: words.and_then(|words| words.get(&(value as i64)).copied()),
            });
        });
        values
    }
}

/// Returns the words of a line such as `VAL_ 160 Role 0 "Starting" 1 "Master" ;`.
fn value_table(line: &'static str) -> BTreeMap<i64, &'static str> {
    let mut parts = line.split('"');
    let mut words = BTreeMap::new();
    while let (Some(before), Some(word)) = (parts.next(), parts.next()) {
        let number = before.split_whitespace().next_back();
        if let Some(number) = number.and_then(|number| number.parse().ok()) {
            words.insert(number, word);
        }
    }
    words
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_bus::{EgoMotion, FRAMES, GearCode};

    #[test]
    fn values_have_the_units_and_words_of_the_dbc() {
        let motion = EgoMotion {
            speed: 1.5,
            gear: GearCode::Park,
            ..EgoMotion::default()
        };
        let signals = SignalTable::new();
        let values = signals.of(&Message::EgoMotion(motion));
        let of = |name| *values.iter().find(|value| value.name == name).unwrap();
        assert_eq!((of("Speed").value, of("Speed").unit), (1.5, "m/s"));
        assert_eq!((of("Gear").word, of("Gear").unit), (Some("Park"), ""));
        assert_eq!(of("Speed").word, None);
        let ids: Vec<_> = signals.units.keys().map(|(id, _)| *id).collect();
        assert!(FRAMES.iter().all(|frame| ids.contains(&frame.id)));
    }
}
