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

/// What the vehicle's process forges is what was asked for, to the last bit of the value.
#[test]
fn a_forgery_crosses_the_backplane() {
    let (_run, backplane) = ScratchRun::create();
    assert_eq!(backplane.forgery(), None);
    for value in [0.0, -3.5, 4_294_967_294.0, f64::MAX] {
        let forgery = Some(Forgery {
            id: 0x7FF,
            field: u8::MAX,
            value,
        });
        backplane.forge(forgery);
        assert_eq!(backplane.forgery(), forgery);
    }
    backplane.forge(None);
    assert_eq!(backplane.forgery(), None);
}

/// S-3: a stamp is a time between those before and after the edge. A cut line carries no edge, and
/// a power-on forgets those before it.
#[test]
fn a_time_edge_has_its_time_unless_the_line_is_cut() {
    let (_run, backplane) = ScratchRun::create();
    let [a, b] = SystemId::ALL;
    let send = || {
        let before = clock::now();
        let arrives = backplane.send_edge(a, Line::Time, Edge::Rising);
        (arrives, before..=clock::now())
    };
    let counts = || [a, b].map(|of| backplane.time_edge(of).map(|edge| edge.count));
    assert_eq!(counts(), [None, None]);
    for count in 1..10 {
        let (_, around) = send();
        let edge = backplane.time_edge(b).unwrap();
        assert_eq!(edge.count, count);
        assert!(around.contains(&edge.at), "{edge:?} {around:?}");
    }
    backplane.set_cut(Wire::Line(Line::Time), a, true);
    assert!(!send().0);
    assert_eq!(counts(), [None, Some(9)]);
    backplane.set_cut(Wire::Line(Line::Time), a, false);
    backplane.clear_received_edges(b);
    assert_eq!(counts(), [None, None]);
    assert!(send().0);
    assert_eq!(counts(), [None, Some(1)]);
}
