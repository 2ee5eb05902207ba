//! One time for the chain, attacked: loss, takeovers, lies. Judged against the grandmaster's true
//! time, from outside.

mod lies;
mod loss;
mod redundancy;
mod takeover;
mod watch;

use crate::time::watch::{S, Watch, apart, driving};
use tandem_board::{Instant, SystemId};
use tandem_sim::time_chain::{ChainConfig, Spread};

use SystemId::{A, B};

/// All clocks have converged.
pub(crate) const CONVERGED: Instant = Instant::from_ns(15_000_000_000);

/// S-1, S-2, S-3, S-4, S-5: the system that drives follows the grandmaster, the standby its pulses,
/// all sensors stamp in global time, and the control cycles of both systems start at the same
/// instants. Crystals at opposite limits. The bounds are those of `tandem time`.
#[test]
fn all_follow_the_grandmaster() {
    let mut watch = Watch::start(ChainConfig::default());
    watch.run_for(S(30));
    let chain = &watch.chain;
    let (master, standby) = (driving(chain), driving(chain).peer());
    assert_eq!([watch.source(master), watch.source(standby)], [1, 2]);
    let spread = |of| Spread::of(chain.offsets(of, CONVERGED).into_iter().map(|it| it.1));
    let [of_master, of_standby] = [spread(master), spread(standby)].map(Option::unwrap);
    assert!(
        of_master.count > 100 && of_master.max <= 1_000,
        "{of_master:?}"
    );
    assert!(
        of_standby.count > 100 && of_standby.max <= 2_000,
        "{of_standby:?}"
    );
    let (stamps, own) = chain.stamps(CONVERGED);
    let stamps = Spread::of(stamps.into_iter().map(|it| it.1)).unwrap();
    assert!(
        stamps.count > 1_000 && own == 0 && stamps.max <= 6_000,
        "{stamps:?} {own}"
    );
    let skew = Spread::of(chain.skews(CONVERGED)).unwrap();
    assert!(skew.count > 1_000 && skew.max <= 20_000, "{skew:?}");
    assert_eq!(watch.told(A).leaps + watch.told(B).leaps, 0);
    watch.assert_drives_well(&[A]);
}

/// S-1, S-4: without a grandmaster the clock of the system that drives is the time.
#[test]
fn all_follow_the_system_that_drives() {
    let mut watch = Watch::start(ChainConfig {
        grandmaster: None,
        ..ChainConfig::default()
    });
    watch.run_for(S(30));
    assert_eq!([watch.source(A), watch.source(B)], [0, 2]);
    let line = watch.line_of(A, CONVERGED);
    for (at, by) in watch.chain.offsets(B, CONVERGED) {
        assert!(apart(by, line(at)).abs() <= 2_000, "{at:?}");
    }
    let (stamps, own) = watch.chain.stamps(CONVERGED);
    assert!(stamps.len() > 1_000 && own == 0);
    for (at, by) in stamps {
        assert!(apart(by, line(at)).abs() <= 6_000, "{at:?}");
    }
    watch.assert_drives_well(&[A]);
}
