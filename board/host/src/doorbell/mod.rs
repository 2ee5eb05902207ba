//! Doorbells: iceoryx2 events between the cores, and from the cores to the bus.
//!
//! A core has one doorbell for the whole run, created and reserved before the first process starts
//! ([`install`]). Each incarnation of the core takes it over with [`Doorbell::attach`], in the same
//! memory. So a ringer keeps its mapping, reaches the core again after a reset, and makes a system
//! call only if the core sleeps. Ringing a dead core has no effect.
//!
//! The types are public for iceoryx2's own conformance suite: `tests/iceoryx2.rs`.

mod bits;
#[cfg(test)]
#[path = "tests/measure.rs"]
mod measure;
mod trigger;

use core::fmt;
use core::sync::atomic::Ordering::SeqCst;
use core::sync::atomic::fence;
use core::time::Duration as Span;

use iceoryx2_bb_container::semantic_string::SemanticString;
use iceoryx2_bb_posix::access_mode::AccessMode;
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_cal::dynamic_storage::{DynamicStorage, DynamicStorageBuilder};
use iceoryx2_cal::event::common::{Configuration, EventImpl, Waiter};
use iceoryx2_cal::event::event_state::EventState as _;
use iceoryx2_cal::event::trigger::State;
use iceoryx2_cal::event::{Event, EventId, Listener, ListenerBuilder, ListenerWaitError};
#[cfg(test)]
use iceoryx2_cal::named_concept::NamedConceptMgmt;
use iceoryx2_cal::named_concept::{NamedConceptBuilder, NamedConceptConfiguration};
use tandem_board::{CoreAddress, CoreId, Instant, SystemId};

use crate::clock;
use crate::name::RunName;
use crate::segment;
use crate::storage::Storage;

pub use bits::PendingBits;
pub use trigger::{Futex, FutexHandle, FutexWaiter};

/// An iceoryx2 event with state `E`, in reserved memory; the listener sleeps on a futex.
pub type FutexEvent<E, const LASTING: bool> =
    EventImpl<E, Futex, Storage<State<E, Futex>, LASTING>, FutexHandle, FutexWaiter>;

type DoorbellEvent = FutexEvent<PendingBits, true>;
type DoorbellState = State<PendingBits, Futex>;
type DoorbellStorage = Storage<DoorbellState, true>;
type DoorbellListener = Waiter<PendingBits, Futex, DoorbellStorage, FutexWaiter>;

/// The doorbell's only event: its receiver reads the details from other memory.
const RUNG: EventId = EventId::new(0);

/// The doorbell of a core could not be set up.
#[derive(Debug, thiserror::Error)]
#[error("doorbell of {of}: {reason}")]
pub struct DoorbellError {
    of: String,
    reason: String,
}

/// The owner of a doorbell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Owner {
    Core(CoreAddress),
    /// The bus, which is part of the vehicle's process.
    Bus,
}

impl Owner {
    fn all() -> impl Iterator<Item = Self> {
        CoreAddress::ALL
            .into_iter()
            .map(Self::Core)
            .chain([Self::Bus])
    }

    fn name(self) -> String {
        match self {
            Self::Core(CoreAddress { system, core }) => format!("{system}{core}"),
            Self::Bus => "bus".to_owned(),
        }
    }

    fn file(self) -> FileName {
        let name = format!("doorbell-{}", self.name());
        // Letters, digits and dashes always form a valid name; the fallback is never used.
        FileName::new(name.as_bytes()).unwrap_or(segment::FALLBACK)
    }
}

/// Creates all doorbells of the run and reserves their memory.
pub(crate) fn install(run: &RunName) -> Result<(), DoorbellError> {
    Owner::all().try_for_each(|of| listener(run, of).map(drop))
}

/// Removes the doorbells that a test has installed.
#[cfg(test)]
pub(crate) fn remove(run: &RunName) {
    for of in Owner::all() {
        // SAFETY: POSIX shared memory keeps its content for every process that has it mapped.
        let removed = unsafe { DoorbellEvent::remove_cfg(&of.file(), &config(run)) };
        assert!(removed.unwrap());
    }
}

fn listener(run: &RunName, of: Owner) -> Result<DoorbellListener, DoorbellError> {
    segment::quiet();
    <DoorbellEvent as Event<_>>::ListenerBuilder::new(&of.file())
        .config(&config(run))
        .event_id_max(RUNG)
        .create()
        .map_err(|cause| DoorbellError {
            of: of.name(),
            reason: format!("{cause}; is /dev/shm full?"),
        })
}

/// The owner's end of a doorbell. A ring wakes the owner.
pub(crate) struct Doorbell {
    listener: DoorbellListener,
}

impl Doorbell {
    /// Takes over the doorbell of this owner. Earlier rings are lost, so the caller must poll all
    /// sources before its first sleep.
    pub(crate) fn attach(run: &RunName, of: Owner) -> Result<Self, DoorbellError> {
        let listener = listener(run, of)?;
        // Pairs with the fence in `Ringers::ring`: if a ring was lost here, the owner's first poll
        // sees everything that the ringer wrote before the ring.
        fence(SeqCst);
        Ok(Self { listener })
    }

    /// Sleeps until rung (returns `true`) or until the deadline has passed (returns `false`).
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
                // The wake-up of a ring that was already handled, or a signal.
                Ok(0) | Err(ListenerWaitError::InterruptSignal) => {}
                Ok(_) => return true,
                // This error was never observed. The caller polls all sources, so no event is lost.
                Err(_) => return true,
            }
        }
    }
}

impl fmt::Debug for Doorbell {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Doorbell")
    }
}

/// The ringers' ends of all doorbells. They can ring from any context.
pub(crate) struct Ringers {
    run: RunName,
    cores: [Option<DoorbellStorage>; CoreAddress::COUNT],
    bus: Option<DoorbellStorage>,
}

impl Ringers {
    /// Maps the doorbells of the run. Ringing a missing doorbell has no effect.
    pub(crate) fn new(run: &RunName) -> Self {
        segment::quiet();
        Self {
            run: run.clone(),
            cores: CoreAddress::ALL.map(|core| storage_of(run, Owner::Core(core))),
            bus: storage_of(run, Owner::Bus),
        }
    }

    /// Rings the current incarnation of the core. No effect if there is none. Never blocks.
    pub(crate) fn ring(&self, system: SystemId, core: CoreId) {
        Self::wake(self.cores[CoreAddress::new(system, core).index()].as_ref());
    }

    /// Rings the bus because a frame waits. No effect without a vehicle. Never blocks.
    pub(crate) fn ring_bus(&self) {
        Self::wake(self.bus.as_ref());
    }

    /// Does what a notifier of iceoryx2 does, with one difference: a notifier skips the trigger if
    /// the state of the event says that the listener is notified. Another notifier sets this state
    /// after its own trigger. If that notifier stalls in between, the listener may handle its event
    /// and sleep again; then the state is "notified", and no later ring wakes the listener.
    fn wake(doorbell: Option<&DoorbellStorage>) {
        // Pairs with the fence in `Doorbell::attach`.
        fence(SeqCst);
        if let Some(doorbell) = doorbell {
            let doorbell: &DoorbellState = doorbell.get();
            // Fails only if a peer has overwritten the doorbell.
            let _ = doorbell.event.activate(RUNG);
            // SAFETY: the listener that created the event has initialized it; any bit pattern is a
            // valid `Futex`.
            unsafe { doorbell.handle.assume_init_ref() }.wake();
        }
    }
}

impl fmt::Debug for Ringers {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Ringers({})", self.run)
    }
}

/// Opens the memory of a doorbell by the name that iceoryx2's event gives it.
fn storage_of(run: &RunName, of: Owner) -> Option<DoorbellStorage> {
    let suffix = FileName::new(b".trigger_mgmt").ok()?;
    let config = crate::storage::Configuration::default()
        .prefix(&segment::prefix(run))
        .suffix(&suffix);
    <DoorbellStorage as DynamicStorage<_>>::Builder::new(&of.file())
        .config(&config)
        .open(AccessMode::ReadWrite)
        .ok()
}

fn config(run: &RunName) -> Configuration<PendingBits, Futex, DoorbellStorage> {
    Configuration::default().prefix(&segment::prefix(run))
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::sync::atomic::{AtomicBool, AtomicU8};
    use std::thread;
    use tandem_board::Duration;

    const CORE: CoreAddress = CoreAddress::new(SystemId::A, CoreId::PLANNING);
    const OF: Owner = Owner::Core(CORE);

    /// The doorbells of a run that has no other files. Dropping this value removes them.
    struct Doorbells(RunName);

    impl Doorbells {
        fn install() -> Self {
            let run = RunName::unique();
            install(&run).unwrap();
            Self(run)
        }

        fn storage(&self) -> DoorbellStorage {
            storage_of(&self.0, OF).unwrap()
        }
    }

    impl Drop for Doorbells {
        fn drop(&mut self) {
            remove(&self.0);
        }
    }

    /// Returns whether a ring wakes a sleeping listener; `harm` runs while the listener sleeps.
    fn a_ring_wakes(harm: impl FnOnce(&DoorbellState)) -> bool {
        let doorbells = Doorbells::install();
        let doorbell = Doorbell::attach(&doorbells.0, OF).unwrap();
        let ringers = Ringers::new(&doorbells.0);
        let asleep = AtomicBool::new(false);
        thread::scope(|scope| {
            let sleeper = scope.spawn(|| {
                let patience = clock::now() + Duration::from_ms(10_000);
                asleep.store(true, SeqCst);
                doorbell.wait(patience) && clock::now() < patience
            });
            while !asleep.load(SeqCst) {
                thread::yield_now();
            }
            thread::sleep(Span::from_millis(50));
            harm(doorbells.storage().get());
            ringers.ring(CORE.system, CORE.core);
            sleeper.join().unwrap()
        })
    }

    /// T-SYNC-3: another notifier stalls just before it marks the listener as notified, and sets
    /// the mark when the listener sleeps again. iceoryx2 would not wake the listener; `ring` must.
    #[test]
    fn a_ring_wakes_whatever_a_stalled_ringer_has_left() {
        const NOTIFIED: u8 = 2;
        assert!(a_ring_wakes(|state| state
            .notification_state
            .store(NOTIFIED, SeqCst)));
    }

    /// A peer can write any value to any byte of the doorbell's memory. Ringer and sleeper must
    /// survive this, and the doorbell of the next incarnation must work.
    #[test]
    fn a_scribbled_doorbell_harms_no_ringer() {
        let doorbells = Doorbells::install();
        let doorbell = Doorbell::attach(&doorbells.0, OF).unwrap();
        let ringers = Ringers::new(&doorbells.0);
        let storage = doorbells.storage();
        let state: *const DoorbellState = storage.get();
        // SAFETY: these are the bytes of the state, in a mapping that is shared and writable.
        let bytes = unsafe {
            core::slice::from_raw_parts(state.cast::<AtomicU8>(), size_of::<DoorbellState>())
        };
        for scribble in [0x00, 0x01, 0x7F, 0x80, 0xAA, 0xFF] {
            for byte in bytes {
                let before = byte.swap(scribble, SeqCst);
                ringers.ring(CORE.system, CORE.core);
                doorbell.wait(clock::now() + Duration::from_us(10));
                byte.store(before, SeqCst);
            }
            bytes.iter().for_each(|byte| byte.store(scribble, SeqCst));
            ringers.ring(CORE.system, CORE.core);
            doorbell.wait(clock::now() + Duration::from_us(10));
            // The next incarnation.
            let doorbell = Doorbell::attach(&doorbells.0, OF).unwrap();
            assert!(!doorbell.wait(clock::now()), "silent after {scribble:#x}");
            ringers.ring(CORE.system, CORE.core);
            assert!(doorbell.wait(Instant::NEVER), "rung after {scribble:#x}");
        }
    }

    /// T-SYNC-3: a ringer keeps its mapping across incarnations of the core.
    #[test]
    fn the_next_incarnation_is_rung_through_the_same_end() {
        let doorbells = Doorbells::install();
        let ringers = Ringers::new(&doorbells.0);
        for _incarnation in 0..3 {
            ringers.ring(CORE.system, CORE.core);
            let doorbell = Doorbell::attach(&doorbells.0, OF).unwrap();
            assert!(
                !doorbell.wait(clock::now()),
                "rung in the incarnation before"
            );
            ringers.ring(CORE.system, CORE.core);
            assert!(doorbell.wait(Instant::NEVER));
        }
    }

    #[test]
    fn ringing_a_missing_doorbell_has_no_effect() {
        let run = RunName::unique();
        Ringers::new(&run).ring(CORE.system, CORE.core);
        let doorbells = Doorbells::install();
        Ringers::new(&doorbells.0).ring(CORE.system, CORE.core);
    }
}
