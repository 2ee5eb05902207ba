//! Numbers of a fault file, checked against their range.

use serde::{Deserialize, Deserializer, Serialize, de::Error as _};
use std::fmt;
use tandem_board::{CoreId, Duration};

/// A number from `LEAST` to `MOST`, the value of the key `amount`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Amount<const LEAST: i32, const MOST: i32> {
    amount: i32,
}

/// The number as written in a file.
#[derive(Deserialize)]
struct Unchecked {
    amount: i64,
}

/// A number, its range and its unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Given {
    /// The number.
    pub number: i32,
    /// The smallest permitted number.
    pub least: i32,
    /// The largest permitted number.
    pub most: i32,
    /// The unit.
    pub unit: &'static str,
}

impl fmt::Display for Given {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} to {} ({})", self.least, self.most, self.unit)
    }
}

/// Returns this number as an amount.
///
/// # Panics
/// If it is out of range.
#[must_use]
pub const fn just<const LEAST: i32, const MOST: i32>(number: i32) -> Amount<LEAST, MOST> {
    assert!(LEAST <= number && number <= MOST, "out of range");
    Amount { amount: number }
}

impl<const LEAST: i32, const MOST: i32> Amount<LEAST, MOST> {
    /// Returns the number.
    #[must_use]
    pub const fn get(self) -> i32 {
        self.amount
    }

    /// Returns a duration of this number of milliseconds.
    #[must_use]
    pub const fn ms(self) -> Duration {
        Duration::from_ms(self.amount.unsigned_abs() as u64)
    }

    /// Returns a duration of this number of microseconds.
    #[must_use]
    pub const fn us(self) -> Duration {
        Duration::from_us(self.amount.unsigned_abs() as u64)
    }

    /// Returns the number with its range, in this unit.
    pub(crate) const fn given(self, unit: &'static str) -> Given {
        Given {
            number: self.amount,
            least: LEAST,
            most: MOST,
            unit,
        }
    }
}

impl Amount<0, 2> {
    /// Returns the core with this number.
    #[must_use]
    pub const fn core(self) -> CoreId {
        CoreId::ALL[self.amount as usize]
    }
}

impl<'de, const LEAST: i32, const MOST: i32> Deserialize<'de> for Amount<LEAST, MOST> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        let number = i32::try_from(Unchecked::deserialize(from)?.amount).ok();
        let number = number.filter(|number| (LEAST..=MOST).contains(number));
        let amount = number.ok_or_else(|| D::Error::custom("`amount` is out of range"))?;
        Ok(Self { amount })
    }
}
