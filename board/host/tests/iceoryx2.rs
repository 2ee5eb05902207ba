//! Runs iceoryx2's own conformance suite on the parts of the host board that replace iceoryx2's:
//! the storage with reserved pages, and the event that sleeps on a futex.

#![allow(missing_docs, reason = "the harness is a macro of iceoryx2")]

extern crate iceoryx2_bb_loggers as _;

use iceoryx2_bb_lock_free::mpmc::counting_bit_set::RelocatableCountingBitSet;
use iceoryx2_bb_testing::instantiate_conformance_tests_with_module as instantiate;
use iceoryx2_cal_conformance_tests as suite;
use iceoryx2_cal_conformance_tests::dynamic_storage_trait::TestData;
use iceoryx2_cal_conformance_tests::named_concept_trait::{DynamicStorageTest, EventTest};
use tandem_board_host::doorbell::{FutexEvent, PendingBits};
use tandem_board_host::storage::Storage;

instantiate!(
    storage,
    suite::dynamic_storage_trait,
    Storage<TestData>,
    Storage<u64>
);
instantiate!(
    storage_by_name,
    suite::named_concept_trait,
    DynamicStorageTest<Storage<u64>>
);
// The event that the doorbells use.
instantiate!(
    doorbell,
    suite::event_trait,
    PendingBits,
    FutexEvent<PendingBits, false>
);
// The futex with iceoryx2's default event state.
instantiate!(
    counting,
    suite::event_trait,
    RelocatableCountingBitSet,
    FutexEvent<RelocatableCountingBitSet, false>
);
instantiate!(
    counting_by_name,
    suite::named_concept_trait,
    EventTest<FutexEvent<RelocatableCountingBitSet, false>>
);

mod harness {
    iceoryx2_bb_testing::test_harness!();
}

fn main() {
    // If a private `/dev/shm` is permitted, files that the suite leaves behind on purpose disappear
    // with this process.
    let _place = tandem_board_host::isolation::enter();
    harness::main();
}
