//! All of `tandem-timesync` that a controller and its sensors use: time base and readers, a slave
//! of gPTP, both ends of the pulse and of the frames on CAN. Its state counts as RAM.
#![no_std]
#![no_main]
#![deny(unsafe_code)]

use core::hint::black_box;
use core::sync::atomic::AtomicU8;
use tandem_board::{Duration, Instant, SystemId};
use tandem_board_riscv32_virt::{clint, entry, hart};
use tandem_timesync::gptp::{EventId, PortIdentity, PtpProfile, Slave, SlaveSettings, TimeOutlet};
use tandem_timesync::{
    Arbitrary, BaseConfig, CanTimeCrc, CanTimeMaster, CanTimeSlave, Conversion, GlobalTime,
    MasterQuality, PULSE_WORDS, PulseMaster, PulseSlave, PulseTransfer, Sample, TimeBase,
    TimeReader,
};

entry!(main);

struct Time {
    base: TimeBase<Arbitrary>,
    reader: TimeReader<Arbitrary>,
    gptp: Slave<Arbitrary>,
    pulses: (PulseMaster, PulseSlave<Arbitrary>),
    frames: (CanTimeMaster, CanTimeSlave<Arbitrary>),
}

/// As large as the parts, which lie on the stack.
#[used]
static STATE: [AtomicU8; size_of::<Time>()] = [const { AtomicU8::new(0) }; size_of::<Time>()];

struct Port;

impl TimeOutlet for Port {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        black_box((message, event));
    }
}

impl Time {
    fn follow(&mut self, now: Instant, sample: Sample<Arbitrary>, error: Duration) {
        let quality = MasterQuality {
            error,
            to_gateway: black_box(false),
        };
        black_box(self.base.on_sample(now, sample, quality));
    }

    fn hear_gptp(&mut self, now: Instant, event: Option<EventId>, message: &[u8]) {
        self.gptp.poll(now, &mut Port);
        if let Some(event) = event {
            self.gptp.on_sent(event, now, &mut Port);
        }
        if let Some(sample) = self.gptp.on_message(now, message, &mut Port) {
            self.follow(now, sample, Duration::ZERO);
        }
        black_box(self.gptp.status());
    }

    fn hear_pulse(&mut self, now: Instant, words: &[u32], edge: Option<(u32, Instant)>) {
        let (_, slave) = &mut self.pulses;
        if let Some(transfer) = PulseTransfer::from_words(words) {
            slave.on_transfer(now, transfer);
        }
        match slave.poll(now, edge) {
            Ok(Some(pulse)) => self.follow(now, pulse.sample, pulse.transfer.master_error),
            other => drop(black_box(other)),
        }
    }

    fn hear_frame(&mut self, at: Instant, from: SystemId, frame: &[u8]) {
        let (_, slave) = &mut self.frames;
        match slave.receive(from, at, frame) {
            Ok(Some(time)) => self.follow(at, time.sample, time.sample.error),
            other => drop(black_box(other)),
        }
    }

    fn tell(&mut self, now: Instant, conversion: Conversion<Arbitrary>) {
        let words = black_box(conversion.to_words());
        let Some(conversion) = Conversion::from_words(words) else {
            return;
        };
        black_box(self.reader.read(&conversion, now));
        let time = conversion.at(now);
        black_box(conversion.local_of(black_box(time)));
        black_box(conversion.rate_ppb());
        let ((pulses, _), (frames, _)) = (&mut self.pulses, &mut self.frames);
        if let Some(transfer) = pulses.raised(now, black_box(now), time) {
            black_box(transfer.to_words());
        }
        black_box(frames.poll(now, time));
        frames.on_sent(black_box(now), time, black_box(false));
        black_box((pulses.due(), frames.due()));
    }
}

fn main(_: usize) -> ! {
    let port = PortIdentity::from_mac(black_box([2, 0, 0, 0, 0, 1]));
    let profile = black_box(PtpProfile::END_TO_END);
    let now = black_box(Instant::ORIGIN);
    let mut time = Time {
        base: TimeBase::new(BaseConfig::PULSE),
        reader: TimeReader::default(),
        gptp: Slave::new(SlaveSettings::new(port, profile)),
        pulses: (PulseMaster::new(now), PulseSlave::default()),
        frames: (
            CanTimeMaster::new(SystemId::A, black_box(true), now),
            CanTimeSlave::new(black_box(CanTimeCrc::Validated)),
        ),
    };
    loop {
        let now = black_box(now);
        let message: &[u8] = black_box(&[0; 76]);
        time.hear_gptp(now, EventId::of(message), message);
        let words: &[u32] = black_box(&[0; PULSE_WORDS]);
        time.hear_pulse(now, words, black_box(Some((0, now))));
        let frame: &[u8] = black_box(&[0; 8]);
        time.hear_frame(now, black_box(SystemId::B), frame);
        if let Some(conversion) = time.base.conversion() {
            time.tell(now, conversion);
        }
        time.base.set_free(now, GlobalTime::from_ns(now.as_ns()));
        clint::post(0);
        hart::sleep();
    }
}
