//! `start` refuses a program whose tasks cannot share its allocator, and runs no task. T-RTOS-1

use tandem_rtos::{Kernel, StartError, TickSource};

#[test]
fn an_allocator_that_tasks_cannot_share_is_refused() {
    let kernel = Kernel::take().expect("it is free");
    assert_eq!(kernel.start(TickSource::Wall), Err(StartError::Allocator));
    assert!(Kernel::take().is_ok(), "the kernel did not come back");
}
