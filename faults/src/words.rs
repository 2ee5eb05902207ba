//! The words that a fault file uses for the types of the board.

/// A wire, written as its name.
pub(crate) mod wire {
    use serde::{Deserialize, Deserializer, Serializer, de::Error as _};
    use tandem_peripherals::network::Wire;

    pub(crate) fn serialize<S: Serializer>(wire: &Wire, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(wire.name())
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Wire, D::Error> {
        let given = String::deserialize(from)?;
        let wire = Wire::ALL.into_iter().find(|wire| wire.name() == given);
        wire.ok_or_else(|| D::Error::custom(format!("there is no wire `{given}`")))
    }
}

/// A time in milliseconds, to the nearest nanosecond.
pub(crate) mod ms {
    use serde::{Deserialize, Deserializer, Serializer, de::Error as _};
    use tandem_board::Duration;

    /// The longest time in a file: ten minutes.
    const LONGEST_MS: f64 = 600_000.0;

    pub(crate) fn serialize<S: Serializer>(time: &Duration, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_f64(time.as_ms_f64())
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Duration, D::Error> {
        let ms = f64::deserialize(from)?;
        if !(0.0..=LONGEST_MS).contains(&ms) {
            return Err(D::Error::custom(format!(
                "{ms} ms: times are 0 to {LONGEST_MS} ms"
            )));
        }
        Ok(Duration::from_ns((ms * 1e6).round() as u64))
    }
}

/// A time in milliseconds for a key that may be absent.
pub(crate) mod ms_or_none {
    use serde::{Deserializer, Serializer};
    use tandem_board::Duration;

    pub(crate) fn serialize<S: Serializer>(
        time: &Option<Duration>,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        match time {
            Some(time) => super::ms::serialize(time, to),
            None => to.serialize_none(),
        }
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        from: D,
    ) -> Result<Option<Duration>, D::Error> {
        super::ms::deserialize(from).map(Some)
    }
}
