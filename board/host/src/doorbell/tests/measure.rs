//! Measures how fast iceoryx2's triggers and the futex trigger wake a sleeper. Run by hand:
//!
//! `cargo test --release -p tandem-board-host --lib -- --ignored --nocapture --test-threads 1 bell`

use core::sync::atomic::AtomicU64;
use core::sync::atomic::Ordering::SeqCst;
use core::time::Duration;
use std::sync::Arc;
use std::thread;

use iceoryx2_bb_container::semantic_string::SemanticString;
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_cal::event::event_state::bit_set::RelocatableBitSet;
use iceoryx2_cal::event::implementations::{SemaphoreShmBitSet, UnixDatagramShmBitSet};
use iceoryx2_cal::event::{Event, EventId, Listener, ListenerBuilder, Notifier, NotifierBuilder};
use iceoryx2_cal::named_concept::{NamedConceptBuilder, NamedConceptConfiguration};

use super::FutexEvent;
use crate::name::RunName;
use crate::{clock, realtime, segment};

type State = RelocatableBitSet;

/// An event of iceoryx2 whose ends can be moved to threads.
trait Sendable: Event<State, Listener: 'static, Notifier: 'static> {}
impl<E: Event<State, Listener: 'static, Notifier: 'static>> Sendable for E {}

struct Pair<E: Event<State>> {
    name: FileName,
    config: E::Configuration,
    listener: E::Listener,
}

impl<E: Event<State>> Pair<E> {
    fn new() -> Self {
        segment::quiet();
        let name = FileName::new(b"measured").expect("a name");
        let config = E::Configuration::default().prefix(&segment::prefix(&RunName::unique()));
        let listener = E::ListenerBuilder::new(&name)
            .config(&config)
            .event_id_max(EventId::new(0))
            .create()
            .expect("a listener");
        Self {
            name,
            config,
            listener,
        }
    }

    fn notifier(&self) -> E::Notifier {
        E::NotifierBuilder::new(&self.name)
            .config(&self.config)
            .open()
            .expect("a notifier")
    }
}

fn realtime_on(cpu: usize) {
    let grant = realtime::claim(realtime::Claim {
        priority: Some(60),
        cpu: Some(cpu),
        lock_memory: false,
    });
    println!("  {grant}");
}

fn print(what: &str, unit: &str, mut samples: Vec<u64>) {
    samples.sort_unstable();
    let at = |share: f64| samples[((samples.len() - 1) as f64 * share) as usize];
    println!(
        "  {what}: p50 {} p99 {} p99.9 {} max {} {unit} of {}",
        at(0.5),
        at(0.99),
        at(0.999),
        at(1.0),
        samples.len()
    );
}

/// Returns by how much waits of 1 ms end late, and the share of the CPU that the waits use.
fn lateness(mut wait: impl FnMut(Duration) + Send + 'static) -> (Vec<u64>, u64) {
    const WAITS: u64 = 2_000;
    let cpu_time = || {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
    };
    let sleeper = thread::spawn(move || {
        realtime_on(0);
        let (began, used) = (clock::now(), cpu_time());
        let mut late = || {
            let due = clock::now() + tandem_board::Duration::from_ms(1);
            wait(Duration::from_millis(1));
            clock::now().since(due).as_us()
        };
        let samples = (0..WAITS).map(|_| late()).collect();
        let share = 100 * (cpu_time() - used) / clock::now().since(began).as_ns();
        (samples, share)
    });
    sleeper.join().expect("samples")
}

fn print_lateness(wait: impl FnMut(Duration) + Send + 'static) {
    let (samples, share) = lateness(wait);
    print(
        &format!("lateness of a wait of 1 ms, {share} % of the CPU"),
        "µs",
        samples,
    );
}

/// Returns the times from a ring on one CPU until the sleeper on the other CPU runs.
fn one_way<E: Sendable>() -> Vec<u64> {
    let pair = Pair::<E>::new();
    let notifier = pair.notifier();
    let rung_at = Arc::new(AtomicU64::new(0));
    let its_rung_at = Arc::clone(&rung_at);
    let sleeper = thread::spawn(move || {
        realtime_on(1);
        let mut samples = vec![];
        while samples.len() < 5_000 {
            pair.listener.blocking_wait(|_| {}).expect("a wait");
            let now = clock::now().as_ns();
            match its_rung_at.swap(0, SeqCst) {
                0 => {}
                at => samples.push(now - at),
            }
        }
        samples
    });
    let ringer = thread::spawn(move || {
        realtime_on(0);
        while !sleeper.is_finished() {
            thread::sleep(Duration::from_micros(200));
            rung_at.store(clock::now().as_ns(), SeqCst);
            // Fails if the sleeper has just finished.
            let _ = notifier.notify(EventId::new(0));
        }
        sleeper.join().expect("samples")
    });
    ringer.join().expect("samples")
}

/// Returns how often the listener stays asleep although two ringers ring, and the number of rings.
fn deafness<E: Sendable>() -> (usize, u64) {
    let end = clock::now() + tandem_board::Duration::from_ms(10_000);
    let pair = Pair::<E>::new();
    let counters = Arc::new([const { AtomicU64::new(0) }; 4]);
    let ringers: Vec<_> = (0..2)
        .map(|n| {
            let (notifier, counters) = (pair.notifier(), Arc::clone(&counters));
            thread::spawn(move || {
                let mut turn = 0;
                while clock::now() < end {
                    turn += 1;
                    counters[n].store(turn, SeqCst);
                    notifier.notify(EventId::new(0)).expect("a ring");
                    while counters[2 + n].load(SeqCst) != turn {
                        thread::yield_now();
                    }
                }
                turn
            })
        })
        .collect();
    let mut deaf = 0;
    while !ringers.iter().all(thread::JoinHandle::is_finished) {
        let before = [0, 1].map(|n| counters[n].load(SeqCst));
        let started = clock::now();
        pair.listener
            .timed_wait(|_| {}, Duration::from_millis(100))
            .expect("a wait");
        let slept = clock::now().since(started).as_us() >= 100_000;
        let after = [0, 1].map(|n| counters[n].load(SeqCst));
        deaf += usize::from(slept && before != after);
        for n in 0..2 {
            counters[2 + n].store(counters[n].load(SeqCst), SeqCst);
        }
    }
    (
        deaf,
        ringers
            .into_iter()
            .map(|ringer| ringer.join().expect("a count"))
            .sum(),
    )
}

fn measure<E: Sendable>(what: &str) {
    println!("{what}");
    let pair = Pair::<E>::new();
    print_lateness(move |span| {
        pair.listener.timed_wait(|_| {}, span).expect("a wait");
    });
    print("one way to a sleeper on another CPU", "ns", one_way::<E>());
    let (deaf, rings) = deafness::<E>();
    println!("  deaf to {deaf} of {rings} rings by two");
}

#[test]
#[ignore = "a measurement"]
fn doorbells_beside_the_triggers_of_iceoryx2() {
    println!("clock_nanosleep, the floor");
    print_lateness(|span| {
        let span = tandem_board::Duration::from_ns(span.as_nanos() as u64);
        clock::sleep_until(clock::now() + span);
    });
    measure::<UnixDatagramShmBitSet>("unix datagram socket (the default of iceoryx2)");
    measure::<SemaphoreShmBitSet>("semaphore");
    measure::<FutexEvent<State, false>>("futex");
}
