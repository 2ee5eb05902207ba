//! The line `Time` and its transfers over the link: the system that drives tells the other one. S-3

use super::super::Executor;
use super::is_to_gateway;
use tandem_board::{Board, Edge, Instant, Line, Lines, Link};
use tandem_timesync::{
    Arbitrary, Conversion, MasterQuality, PulseMaster, PulseSlave, PulseTransfer, Sample,
};

/// Both ends of the line.
pub(super) struct Pulses {
    master: PulseMaster,
    slave: PulseSlave<Arbitrary>,
    heard: Option<Instant>,
}

impl Pulses {
    pub(super) fn new(now: Instant) -> Self {
        Self {
            master: PulseMaster::new(now),
            slave: PulseSlave::default(),
            heard: None,
        }
    }

    /// Returns when the last pulse gave a sample.
    pub(super) const fn heard(&self) -> Option<Instant> {
        self.heard
    }

    /// Sends the edge and its transfer if they are due. Returns when the next ones are.
    pub(super) fn tell<'b, B: Board>(
        &mut self,
        board: &'b B,
        conversion: &Conversion<Arbitrary>,
        executor: &impl Executor<'b, B>,
    ) -> Instant {
        if board.now() >= self.master.due() {
            let before = board.now();
            board.lines().send(Line::Time, Edge::Rising);
            let after = board.now();
            board.lines().send(Line::Time, Edge::Falling);
            let transfer = self.master.raised(before, after, conversion.at(before));
            if let Some(transfer) = transfer {
                let transfer = PulseTransfer {
                    master_error: conversion.error_at(before),
                    is_to_gateway: is_to_gateway(conversion.status_at(before)),
                    ..transfer
                };
                executor.shared(|shared| {
                    let words = shared.time.datagram(&transfer);
                    // A transfer that finds no room is lost; the next edge has another one.
                    let _full = board.link().try_send(&words);
                });
            }
        }
        self.master.due()
    }

    /// Takes a transfer of the other system. Returns what it tells, and what it is worth.
    pub(super) fn follow<B: Board>(
        &mut self,
        board: &B,
        transfer: Option<(Instant, PulseTransfer<Arbitrary>)>,
    ) -> Option<(Sample<Arbitrary>, MasterQuality)> {
        if let Some((at, transfer)) = transfer {
            self.slave.on_transfer(at, transfer);
        }
        let edge = board.lines().time_edge().map(|edge| (edge.count, edge.at));
        let now = board.now();
        let pulse = self.slave.poll(now, edge).ok().flatten()?;
        self.heard = Some(now);
        let quality = MasterQuality {
            to_gateway: pulse.transfer.is_to_gateway,
            error: pulse.transfer.master_error,
        };
        Some((pulse.sample, quality))
    }
}
