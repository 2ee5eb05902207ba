//! A supply watches a core: services in the window are accepted, an early one and silence are not.
//! `cargo run -p tandem-peripherals --example watchdog`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_board::{Duration, Instant, watchdog_answer};
use tandem_peripherals::watchdog::{Watchdog, WatchdogFault, Window};

fn main() {
    let mut watchdog = Watchdog::new(Window::TARGET, Instant::ORIGIN);
    let ms = |ms| Instant::ORIGIN + Duration::from_ms(ms);
    // Each 10 ms, as a control cycle would.
    for cycle in 1..=5 {
        let answer = watchdog_answer(watchdog.question());
        let now = ms(10 * cycle);
        assert_eq!(watchdog.service(now, now, Some(answer)), Ok(()));
        println!(
            "{now:?}: in time; the next one until {:?}",
            watchdog.closes()
        );
    }
    let answer = watchdog_answer(watchdog.question());
    let early = watchdog.service(ms(52), ms(52), Some(answer));
    assert_eq!(early, Err(WatchdogFault::Early));
    let wrong = watchdog.service(ms(60), ms(60), Some(answer ^ 1));
    assert_eq!(wrong, Err(WatchdogFault::WrongAnswer));
    let silent = watchdog.check(ms(71));
    assert_eq!(silent, Err(WatchdogFault::Late));
    println!("after that: {early:?}, {wrong:?}, {silent:?}");
}
