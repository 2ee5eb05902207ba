//! One round of a drive: a sequence of faults is injected, then everything is restored. The round
//! ends when one system is master and the other standby again.

use std::path::Path;

use clap::Parser as _;
use tandem_board::{Duration, Instant, RoleLamp, SystemId};

use crate::args::{Cli, Command};
use tandem::args::RunArgs;

/// After the restoration, the systems must be master and standby again within this time.
pub(super) const HEALED_WITHIN: Duration = Duration::from_ms(60_000);
/// A system that has been suspended for this long is switched off and on.
pub(super) const SUSPENDED_FOR: Duration = Duration::from_ms(3_000);
/// The systems must have been master and standby for at least this long before a fault, ms.
pub(super) const SETTLED_MS: u64 = 300;
/// The longest duration of a round, s. The run is long enough for all its rounds.
const LONGEST_FAULT_S: f64 = 12.0;

/// One injected sequence of faults.
#[derive(Clone, Debug)]
pub(super) struct Injected {
    pub(super) number: u64,
    /// The system that drove at the injection.
    pub(super) driver: SystemId,
    /// Time of the injection, ns.
    pub(super) at_ns: u64,
    /// Time at which the systems were master and standby again, ns.
    pub(super) healed_ns: Option<u64>,
    /// Number of times that a suspended system was switched off and on.
    pub(super) power_cycles: u32,
    /// The roles at the end of the wait, for a message.
    pub(super) roles: [RoleLamp; 2],
}

impl Injected {
    /// Creates the record of a sequence that begins at `at`.
    pub(super) const fn new(number: u64, driver: SystemId, at: Instant) -> Self {
        Self {
            number,
            driver,
            at_ns: at.as_ns(),
            healed_ns: None,
            power_cycles: 0,
            roles: [RoleLamp::Starting; 2],
        }
    }
}

/// Returns the arguments of a run that is long enough for these faults.
pub(super) fn arguments(numbers: &[u64], out: &Path, further: &[&str]) -> anyhow::Result<RunArgs> {
    let duration_s = (numbers.len() as f64 * LONGEST_FAULT_S + 60.0).min(3_600.0);
    let line =
        format!("tandem run --scenario free-lane --duration {duration_s}s --reintegrate --quiet");
    let words = line
        .split(' ')
        .chain(further.iter().copied())
        .chain(["--out"]);
    let words = words.map(Into::into).chain([out.into()]);
    match Cli::try_parse_from::<_, std::ffi::OsString>(words)?.command {
        Command::Run(args) => Ok(args),
        _ => anyhow::bail!("`{line}` is no run"),
    }
}

/// Returns how long the systems must be master and standby before this fault. The time differs
/// between faults, so that they occur in all phases of the control cycle.
pub(super) fn settled(number: u64) -> Duration {
    Duration::from_ms(SETTLED_MS + number.wrapping_mul(7_919) % 311)
}

/// Returns the driving system if the other system is its standby. `roles` are those of A and B.
pub(super) fn driver(roles: [RoleLamp; 2]) -> Option<SystemId> {
    SystemId::ALL.into_iter().find(|system| {
        let of = |system: SystemId| roles[system.index()];
        of(*system) == RoleLamp::Master && of(system.peer()) == RoleLamp::Standby
    })
}
