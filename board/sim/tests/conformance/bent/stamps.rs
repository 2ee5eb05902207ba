//! Defects of the times that hardware records: of edges on the time line, and of sent frames.

use super::{Bent, Defect};
use tandem_board::{Board, Can, CanFrame, Instant, Lines, TimeEdge, TransmitFull};

impl Bent {
    pub(super) fn bent_time_edge(&self) -> Option<TimeEdge> {
        let edge = self.board.lines().time_edge();
        if self.is(Defect::TimeEdgeTooSoon) {
            let (count, at) = (0, Instant::ORIGIN);
            return edge.or(Some(TimeEdge { count, at }));
        }
        if self.is(Defect::TimeEdgeForgotten) && self.board.identity().generation.0 > 1 {
            return None;
        }
        let mut edge = edge?;
        let before = self.time_edges.replace(edge.count);
        match self.defect {
            Some(Defect::TimeEdgeLate) => edge.at = self.board.now(),
            Some(Defect::TimeEdgeTorn) if before > 0 => edge.count = before,
            _ => {}
        }
        Some(edge)
    }

    pub(super) fn send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        let now = self.board.now();
        self.board.can().try_send_stamped(frame)?;
        if self.is(Defect::StampAtOnce) {
            *self.common.stamp.lock().unwrap() = Some(now);
        }
        Ok(())
    }

    pub(super) fn bent_stamp(&self) -> Option<Instant> {
        let stamp = self.board.can().stamp();
        let mut kept = self.common.stamp.lock().unwrap();
        match self.defect {
            Some(Defect::StampAtOnce) => *kept,
            Some(Defect::StampLate) => stamp.map(|_| self.board.now()),
            Some(Defect::StampStays) => {
                *kept = stamp.or(*kept);
                *kept
            }
            _ => stamp,
        }
    }
}
