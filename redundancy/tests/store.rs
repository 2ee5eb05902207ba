//! The state store when power is lost at every byte of every operation, and on a failing flash.
#![allow(clippy::unwrap_used)]

use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use proptest_state_machine::{ReferenceStateMachine, StateMachineTest, prop_state_machine};
use tandem_board::{FlashError, FlashStatus, SystemId};
use tandem_redundancy::{FailureMode, FlashOp, Geometry, Loaded, StateStore, SystemState, Term};

/// The content of an operation's range when it was interrupted after `n` bytes.
#[derive(Clone, Copy, Debug)]
enum Torn {
    /// The first `n` bytes are new.
    Front,
    /// The last `n` bytes are new.
    Back,
    /// `n` scattered bytes are new, and in one more byte some bits.
    Scattered,
}

const TORN: [Torn; 3] = [Torn::Front, Torn::Back, Torn::Scattered];

#[derive(Clone)]
struct Flash {
    bytes: Vec<u8>,
    geometry: Geometry,
}

impl Flash {
    fn new(sector_bytes: u32) -> Self {
        let geometry = Geometry {
            sector_bytes,
            first_sector: 1,
        };
        // A sector before and one after, which the store must not touch.
        Self {
            bytes: vec![0xFF; 4 * sector_bytes as usize],
            geometry,
        }
    }

    fn load(&self) -> (StateStore, Loaded) {
        StateStore::load(self.geometry, |offset, into| {
            let at = offset as usize;
            into.copy_from_slice(&self.bytes[at..at + into.len()]);
            Ok(())
        })
    }

    /// Returns the range of an operation and its new content.
    fn effect(&self, op: &FlashOp) -> (usize, Vec<u8>) {
        let sector = self.geometry.sector_bytes;
        let (at, new) = match op {
            FlashOp::Erase { sector: n } => ((n * sector) as usize, vec![0xFF; sector as usize]),
            FlashOp::Program { offset, data } => {
                let at = *offset as usize;
                assert_eq!(at % 8, 0);
                let old = &self.bytes[at..at + data.len()];
                assert!(
                    old.iter().all(|&byte| byte == 0xFF),
                    "programmed what was not erased"
                );
                (at, data.to_vec())
            }
        };
        let own = sector as usize..3 * sector as usize;
        assert!(
            own.contains(&at) && at + new.len() <= own.end,
            "outside of its two sectors"
        );
        (at, new)
    }

    fn apply(&mut self, op: &FlashOp) {
        let (at, new) = self.effect(op);
        self.bytes[at..at + new.len()].copy_from_slice(&new);
    }

    fn apply_torn(&mut self, op: &FlashOp, n: usize, torn: Torn) {
        let (at, new) = self.effect(op);
        let len = new.len();
        for (i, &byte) in new.iter().enumerate() {
            let is_new = match torn {
                Torn::Front => i < n,
                Torn::Back => i >= len - n,
                // 7 is coprime to all lengths: `i * 7` visits each byte once; take the first n.
                Torn::Scattered => (i * 7 + n * 3) % len < n,
            };
            if is_new {
                self.bytes[at + i] = byte;
            }
        }
        if matches!(torn, Torn::Scattered) && n < len {
            let i = (n * 5) % len;
            let mask = 0x5Au8.rotate_left(n as u32 % 8);
            self.bytes[at + i] = self.bytes[at + i] & !mask | new[i] & mask;
        }
    }
}

fn state(n: u32) -> SystemState {
    SystemState {
        is_master: n.is_multiple_of(2),
        cpsys_failure: n.is_multiple_of(3),
        failure_mode: FailureMode::from_code((n % 8) as u8),
        total_resets: n,
        abn_resets: u32::MAX - n,
        term: Term::from_bits(n.wrapping_mul(0x9E37_79B9)),
        ..SystemState::factory(SystemId::A)
    }
}

/// Returns the state in flash; `None` before the first write is complete (factory state).
fn read(flash: &Flash) -> Option<SystemState> {
    match flash.load().1 {
        Loaded::State(state) => Some(state),
        Loaded::Blank | Loaded::Lost => None,
    }
}

/// Writes `state` completely; calls `before` with the flash before each operation.
fn write(
    store: &mut StateStore,
    flash: &mut Flash,
    state: SystemState,
    mut before: impl FnMut(&Flash, &FlashOp),
) {
    store.request(state);
    while let Some(op) = store.poll(FlashStatus::Idle) {
        before(flash, &op);
        flash.apply(&op);
    }
    assert!(store.is_settled());
    assert_eq!(store.durable(), Some(&state));
}

fn steps(flash: &Flash, op: &FlashOp) -> usize {
    flash.effect(op).1.len()
}

/// T-RED-1: power is lost at every byte of every operation of many writes (several changes of
/// sector), with three kinds of tearing. After the reboot the state is the old or the new one, and
/// writing continues. A second loss then hits every byte of the operations that follow.
#[test]
fn power_loss_at_every_byte_leaves_the_old_or_the_new_state() {
    let mut flash = Flash::new(128);
    let (mut store, loaded) = flash.load();
    assert_eq!(loaded, Loaded::Blank);
    let mut old = None;
    let (mut cuts, mut erases, mut torn_old, mut torn_new) = (0u64, 0, 0, 0);
    for n in 0..14 {
        let new = state(n);
        write(&mut store, &mut flash, new, |flash, op| {
            erases += u32::from(matches!(op, FlashOp::Erase { .. }));
            for torn in TORN {
                for cut in 0..=steps(flash, op) {
                    let mut after = flash.clone();
                    after.apply_torn(op, cut, torn);
                    let found = read(&after);
                    assert!(
                        found == old || found == Some(new),
                        "{torn:?} {cut}: {found:?}"
                    );
                    torn_old += u32::from(found == old);
                    torn_new += u32::from(found == Some(new));
                    cuts += 1 + go_on_after_loss(after, found);
                }
            }
        });
        old = Some(new);
        assert_eq!(read(&flash), old);
    }
    assert!(erases >= 2 && torn_old > 0 && torn_new > 0);
    println!("{cuts} power losses, {erases} of the writes with an erase");
}

/// After a loss, makes one more write, with a second loss at every byte of each of its operations.
fn go_on_after_loss(mut flash: Flash, old: Option<SystemState>) -> u64 {
    let mut cuts = 0;
    let (mut store, _) = flash.load();
    let new = state(1000);
    write(&mut store, &mut flash, new, |flash, op| {
        for cut in 0..=steps(flash, op) {
            let mut after = flash.clone();
            after.apply_torn(op, cut, Torn::Scattered);
            let found = read(&after);
            assert!(
                found == old || found == Some(new),
                "second loss at {cut}: {found:?}"
            );
            cuts += 1;
        }
    });
    assert_eq!(read(&flash), Some(new));
    cuts
}

/// T-RED-1: the same with sectors of the real size, at every byte of one erase and the programs
/// around it.
#[test]
fn power_loss_with_sectors_of_real_size() {
    let mut flash = Flash::new(4096);
    let (mut store, _) = flash.load();
    for n in 0..254 {
        write(&mut store, &mut flash, state(n), |_, _| {});
    }
    let mut old = Some(state(253));
    let mut erases = 0;
    for n in 254..258 {
        let new = state(n);
        write(&mut store, &mut flash, new, |flash, op| {
            erases += u32::from(matches!(op, FlashOp::Erase { .. }));
            for (i, cut) in (0..=steps(flash, op)).enumerate() {
                let mut after = flash.clone();
                after.apply_torn(op, cut, TORN[i % 3]);
                let found = read(&after);
                assert!(found == old || found == Some(new), "{cut}: {found:?}");
            }
        });
        old = Some(new);
    }
    assert_eq!(erases, 1);
}

/// T-RED-1: if there is no valid record, the loss is reported, and the next write is still durable.
#[test]
fn a_flash_full_of_garbage_is_lost_and_written_anew() {
    let mut flash = Flash::new(128);
    let sector = 128;
    flash.bytes[sector..3 * sector].fill(0xA7);
    let (mut store, loaded) = flash.load();
    assert_eq!(loaded, Loaded::Lost);
    write(&mut store, &mut flash, state(5), |_, _| {});
    assert_eq!(read(&flash), Some(state(5)));
}

/// T-RED-1: after a start the log continues after its last record without erasing a sector. A
/// flash without a valid record is not trusted: its first sector is erased.
#[test]
fn the_first_write_after_a_start_erases_only_a_lost_flash() {
    let first_write = |flash: &Flash| {
        let (mut store, _) = flash.load();
        store.request(state(9));
        match store.poll(FlashStatus::Idle) {
            Some(FlashOp::Program { offset, .. }) => (false, offset),
            Some(FlashOp::Erase { sector }) => (true, sector),
            None => panic!("nothing is written"),
        }
    };
    let sector = 128;
    let mut flash = Flash::new(sector);
    assert_eq!(first_write(&flash), (false, sector));
    for record in 1..3 {
        let (mut store, _) = flash.load();
        write(&mut store, &mut flash, state(record), |_, _| {});
        let behind = sector + record * SystemState::BYTES as u32;
        assert_eq!(first_write(&flash), (false, behind));
    }
    let mut flash = Flash::new(sector);
    flash.bytes[sector as usize] = 0xA7;
    assert_eq!(first_write(&flash), (true, 1));
}

#[test]
fn an_unreadable_flash_is_lost() {
    let geometry = Geometry {
        sector_bytes: 128,
        first_sector: 0,
    };
    let (_, loaded) = StateStore::load(geometry, |_, _| Err(FlashError::Failed));
    assert_eq!(loaded, Loaded::Lost);
}

/// T-RED-1: while an operation runs, newer requests replace older ones; the newest is written.
#[test]
fn the_newest_request_wins() {
    let mut flash = Flash::new(128);
    let (mut store, _) = flash.load();
    store.request(state(1));
    let first = store.poll(FlashStatus::Idle).unwrap();
    for n in 2..=4 {
        store.request(state(n));
        assert_eq!(store.poll(FlashStatus::Busy), None);
        assert!(!store.is_settled());
    }
    flash.apply(&first);
    let second = store.poll(FlashStatus::Idle).unwrap();
    flash.apply(&second);
    assert_eq!(
        store.poll(FlashStatus::Idle),
        None,
        "states 2 and 3 are not written"
    );
    assert_eq!(read(&flash), Some(state(4)));
    store.request(state(4));
    assert_eq!(
        store.poll(FlashStatus::Idle),
        None,
        "what is durable is not written again"
    );
    assert!(store.is_settled());
}

#[test]
fn a_medium_that_always_fails_is_given_up() {
    let mut flash = Flash::new(128);
    let (mut store, _) = flash.load();
    store.request(state(1));
    let mut tries = 0;
    let mut status = FlashStatus::Idle;
    while let Some(op) = store.poll(status) {
        flash.apply_torn(&op, 9, Torn::Front);
        status = FlashStatus::Failed;
        tries += 1;
        assert!(tries < 100);
    }
    assert!(store.is_broken() && store.is_settled());
}

/// One event for a store.
#[derive(Clone, Copy, Debug)]
enum RedundancyEvent {
    Request,
    Poll,
    /// A poll whose operation is not started.
    Refuse,
    /// The running operation ends.
    Finish,
    /// The running operation fails, and leaves its range torn.
    Fail(usize, Torn),
    /// The system loses power, whether or not an operation runs, and starts again.
    Lose(usize, Torn),
}

/// The expected state, known without reading the store.
#[derive(Clone, Debug)]
struct Life {
    /// Requests so far.
    requests: u32,
    /// There was a request since the last start.
    requested: bool,
    /// Failures since the last operation that succeeded.
    failures: u32,
}

impl ReferenceStateMachine for Life {
    type State = Self;
    type Transition = RedundancyEvent;

    fn init_state() -> BoxedStrategy<Self> {
        let new = Self {
            requests: 0,
            requested: false,
            failures: 0,
        };
        Just(new).boxed()
    }

    fn transitions(_: &Self) -> BoxedStrategy<RedundancyEvent> {
        let torn = || (0..=128_usize, prop::sample::select(&TORN[..]));
        prop_oneof![
            3 => Just(RedundancyEvent::Request),
            6 => Just(RedundancyEvent::Poll),
            1 => Just(RedundancyEvent::Refuse),
            5 => Just(RedundancyEvent::Finish),
            2 => torn().prop_map(|(cut, torn)| RedundancyEvent::Fail(cut, torn)),
            1 => torn().prop_map(|(cut, torn)| RedundancyEvent::Lose(cut, torn)),
        ]
        .boxed()
    }

    /// Permits at most three failures in a row: the flash is not broken.
    fn preconditions(life: &Self, event: &RedundancyEvent) -> bool {
        !matches!(event, RedundancyEvent::Fail(..)) || life.failures < 3
    }

    fn apply(mut life: Self, event: &RedundancyEvent) -> Self {
        match event {
            RedundancyEvent::Request => (life.requests, life.requested) = (life.requests + 1, true),
            RedundancyEvent::Fail(..) => life.failures += 1,
            RedundancyEvent::Lose(..) => (life.requested, life.failures) = (false, 0),
            RedundancyEvent::Finish | RedundancyEvent::Poll | RedundancyEvent::Refuse => {}
        }
        life
    }
}

/// The store and its flash.
struct Machine {
    store: StateStore,
    flash: Flash,
    running: Option<FlashOp>,
    /// The result of the last operation of the flash.
    status: FlashStatus,
    /// The states that the next start may find: the durable one, and those begun since. A failed
    /// write may have written its whole record.
    readable: Vec<Option<SystemState>>,
}

impl Machine {
    fn poll(&mut self) -> Option<FlashOp> {
        let op = self.store.poll(self.status);
        self.status = FlashStatus::Idle;
        if let Some(&durable) = self.store.durable() {
            let known = self.readable.iter().rposition(|it| *it == Some(durable));
            // The states whose writing began before this one are out of date.
            self.readable.drain(..known.unwrap());
        }
        if let Some(FlashOp::Program { data, .. }) = &op {
            let (new, _) = SystemState::decode(data).unwrap();
            self.readable.push(Some(new));
        }
        op
    }

    fn end(&mut self, cut: usize, torn: Torn) {
        if let Some(op) = self.running.take() {
            let cut = cut.min(steps(&self.flash, &op));
            self.flash.apply_torn(&op, cut, torn);
            self.status = FlashStatus::Failed;
        }
    }
}

impl StateMachineTest for Machine {
    type SystemUnderTest = Self;
    type Reference = Life;

    fn init_test(_: &Life) -> Self {
        let flash = Flash::new(128);
        Self {
            store: flash.load().0,
            flash,
            running: None,
            status: FlashStatus::Idle,
            readable: vec![None],
        }
    }

    fn apply(mut it: Self, life: &Life, event: RedundancyEvent) -> Self {
        match event {
            RedundancyEvent::Request => it.store.request(state(life.requests)),
            RedundancyEvent::Poll | RedundancyEvent::Refuse if it.running.is_some() => {
                assert_eq!(it.store.poll(FlashStatus::Busy), None);
            }
            RedundancyEvent::Poll => it.running = it.poll(),
            RedundancyEvent::Refuse => {
                if it.poll().is_some() {
                    it.store.refused();
                }
            }
            RedundancyEvent::Finish => {
                if let Some(op) = it.running.take() {
                    it.flash.apply(&op);
                }
            }
            RedundancyEvent::Fail(cut, torn) => it.end(cut, torn),
            RedundancyEvent::Lose(cut, torn) => {
                it.end(cut, torn);
                (it.store, it.status) = (it.flash.load().0, FlashStatus::Idle);
                let found = read(&it.flash);
                assert!(it.readable.contains(&found), "{found:?}");
                it.readable = vec![found];
            }
        }
        it
    }

    fn check_invariants(it: &Self, life: &Life) {
        assert!(!it.store.is_broken());
        if it.running.is_none() {
            let found = read(&it.flash);
            assert!(it.readable.contains(&found), "{found:?}");
        }
        if life.requested && it.store.is_settled() {
            assert_eq!(it.store.durable(), Some(&state(life.requests)));
        }
    }
}

prop_state_machine! {
    #![proptest_config(ProptestConfig {
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(1),
        ..ProptestConfig::default()
    })]

    /// T-RED-1: operations that fail, are refused or are cut off by a loss of power lose nothing
    /// that was durable, and the newest request becomes durable.
    #[test]
    fn a_store_keeps_its_promise(sequential 1..80 => Machine);
}
