//! The vehicle's process: the world at 1 kHz, the CAN bus, and the log of everything on it.

use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use tandem_board::{CanFrame, CanId, Received, RoleLamp, SystemId, Traced};
use tandem_board_host::VehicleArgs;
use tandem_bus::Message;
use tandem_vehicle::{Config, Scenario, Snapshot, World};

use crate::files::RunFiles;
use crate::live::Live;
use crate::observe;
use crate::outside::{OnHost, Outside};
use crate::plan::RunPlan;
use crate::recorder::Recorder;
use crate::runlog::{Header, PowerSeen, Record, RoadSeen, Sample, System};
use crate::tape::{Entry, Source};

/// The log gets the state of the world every so many ticks, the other vehicles and the road more
/// seldom.
const SAMPLE_TICKS: u64 = 20;
const OTHERS_TICKS: u64 = 100;
const ROAD_TICKS: u64 = 5_000;
/// The recorder gets what was collected every so many ticks.
const HAND_OVER_TICKS: u64 = 100;
/// If no control frame was accepted by then, none will be, ms of 1 kHz ticks.
const GIVE_UP_TICKS: u64 = 15_000;

/// Drives the scenario to its end.
///
/// # Errors
/// If the scenario cannot be loaded, the run is over, or its log cannot be written.
pub(crate) fn run(args: &VehicleArgs) -> anyhow::Result<()> {
    let plan = RunPlan::from_extra(&args.common.extra)?;
    let scenario = Scenario::load(&plan.scenario)?;
    let recorder = Recorder::create(&RunFiles::of(&args.common.run))?;
    // Not before the recorder runs: that must not get this thread's priority.
    let _ = args.claim();
    let port = OnHost::attach(args).context("the vehicle cannot connect to the run")?;
    drive(&plan, &scenario, port, recorder).map(drop)
}

/// Drives the scenario to its end, with a controller on whatever board.
///
/// # Errors
/// If the board fails, or the log cannot be written.
pub(crate) fn drive<P: Outside>(
    plan: &RunPlan,
    scenario: &Scenario,
    port: P,
    recorder: Recorder,
) -> anyhow::Result<Ended> {
    let mut drive = Drive::new(plan, scenario, port, recorder);
    let ended = drive.work()?;
    drive.finish(ended)?;
    Ok(ended)
}

/// How a drive ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ended {
    /// After its whole duration, or for want of a controller: the log is complete.
    ByItself,
    /// A person asked for it.
    Stopped,
}

struct Drive<P> {
    world: World,
    port: P,
    recorder: Recorder,
    duration_s: f64,
    /// Ticks since the ignition.
    ticks: u64,
    running: bool,
    collides: bool,
    powered: [bool; 2],
    lost_trace: u64,
    /// Time of day less the clock's time, µs: the CAN log has the time of day.
    epoch_us: u64,
}

impl<P: Outside> Drive<P> {
    fn new(plan: &RunPlan, scenario: &Scenario, port: P, mut recorder: Recorder) -> Self {
        recorder.record(Record::Header(Header {
            scenario: scenario.name().to_owned(),
            seed: plan.seed,
            duration_s: plan.duration_s,
        }));
        let now_us = port.now().as_ns() / 1_000;
        let today = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        Self {
            world: World::new(scenario, Config { seed: plan.seed }),
            port,
            recorder,
            duration_s: plan.duration_s,
            ticks: 0,
            running: false,
            collides: false,
            powered: [false; 2],
            lost_trace: 0,
            epoch_us: (today.as_micros() as u64).saturating_sub(now_us),
        }
    }

    fn work(&mut self) -> anyhow::Result<Ended> {
        self.port.set_ignition(true);
        loop {
            let due = self.port.tick()?;
            if self.port.stop_requested() {
                return Ok(Ended::Stopped);
            }
            self.receive();
            // The tick's own time, not the time of waking: the world does not feel jitter.
            self.send(due.as_ns());
            self.look(due.as_ns());
            self.ticks += 1;
            let time_s = self.world.snapshot().time_s;
            if time_s >= self.duration_s || (!self.running && self.ticks >= GIVE_UP_TICKS) {
                return Ok(Ended::ByItself);
            }
        }
    }

    /// Frames of the controller: on the bus, into the log, to the world.
    fn receive(&mut self) {
        let Self {
            world,
            port,
            recorder,
            epoch_us,
            ..
        } = self;
        let now_ns = port.now().as_ns();
        port.transmitted(&mut |_, _, Received { frame, at }| {
            recorder.frame(*epoch_us + now_ns / 1_000, frame);
            let CanId::Standard(id) = frame.id() else {
                return;
            };
            world.on_frame(now_ns, u32::from(id), frame.data());
            let message = Message::decode(u32::from(id), frame.data()).ok();
            if let Some(seen) = message.and_then(|m| observe::status(now_ns, &m)) {
                recorder.record(Record::Status(seen));
            }
            for acceptance in world.gate_mut().drain_log() {
                let seen = observe::control(acceptance, at.as_ns(), message.as_ref());
                recorder.record(Record::Control(seen));
            }
        });
    }

    /// Lets the world run, and sends what its sensors send.
    fn send(&mut self, now_ns: u64) {
        let Self {
            world,
            port,
            recorder,
            epoch_us,
            ..
        } = self;
        world.step(now_ns, &mut |id, data| {
            // The world sends what the DBC has, which is always a frame.
            if let Ok(frame) = CanFrame::new(CanId::Standard(id), true, data) {
                port.broadcast(&frame);
                recorder.frame(*epoch_us + now_ns / 1_000, frame);
            }
        });
        port.ring_receivers();
    }

    /// Everything that the log is to know.
    fn look(&mut self, now_ns: u64) {
        self.drain_traces();
        let recorder = &mut self.recorder;
        for system in SystemId::ALL {
            let on = self.port.is_powered(system);
            if on != self.powered[system.index()] {
                self.powered[system.index()] = on;
                let system = System::from(system);
                recorder.record(Record::Power(PowerSeen {
                    at_ns: now_ns,
                    system,
                    on,
                }));
            }
        }
        let snapshot = self.world.snapshot();
        if snapshot.running && !self.running {
            self.running = true;
            let at_ns = snapshot.accepted.map_or(now_ns, |accepted| accepted.at_ns);
            recorder.record(Record::Start { at_ns });
        }
        if snapshot.collides && !self.collides {
            recorder.record(Record::Collision { at_ns: now_ns });
        }
        self.collides = snapshot.collides;
        if self.running {
            self.sample(now_ns);
        }
        if self.ticks.is_multiple_of(HAND_OVER_TICKS) {
            let live = self.live(now_ns);
            self.recorder.live(live);
            self.recorder
                .record(Record::Figures(observe::figures(&self.world.metrics())));
            self.recorder.hand_over();
        }
    }

    /// What cores and supplies have traced.
    fn drain_traces(&mut self) {
        let Self { port, recorder, .. } = self;
        let mut lost = 0;
        let dropped = port.drain_trace(&mut |traced| lost += u64::from(!keep(recorder, traced)));
        port.drain_supplies(&mut |at, system, event| {
            let (source, record) = (Source::Supply(system), event.encode());
            let kept = recorder.trace(Entry { at, source, record });
            lost += u64::from(!kept);
        });
        self.lost_trace += lost + u64::from(dropped);
    }

    fn sample(&mut self, now_ns: u64) {
        let snapshot = self.world.snapshot();
        if self.ticks.is_multiple_of(ROAD_TICKS) || snapshot.time_s <= 0.0015 {
            let lanes = observe::lanes(self.world.road(), snapshot.pose.position);
            self.recorder.record(Record::Road(RoadSeen {
                at_ns: now_ns,
                lanes,
            }));
        }
        if self.ticks.is_multiple_of(SAMPLE_TICKS) {
            let mut sample = self.state(now_ns, snapshot);
            if self.ticks.is_multiple_of(OTHERS_TICKS) {
                sample.others = snapshot.vehicles.iter().map(observe::other).collect();
            }
            self.recorder.record(Record::Sample(sample));
        }
    }

    fn state(&self, now_ns: u64, snapshot: &Snapshot) -> Sample {
        let gap = Some(snapshot.gap).filter(|gap| gap.is_finite());
        Sample {
            at_ns: now_ns,
            x: snapshot.pose.position.x,
            y: snapshot.pose.position.y,
            heading: snapshot.pose.yaw,
            speed: snapshot.speed,
            set_speed: Some(self.world.set_speed()),
            accel: snapshot.acceleration,
            lat_accel: snapshot.lateral_acceleration,
            lane: snapshot.lane.0,
            lateral_error: snapshot.lateral_offset,
            lead_gap: gap,
            closing_speed: gap.map(|_| snapshot.speed - snapshot.leader_speed),
            others: Vec::new(),
        }
    }

    fn live(&self, now_ns: u64) -> Live {
        let snapshot = self.world.snapshot();
        let gate = self.world.gate();
        Live {
            time_s: snapshot.time_s,
            speed: snapshot.speed,
            roles: SystemId::ALL.map(|system| {
                let role = if self.port.is_powered(system) {
                    role_name(self.port.role(system))
                } else {
                    "off"
                };
                role.to_owned()
            }),
            gap_max_ms: gate.gap_max_ns(now_ns) as f64 * 1e-6,
            takeovers: gate.switches(),
        }
    }

    /// Ends the run for all, and the log.
    fn finish(mut self, ended: Ended) -> anyhow::Result<()> {
        let at_ns = self.port.now().as_ns();
        self.port.set_ignition(false);
        self.drain_traces();
        let Self { port, recorder, .. } = &mut self;
        port.salvage_trace(&mut |traced| {
            keep(recorder, traced);
        });
        self.recorder
            .record(Record::Figures(observe::figures(&self.world.metrics())));
        if ended == Ended::ByItself {
            let stalled_ms = self.world.stalled_ns() as f64 * 1e-6;
            let lost_trace = self.lost_trace;
            self.recorder.record(Record::End {
                at_ns,
                lost_trace,
                stalled_ms,
            });
        }
        self.recorder.close()
    }
}

/// Puts a core's record into both logs. Whether the trace has room for it.
fn keep(recorder: &mut Recorder, traced: Traced) -> bool {
    if let Some(event) = observe::event(traced) {
        recorder.record(Record::Event(event));
    }
    recorder.trace(Entry {
        at: traced.at,
        source: Source::Core(traced.system, traced.core),
        record: traced.record,
    })
}

const fn role_name(lamp: RoleLamp) -> &'static str {
    match lamp {
        RoleLamp::Starting => "starting",
        RoleLamp::Master => "master",
        RoleLamp::DegradedMaster => "degraded",
        RoleLamp::Standby => "standby",
        RoleLamp::Suspended => "suspended",
    }
}
