//! Defects of the times that hardware records.

use super::{Bent, Defect};
use tandem_board::{Board, Instant, Lines, TimeEdge};

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
}
