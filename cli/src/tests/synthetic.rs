//! A synthetic run, for tests of the figures and of the report.

use tandem_board::{CoreId, Instant, SystemId, Traced};
use tandem_bus::{ModeCode, RoleCode};
use tandem_cores::task_table::TaskCode;
use tandem_cores::trace::{Begin, Event};
use tandem_record::log::{DriveFigures, Header, Lane, Other, RoadPiece, Sample, VehicleRecord};
use tandem_record::run_log::{ControlFrame, CoreEvent, StatusFrame};
use tandem_record::{Entry, RunLog};
use tandem_redundancy::Evidence;
use tandem_vehicle::Ruling;

/// Time on the run's clock at the start of the world, ns.
const START_NS: u64 = 1_700_000_000;

/// A small deterministic noise generator.
struct Noise(u64);

impl Noise {
    /// Returns a number from -1 to 1. Large values are rare.
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        let u = (self.0 >> 11) as f64 / (1_u64 << 53) as f64 * 2.0 - 1.0;
        u * u * u
    }
}

/// Returns a run of `duration_s` in which A loses power in the middle and B takes over.
pub(crate) fn with_takeover(duration_s: f64) -> RunLog {
    let mut log = RunLog::default();
    push(
        &mut log,
        VehicleRecord::Header(Header {
            scenario: "cut-in".into(),
            seed: 1,
            duration_s,
            epoch_us: 0,
            cpus: (0..6).collect(),
        }),
    );
    push(
        &mut log,
        VehicleRecord::Road(RoadPiece {
            at_ns: START_NS,
            lanes: (0..3).map(lane).collect(),
        }),
    );
    push(&mut log, VehicleRecord::Start { at_ns: START_NS });
    let middle_ns = START_NS + (duration_s * 0.5e9) as u64;
    let end_ns = START_NS + (duration_s * 1e9) as u64;
    add_samples(&mut log, end_ns);
    add_control(&mut log, middle_ns, end_ns);
    add_status(&mut log, middle_ns, end_ns);
    push(
        &mut log,
        VehicleRecord::Power {
            at_ns: middle_ns,
            system: 0,
            on: false,
        },
    );
    push(
        &mut log,
        VehicleRecord::Figures(DriveFigures {
            lateral_error_max_m: 0.13,
            lead_gap_min_m: Some(22.0),
            ttc_min_s: Some(21.7),
            distance_m: 22.0 * duration_s,
            ..DriveFigures::default()
        }),
    );
    push(
        &mut log,
        VehicleRecord::End {
            at_ns: end_ns,
            lost_trace: 0,
            stalled_ms: 0.0,
        },
    );
    log.sort();
    log
}

fn push(log: &mut RunLog, record: VehicleRecord) {
    log.push(record.into());
}

/// Returns the lateral position of the road's middle at `x`.
fn road(x: f64) -> f64 {
    12.0 * (x / 220.0).sin()
}

fn lane(number: i32) -> Lane {
    let border = |offset: f64| {
        (-20..300)
            .map(|i| f64::from(i) * 5.0)
            .map(move |x| [x, road(x) + offset])
    };
    let right = f64::from(number - 1) * 3.5 - 1.75;
    Lane {
        left: border(right + 3.5).collect(),
        right: border(right).collect(),
    }
}

fn add_samples(log: &mut RunLog, end_ns: u64) {
    let (mut x, mut speed, mut noise) = (0.0_f64, 20.0_f64, Noise(7));
    for (step, at_ns) in (START_NS..end_ns).step_by(20_000_000).enumerate() {
        let t = step as f64 * 0.02;
        let accel = 1.2 * (t / 4.0).sin() * (-(t / 40.0)).exp() + 0.02 * noise.next();
        speed += accel * 0.02;
        x += speed * 0.02;
        let lateral_error = 0.12 * (t / 3.0).sin() + 0.01 * noise.next();
        let heading = (12.0 / 220.0 * (x / 220.0).cos()).atan();
        let gap = 30.0 - 8.0 * (t / 6.0).sin();
        let other = |ahead: f64, offset: f64, length: f64| Other {
            x: x + ahead,
            y: road(x + ahead) + offset,
            heading: (12.0 / 220.0 * ((x + ahead) / 220.0).cos()).atan(),
            length,
            width: if length > 6.0 { 2.5 } else { 1.85 },
        };
        push(
            log,
            VehicleRecord::Sample(Sample {
                at_ns,
                x,
                y: road(x) + lateral_error,
                heading,
                speed,
                set_speed: Some(27.0),
                accel,
                lat_accel: 0.5 * (t / 3.0).cos(),
                lane: 1,
                lateral_error,
                lead_gap: (t > 6.0).then_some(gap),
                closing_speed: Some(8.0 / 6.0 * (t / 6.0).cos()),
                others: vec![
                    other(gap + 4.6, 0.0, 4.6),
                    other(12.0, 3.5, 4.4),
                    other(-22.0, -3.5, 12.0),
                    other(55.0, -3.5, 4.5),
                ],
            }),
        );
    }
}

/// Returns the driving system at a time, its term and its mode.
const fn master(at_ns: u64, middle_ns: u64) -> (SystemId, u32, ModeCode) {
    if at_ns < middle_ns {
        (SystemId::A, 2, ModeCode::L3)
    } else {
        (SystemId::B, 3, ModeCode::DegradedL2)
    }
}

fn add_control(log: &mut RunLog, middle_ns: u64, end_ns: u64) {
    let mut noise = Noise(99);
    let mut add = |at_ns, system, event| {
        log.events.push(CoreEvent {
            at_ns,
            system,
            core: CoreId::CONTROL,
            event,
        });
    };
    let (generation, cause) = (1, 0);
    let started = Event::Started { generation, cause };
    let role = |role: RoleCode, mode: ModeCode, term| Event::Role {
        role: role as u8,
        mode: mode as u8,
        term,
    };
    let took = Event::TookOver {
        cause: Evidence::PeerOff,
        since_heartbeat_us: 1_100,
        since_control_us: 9_000,
        term: 3,
    };
    add(START_NS - 300_000_000, SystemId::A, started);
    add(START_NS - 290_000_000, SystemId::B, started);
    let [first, second] = [RoleCode::Master, RoleCode::Standby].map(|of| role(of, ModeCode::L3, 2));
    add(START_NS - 20_000_000, SystemId::A, first);
    add(START_NS - 19_000_000, SystemId::B, second);
    add(middle_ns + 620_000, SystemId::B, took);
    let degraded = role(RoleCode::Master, ModeCode::DegradedL2, 3);
    add(middle_ns + 630_000, SystemId::B, degraded);
    for cycle_ns in (START_NS..end_ns).step_by(50_000_000) {
        let latency_ns = ((14.0 + 3.0 * noise.next()) * 1e6) as u32;
        let chain = Event::Chain {
            latency_ns,
            cycle: 0,
        };
        add(cycle_ns + 15_000_000, master(cycle_ns, middle_ns).0, chain);
    }
    for cycle_ns in (START_NS..end_ns).step_by(10_000_000) {
        let late_ns = 60_000 + (50_000.0 * (1.0 + noise.next())) as u64;
        let (system, term, mode) = master(cycle_ns, middle_ns);
        let phase_ns = if term == 2 { 0 } else { 3_300_000 };
        let sent_ns = cycle_ns + phase_ns + late_ns;
        log.control.push(ControlFrame {
            at_ns: (sent_ns + 40_000) / 1_000_000 * 1_000_000 + 1_000_000,
            sent_ns,
            system,
            term,
            mode,
            asks: false,
            age_ns: None,
            ruling: Ruling::Accepted,
        });
    }
}

fn add_status(log: &mut RunLog, middle_ns: u64, end_ns: u64) {
    for at_ns in (START_NS..end_ns).step_by(100_000_000) {
        let (driving, _, mode) = master(at_ns, middle_ns);
        for system in SystemId::ALL {
            let (role, mode) = match system == driving {
                true => (RoleCode::Master, mode),
                false => (RoleCode::Standby, ModeCode::L3),
            };
            // From the middle of the run on, A sends nothing.
            if system == driving || driving == SystemId::A {
                log.status.push(StatusFrame {
                    at_ns,
                    system,
                    role,
                    mode,
                    ability: tandem_bus::AbilityCode::All,
                });
            }
        }
    }
}

/// Adds the time of a grandmaster that is `ahead_ns` ahead of the run's clock. A is 2 µs later and
/// B 1 µs earlier than that; A's control cycles begin 8 µs later. A is in holdover from 10 s to
/// 14 s, and follows a leap at 15 s.
pub(crate) fn add_time(log: &mut RunLog, ahead_ns: u64) {
    let end_ns = log.end_ns.unwrap_or(START_NS);
    let mut traced = |system, at_ns, event: Event| {
        log.push(Entry::Trace(Traced {
            at: Instant::from_ns(at_ns),
            system,
            core: CoreId::CONTROL,
            record: event.encode(),
        }));
    };
    for (system, source, by_ns) in [(SystemId::A, 1, 2_000), (SystemId::B, 2, -1_000)] {
        for at_ns in (START_NS..end_ns).step_by(100_000_000) {
            let after_s = (at_ns - START_NS) / 1_000_000_000;
            let is_held = system == SystemId::A && (10..14).contains(&after_s);
            let global_ns = (at_ns + ahead_ns).wrapping_add_signed(by_ns) as u32;
            let event = Event::Time {
                source,
                status: if is_held { 0x89 } else { 0x08 },
                global_ns,
                local_ns: at_ns as u32,
                rate_ppb: 200,
            };
            traced(system, at_ns, event);
            let event = Event::TimeSample {
                source,
                offset_ns: -(by_ns as i32),
                delay_ns: if source == 1 { 7_000 } else { 0 },
                error_ns: 17_000,
            };
            traced(system, at_ns, event);
        }
        let late_ns = if system == SystemId::A { 8_000 } else { 0 };
        for at_ns in (START_NS + late_ns..end_ns).step_by(10_000_000) {
            let begin = Begin::Released {
                late_ns: 0,
                missed: 0,
            };
            let task = TaskCode::CONTROL;
            traced(system, at_ns, Event::TaskIn { task, begin });
        }
    }
    let leap = Event::TimeLeap {
        source: 1,
        followed: true,
        by_us: 3_000,
    };
    traced(SystemId::A, START_NS + 15_000_000_000, leap);
    log.sort();
}
