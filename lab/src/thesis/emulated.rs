//! The experiments with firmware in emulated machines, in the emulator's time.

use anyhow::Context as _;
use tandem_board::{RoleLamp, SystemId, VehiclePort as _};
use tandem_board_qemu::{EmulatedWorld, MachineOptions, WorldLayout};
use tandem_record::{Entry, RunLog};
use tandem_vehicle::{Scenario, World, WorldConfig};

use super::outputs::Done;
use super::two_cores::{Counted, Exchange};
use crate::emulated::image;

/// Durations in steps of a millisecond: the delay of switching A on after B, as in the thesis; the
/// pause between two faults; and the longest wait for a state of the systems.
const STAGGER: u32 = 40;
const PAUSE: u32 = 1_000;
const PATIENCE: u32 = 10_000;

/// Returns the messages of the image `thesis`, and its counts without and with the lock.
pub(super) fn two_cores() -> anyhow::Result<(Vec<Exchange>, [Counted; 2])> {
    let log = tandem_board_qemu::run_to_end(&image("thesis", None)?)?;
    parse(&log).with_context(|| format!("the image has another version: {log}"))
}

fn parse(log: &str) -> Option<(Vec<Exchange>, [Counted; 2])> {
    let lines = |head: String| {
        log.lines()
            .filter_map(move |line| line.strip_prefix(&head).map(str::trim))
    };
    let numbers = |line: &str| {
        let words = line.split(|c: char| !c.is_ascii_digit());
        let numbers = words.filter(|word| !word.is_empty()).map(str::parse);
        numbers.collect::<Result<Vec<u32>, _>>().ok()
    };
    let exchanges = lines("exchange ".to_owned()).map(|line| {
        let [sent, received, took] = numbers(line)?.try_into().ok()?;
        let took_ns = f64::from(took);
        Some(Exchange {
            sent,
            received,
            took_ns,
        })
    });
    let counted = |locked: bool| {
        let line = lines(format!("counter {locked} ")).next()?;
        let [increments, counter] = numbers(line)?.try_into().ok()?;
        let seen = |core: u32| numbers(lines(format!("seen {locked} {core} ")).next()?);
        Some(Counted {
            increments,
            counter,
            seen: [seen(0)?, seen(1)?],
        })
    };
    Some((
        exchanges.collect::<Option<_>>()?,
        [counted(false)?, counted(true)?],
    ))
}

/// Both systems as firmware, and the vehicle.
struct Emulated {
    systems: EmulatedWorld,
    vehicle: World,
    log: RunLog,
}

impl Emulated {
    fn step(&mut self) -> anyhow::Result<()> {
        let Self {
            systems,
            vehicle,
            log,
        } = self;
        let due = systems.tick()?;
        vehicle.run_period(due, systems, &mut |frame| log.push(Entry::Frame(frame)));
        systems.drain_trace(&mut |traced| log.push(Entry::Trace(traced)));
        Ok(())
    }

    fn steps(&mut self, count: u32) -> anyhow::Result<()> {
        (0..count).try_for_each(|_| self.step())
    }

    fn until(&mut self, lamps: [RoleLamp; 2]) -> anyhow::Result<()> {
        let shown = |of: &Self| SystemId::ALL.map(|system| of.systems.role(system));
        for _ in 0..PATIENCE {
            if shown(self) == lamps {
                return Ok(());
            }
            self.step()?;
        }
        let shown = shown(self);
        anyhow::bail!("the systems are {shown:?} instead of {lamps:?}")
    }
}

impl Emulated {
    /// Starts the systems one after the other, in one or two machines. A then drives.
    fn start(layout: WorldLayout) -> anyhow::Result<Self> {
        let options = MachineOptions {
            reintegrate: true,
            ..MachineOptions::default()
        };
        let mut of = Self {
            systems: EmulatedWorld::start(&image("controller", None)?, layout, options)?,
            vehicle: World::new(&Scenario::load("free-lane")?, WorldConfig { seed: 1 }),
            log: RunLog::default(),
        };
        of.step()?;
        of.systems.set_feed(SystemId::B, true);
        of.steps(STAGGER)?;
        of.systems.set_feed(SystemId::A, true);
        of.until([RoleLamp::Master, RoleLamp::Standby])?;
        of.steps(PAUSE)?;
        Ok(of)
    }

    fn end(mut self) -> anyhow::Result<RunLog> {
        self.systems.end()?;
        self.log.sort();
        Ok(self.log)
    }
}

/// Records a start. Both systems run in one machine, because an edge between two machines takes 1
/// to 2 ms, which is longer than the time to be measured.
pub(super) fn start() -> anyhow::Result<RunLog> {
    Emulated::start(WorldLayout::One)?.end()
}

/// Records two takeovers. Core 0 of A raises an exception, so A is reset and returns as standby.
/// Then B loses its power. Each system is a separate machine, with its tasks under FreeRTOS.
pub(super) fn takeovers() -> anyhow::Result<(RunLog, Done)> {
    let mut of = Emulated::start(WorldLayout::Two)?;
    let reset_ns = of.systems.reported().as_ns();
    of.systems.crash(SystemId::A);
    of.until([RoleLamp::Standby, RoleLamp::Master])?;
    of.steps(PAUSE)?;
    let off_ns = of.systems.reported().as_ns();
    of.systems.set_feed(SystemId::B, false);
    of.steps(PAUSE)?;
    Ok((of.end()?, Done { reset_ns, off_ns }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_image_prints_is_read() {
        let log = "exchange 50462977 50462977 48\nexchange 50462978 50462978 47\n\
                   counter false 40 23\nseen false 0 [1, 2]\nseen false 1 [1, 3]\n\
                   counter true 40 40\nseen true 0 [1, 3]\nseen true 1 [2, 4]\n";
        let (exchanges, [free, locked]) = parse(log).unwrap();
        assert_eq!(
            (exchanges[1].received, exchanges[1].took_ns),
            (50_462_978, 47.0)
        );
        assert_eq!((free.lost(), locked.lost()), (17, 0));
        assert_eq!(locked.seen, [[1, 3], [2, 4]]);
        assert!(parse(&log.replace("seen true 1", "seen true 2")).is_none());
    }
}
