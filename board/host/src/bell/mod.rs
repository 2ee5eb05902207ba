//! Doorbells: iceoryx2 events between the cores.
//!
//! Every life of a core has a bell of its own, named with the generation. Whoever rings looks up
//! which life is the current one, so that a core that was reset is found again and one that is dead
//! is rung in vain, which is what ringing a dead core means.

#[cfg(test)]
mod measure;
mod trigger;

use core::fmt;
use core::sync::atomic::Ordering::SeqCst;
use core::time::Duration as Span;
use std::sync::{Mutex, PoisonError};

use iceoryx2_bb_container::semantic_string::SemanticString;
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_cal::dynamic_storage::posix_shared_memory as shm;
use iceoryx2_cal::event::common::{Configuration, EventImpl, Handle, Waiter};
use iceoryx2_cal::event::event_state::bit_set::RelocatableBitSet;
use iceoryx2_cal::event::trigger::State;
use iceoryx2_cal::event::{
    Event, EventId, Listener, ListenerBuilder, ListenerWaitError, Notifier, NotifierBuilder,
};
use iceoryx2_cal::named_concept::NamedConceptMgmt;
use iceoryx2_cal::named_concept::{NamedConceptBuilder, NamedConceptConfiguration};
use tandem_board::{CoreId, Generation, Identity, Instant, SystemId};

use crate::backplane::Backplane;
use crate::clock;
use crate::name::RunName;
use crate::segment;
use trigger::{FutexHandle, FutexWaiter};

type EventStorage = shm::Storage<State<RelocatableBitSet, ()>>;
type BellEvent = EventImpl<RelocatableBitSet, (), EventStorage, FutexHandle, FutexWaiter>;
type BellListener = Waiter<RelocatableBitSet, (), EventStorage, FutexWaiter>;
type BellNotifier = Handle<RelocatableBitSet, (), EventStorage, FutexHandle>;

/// What is pending is in the memory that the receiver looks at; the bell carries one bit.
const RUNG: EventId = EventId::new(0);

/// The bell of a core could not be hung.
#[derive(Debug, thiserror::Error)]
#[error("doorbell of core {core}: {reason}")]
pub struct BellError {
    core: String,
    reason: String,
}

/// The bell of one life of a core, on the side of the core that is woken by it.
pub(crate) struct Bell {
    listener: BellListener,
}

impl Bell {
    /// Hangs the bell of this life and removes that of the life before.
    pub(crate) fn hang(run: &RunName, of: Identity) -> Result<Self, BellError> {
        segment::quiet();
        let error = |reason: String| BellError {
            core: format!("{}{}", of.system, of.core),
            reason,
        };
        if let Some(before) = of.generation.0.checked_sub(1) {
            let before = Identity {
                generation: Generation(before),
                ..of
            };
            // SAFETY: that life is over, and those who still ring it have it mapped, which a
            // removed name does not disturb.
            let _ = unsafe { BellEvent::remove_cfg(&file(before), &config(run)) };
        }
        let listener = <BellEvent as Event<_>>::ListenerBuilder::new(&file(of))
            .config(&config(run))
            .event_id_max(RUNG)
            .create()
            .map_err(|cause| error(cause.to_string()))?;
        Ok(Self { listener })
    }

    /// Sleeps until rung (`true`) or until the deadline has come (`false`).
    pub(crate) fn wait(&self, deadline: Instant) -> bool {
        loop {
            let left = deadline.since(clock::now()).as_ns();
            let woken = if left == 0 {
                self.listener.try_wait(|_| {})
            } else {
                self.listener.timed_wait(|_| {}, Span::from_nanos(left))
            };
            match woken {
                Ok(0) if clock::now() >= deadline => return false,
                // Left over from a ring that was taken before, or a signal.
                Ok(0) | Err(ListenerWaitError::InterruptSignal) => {}
                Ok(_) => return true,
                // Never seen. The caller looks for itself; at least nothing is lost.
                Err(_) => return true,
            }
        }
    }
}

impl fmt::Debug for Bell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Bell")
    }
}

/// The bells of all cores, on the side of those who ring.
pub(crate) struct Ringers {
    run: RunName,
    open: [[Mutex<Option<Opened>>; CoreId::COUNT]; 2],
}

struct Opened {
    generation: Generation,
    notifier: BellNotifier,
    futex: FutexHandle,
}

impl Ringers {
    pub(crate) fn new(run: &RunName) -> Self {
        Self {
            run: run.clone(),
            open: Default::default(),
        }
    }

    /// Rings the core, in whichever life it is. Does nothing if it has none. Never waits for it.
    pub(crate) fn ring(&self, backplane: Backplane, system: SystemId, core: CoreId) {
        // What the caller has written before must be seen by a life that hangs its bell just now
        // and is therefore not rung: pairs with the fence in `HostBoard::attach`.
        core::sync::atomic::fence(SeqCst);
        let generation = backplane.bell_generation(system, core);
        if generation == Generation(0) {
            return;
        }
        let mut open = self.open[system.index()][core.index()]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        if open
            .as_ref()
            .is_none_or(|opened| opened.generation != generation)
        {
            let of = Identity {
                system,
                core,
                generation,
            };
            *open = self.open(of);
        }
        if let Some(opened) = open.as_ref() {
            // The only refusals are those of a receiver that has gone.
            let woken = trigger::has_woken(|| opened.notifier.notify(RUNG));
            // iceoryx2 leaves a listener asleep whom another notifier is about to mark as notified;
            // if that one was stalled since the listener took its event, nobody wakes it any more.
            // Not always: on one CPU the listener may have come, answered and gone to sleep again
            // by now, and a second wake would cost it a look for nothing.
            if !woken {
                opened.futex.wake();
            }
        }
    }

    fn open(&self, of: Identity) -> Option<Opened> {
        segment::quiet();
        let notifier = <BellEvent as Event<_>>::NotifierBuilder::new(&file(of))
            .config(&config(&self.run))
            .open()
            .ok()?;
        let futex = FutexHandle::open(&file(of), &segment::prefix(&self.run)).ok()?;
        Some(Opened {
            generation: of.generation,
            notifier,
            futex,
        })
    }
}

impl fmt::Debug for Ringers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Ringers({})", self.run)
    }
}

fn config(run: &RunName) -> Configuration<RelocatableBitSet, (), EventStorage> {
    Configuration::default().prefix(&segment::prefix(run))
}

fn file(of: Identity) -> FileName {
    let name = format!("bell-{}{}-{}", of.system, of.core, of.generation.0);
    // Letters, digits and dashes: always a valid name. The fallback only keeps it total.
    FileName::new(name.as_bytes()).unwrap_or_else(|_| BellEvent::default_prefix())
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::sync::atomic::AtomicBool;
    use iceoryx2_bb_posix::access_mode::AccessMode;
    use iceoryx2_cal::dynamic_storage::{DynamicStorage, DynamicStorageBuilder};
    use std::thread;
    use tandem_board::Duration;

    const OF: Identity = Identity {
        system: SystemId::A,
        core: CoreId::PLANNING,
        generation: Generation(1),
    };

    /// The state that iceoryx2 keeps of an event, as a stalled notifier would reach it.
    fn state_of(run: &RunName) -> EventStorage {
        let suffix = FileName::new(b".trigger_mgmt").unwrap();
        let config = shm::Configuration::default()
            .prefix(&segment::prefix(run))
            .suffix(&suffix);
        <EventStorage as DynamicStorage<_>>::Builder::new(&file(OF))
            .config(&config)
            .has_ownership(false)
            .open(AccessMode::ReadWrite)
            .unwrap()
    }

    /// T-SYNC-3: another notifier is stalled just before it marks the listener as notified, and
    /// does so when the listener sleeps again. iceoryx2 then wakes nobody any more; the ring must.
    #[test]
    fn a_ring_wakes_whatever_a_stalled_ringer_has_left() {
        const NOTIFIED: u8 = 2;
        let run = RunName::unique();
        let backplane = Backplane::create(&run).unwrap();
        let bell = Bell::hang(&run, OF).unwrap();
        backplane.set_bell_generation(OF.system, OF.core, OF.generation);
        let asleep = AtomicBool::new(false);
        thread::scope(|scope| {
            let sleeper = scope.spawn(|| {
                let patience = clock::now() + Duration::from_ms(10_000);
                asleep.store(true, SeqCst);
                bell.wait(patience) && clock::now() < patience
            });
            while !asleep.load(SeqCst) {
                thread::yield_now();
            }
            thread::sleep(Span::from_millis(50));
            state_of(&run)
                .get()
                .notification_state
                .store(NOTIFIED, SeqCst);
            Ringers::new(&run).ring(backplane, OF.system, OF.core);
            assert!(sleeper.join().unwrap(), "slept through a ring");
        });
        Backplane::remove(&run);
    }

    #[test]
    fn a_bell_that_never_hung_is_rung_in_vain() {
        let run = RunName::unique();
        let backplane = Backplane::create(&run).unwrap();
        let ringers = Ringers::new(&run);
        ringers.ring(backplane, OF.system, OF.core);
        // The life is announced, but what it left is gone.
        backplane.set_bell_generation(OF.system, OF.core, Generation(7));
        ringers.ring(backplane, OF.system, OF.core);
        Backplane::remove(&run);
    }
}
