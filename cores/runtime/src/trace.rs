//! Converts the kernel's events to events of the cores' trace.

use crate::Runtime;
use core::sync::atomic::Ordering::Relaxed;
use tandem_board::Board;
use tandem_cores::core0::Core0Task;
use tandem_cores::task_table::IrqCode;
use tandem_cores::trace::{Begin, Event, Leaves};
use tandem_rtos::{Interrupt, KernelEventKind, TraceSink};

/// Does not trace the wait of a task between two jobs, or the kernel's own tasks.
impl<B: Board + Sync> TraceSink for Runtime<B> {
    fn record(&self, event: tandem_rtos::KernelEvent) {
        let irq = if event.subject == u32::from(Interrupt::DOORBELL.number()) {
            IrqCode::DOORBELL
        } else {
            IrqCode::TICK
        };
        match event.kind {
            KernelEventKind::InterruptEntered => return self.trace(Event::IrqIn { irq }),
            KernelEventKind::InterruptLeft => return self.trace(Event::IrqOut { irq }),
            KernelEventKind::SwitchedIn | KernelEventKind::SwitchedOut | KernelEventKind::Ready => {
            }
        }
        let is_it = |task: &Core0Task| self.state(*task).number.load(Relaxed) == event.subject;
        let Some(id) = Core0Task::ALL.into_iter().find(is_it) else {
            return;
        };
        let (state, task) = (self.state(id), id.info().code);
        let in_job = state.in_job.load(Relaxed);
        match event.kind {
            KernelEventKind::SwitchedIn if in_job => {
                let begin = Begin::Goes;
                self.trace(Event::TaskIn { task, begin });
            }
            KernelEventKind::SwitchedOut if in_job => {
                let leaves = if state.waits_for_lock.load(Relaxed) {
                    Leaves::Blocked
                } else {
                    Leaves::Preempted
                };
                self.trace(Event::TaskOut { task, leaves });
            }
            // Not for the trajectory input: in the trace, core 2's signal is its release.
            KernelEventKind::Ready if !in_job && id != Core0Task::TrajectoryInput => {
                self.trace(Event::Ready { task });
            }
            _ => {}
        }
    }
}
