//! Real time as far as the machine permits: a pinned CPU, SCHED_FIFO, locked memory, no timer
//! slack.

use core::fmt;
use std::hint::black_box;

use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit};
use rustix::thread::{CapabilitySet, capabilities};

/// The claims of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Claim {
    /// Priority under SCHED_FIFO, 1 ..= 99; `None` requests the default policy.
    pub priority: Option<u8>,
    /// The CPU, as an index into those that this process may use (modulo their number); with `None`
    /// the kernel chooses.
    pub cpu: Option<usize>,
    /// Whether memory must stay resident.
    pub lock_memory: bool,
}

/// The granted claims; none by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Grant {
    /// The priority under SCHED_FIFO, if granted.
    pub fifo: Option<u8>,
    /// The number of the CPU to which the process is pinned, if it is pinned.
    pub cpu: Option<usize>,
    /// Whether memory stays resident after its first access.
    pub memory_locked: bool,
}

impl Grant {
    /// Returns whether timing may be judged by real-time limits.
    #[must_use]
    pub const fn is_realtime(&self) -> bool {
        self.fifo.is_some()
    }
}

impl fmt::Display for Grant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.fifo {
            Some(priority) => write!(f, "SCHED_FIFO {priority}")?,
            None => f.write_str("no real-time priority")?,
        }
        match self.cpu {
            Some(cpu) => write!(f, ", pinned to CPU {cpu}")?,
            None => f.write_str(", not pinned")?,
        }
        f.write_str(if self.memory_locked {
            ", memory locked"
        } else {
            ", memory not locked"
        })
    }
}

/// How many bytes of stack are touched in advance: more than the deepest cycle of a core uses.
const STACK: usize = 256 * 1024;

/// Makes the claims for the calling thread (and for its process's memory) and returns what was
/// granted. Threads that are started later inherit the CPU but not the priority.
///
/// Memory is locked when it is first touched, not all at once, because the kernel releases the
/// touched memory of a killed process before it reports the death (about 58 µs per MiB).
pub fn claim(claim: Claim) -> Grant {
    // An error only means that the kernel does not have this setting.
    let _ = rustix::thread::set_current_timer_slack(core::num::NonZeroU64::new(1));
    let cpu = claim.cpu.and_then(pin);
    let memory_locked = claim.lock_memory && may_lock() && {
        let flags = MlockAllFlags::CURRENT | MlockAllFlags::FUTURE | MlockAllFlags::ONFAULT;
        mlockall(flags).is_ok()
    };
    touch_stack();
    let fifo = claim.priority.filter(|priority| set_fifo(*priority));
    Grant {
        fifo,
        cpu,
        memory_locked,
    }
}

/// Returns what [`claim`] would grant, without changing the calling thread or its process's memory.
#[must_use]
pub fn probe(wanted: Claim) -> Grant {
    let tried = std::thread::spawn(move || {
        claim(Claim {
            lock_memory: false,
            ..wanted
        })
    })
    .join();
    Grant {
        memory_locked: wanted.lock_memory && may_lock(),
        ..tried.unwrap_or_default()
    }
}

/// Returns how many CPUs this process may use; at least 1.
#[must_use]
pub fn cpus() -> usize {
    core_affinity::get_core_ids().map_or(1, |ids| ids.len().max(1))
}

fn pin(index: usize) -> Option<usize> {
    let ids = core_affinity::get_core_ids()?;
    let id = *ids.get(index.checked_rem(ids.len())?)?;
    core_affinity::set_for_current(id).then_some(id.id)
}

/// Returns whether memory may be locked without limit; with a limit, later allocations would fail.
fn may_lock() -> bool {
    let unlimited = getrlimit(Resource::Memlock).current.is_none();
    let privileged =
        capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::IPC_LOCK));
    unlimited || privileged
}

fn set_fifo(priority: u8) -> bool {
    // Threads and processes that this thread starts do not inherit the policy.
    set_policy(libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, priority)
}

/// Gives the real-time priority of the calling thread back. Returns whether it has none now.
pub fn give_back() -> bool {
    set_policy(libc::SCHED_OTHER, 0)
}

/// Sets the scheduling of the calling thread. Returns whether the kernel permits it.
fn set_policy(policy: libc::c_int, priority: u8) -> bool {
    let param = libc::sched_param {
        sched_priority: libc::c_int::from(priority),
    };
    // SAFETY: `param` is a valid `sched_param` during the call; 0 means the calling thread.
    unsafe { libc::sched_setscheduler(0, policy, &raw const param) == 0 }
}

#[inline(never)]
fn touch_stack() {
    let stack = [0_u8; STACK];
    black_box(&stack);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_says_what_was_granted() {
        let none = Grant {
            fifo: None,
            cpu: None,
            memory_locked: false,
        };
        assert_eq!(
            none.to_string(),
            "no real-time priority, not pinned, memory not locked"
        );
        let all = Grant {
            fifo: Some(60),
            cpu: Some(1),
            memory_locked: true,
        };
        assert_eq!(
            all.to_string(),
            "SCHED_FIFO 60, pinned to CPU 1, memory locked"
        );
    }

    #[test]
    fn a_claim_for_nothing_is_granted_nothing() {
        let claimed = claim(Claim {
            priority: None,
            cpu: None,
            lock_memory: false,
        });
        assert_eq!(
            claimed,
            Grant {
                fifo: None,
                cpu: None,
                memory_locked: false
            }
        );
    }

    #[test]
    fn a_probe_leaves_the_caller_alone() {
        let cpus_before = cpus();
        let _ = probe(Claim {
            priority: Some(1),
            cpu: Some(0),
            lock_memory: true,
        });
        assert_eq!(cpus(), cpus_before);
        // SAFETY: only reads the policy of the calling thread.
        assert_eq!(unsafe { libc::sched_getscheduler(0) }, libc::SCHED_OTHER);
    }

    /// In a thread of its own: where the machine grants no priority, there is none to give back.
    #[test]
    fn a_priority_is_given_back() {
        let policy = std::thread::spawn(|| {
            let _ = set_fifo(1);
            assert!(give_back());
            // SAFETY: only reads the policy of the calling thread.
            unsafe { libc::sched_getscheduler(0) }
        });
        assert_eq!(
            policy.join().unwrap() & !libc::SCHED_RESET_ON_FORK,
            libc::SCHED_OTHER
        );
    }

    #[test]
    fn any_index_names_a_cpu() {
        let handle = std::thread::spawn(|| {
            claim(Claim {
                priority: None,
                cpu: Some(1_000_003),
                lock_memory: false,
            })
            .cpu
        });
        assert!(handle.join().unwrap().is_some());
    }
}
