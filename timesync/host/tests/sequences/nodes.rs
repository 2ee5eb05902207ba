//! The nodes of the chain: a grandmaster, two systems, a sensor, each with a clock of its own.

use tandem_board::{Duration, Instant, SystemId};
use tandem_timesync::gptp::{
    Claims, EventId, Master, MasterSettings, PortIdentity, PtpProfile, Slave, SlaveSettings,
    TimeOutlet,
};
use tandem_timesync::{
    Arbitrary, BaseConfig, CanTimeCrc, CanTimeMaster, CanTimeSlave, GlobalTime, Heard,
    MasterQuality, PulseMaster, PulseSlave, Sample, TimeBase, TimeReader, TimeReading,
};

use crate::oracle::{Violation, Watched};

pub(crate) type Time = GlobalTime<Arbitrary>;

/// A system that drives waits this long for a grandmaster.
const GRANDMASTER_WAIT: Duration = Duration::from_ms(3_000);
/// A standby follows the grandmaster if no pulse was heard for this long.
const PULSES_SILENT: Duration = Duration::from_ms(700);

/// A clock: what it shows at a true time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Clock {
    pub(crate) since: u64,
    pub(crate) shown: u64,
    pub(crate) ppb: i64,
}

impl Clock {
    pub(crate) fn at(&self, now: u64) -> u64 {
        let span = i128::from(now) - i128::from(self.since);
        let run = span + span * i128::from(self.ppb) / 1_000_000_000;
        (i128::from(self.shown) + run).max(0) as u64
    }

    pub(crate) fn local(&self, now: u64) -> Instant {
        Instant::from_ns(self.at(now))
    }

    /// Moves it by `by`, ns; it has this rate from now on.
    pub(crate) fn set(&mut self, now: u64, by: i64, ppb: i64) {
        let shown = self.at(now).saturating_add_signed(by);
        *self = Self {
            since: now,
            shown,
            ppb,
        };
    }
}

/// What a station of the Ethernet sends.
#[derive(Default)]
pub(crate) struct Out(pub(crate) Vec<(Vec<u8>, Option<EventId>)>);

impl TimeOutlet for Out {
    fn send(&mut self, message: &[u8], event: Option<EventId>) {
        self.0.push((message.to_vec(), event));
    }
}

pub(crate) struct Grandmaster {
    pub(crate) clock: Clock,
    /// How much later than its clock its time is.
    pub(crate) set_by: i64,
    pub(crate) master: Master<Arbitrary>,
    pub(crate) is_alive: bool,
}

impl Grandmaster {
    pub(crate) fn new(number: u8, clock: Clock) -> Self {
        Self {
            clock,
            set_by: 0,
            master: Master::new(MasterSettings {
                identity: identity(number),
                profile: PtpProfile::END_TO_END,
                claims: Claims::default(),
                sync_exponent: -3,
            }),
            is_alive: true,
        }
    }

    pub(crate) fn time(&self, now: u64) -> Time {
        Time::from_ns(self.clock.at(now)).moved(self.set_by)
    }
}

/// Returns a grandmaster's time as a function of its clock.
pub(crate) fn global(set_by: i64) -> impl Fn(Instant) -> Option<Time> + Copy {
    move |at| Some(Time::from_ns(at.as_ns()).moved(set_by))
}

fn identity(number: u8) -> PortIdentity {
    PortIdentity::from_mac([2, 0, 0, 0, 0, number])
}

/// What follows another clock, with its readers.
pub(crate) struct Follower {
    pub(crate) clock: Clock,
    pub(crate) base: TimeBase<Arbitrary>,
    pub(crate) watched: Watched,
    pub(crate) readers: [TimeReader<Arbitrary>; 2],
    /// What a change of the time has shown.
    pub(crate) violation: Option<Violation>,
}

impl Follower {
    fn new(clock: Clock, config: BaseConfig) -> Self {
        Self {
            clock,
            base: TimeBase::new(config),
            watched: Watched::default(),
            readers: [TimeReader::default(); 2],
            violation: None,
        }
    }

    /// What a new reader would see now.
    pub(crate) fn reading(&self, now: u64) -> Option<TimeReading<Arbitrary>> {
        let conversion = self.base.conversion()?;
        Some(conversion.reading(self.clock.local(now)))
    }

    /// Returns whether the sample was followed.
    fn take(&mut self, now: Instant, sample: Sample<Arbitrary>, quality: MasterQuality) -> bool {
        let before = self.base.conversion();
        let heard = self.base.on_sample(now, sample, quality);
        let pair = before.zip(self.base.conversion());
        let pair = pair.map(|(before, after)| (before.reading(now), after.reading(now)));
        if let Some((before, after)) = pair {
            let found = self.watched.judge_change(now, &before, &after);
            self.violation = self.violation.or(found);
        }
        let is_followed = matches!(
            heard,
            Heard::First | Heard::Followed | Heard::Stepped(_) | Heard::LeapFollowed(_)
        );
        if is_followed {
            self.watched.follows(sample.local);
        }
        is_followed
    }
}

/// A system. It chooses what it follows as core 0 does.
pub(crate) struct System {
    id: SystemId,
    pub(crate) time: Follower,
    started: Instant,
    last_turn: Instant,
    pub(crate) is_alive: bool,
    pub(crate) drives: bool,
    pub(crate) gptp: Slave<Arbitrary>,
    pub(crate) master: PulseMaster,
    pub(crate) slave: PulseSlave<Arbitrary>,
    heard: Option<Instant>,
    /// The newest edge of the line; it outlives a restart.
    pub(crate) edge: Option<(u32, Instant)>,
    pub(crate) can: CanTimeMaster,
}

impl System {
    pub(crate) fn new(number: usize, clock: Clock, now: u64) -> Self {
        let (id, at) = (SystemId::ALL[number], clock.local(now));
        let settings = SlaveSettings::new(identity(10 + number as u8), PtpProfile::END_TO_END);
        Self {
            id,
            time: Follower::new(clock, BaseConfig::PULSE),
            started: at,
            last_turn: at,
            is_alive: true,
            drives: false,
            gptp: Slave::new(settings),
            master: PulseMaster::new(at),
            slave: PulseSlave::default(),
            heard: None,
            edge: None,
            can: CanTimeMaster::new(id, true, at),
        }
    }

    fn renew(&mut self, now: Instant) {
        self.master = PulseMaster::new(now);
        (self.slave, self.heard) = (PulseSlave::default(), None);
        self.can = CanTimeMaster::new(self.id, true, now);
    }

    /// Begins a turn in this role. Returns whether it becomes the origin of a time.
    pub(crate) fn begin_turn(&mut self, now: Instant, drives: bool, waits: bool) -> bool {
        let is_back = now < core::mem::replace(&mut self.last_turn, now);
        let is_new = core::mem::replace(&mut self.drives, drives) != drives;
        if is_back || is_new {
            self.time.base.look(now);
            self.renew(now);
        }
        let start = Time::from_ns(now.as_ns());
        let base = &mut self.time.base;
        if is_new && drives && base.conversion().is_some() {
            base.set_free(now, start);
            self.time.watched.is_origin();
        }
        let waits = waits && now.since(self.started) < GRANDMASTER_WAIT;
        let begins = drives && self.time.base.conversion().is_none() && !waits;
        if begins {
            self.time.base.set_free(now, start);
        }
        begins
    }

    pub(crate) fn on_grandmaster(&mut self, now: Instant, sample: Sample<Arbitrary>) {
        let pulses = self
            .heard
            .is_some_and(|at| now >= at && now.since(at) < PULSES_SILENT);
        if self.drives || !pulses {
            self.time.take(now, sample, MasterQuality::default());
        }
    }

    pub(crate) fn follow_pulses(&mut self, now: Instant) {
        if let Ok(Some(pulse)) = self.slave.poll(now, self.edge) {
            self.heard = Some(now);
            let quality = MasterQuality {
                to_gateway: pulse.transfer.is_to_gateway,
                error: pulse.transfer.master_error,
            };
            self.time.take(now, pulse.sample, quality);
        }
    }
}

/// A sensor on the CAN bus.
pub(crate) struct Sensor {
    pub(crate) time: Follower,
    /// The error that its master stated for the newest sample. Frames of time do not carry it.
    pub(crate) master_error_ns: u64,
    slave: CanTimeSlave<Arbitrary>,
}

impl Sensor {
    pub(crate) fn new(clock: Clock) -> Self {
        Self {
            time: Follower::new(clock, BaseConfig::CAN),
            master_error_ns: 0,
            slave: CanTimeSlave::new(CanTimeCrc::Validated),
        }
    }

    /// `master_error_ns`: what the sender would state now.
    pub(crate) fn hear(
        &mut self,
        now: u64,
        (from, at): (usize, Instant),
        frame: &[u8],
        master_error_ns: u64,
    ) {
        let heard = self.slave.receive(SystemId::ALL[from], at, frame);
        if let Ok(Some(heard)) = heard {
            let now = self.time.clock.local(now).max(at);
            let quality = MasterQuality {
                to_gateway: heard.is_to_gateway,
                ..MasterQuality::default()
            };
            if self.time.take(now, heard.sample, quality) {
                self.master_error_ns = master_error_ns;
            }
        }
    }
}
