//! The backplane of a test, and a test of its limits.

use super::*;
use crate::doorbell;

impl Backplane {
    /// Removes the backplane that a test has created.
    pub(crate) fn remove(run: &RunName) {
        Segment::<WORDS>::remove(run, NAME);
    }
}

/// The run of a test with its backplane. Dropping it removes the files, even if the test panics.
pub(crate) struct ScratchRun(RunName);

impl ScratchRun {
    pub(crate) fn create() -> (Self, Backplane) {
        let run = RunName::unique();
        let backplane = Backplane::create(&run).unwrap();
        doorbell::install(&run).unwrap();
        (Self(run), backplane)
    }
}

impl core::ops::Deref for ScratchRun {
    type Target = RunName;

    fn deref(&self) -> &RunName {
        &self.0
    }
}

impl Drop for ScratchRun {
    fn drop(&mut self) {
        Backplane::remove(&self.0);
        doorbell::remove(&self.0);
    }
}

#[test]
fn a_delay_of_the_bus_is_at_most_that_of_a_fault() {
    let (_run, backplane) = ScratchRun::create();
    let late_ms = |ms| {
        backplane.system(SystemId::A, System::LateMs).set(ms);
        backplane.bus_fault(SystemId::A).late.as_us() / 1_000
    };
    let most = 1_000;
    for ms in [0, 1, most, most + 1, u32::MAX] {
        assert_eq!(late_ms(ms), u64::from(ms.min(most)));
    }
}
