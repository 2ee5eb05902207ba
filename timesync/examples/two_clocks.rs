//! A slave learns the time of a master over CAN; its own clock is fast by 50 ppm.
//! `cargo run -p tandem-timesync --example two_clocks`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_board::{Instant, SystemId};
use tandem_timesync::{
    BaseConfig, CanTimeCrc, CanTimeMaster, CanTimeSlave, GlobalTime, MasterQuality, Tai, TimeBase,
};

/// What the slave's clock shows at a time of the master: it began 3 s earlier.
fn slave_clock(master_ns: u64) -> Instant {
    Instant::from_ns(3_000_000_000 + master_ns + master_ns / 20_000)
}

fn main() {
    let system = SystemId::A;
    let mut master = CanTimeMaster::new(system, true, Instant::ORIGIN);
    let mut slave = CanTimeSlave::<Tai>::new(CanTimeCrc::Validated);
    let mut base = TimeBase::new(BaseConfig::CAN);
    for ms in 0..20_000 {
        let ns = ms * 1_000_000;
        let (now, time) = (Instant::from_ns(ns), GlobalTime::<Tai>::from_ns(ns));
        let Some(frame) = master.poll(now, time) else {
            continue;
        };
        // A controller stamps the frame when it is on the bus, in the sender and in the receiver.
        master.on_sent(now, time, false);
        let at = slave_clock(ns);
        if let Ok(Some(heard)) = slave.receive(system, at, &frame) {
            base.on_sample(at, heard.sample, MasterQuality::default());
        }
    }
    let local = slave_clock(20_000_000_000);
    let Some(conversion) = base.conversion() else {
        panic!("the samples do not agree");
    };
    let reading = conversion.reading(local);
    let off_ns = reading.time.after(GlobalTime::from_ns(20_000_000_000));
    println!("off by {off_ns} ns, said to be within {:?}", reading.error);
    println!(
        "the master's clock is slower: {} ppb",
        conversion.rate_ppb()
    );
    assert!(reading.status.is_synchronised());
    assert!(off_ns.unsigned_abs() <= reading.error.as_ns());
    assert!((-50_100..=-49_900).contains(&conversion.rate_ppb()));
}
