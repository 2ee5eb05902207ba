//! Two cores that hand over values: each is a thread here.
//! `cargo run -p tandem-shm --example two_cores`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::error::Error;
use std::sync::atomic::AtomicU32;
use std::thread;

use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Ring, TaskId};
use tandem_shm::map::Map;
use tandem_shm::region::{Mailbox, Newest, Region};

const NEWS: Region<Mailbox> = Region::first("news");
const SPEED: Region<Newest<u32>> = NEWS.then("speed");
const LAST: u32 = 5;

/// The shared memory begins on a cache line. On a chip, the linker places it.
#[repr(align(64))]
struct Lmu([AtomicU32; 512]);
static LMU: Lmu = Lmu([const { AtomicU32::new(0) }; 512]);

fn main() -> Result<(), Box<dyn Error>> {
    let map = Map::format(&LMU.0, SPEED.end())?;
    let sender = Incarnation::new(0, 1).ok_or("no core 0")?;
    let receiver = Incarnation::new(1, 1).ok_or("no core 1")?;
    for core in [sender, receiver] {
        map.incarnations().announce(core)?;
    }
    let (mut writer, mut to) = (SPEED.writer(&map, sender)?, NEWS.sender(&map, sender)?);
    let (mut reader, mut from) = (SPEED.reader(&map)?, NEWS.receiver(&map, receiver)?);
    let receiver = thread::spawn(move || {
        let mut last = 0;
        while last < LAST {
            from.poll(|_signals| {
                if let Ok(Some(speed)) = reader.fetch() {
                    println!("core 1: {speed} m/s");
                    last = speed;
                }
            });
            thread::yield_now();
        }
    });
    for speed in 1..=LAST {
        writer.publish(&speed);
        // A receiver that sleeps is woken by its doorbell; this one polls.
        let _: Ring = to.signal(TaskId::FIRST);
        thread::sleep(std::time::Duration::from_millis(20));
    }
    receiver.join().map_err(|_| "core 1 panicked")?;
    Ok(())
}
