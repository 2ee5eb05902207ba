//! From power-on until all three cores are in sync, on the host board.

use crate::clock::ticks;
use crate::harness::{Batch, Plan};
use crate::shared::Shared;
use crate::worker::{Child, Part, perform};
use std::io;
use std::sync::atomic::Ordering;
use tandem_board::{Board, CoreId, Duration, Generation};
use tandem_board_host::{HostBoard, UnsupervisedSystem, isolation};
use tandem_shm::incarnation::Incarnation;
use tandem_shm::mailbox::{Ring, TaskId};
use tandem_shm::map::{AttachError, Layout, Map};
use tandem_shm::region::{Mailbox, Region};

const CORES: usize = CoreId::COUNT;
/// One mailbox from each core to each other.
const MAILBOXES: [Region<Mailbox>; 6] = {
    let from_1_to_0 = Region::first("mailbox 1 to 0");
    let from_2_to_0 = from_1_to_0.then("mailbox 2 to 0");
    let from_0_to_1 = from_2_to_0.then("mailbox 0 to 1");
    let from_2_to_1 = from_0_to_1.then("mailbox 2 to 1");
    let from_0_to_2 = from_2_to_1.then("mailbox 0 to 2");
    let from_1_to_2 = from_0_to_2.then("mailbox 1 to 2");
    [
        from_1_to_0,
        from_2_to_0,
        from_0_to_1,
        from_2_to_1,
        from_0_to_2,
        from_1_to_2,
    ]
};
const LAYOUT: Layout = MAILBOXES[5].end();

/// Which mailbox lies between two different cores.
const fn mailbox(from: usize, to: usize) -> usize {
    2 * to + if from < to { from } else { from - 1 }
}

const STARTED: u8 = 1;

/// Each round powers a fresh system on: LMU, doorbells, data flash, three core processes. Core 0
/// formats the LMU; each core announces its incarnation, signals both others and waits, asleep, for
/// theirs. A sample is the time from before the power-on until the last core is in sync.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or a core failed.
pub fn start_up(plan: &Plan) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let supply = Part::on(plan.cpus[0], |role| {
        let place = isolation::enter().map_err(io::Error::other)?;
        for round in 0..plan.warm_up + plan.rounds {
            let begin = ticks();
            let system = UnsupervisedSystem::power_on(&place).map_err(io::Error::other)?;
            let start = |core: CoreId| {
                let in_sync = role.shared.line(core.index());
                Child::start(plan.cpus[core.index() % 2], || {
                    let done = start_core(&system, core).is_ok();
                    in_sync.store(ticks(), Ordering::Relaxed);
                    done
                })
            };
            let cores = CoreId::ALL.map(start);
            for core in cores {
                core?.join()?;
            }
            let in_sync = (0..CORES).map(|core| role.shared.line(core).load(Ordering::Relaxed));
            let last = in_sync.map(|at| at.wrapping_sub(begin)).max();
            if round >= plan.warm_up {
                role.log.push(0, last.unwrap_or(0));
            }
            place.wipe();
        }
        Ok(())
    });
    perform(&shared, vec![supply])?;
    Ok(Batch {
        cpu_ns_per_message: None,
        memory_bytes: None,
        payload_bytes: 0,
        ..Batch::collect(&shared, 1, plan.rounds, 0)
    })
}

/// The incarnation of a core until it has heard of both others.
fn start_core(system: &UnsupervisedSystem, core: CoreId) -> Result<(), Box<dyn std::error::Error>> {
    let board = system.attach(core, Generation(1))?;
    let map = map(&board, core);
    let incarnation = Incarnation::new(core.index(), 1).ok_or("no incarnation")?;
    map.incarnations()
        .announce(incarnation)
        .map_err(|_| "outdated")?;
    let started = TaskId::new(STARTED).ok_or("no task")?;
    let others = CoreId::ALL.into_iter().filter(|other| *other != core);
    let mut receivers = vec![];
    for other in others.clone() {
        let inward = MAILBOXES[mailbox(other.index(), core.index())];
        let receiver = inward.receiver(&map, incarnation).map_err(|_| "taken")?;
        receivers.push((receiver, false));
    }
    for other in others {
        let out = MAILBOXES[mailbox(core.index(), other.index())];
        let mut sender = out.sender(&map, incarnation).map_err(|_| "taken")?;
        if sender.signal(started) == Ring::Needed {
            board.ring(other);
        }
    }
    loop {
        for (receiver, heard) in &mut receivers {
            *heard |= receiver.poll(|_| {}) > 0;
        }
        if receivers.iter().all(|(_, heard)| *heard) {
            return Ok(());
        }
        let may_sleep = receivers
            .iter_mut()
            .map(|(receiver, _)| receiver.prepare_sleep())
            .fold(true, |all, one| all & one);
        if may_sleep {
            board.wait(board.now() + Duration::from_ms(100));
        }
        for (receiver, _) in &mut receivers {
            receiver.awake();
        }
    }
}

/// Core 0 formats the LMU, the others wait until it is ready.
fn map(board: &HostBoard, core: CoreId) -> Map<'_> {
    loop {
        let map = if core == CoreId::CONTROL {
            Map::format(board.lmu(), LAYOUT).map_err(AttachError::from)
        } else {
            Map::attach(board.lmu(), LAYOUT)
        };
        match map {
            Ok(map) => return map,
            Err(AttachError::NotReady) => std::thread::yield_now(),
            Err(error) => panic!("the LMU cannot be used: {error:?}"),
        }
    }
}

/// Three processes that do nothing, until the last one has ended.
///
/// # Errors
/// If the processes or the shared memory cannot be had.
pub fn fork_three(plan: &Plan) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let parent = Part::on(plan.cpus[0], |role| {
        for round in 0..plan.warm_up + plan.rounds {
            let begin = ticks();
            let children = [0, 1, 2].map(|n| Child::start(plan.cpus[n % 2], || true));
            for child in children {
                child?.join()?;
            }
            if round >= plan.warm_up {
                role.log.push(0, ticks().wrapping_sub(begin));
            }
        }
        Ok(())
    });
    perform(&shared, vec![parent])?;
    Ok(Batch {
        cpu_ns_per_message: None,
        memory_bytes: None,
        payload_bytes: 0,
        ..Batch::collect(&shared, 1, plan.rounds, 0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_pair_of_cores_has_a_mailbox_of_its_own() {
        let mut mailboxes: Vec<_> = (0..CORES)
            .flat_map(|from| (0..CORES).map(move |to| (from, to)))
            .filter(|(from, to)| from != to)
            .map(|(from, to)| mailbox(from, to))
            .collect();
        mailboxes.sort_unstable();
        assert_eq!(mailboxes, (0..MAILBOXES.len()).collect::<Vec<_>>());
    }
}
