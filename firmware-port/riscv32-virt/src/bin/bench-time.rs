//! Counts the instructions that core 0 spends on the time of the vehicle.
//!
//! One hart hears a master whose clock runs 100 ppm faster, through stamps that err by 2 µs at
//! most. Each protocol's sample is counted without the time base, which all of them feed.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use tandem_board::{Duration, Instant, SystemId};
use tandem_board_riscv32_virt::measure::{self, WARM_UP};
use tandem_board_riscv32_virt::{entry, exit, hart, must};
use tandem_timesync::gptp::{
    Claims, EventId, Master, MasterSettings, PortIdentity, PtpProfile, Slave, SlaveSettings,
    TimeOutlet,
};
use tandem_timesync::{
    Arbitrary, BaseConfig, CanTimeCrc, CanTimeMaster, CanTimeSlave, GlobalTime, Heard,
    MasterQuality, PulseMaster, PulseSlave, PulseTransfer, Sample, TimeBase,
};

entry!(main);

const PERIOD: Duration = Duration::from_ms(125);
const BEGIN_NS: u64 = 1_790_000_000_000_000_000;

fn main(hart: usize) -> ! {
    if hart != 0 {
        hart::park();
    }
    base();
    gptp();
    pulse();
    can();
    exit::exit(0)
}

/// Returns what the master's clock shows at a local time.
fn truth(local: Instant) -> GlobalTime<Arbitrary> {
    GlobalTime::from_ns(BEGIN_NS + local.as_ns() + local.as_ns() / 10_000)
}

/// Returns a stamp that errs by 0 to 2 µs, which differs from round to round.
fn stamped(at: Instant, number: u32) -> Instant {
    at + Duration::from_ns((number.wrapping_mul(2_654_435_761) >> 21).into())
}

/// Returns how many instructions a call takes.
fn count(what: impl FnOnce()) -> u32 {
    let begin = hart::cycles();
    what();
    hart::cycles().wrapping_sub(begin)
}

fn base() {
    let mut base = TimeBase::new(BaseConfig::GPTP);
    let mut at = Instant::from_ns(1);
    measure::repeat(
        "time/sample",
        || (),
        |number| {
            at += PERIOD;
            let sample = Sample {
                local: stamped(at, number),
                global: truth(at),
                error: Duration::from_us(10),
            };
            let now = at + Duration::from_ms(10);
            let mut heard = None;
            let took = count(|| {
                heard = Some(base.on_sample(black_box(now), sample, MasterQuality::default()))
            });
            assert!(
                heard == Some(Heard::Followed) || number < WARM_UP,
                "{heard:?}"
            );
            took
        },
    );
    let conversion = must(base.conversion().ok_or(()));
    measure::repeat(
        "time/at",
        || (),
        |number| {
            let local = black_box(at + PERIOD.times(number));
            count(|| _ = black_box(conversion.at(local)))
        },
    );
}

/// The last message that was sent.
struct Cable {
    bytes: [u8; 128],
    len: usize,
    event: Option<EventId>,
}

impl TimeOutlet for Cable {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        for (to, from) in self.bytes.iter_mut().zip(message) {
            *to = *from;
        }
        (self.len, self.event) = (message.len(), event);
    }
}

impl Cable {
    const fn new() -> Self {
        Self {
            bytes: [0; 128],
            len: 0,
            event: None,
        }
    }

    fn message(&self) -> &[u8] {
        self.bytes.get(..self.len).unwrap_or_default()
    }
}

/// Sync and Follow_Up with the end-to-end delay, which is asked for once a second.
fn gptp() {
    let profile = PtpProfile::END_TO_END;
    let mut master = Master::<Arbitrary>::new(MasterSettings {
        identity: PortIdentity::from_mac([2, 0, 0, 0, 0, 1]),
        profile,
        claims: Claims::default(),
        sync_exponent: -3,
    });
    let port = PortIdentity::from_mac([2, 0, 0, 0, 0, 2]);
    let mut slave = Slave::<Arbitrary>::new(SlaveSettings {
        // The cable keeps one message: the Sync, not the Announce before it.
        unannounced: Some(Claims::default()),
        ..SlaveSettings::new(port, profile)
    });
    let (mut down, mut up) = (Cable::new(), Cable::new());
    let (wire, turn) = (Duration::from_us(5), Duration::from_ms(20));
    let time = |at| Some(truth(at));
    let mut at = Instant::from_ns(1);
    measure::repeat(
        "time/gptp",
        || (),
        |number| {
            at += PERIOD;
            master.poll(at, time, &mut down);
            let arrives = black_box(stamped(at + wire, number));
            let mut sample = None;
            let mut took = count(|| _ = slave.on_message(arrives, down.message(), &mut up));
            if let Some(event) = down.event {
                master.on_sent(event, at, time, &mut down);
            }
            took += count(|| sample = slave.on_message(arrives, down.message(), &mut up));
            assert!(sample.is_some() || number < WARM_UP, "{:?}", slave.status());
            slave.poll(at + turn, &mut up);
            if let Some(event) = up.event.take() {
                slave.on_sent(event, at + turn, &mut up);
                master.on_message(at + turn + wire, up.message(), time, &mut down);
                let _sample = slave.on_message(at + turn + wire + wire, down.message(), &mut up);
            }
            took
        },
    );
}

/// The edge and its transfer, at the standby.
fn pulse() {
    let mut master = PulseMaster::new(Instant::from_ns(1));
    let mut slave = PulseSlave::<Arbitrary>::default();
    measure::repeat(
        "time/pulse",
        || (),
        |number| {
            let before = master.due();
            let raised = master.raised(before, before + Duration::from_ns(200), truth(before));
            let words = black_box(must(raised.ok_or(())).to_words());
            let edge = black_box(Some((number, stamped(before, number))));
            let now = black_box(before + Duration::from_ms(1));
            let mut heard = Ok(None);
            let took = count(|| {
                let transfer = PulseTransfer::from_words(&words);
                slave.on_transfer(now, must(transfer.ok_or(())));
                heard = slave.poll(now, edge);
            });
            assert!(
                matches!(heard, Ok(Some(_))) || number < WARM_UP,
                "{heard:?}"
            );
            took
        },
    );
}

/// SYNC and FUP on CAN, at a sensor.
fn can() {
    let mut master = CanTimeMaster::new(SystemId::A, true, Instant::from_ns(1));
    let mut slave = CanTimeSlave::<Arbitrary>::new(CanTimeCrc::Validated);
    measure::repeat(
        "time/can",
        || (),
        |number| {
            let sent = master.due();
            let sync = black_box(must(master.poll(sent, truth(sent)).ok_or(())));
            master.on_sent(sent, truth(sent), false);
            let due = master.due();
            let follow_up = black_box(must(master.poll(due, truth(due)).ok_or(())));
            let arrives = black_box(stamped(sent, number));
            let mut heard = Ok(None);
            let took = count(|| {
                let _waits = slave.receive(SystemId::A, arrives, &sync);
                heard = slave.receive(SystemId::A, due, &follow_up);
            });
            assert!(
                matches!(heard, Ok(Some(_))) || number < WARM_UP,
                "{heard:?}"
            );
            took
        },
    );
}
