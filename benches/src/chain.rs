//! A wake-up that is passed on: from core 1 over core 2 to core 0.
//!
//! Core 1 sends its time stamp to core 2, which passes it on to core 0, which takes the time when
//! its handler runs and then tells core 1 that the next round may begin. Cores 1 and 0 share the
//! near CPU, core 2 has the far one.

use crate::clock::ticks;
use crate::harness::{Batch, End, Plan};
use crate::shared::Shared;
use crate::worker::{Part, Role, perform};
use std::io;

/// The parts in the order of the chain; each sends to the next and receives from the one before.
pub const PARTS: usize = 3;

/// Passes stamps around; `end` makes the end of each part. `own_bytes` of the words that the
/// harness shares belong to the case.
///
/// # Errors
/// If the processes or the shared memory cannot be had, or an end failed.
pub fn through_three<E: End>(
    plan: &Plan,
    own_bytes: u64,
    end: impl Fn(usize, &Shared) -> E,
) -> io::Result<Batch> {
    let shared = Shared::new()?;
    let end = &end;
    let rounds = plan.warm_up + plan.rounds;
    let part = |number: usize| {
        Part::on(plan.cpus[number % 2], move |role: &mut Role<'_>| {
            let mut end = end(number, role.shared);
            role.shared.meet(PARTS as u32);
            for round in 0..rounds {
                if round == plan.warm_up {
                    role.begin();
                }
                match number {
                    0 => {
                        end.send(ticks());
                        end.receive();
                    }
                    1 => {
                        let stamp = end.receive();
                        end.send(stamp);
                    }
                    _ => {
                        let stamp = end.receive();
                        let way = ticks().wrapping_sub(stamp);
                        if round >= plan.warm_up {
                            role.log.push(0, way);
                        }
                        end.send(ticks());
                    }
                }
            }
            role.end();
            Ok(())
        })
    };
    perform(&shared, (0..PARTS).map(part).collect())?;
    Ok(Batch::collect(
        &shared,
        PARTS,
        PARTS * plan.rounds,
        own_bytes,
    ))
}
