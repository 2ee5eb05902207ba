//! One time for the vehicle: core 0 follows another clock, and tells its time to others. S-1
//!
//! The system that drives is the vehicle's master of time. It follows the grandmaster if it hears
//! one, else its own clock, or the time that it followed before a takeover. It tells the other
//! system by a pulse on the line `Time` (S-3), and the sensors by frames on CAN (S-4). A standby
//! follows the pulses; without them, the grandmaster.
//!
//! Nothing of the redundancy reads this time. It moves the control cycles by at most a tick each.

mod grandmaster;
mod pulses;
mod share;
mod sync_frames;

use super::{Core0Task, Executor, TaskBody};
use crate::layout::{ControllerMap, VEHICLE_TIME};
use crate::trace::{Begin, Event};
use crate::words::VehicleTime;
use grandmaster::Grandmaster;
use pulses::Pulses;
pub(super) use share::TimeShare;
use sync_frames::SyncFrames;
use tandem_board::{Board, Channel, Duration, Instant, Network};
use tandem_shm::newest::Writer;
use tandem_timesync::{
    Arbitrary, BaseConfig, GlobalTime, Heard, MasterQuality, Sample, TimeBase, TimeStatus,
};

/// How often the port is read while there is a grandmaster, and the stamp of a frame.
const POLLS_EVERY: Duration = Duration::from_ms(10);
/// How often the task looks whether its system drives.
const LOOKS_EVERY: Duration = Duration::from_ms(100);
/// A system that drives waits this long for a grandmaster before its own clock becomes the time.
const GRANDMASTER_WAIT: Duration = Duration::from_ms(3_000);
/// A standby follows the grandmaster if no pulse has arrived for this long: four of them are
/// missing.
const PULSES_SILENT: Duration = Duration::from_ms(700);
/// How often the time is traced.
const TELLS_EVERY: Duration = Duration::from_ms(100);

/// Whose time core 0 follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum TimeSource {
    /// No other clock: its own, or what it followed before.
    #[default]
    Own,
    /// The grandmaster, by gPTP.
    Grandmaster,
    /// The system that drives, by its pulses.
    Pulse,
}

/// Follows another clock, and tells the time to the other system and to the sensors.
pub struct TimeTask<'b, B> {
    board: &'b B,
    started: Instant,
    base: TimeBase<Arbitrary>,
    source: TimeSource,
    drives: bool,
    grandmaster: Grandmaster,
    pulses: Pulses,
    frames: SyncFrames,
    /// `None` until the LMU is attached.
    shown: Option<Writer<'b, VehicleTime>>,
    told: Instant,
    polled: Instant,
}

impl<'b, B: Board> TimeTask<'b, B> {
    pub(super) fn new(board: &'b B) -> Self {
        let started = board.now();
        Self {
            board,
            started,
            base: TimeBase::new(BaseConfig::PULSE),
            source: TimeSource::Own,
            drives: false,
            grandmaster: Grandmaster::default(),
            pulses: Pulses::new(started),
            frames: SyncFrames::new(board.identity().system, started),
            shown: None,
            told: started,
            polled: started,
        }
    }

    fn attach(&mut self) {
        if self.shown.is_none()
            && let Ok(lmu) = ControllerMap::attach(self.board)
        {
            self.shown = VEHICLE_TIME.writer(&lmu.map, lmu.incarnation).ok();
            // The LMU may hold the time from before a reset, which stopped or changed the clock.
            if let Some(shown) = &mut self.shown {
                shown.publish(&VehicleTime(None));
            }
        }
    }

    /// Changes what is followed when the role has changed. Also begins anew when the clock has gone
    /// back: what is due would wait for as long as it jumped.
    fn change_role(&mut self, now: Instant, drives: bool) {
        let went_back = now < core::mem::replace(&mut self.polled, now);
        let is_new = core::mem::replace(&mut self.drives, drives) != drives;
        if !went_back && !is_new {
            return;
        }
        self.base.look(now);
        self.told = self.told.min(now);
        self.pulses = Pulses::new(now);
        self.frames = SyncFrames::new(self.board.identity().system, now);
        if is_new && drives && self.base.conversion().is_some() {
            // It goes on from the time that it followed.
            self.become_origin(now);
        }
    }

    fn become_origin(&mut self, now: Instant) {
        self.base.set_free(now, GlobalTime::from_ns(now.as_ns()));
        self.source = TimeSource::Own;
    }

    /// Begins a time if this system drives and no grandmaster gives one.
    fn begin(&mut self, now: Instant) {
        let waits = self.grandmaster.is_open() && now.since(self.started) < GRANDMASTER_WAIT;
        if self.drives && self.base.conversion().is_none() && !waits {
            self.become_origin(now);
        }
    }

    /// Takes a sample of this source. Traces what becomes of it.
    fn take(
        &mut self,
        source: TimeSource,
        sample: Sample<Arbitrary>,
        quality: MasterQuality,
        delay: Duration,
    ) {
        let heard = self.base.on_sample(self.board.now(), sample, quality);
        match heard {
            Heard::First | Heard::Followed | Heard::Stepped(_) => self.source = source,
            Heard::LeapTold(by_ns) | Heard::LeapFollowed(by_ns) => {
                let followed = matches!(heard, Heard::LeapFollowed(_));
                let by_us = clamped(by_ns / 1_000);
                self.trace(Event::TimeLeap {
                    source: source as u8,
                    followed,
                    by_us,
                });
            }
            Heard::Unconfirmed | Heard::Outlier | Heard::Refused => {}
        }
        self.trace(Event::TimeSample {
            source: source as u8,
            offset_ns: clamped(self.base.offset_ns()),
            delay_ns: clamped_span(delay),
            error_ns: clamped_span(sample.error),
        });
    }

    /// Reads the port of the grandmaster.
    fn follow_grandmaster(&mut self, now: Instant) {
        self.grandmaster.open(self.board);
        while let Some((sample, quality, delay)) = self.grandmaster.next(self.board) {
            let hears_pulses = self
                .pulses
                .heard()
                .is_some_and(|at| now.since(at) < PULSES_SILENT);
            if self.drives || !hears_pulses {
                self.take(TimeSource::Grandmaster, sample, quality, delay);
            } else if let Some(apart_ns) =
                self.grandmaster.disagrees(&sample, self.base.conversion())
            {
                let apart_ns = clamped(apart_ns);
                self.trace(Event::TimeDisagrees { apart_ns });
            }
        }
        if let Some(event) = self.grandmaster.change() {
            self.trace(event);
        }
        if let Some(event) = self.grandmaster.others(now) {
            self.trace(event);
        }
    }

    /// Shows the time to the other tasks and cores, and traces it.
    fn show(&mut self, now: Instant, executor: &impl Executor<'b, B>) {
        let Some(conversion) = self.base.conversion() else {
            return;
        };
        if let Some(shown) = &mut self.shown {
            shown.publish(&VehicleTime(Some(conversion)));
        }
        let clock = VehicleTime(Some(conversion)).clock(now);
        executor.shared(|shared| {
            shared.time.conversion = Some(conversion);
            shared.scene_check.set_global(clock);
        });
        if now.since(self.told) < TELLS_EVERY {
            return;
        }
        self.told = now;
        let local = self.board.now();
        self.trace(Event::Time {
            source: self.source as u8,
            status: conversion.status_at(local).bits(),
            global_ns: conversion.at(local).as_ns() as u32,
            local_ns: local.as_ns() as u32,
            rate_ppb: conversion.rate_ppb(),
        });
    }

    fn trace(&self, event: Event) {
        self.board.trace(event.encode());
    }
}

/// Returns whether the time is not that of the master of the whole network: it is told to those who
/// follow this system.
fn is_to_gateway(status: TimeStatus) -> bool {
    status.has(TimeStatus::SYNC_TO_GATEWAY) || !status.is_synchronised()
}

fn clamped(ns: i64) -> i32 {
    ns.max(i32::MIN.into()).min(i32::MAX.into()) as i32
}

fn clamped_span(span: Duration) -> u32 {
    u32::try_from(span.as_ns()).unwrap_or(u32::MAX)
}

impl<'b, B: Board> TaskBody<'b, B> for TimeTask<'b, B> {
    const ID: Core0Task = Core0Task::Time;

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        executor.begins(Self::ID, Begin::Goes);
        self.attach();
        let now = self.board.now();
        let (drives, transfer) = executor.shared(|shared| {
            let drives = shared.redundancy.is_driving();
            (drives, shared.time.transfer.take())
        });
        self.change_role(now, drives);
        self.follow_grandmaster(now);
        self.begin(now);
        let conversion = self.base.conversion();
        let mut due = now + LOOKS_EVERY;
        if let Some(conversion) = conversion.filter(|_| drives) {
            due = due.min(self.pulses.tell(self.board, &conversion, executor));
            due = due.min(self.frames.tell(self.board, &conversion, executor));
        } else if !drives && let Some((sample, quality)) = self.pulses.follow(self.board, transfer)
        {
            self.take(TimeSource::Pulse, sample, quality, Duration::ZERO);
        }
        self.show(now, executor);
        executor.ends(Self::ID);
        match self.board.network().address(Channel::Time) {
            Some(_) => due.min(now + POLLS_EVERY),
            None => due,
        }
    }
}
