//! Sensors hear the time on CAN: their stamps, and what becomes of them without a master.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

use tandem_board::{CanFrame, CanId, Carried, Duration, Instant, SystemId};
use tandem_bus::{FrameReceiver, Message, SensorHeader, SensorId, TimeStateCode, TimeSync};
use tandem_timesync::{Arbitrary, CanTimeMaster, GlobalTime};
use tandem_vehicle::{Scenario, SensorTiming, World, WorldConfig};

const MS: u64 = 1_000_000;

fn at(ms: u64) -> Instant {
    Instant::from_ns(ms * MS)
}

/// The global time: ahead of the vehicle's clock, and 50 ppm faster.
fn global(at: Instant) -> GlobalTime<Arbitrary> {
    GlobalTime::from_ns(at.as_ns() + 4_290_000 * MS + at.as_ns() / 20_000)
}

/// A world, and two systems that may send the time.
struct Bench {
    world: World,
    receiver: FrameReceiver,
    masters: [CanTimeMaster; 2],
    now_ms: u64,
}

impl Bench {
    fn new(timing: &[&str]) -> Self {
        let scenario = Scenario::load("free-lane").unwrap();
        let mut world = World::new(&scenario, WorldConfig { seed: 1 });
        let timing: Vec<SensorTiming> = timing.iter().map(|it| it.parse().unwrap()).collect();
        world.set_sensor_timing(&timing);
        Self {
            world,
            receiver: FrameReceiver::new(),
            masters: SystemId::ALL.map(|system| CanTimeMaster::new(system, true, at(0))),
            now_ms: 0,
        }
    }

    /// Runs while this system is the master of time. Returns the headers, with the time at which
    /// they were sent.
    fn run(&mut self, ms: u64, master: Option<SystemId>) -> Vec<(Instant, SensorId, SensorHeader)> {
        let mut headers = Vec::new();
        for _ in 0..ms {
            let now = at(self.now_ms);
            if let Some(system) = master {
                let master = &mut self.masters[system.index()];
                if let Some(bytes) = master.poll(now, global(now)) {
                    let id = CanId::Standard(TimeSync::IDS[system.index()]);
                    let frame = CanFrame::new(id, false, &bytes).unwrap();
                    let at = now + Duration::from_us(310 + 100 * (self.now_ms % 7));
                    self.world.hear(
                        at,
                        Carried {
                            frame,
                            sent: now,
                            at,
                        },
                    );
                    master.on_sent(at, global(at), false);
                }
            }
            let receiver = &mut self.receiver;
            self.world.step(now.as_ns(), &mut |id, data| {
                let message = receiver.receive(id.into(), data).unwrap();
                if let Message::SensorHeader(sensor, header) = message {
                    headers.push((now, sensor, header));
                }
            });
            self.now_ms += 1;
        }
        headers
    }
}

/// Returns how much later than the global time the stamps are, µs, sorted by their absolute values,
/// and whether all are of this state.
fn errors(
    headers: &[(Instant, SensorId, SensorHeader)],
    delay_ms: u64,
    state: TimeStateCode,
) -> Vec<i32> {
    let mut errors: Vec<i32> = Vec::new();
    for (sent, sensor, header) in headers {
        assert_eq!(header.time_state, state, "{sensor:?} at {sent:?}");
        let measured = Instant::from_ns(sent.as_ns() - delay_ms * MS);
        let right = (global(measured).as_ns() / 1_000) as u32;
        errors.push(header.measured_at.wrapping_sub(right) as i32);
    }
    errors.sort_by_key(|it| it.abs());
    errors
}

fn print(name: &str, errors: &[i32]) {
    let of = |share: usize| errors[(errors.len() - 1) * share / 100].abs();
    println!(
        "{name}: p50 {} us, p99 {} us, max {} us of {}",
        of(50),
        of(99),
        of(100),
        errors.len()
    );
}

/// S-4: sensors stamp in global time once they hear the master, whatever their clocks show; the
/// stamp is that of the measurement, 20 ms before the frame.
#[test]
fn sensors_stamp_in_the_time_of_the_master() {
    let mut bench = Bench::new(&[
        "all:rate:100ppm",
        "radar-front:rate:-100ppm",
        "camera-front:offset:70000ms",
        "radar-rear-left:drift:0.2ppm/s",
        "all:delay:20ms",
    ]);
    let own = bench.run(1_000, None);
    assert!(
        own.iter()
            .all(|it| it.2.time_state == TimeStateCode::OwnClock)
    );
    bench.run(2_000, Some(SystemId::A));
    let synchronised = bench.run(60_000, Some(SystemId::A));
    let errors_us = errors(&synchronised, 20, TimeStateCode::Global);
    print("CAN, sensors", &errors_us);
    assert_eq!(errors_us.len(), 6 * 1_200);
    assert!(errors_us[errors_us.len() - 1].abs() <= 5, "{errors_us:?}");
}

/// S-4: the other system goes on as master of time after a takeover, and the sensors follow it.
/// Between the two, and without any master, they go on by the rate that they have learned.
#[test]
fn sensors_go_on_without_a_master_and_follow_the_next_one() {
    let mut bench = Bench::new(&["all:rate:100ppm"]);
    bench.run(20_000, Some(SystemId::A));
    let lost = bench.run(60_450, None);
    let (first, rest) = lost.split_at(6 * 6);
    errors(first, 0, TimeStateCode::Global);
    let last = rest
        .iter()
        .position(|it| it.2.time_state == TimeStateCode::Holdover);
    assert!(last.is_some_and(|it| it <= 6 * 3), "{last:?}");
    let holdover = errors(&rest[6 * 3..], 0, TimeStateCode::Holdover);
    print("CAN, 60 s without a master", &holdover);
    assert!(holdover[holdover.len() - 1].abs() <= 20, "{holdover:?}");
    bench.run(1_000, Some(SystemId::B));
    let of_b = errors(
        &bench.run(10_000, Some(SystemId::B)),
        0,
        TimeStateCode::Global,
    );
    print("CAN, of the next master", &of_b);
    assert!(of_b[of_b.len() - 1].abs() <= 5, "{of_b:?}");
}
