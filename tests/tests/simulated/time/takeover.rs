//! Takeovers: the new master goes on from the time that it followed.

use crate::time::CONVERGED;
use crate::time::watch::{MS, S, Watch, apart};
use tandem_board::{CoreId, Duration, Instant, ResetCause, SystemId};
use tandem_sim::time_chain::{Chain, ChainConfig};
use tandem_timesync::TimeStatus;

use SystemId::{A, B};

/// How a master fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Failure {
    PowerLoss,
    Reset,
    Freeze,
    CoreDies,
}

const FAILURES: [Failure; 4] = [
    Failure::PowerLoss,
    Failure::Reset,
    Failure::Freeze,
    Failure::CoreDies,
];

impl Failure {
    fn befalls(self, of: SystemId, chain: &mut Chain) {
        let pair = &mut chain.drive.pair;
        match self {
            Self::PowerLoss => pair.power_off(of),
            Self::Reset => pair.reset(of, ResetCause::Software),
            Self::Freeze => pair.freeze(of, MS(300)),
            Self::CoreDies => pair.kill_core(of, CoreId::CONTROL),
        }
    }
}

/// When the master fails.
const FAILS: Duration = Duration::from_ms(20_000);
/// A stamp of a sensor counts microseconds; a new master errs by what it erred as a follower, and
/// the sensors by what they erred.
const CONTINUOUS_NS: i64 = 12_000;

/// Drives until a takeover, then until the old master, if it lives, has followed for a while.
fn taken_over(failure: Failure, config: ChainConfig) -> Watch {
    let mut watch = Watch::start(config);
    watch.run_for(FAILS);
    failure.befalls(A, &mut watch.chain);
    watch.run_for(S(12));
    if failure == Failure::PowerLoss {
        watch.chain.drive.pair.power_on(A);
    }
    watch.run_for(S(16));
    watch
}

/// S-4, T-RED-4: whatever ends the master, its successor goes on from the time that it followed. No
/// time and no stamp of a sensor leaps, and the old master follows when it is back.
#[test]
fn the_new_master_goes_on_from_the_time_that_it_followed() {
    for failure in FAILURES {
        let watch = taken_over(failure, ChainConfig::default());
        println!("{failure:?}");
        watch.assert_drives_well(&[A, B]);
        assert_eq!([watch.source(A), watch.source(B)], [2, 1], "{failure:?}");
        assert_eq!(watch.told(B).leaps, 0, "{failure:?}");
        for of in SystemId::ALL {
            let from = if of == A {
                Instant::ORIGIN + FAILS + S(25)
            } else {
                CONVERGED
            };
            let offsets = watch.chain.offsets(of, from);
            assert!(!offsets.is_empty(), "{failure:?}");
            for (at, by) in offsets {
                assert!(by.abs() <= 2_000, "{failure:?}: {of} {by} ns at {at:?}");
            }
        }
        let (stamps, own) = watch.chain.stamps(CONVERGED);
        let farthest = stamps.iter().map(|it| it.1.abs()).max();
        assert!(stamps.len() > 3_000 && own == 0, "{failure:?} {own}");
        assert!(farthest <= Some(CONTINUOUS_NS), "{failure:?}: {farthest:?}");
    }
}

/// S-4: the same without a grandmaster. The time is that of the dead master's crystal, by what its
/// successor learned of it; its status says so.
#[test]
fn the_time_of_a_dead_master_goes_on() {
    for failure in FAILURES {
        let config = ChainConfig {
            grandmaster: None,
            ..ChainConfig::default()
        };
        let mut watch = Watch::start(config);
        watch.run_for(FAILS);
        let line = watch.line_of(A, CONVERGED);
        failure.befalls(A, &mut watch.chain);
        watch.run_for(S(12));
        println!("{failure:?}");
        watch.assert_drives_well(&[A, B]);
        assert!(
            watch.reading(B).status.has(TimeStatus::HOLDOVER),
            "{failure:?}"
        );
        for (at, by) in watch.chain.offsets(B, CONVERGED) {
            let by = apart(by, line(at));
            assert!(by.abs() <= 5_000, "{failure:?}: {by} ns at {at:?}");
        }
        let (stamps, own) = watch.chain.stamps(CONVERGED);
        assert!(stamps.len() > 1_500 && own == 0, "{failure:?} {own}");
        for (at, by) in stamps {
            let by = apart(by, line(at));
            assert!(by.abs() <= CONTINUOUS_NS, "{failure:?}: {by} ns at {at:?}");
        }
        if failure != Failure::PowerLoss {
            watch.run_for(S(10));
            assert_eq!([watch.source(A), watch.source(B)], [2, 0], "{failure:?}");
            let apart = watch.reading(A).time.after(watch.reading(B).time);
            assert!(apart.abs() <= 2_000, "{failure:?}: {apart}");
        }
    }
}
