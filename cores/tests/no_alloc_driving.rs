//! No allocation in a cycle of the driving functions, however long they drive.

mod drive;

use std::alloc::{GlobalAlloc, Layout, System as SystemAllocator};
use std::cell::Cell;

use drive::Drive;
use tandem_board::{CanFrame, CanId, Duration, Instant};
use tandem_bus::Message;
use tandem_cores::driving::control::MotionControl;
use tandem_cores::driving::degraded::DegradedControl;
use tandem_cores::driving::perception::{Perception, ego_of};
use tandem_cores::driving::planning::Planner;
use tandem_cores::driving::types::Ego;
use tandem_vehicle::Scenario;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

/// Counts the allocations of each thread.
struct Counting;

// SAFETY: every call is handed on to the system's allocator unchanged; counting allocates nothing,
// because the thread-local counter is const-initialised and has no destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { SystemAllocator.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the pointer came from `alloc` above, with this layout.
        unsafe { SystemAllocator.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations of this thread while `work` runs.
fn allocations(work: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.with(Cell::get);
    work();
    ALLOCATIONS.with(Cell::get) - before
}

#[test]
fn the_counter_counts() {
    assert_eq!(allocations(|| drop(std::hint::black_box(Box::new(1)))), 1);
}

/// T-CHIP-2: perception, planning, control and degraded control allocate nothing in 60 s of dense
/// traffic.
#[test]
fn no_cycle_allocates() {
    let scenario = Scenario::load("cut-in").unwrap();
    let mut drive = Drive::new(&scenario, 3, 1);
    let mut frames: Vec<(Instant, CanFrame)> = Vec::new();
    drive.record(60.0, &mut frames);
    assert!(frames.len() > 20_000);

    let mut receiver = tandem_bus::Receiver::new();
    let (mut perception, mut planner) = (Perception::new(), Planner::new());
    let (mut control, mut degraded) = (MotionControl::new(), DegradedControl::new());
    let mut ego = Ego::default();
    let mut next = frames[0].0 + Duration::from_ms(25);
    let (mut cycles, mut tracks) = (0, 0);
    let count = allocations(|| {
        for (at, frame) in &frames {
            let CanId::Standard(id) = frame.id() else {
                continue;
            };
            let Ok(message) = receiver.receive(u32::from(id), frame.data()) else {
                continue;
            };
            perception.on_message(*at, &message);
            if let Message::EgoMotion(motion) = &message {
                ego = ego_of(motion);
                control.on_ego(*at, &ego);
            }
            if *at >= next {
                next += Duration::from_ms(50);
                let scene = perception.cycle(*at);
                let trajectory = planner.plan(scene);
                degraded.step(*at, &ego, scene);
                let followed = control.step(*at, &ego, &trajectory);
                assert!(followed.is_ok());
                (cycles, tracks) = (cycles + 1, tracks.max(scene.objects.len()));
            }
        }
    });
    assert!(
        cycles > 1_000 && tracks > 2,
        "{cycles} cycles, {tracks} tracks"
    );
    assert_eq!(count, 0);
}
