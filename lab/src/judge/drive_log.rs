//! The recording of one drive, for the same report as that of a run.

use std::fmt::Write as _;

use tandem::collected::Collected;
use tandem::output::ReportFolder;
use tandem_board::{Duration, Instant, SystemId, Traced};
use tandem_processes::world_record;
use tandem_record::file::candump_line;
use tandem_record::log::{Header, VehicleRecord};
use tandem_record::{Entry, RunLog};
use tandem_vehicle::{LoggedFrame, World};

use crate::sim::recording::around;

/// What a report needs of a drive.
#[derive(Debug, Default)]
pub(super) struct Recording {
    log: RunLog,
    candump: String,
    ticks: u64,
    collides: bool,
}

impl Recording {
    /// A recording of this scenario, before its first tick.
    pub(super) fn new(scenario: &str, seed: u64, duration_s: f64) -> Self {
        let mut it = Self::default();
        it.push(VehicleRecord::Header(Header {
            scenario: scenario.to_owned(),
            seed,
            duration_s,
            ..Header::default()
        }));
        for system in SystemId::ALL {
            let system = system.index() as u8;
            it.push(VehicleRecord::Power {
                at_ns: 0,
                system,
                on: true,
            });
        }
        it
    }

    fn push(&mut self, record: VehicleRecord) {
        self.log.push(record.into());
    }

    /// Takes a frame of the bus.
    pub(super) fn hear(&mut self, frame: LoggedFrame) {
        // Writing to a string cannot fail.
        let _ = writeln!(self.candump, "{}", candump_line(&frame, 0));
        self.log.push(Entry::Frame(frame));
    }

    /// Takes the events of the cores.
    pub(super) fn trace(&mut self, traced: Vec<Traced>) {
        for traced in traced {
            self.log.push(Entry::Trace(traced));
        }
    }

    /// Takes the state of the world after a tick of a millisecond.
    pub(super) fn see(&mut self, at: Instant, world: &World) {
        let (at_ns, now) = (at.as_ns(), world.snapshot());
        if now.running {
            if self.log.start_ns.is_none() {
                let at_ns = now.accepted.map_or(at_ns, |accepted| accepted.at_ns);
                self.push(VehicleRecord::Start { at_ns });
            }
            for record in world_record::at_tick(world, at_ns, self.ticks) {
                self.push(record);
            }
            self.ticks += 1;
        }
        if now.collides && !self.collides {
            self.push(VehicleRecord::Collision { at_ns });
        }
        self.collides = now.collides;
    }

    /// Writes the report of the drive that ended at this time.
    ///
    /// # Errors
    /// If the folder cannot be written.
    pub(super) fn write(
        mut self,
        world: &World,
        at: Instant,
        out: &ReportFolder,
    ) -> anyhow::Result<()> {
        self.push(VehicleRecord::Figures(world_record::figures(
            &world.metrics(),
        )));
        self.push(VehicleRecord::End {
            at_ns: at.as_ns(),
            lost_trace: 0,
            stalled_ms: 0.0,
        });
        self.log.sort();
        let limits = tandem_cores::Config::rt().redundancy;
        let around = around(limits, Duration::ZERO, "virtual time".to_owned());
        Collected::of(out, self.log, &self.candump)?.write(out, &around)?;
        Ok(())
    }
}
