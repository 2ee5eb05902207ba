//! Measures the cost of a path: repeats it, and prints the lowest and highest instruction count.

use crate::log;

/// Number of rounds that count.
pub const ROUNDS: u32 = 1000;
/// Number of rounds before the first one that counts.
pub const WARM_UP: u32 = 5;

/// Repeats `prepare` and `round`, which returns its number of instructions. Prints the lowest and
/// the highest count: `bench NAME MIN MAX`.
pub fn repeat(name: &str, prepare: impl Fn(), mut round: impl FnMut(u32) -> u32) {
    let (mut min, mut max) = (u32::MAX, 0);
    for number in 0..WARM_UP + ROUNDS {
        prepare();
        let took = round(number);
        if number >= WARM_UP {
            min = min.min(took);
            max = max.max(took);
        }
    }
    log!("bench {name} {min} {max}");
}
