//! A counter in hardware that only rises, against old firmware with a valid signature. E-4

/// A counter that only rises, also without power, and that no write of the program flash changes: a
/// hardware counter or one-time programmable words. A board without one uses [`NoCounter`].
pub trait MonotonicCounter {
    /// Returns its value. Task context.
    fn value(&mut self) -> u32;

    /// Raises it to `to` if it is lower. Task context; may block. After a loss of power in
    /// this time it has any value from the old one to `to`. Returns whether it is at least `to`.
    fn raise(&mut self, to: u32) -> bool;
}

/// No counter: always 0.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoCounter;

impl MonotonicCounter for NoCounter {
    fn value(&mut self) -> u32 {
        0
    }

    fn raise(&mut self, to: u32) -> bool {
        to == 0
    }
}
