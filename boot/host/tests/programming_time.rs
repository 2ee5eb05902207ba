//! Compares the time of a download on a 500 kbit/s bus with the minimum for its frames.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{factory, image};
use tandem_board::{CanFrame, Instant, SystemId};
use tandem_boot::{Answer, HostRequest, Loader, Next, Slot};
use tandem_boot_host::life::{TEST_KEY_1, TEST_PUBLIC};
use tandem_boot_host::{
    FileSender, FlashTimes, FlashTraits, SigningKey, SimulatedFlash, ToDo, bits, records,
};

const BIT_NS: u64 = 2_000;
/// The time that riscv32 needs for a signature: the tester's, and that of the manifest.
const SIGNATURE_NS: u64 = 38_000_000;
/// The time that a PC needs between an answer and its next frame.
const HOST_NS: u64 = 50_000;

struct Measured {
    total_ns: u64,
    bus_ns: u64,
    flash_ns: u64,
}

/// Sends 96 KiB over a simulated bus, as a tester that proves its key.
fn measure(window: u8, host_ns: u64, flash_takes_time: bool) -> Measured {
    let times = match flash_takes_time {
        true => FlashTimes::AURIX,
        false => FlashTimes::default(),
    };
    let mut flash = factory().with_traits(FlashTraits {
        times,
        ..FlashTraits::default()
    });
    let new = image(Slot::B, 2, 96 * 1024);
    let host = FileSender::new(records("new", &[&new]), None, window);
    let tester = SigningKey {
        number: 0,
        ..TEST_KEY_1
    };
    let mut host = host.proving(SystemId::A, tester);
    let (keys, testers) = ([TEST_PUBLIC], [TEST_KEY_1.public()]);
    let mut setup = fixture::setup(&keys);
    setup.trust.testers = &testers;
    let mut measured = Measured {
        total_ns: 0,
        bus_ns: 0,
        flash_ns: 0,
    };
    // The manifest's signature.
    let mut now = Instant::from_ns(SIGNATURE_NS);
    let mut loader = Loader::start(&mut flash, setup, now);
    let busy = |loader: &Loader<'_, &mut SimulatedFlash>| loader.flash().busy();
    let erased = |loader: &Loader<'_, &mut SimulatedFlash>| loader.flash().work().0;
    let mut done = (busy(&loader), erased(&loader));
    let mut send = |now: &mut Instant, frame: &CanFrame| {
        let span = u64::from(bits(frame)) * BIT_NS;
        measured.bus_ns += span;
        *now = Instant::from_ns(now.as_ns() + span);
    };
    loop {
        match loader.next(now) {
            Next::Send(frame) => {
                send(&mut now, &frame);
                now = Instant::from_ns(now.as_ns() + host_ns);
                host.on_frame(now, &frame);
                if Answer::decode(frame.data()) == Some(Answer::Proved) {
                    now = Instant::from_ns(now.as_ns() + SIGNATURE_NS);
                }
                continue;
            }
            Next::Wait(_) => {}
            next => panic!("{next:?}"),
        }
        match host.next(now) {
            ToDo::Send(frame) => {
                send(&mut now, &frame);
                loader.on_frame(now, &frame);
                let span = (busy(&loader) - done.0).as_ns();
                let erase_ns = times.erase.as_ns() * ((erased(&loader) - done.1) / 0x4000);
                done = (busy(&loader), erased(&loader));
                measured.flash_ns += span;
                // With a window, frames are sent while the flash programs, not while it erases.
                now = Instant::from_ns(now.as_ns() + if window > 0 { erase_ns } else { span });
            }
            ToDo::Done => break,
            ToDo::Wait(until) => now = until,
            other => panic!("{other:?}"),
        }
    }
    measured.total_ns = now.as_ns();
    measured
}

/// T-BOOT-3: a download without a window, with the proof of the tester, takes at most 5 % longer
/// than the frames of its file. Their time is
/// computed to the bit from the file alone: the frames of each record and its acknowledgement. Also
/// prints the extra time of a flash that erases 256 KiB in a second.
#[test]
fn stop_and_wait_is_within_5_percent_of_the_bus() {
    let [measured, slow] = [false, true].map(|flash| measure(0, 0, flash));
    let lines = records("new", &[&image(Slot::B, 2, 96 * 1024)]);
    let accepted = tandem_boot::Answer::Accepted { records: 0 }
        .frame()
        .unwrap();
    let frames = lines.iter().flat_map(|line| line.as_bytes().chunks(8));
    let record_bits: u64 = frames
        .map(|piece| u64::from(bits(&HostRequest::Data(piece).frame().unwrap())))
        .sum();
    let limit_ns = (record_bits + lines.len() as u64 * u64::from(bits(&accepted))) * BIT_NS;
    let ratio = measured.total_ns as f64 / limit_ns as f64;
    println!(
        "96 KiB: limit {:.2} s, took {:.2} s ({ratio:.4}), and {:.2} s more of flash",
        limit_ns as f64 / 1e9,
        measured.total_ns as f64 / 1e9,
        slow.flash_ns as f64 / 1e9,
    );
    assert!((1.0..1.05).contains(&ratio), "{ratio}");
    assert!(measured.bus_ns >= limit_ns);
}

/// T-BOOT-3: how much faster a window of 16 is than stop-and-wait, with a host that needs 50 µs
/// between frames and with one that needs 1 ms because of its USB adapter.
#[test]
fn a_window_saves_time() {
    for (host_ns, at_least) in [(HOST_NS, 1.10), (1_000_000, 1.4)] {
        let [slow, fast] = [0, 16].map(|window| measure(window, host_ns, true).total_ns as f64);
        println!(
            "host {host_ns} ns: {:.2} s, with a window {:.2} s",
            slow / 1e9,
            fast / 1e9
        );
        assert!(slow / fast > at_least, "{}", slow / fast);
    }
}
