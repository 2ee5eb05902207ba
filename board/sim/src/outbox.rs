//! What a core sends while a job of it still takes time: it leaves when the job ends.

use crate::board::SimBoard;
use crate::machine::Machine;
use tandem_board::{CanFrame, CoreAddress, Edge, Line, LinkFull, TransmitFull};

/// What a core does to the outside.
#[derive(Clone, Debug)]
pub(crate) enum Output {
    Edge(Line, Edge),
    Datagram(Vec<u32>),
    Frame(CanFrame),
    /// The answer to the watchdog's question.
    Service(u8),
}

/// For an executor that gives jobs a time.
impl SimBoard {
    /// What this core sends from now on belongs to this job, and leaves with
    /// [`SimBoard::let_go`]; `None`: it leaves at once.
    pub fn hold(&self, job: Option<u8>) {
        self.port
            .alive(|machine| machine.core(self.port.place).job = job);
    }

    /// What belongs to this job leaves, in its order.
    pub fn let_go(&self, job: u8) {
        let place = self.port.place;
        self.port.alive(|machine| {
            let held = core::mem::take(&mut machine.core(place).outbox);
            let (gone, held) = held.into_iter().partition(|(of, _)| *of == job);
            machine.core(place).outbox = held;
            let gone: Vec<(u8, Output)> = gone;
            for (_, output) in gone {
                machine.put_out(place, output);
            }
        });
    }

    /// Whether an interrupt has caused the present call of this core.
    #[must_use]
    pub fn is_interrupted(&self) -> bool {
        let called = self
            .port
            .alive(|machine| machine.core(self.port.place).interrupted);
        called.unwrap_or(false)
    }

    /// A number below `limit`, drawn from the seed of the run; 0 if that is 0.
    #[must_use]
    pub fn draw_below(&self, limit: u64) -> u64 {
        self.port.shared.lock().draw_below(limit)
    }
}

impl Machine {
    /// Whether the output waits for the end of the core's job; if not, it is for the caller to do.
    pub(crate) fn holds(&mut self, from: CoreAddress, output: impl FnOnce() -> Output) -> bool {
        let core = self.core(from);
        if let Some(job) = core.job {
            core.outbox.push((job, output()));
        }
        core.job.is_some()
    }

    /// A full receiver or buffer loses what arrives: its sender has gone on.
    fn put_out(&mut self, from: CoreAddress, output: Output) {
        match output {
            Output::Edge(line, edge) => self.send_edge(from.system, line, edge),
            Output::Datagram(words) => {
                let _full: Result<(), LinkFull> = self.send_link(from.system, &words);
            }
            Output::Frame(frame) => {
                let _full: Result<(), TransmitFull> = self.send_can(from, &frame);
            }
            Output::Service(answer) => self.service_watchdog(from.system, answer),
        }
    }
}
