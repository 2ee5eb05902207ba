//! The vehicle's process: simulates the world in steps of 1 ms, and records the bus and the run.

use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context as _;
use tandem_board::{CanFrame, Carried, Instant, Pass, SystemId, VehiclePort};
use tandem_board_host::process_list::role_name;
use tandem_board_host::{HostVehiclePort, VehicleArgs};
use tandem_record::Entry;
use tandem_record::log::{Header, VehicleRecord};
use tandem_vehicle::{Habit, LoggedFrame, Scenario, World, WorldConfig};

use crate::files::RunFiles;
use crate::forging::Forging;
use crate::live::Live;
use crate::open_bus::{FRAMES_PER_MS, OpenBus};
use crate::recorder::Recorder;
use crate::run_config::RunConfig;
use crate::update::Update;
use crate::world_record;

/// Ticks between two hand-overs of collected records to the recorder.
const HAND_OVER_TICKS: u64 = 100;
/// A period that begins later than this counts as delayed, ns.
const HELD_UP_NS: u64 = 2_000_000;
/// Ticks between two forged frames.
const FORGED_TICKS: u64 = 10;
/// The run ends if no control frame was accepted within this number of ticks of 1 ms.
const GIVE_UP_TICKS: u64 = 15_000;

/// Drives the scenario to its end. Returns whether the process that had started the run died: then
/// nobody else reads the recording.
///
/// # Errors
/// If the scenario cannot be loaded, the run has ended, or its recording cannot be written.
pub fn run(args: &VehicleArgs, run: &RunConfig) -> anyhow::Result<bool> {
    let scenario = run.load_scenario()?;
    let recorder = Recorder::create(&RunFiles::of(&args.common.run))?;
    // Start the recorder first, because its thread must not inherit this thread's priority.
    let _ = args.claim();
    let mut port =
        HostVehiclePort::attach(args).context("the vehicle cannot connect to the run")?;
    drive(run, &scenario, &mut port, recorder)?;
    Ok(port.launcher_died().is_some())
}

/// Drives the scenario to its end, with a controller on any board.
///
/// # Errors
/// If the board fails, or the recording cannot be written.
pub fn drive<P>(
    run: &RunConfig,
    scenario: &Scenario,
    port: &mut P,
    recorder: Recorder,
) -> anyhow::Result<DriveEnd>
where
    P: VehiclePort<Error: std::error::Error + Send + Sync + 'static>,
{
    let mut drive = Drive::new(run, scenario, port, recorder)?;
    let ended = drive.work()?;
    drive.finish(ended)?;
    Ok(ended)
}

/// How a drive ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriveEnd {
    /// It ran for its whole duration, or no controller drove. The recording is complete.
    ByItself,
    /// The user requested the end.
    Stopped,
}

struct Drive<'p, P> {
    world: World,
    update: Option<Update>,
    /// Other programs on the bus.
    outside: Option<OpenBus>,
    forging: Forging,
    port: &'p mut P,
    recorder: Recorder,
    duration_s: f64,
    /// Ticks since the ignition.
    ticks: u64,
    running: bool,
    collides: bool,
    powered: [bool; 2],
    lost_trace: u64,
    /// End of the last delay of the bus, ns.
    held_up_ns: u64,
}

impl<'p, P> Drive<'p, P>
where
    P: VehiclePort<Error: std::error::Error + Send + Sync + 'static>,
{
    fn new(
        run: &RunConfig,
        scenario: &Scenario,
        port: &'p mut P,
        mut recorder: Recorder,
    ) -> anyhow::Result<Self> {
        let now_us = port.now().as_ns() / 1_000;
        let today = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        recorder.record(VehicleRecord::Header(Header {
            scenario: scenario.title(),
            seed: run.seed,
            duration_s: run.duration_s,
            epoch_us: (today.as_micros() as u64).saturating_sub(now_us),
            cpus: run.cpus.clone(),
        }));
        let mut world = World::new(scenario, WorldConfig { seed: run.seed });
        world.set_driver(Habit {
            overrides_s: run.overrides_s,
            answers_after_s: run.answers_after_s,
            parks_from_s: run.parks_from_s,
        });
        let faults = run.sensor_faults.iter().map(|text| text.parse());
        world.set_sensor_faults(faults.collect::<Result<_, _>>()?);
        let timing = run.sensor_timing.iter().map(|text| text.parse());
        world.set_sensor_timing(&timing.collect::<Result<Vec<_>, _>>()?);
        let update = run.update.as_ref().map(Update::read).transpose()?;
        Ok(Self {
            world,
            update,
            outside: run.can.as_ref().map(OpenBus::join).transpose()?,
            forging: Forging::default(),
            port,
            recorder,
            duration_s: run.duration_s,
            ticks: 0,
            running: false,
            collides: false,
            powered: [false; 2],
            lost_trace: 0,
            held_up_ns: 0,
        })
    }

    fn work(&mut self) -> anyhow::Result<DriveEnd> {
        self.port.set_ignition(true);
        loop {
            let now = self.port.now();
            // A programming host and a foreign node send in every period.
            let forges = self.forging.follow(self.port.forgery());
            let event = match self.update {
                Some(_) => now,
                None if forges || self.outside.is_some() => now,
                None => Instant::from_ns(self.world.next_frame(now.as_ns())),
            };
            let pass = self.port.wait_for(event)?;
            if self.port.stop_requested() {
                return Ok(DriveEnd::Stopped);
            }
            if let Pass::Period(due) = pass {
                self.note_lateness(due.as_ns());
            }
            let Self {
                world,
                port,
                recorder,
                update,
                outside,
                forging,
                ..
            } = self;
            let mut seen = |logged: LoggedFrame| {
                if let Some(update) = update {
                    update.on_frame(logged.at, &logged.frame);
                }
                if let Some(outside) = outside {
                    outside.tell(&logged.frame);
                }
                forging.hear(&logged.frame);
                recorder.record(Entry::Frame(logged));
            };
            let due = match pass {
                Pass::Period(due) => {
                    world.run_period(due, *port, &mut seen);
                    due
                }
                Pass::Quiet(due) => {
                    world.run_quiet_period(due);
                    due
                }
                Pass::Frames => {
                    let mut sent_ns = u64::MAX;
                    world.run_between(*port, &mut |logged| {
                        sent_ns = sent_ns.min(logged.sent.as_ns());
                        seen(logged);
                    });
                    // Each frame wakes the bus, so the bus was held up if a frame had to wait.
                    self.note_lateness(sent_ns);
                    continue;
                }
            };
            self.update();
            self.forge();
            self.let_in();
            if let Pass::Period(_) = pass {
                self.drain_traces();
            }
            self.record_period(due.as_ns());
            self.ticks += 1;
            let time_s = self.world.snapshot().time_s;
            if time_s >= self.duration_s || (!self.running && self.ticks >= GIVE_UP_TICKS) {
                return Ok(DriveEnd::ByItself);
            }
        }
    }

    /// Records a delay of the bus if this period or frame was late. No frame moved in that time.
    fn note_lateness(&mut self, due_ns: u64) {
        let to_ns = self.port.now().as_ns();
        let from_ns = due_ns.max(self.held_up_ns);
        // Late periods that follow without a pause are part of the same delay.
        if to_ns.saturating_sub(from_ns) > HELD_UP_NS {
            self.held_up_ns = to_ns;
            self.recorder
                .record(VehicleRecord::HeldUp { from_ns, to_ns });
        }
    }

    /// Sends the frames of the programming host.
    fn update(&mut self) {
        let Some(update) = self.update.as_mut().filter(|_| self.running) else {
            return;
        };
        let now = self.port.now();
        let roles = SystemId::ALL.map(|system| self.port.role(system));
        let Self {
            port,
            recorder,
            outside,
            ..
        } = self;
        update.poll(now, roles, &mut |frame| {
            if let Some(outside) = outside {
                outside.tell(frame);
            }
            let at = port.broadcast(frame);
            recorder.record(Entry::Frame(LoggedFrame {
                at,
                sent: at,
                frame: *frame,
                ruling: None,
            }));
        });
        port.ring_receivers();
    }

    /// Sends the next frame of a foreign node. The vehicle's gate hears it as well.
    fn forge(&mut self) {
        if !self.ticks.is_multiple_of(FORGED_TICKS) {
            return;
        }
        let Some(frame) = self.forging.next() else {
            return;
        };
        if let Some(outside) = &self.outside {
            outside.tell(&frame);
        }
        self.send_foreign(frame);
        self.port.ring_receivers();
    }

    /// Sends what other programs want to send.
    fn let_in(&mut self) {
        for _ in 0..FRAMES_PER_MS {
            let Some(frame) = self.outside.as_ref().and_then(OpenBus::hear) else {
                break;
            };
            if let Some(update) = &mut self.update {
                update.on_frame(self.port.now(), &frame);
            }
            self.send_foreign(frame);
        }
        if self.outside.is_some() {
            self.port.ring_receivers();
        }
    }

    fn send_foreign(&mut self, frame: CanFrame) {
        let at = self.port.broadcast(&frame);
        let sent = at;
        let logged = self.world.hear(at, Carried { frame, sent, at });
        self.recorder.record(Entry::Frame(logged));
    }

    /// Records the state of the world and the power of the systems after a period.
    fn record_period(&mut self, now_ns: u64) {
        let recorder = &mut self.recorder;
        for system in SystemId::ALL {
            let on = self.port.is_powered(system);
            if on != self.powered[system.index()] {
                self.powered[system.index()] = on;
                recorder.record(VehicleRecord::Power {
                    at_ns: now_ns,
                    system: system.index() as u8,
                    on,
                });
            }
        }
        let collides = self.world.snapshot().collides;
        if collides && !self.collides {
            recorder.record(VehicleRecord::Collision { at_ns: now_ns });
        }
        self.collides = collides;
        self.note_start(now_ns);
        if self.running {
            self.sample(now_ns);
        }
        if self.ticks.is_multiple_of(HAND_OVER_TICKS) {
            let live = self.live(now_ns);
            self.recorder.live(live);
            self.recorder
                .record(VehicleRecord::Figures(world_record::figures(
                    &self.world.metrics(),
                )));
            self.recorder.hand_over();
        }
    }

    /// Records the first control frame that the vehicle obeyed.
    fn note_start(&mut self, now_ns: u64) {
        let snapshot = self.world.snapshot();
        if snapshot.running && !self.running {
            self.running = true;
            let at_ns = snapshot.accepted.map_or(now_ns, |accepted| accepted.at_ns);
            self.recorder.record(VehicleRecord::Start { at_ns });
        }
    }

    /// Moves the trace records of cores and supplies to the recorder.
    fn drain_traces(&mut self) {
        let Self { port, recorder, .. } = self;
        let mut lost = 0;
        let dropped = port.drain_trace(&mut |traced| lost += u64::from(!recorder.trace(traced)));
        let at_ns = port.now().as_ns();
        port.drain_hands(&mut |handled| {
            recorder.record(VehicleRecord::Hand {
                at_ns,
                system: handled.system.index() as u8,
                what: handled.what.to_string(),
                cuts: handled.cuts,
            });
        });
        port.drain_supplies(&mut |at, system, event| {
            recorder.record(Entry::Supply(at, system, event));
        });
        self.lost_trace += lost + u64::from(dropped);
    }

    fn sample(&mut self, now_ns: u64) {
        for record in world_record::at_tick(&self.world, now_ns, self.ticks) {
            self.recorder.record(record);
        }
    }

    fn live(&self, now_ns: u64) -> Live {
        let snapshot = self.world.snapshot();
        let mastership = self.world.gate().mastership();
        Live {
            time_s: snapshot.time_s,
            speed: snapshot.speed,
            lead_gap: Some(snapshot.gap).filter(|gap| gap.is_finite()),
            roles: SystemId::ALL.map(|system| {
                let role = if self.port.is_powered(system) {
                    role_name(self.port.role(system))
                } else {
                    "off"
                };
                role.to_owned()
            }),
            gap_max_ms: mastership.gap_max_ns(now_ns) as f64 * 1e-6,
            takeovers: mastership.changes(),
        }
    }

    /// Ends the run for all processes, and completes the recording.
    fn finish(mut self, ended: DriveEnd) -> anyhow::Result<()> {
        let at_ns = self.port.now().as_ns();
        self.port.set_ignition(false);
        self.drain_traces();
        if ended == DriveEnd::Stopped {
            // The drive ends here, not at its last regular sample, because even one accepted
            // control frame counts as a drive.
            self.note_start(at_ns);
            if self.running {
                let last = world_record::sample(&self.world, at_ns, false);
                self.recorder.record(VehicleRecord::Sample(last));
            }
        }
        let Self { port, recorder, .. } = &mut self;
        let died = port.launcher_died();
        if let Some(at_ns) = died.map(Instant::as_ns) {
            recorder.record(VehicleRecord::LauncherDied { at_ns });
        }
        port.salvage_trace(&mut |traced| {
            recorder.trace(traced);
        });
        self.recorder
            .record(VehicleRecord::Figures(world_record::figures(
                &self.world.metrics(),
            )));
        if ended == DriveEnd::ByItself {
            let stalled_ms = self.world.stalled_ns() as f64 * 1e-6;
            let lost_trace = self.lost_trace;
            self.recorder.record(VehicleRecord::End {
                at_ns,
                lost_trace,
                stalled_ms,
            });
        }
        self.recorder.close()
    }
}
