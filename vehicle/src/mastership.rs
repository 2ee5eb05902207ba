//! Which system drives, according to the obeyed control frames: gaps, changes, and two masters.
//!
//! This does not rely on the fence: it counts the frames that were obeyed.

/// Number of masterships that are stored. The oldest is dropped first.
const MASTERSHIPS: usize = 64;

/// One system with one term. It lasts from its first to its last obeyed frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Span {
    system: u8,
    term: u32,
    /// Time of the other system's first frame after the last one of this span, ns.
    other_ns: Option<u64>,
}

/// Which system drives, according to the obeyed frames.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Mastership {
    spans: Vec<Span>,
    /// Time and system of the last frame.
    last: Option<(u64, u8)>,
    gap_max_ns: u64,
    changes: u32,
    /// When the obeyed system changed last, ns.
    changed_ns: u64,
    two_masters_ns: u64,
    /// Two masters were counted up to this time, ns.
    counted_ns: u64,
}

impl Mastership {
    /// Counts an obeyed frame: its time, ns; its system, 0 = A, 1 = B; its term. Times never
    /// decrease.
    pub fn accept(&mut self, at_ns: u64, system: u8, term: u32) {
        if let Some((last_ns, last_system)) = self.last.replace((at_ns, system)) {
            self.gap_max_ns = self.gap_max_ns.max(at_ns.saturating_sub(last_ns));
            if last_system != system {
                self.changes += 1;
                self.changed_ns = at_ns;
            }
        }
        for span in self.spans.iter_mut().filter(|span| span.system != system) {
            span.other_ns.get_or_insert(at_ns);
        }
        let own = |span: &&mut Span| (span.system, span.term) == (system, term);
        match self.spans.iter_mut().find(own) {
            // This mastership continues although the other system's has begun.
            Some(span) => {
                if let Some(other_ns) = span.other_ns.take() {
                    let from_ns = other_ns.max(self.counted_ns);
                    // The other system counts as a master until the frame after its last one.
                    self.two_masters_ns += self.changed_ns.saturating_sub(from_ns);
                    self.counted_ns = self.counted_ns.max(self.changed_ns);
                }
            }
            None => {
                if self.spans.len() == MASTERSHIPS {
                    self.spans.remove(0);
                }
                self.spans.push(Span {
                    system,
                    term,
                    other_ns: None,
                });
            }
        }
    }

    /// Returns the longest time between two obeyed frames, or from the last one to `until_ns`; 0
    /// before the first.
    #[must_use]
    pub fn gap_max_ns(&self, until_ns: u64) -> u64 {
        let open = self
            .last
            .map_or(0, |(last_ns, _)| until_ns.saturating_sub(last_ns));
        self.gap_max_ns.max(open)
    }

    /// Returns how often the obeyed system changed.
    #[must_use]
    pub const fn changes(&self) -> u32 {
        self.changes
    }

    /// Time in which masterships of both systems overlapped, ns: from the first frame of one to the
    /// frame after the last of the other. Successive takeovers with new terms do not overlap.
    #[must_use]
    pub const fn two_masters_ns(&self) -> u64 {
        self.two_masters_ns
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: u8 = 0;
    const B: u8 = 1;

    /// Frames of (time, system, term).
    fn of(frames: &[(u64, u8, u32)]) -> Mastership {
        let mut mastership = Mastership::default();
        for (at_ns, system, term) in frames {
            mastership.accept(*at_ns, *system, *term);
        }
        mastership
    }

    #[test]
    fn a_clean_takeover_has_a_gap_and_no_second_master() {
        let clean = of(&[(0, A, 2), (10, A, 2), (23, B, 3)]);
        assert_eq!((clean.gap_max_ns(23), clean.changes()), (13, 1));
        assert_eq!(clean.two_masters_ns(), 0);
        assert_eq!(clean.gap_max_ns(50), 27, "silence after the last frame");
    }

    #[test]
    fn there_and_back_with_new_terms_are_two_changes_and_no_second_master() {
        let back = of(&[(0, A, 2), (10, B, 3), (20, A, 4)]);
        assert_eq!((back.changes(), back.two_masters_ns()), (2, 0));
    }

    /// T-RED-9: two masters are seen even if the fence that should prevent them is broken.
    #[test]
    fn frames_of_the_old_term_after_the_new_master_are_two_masters() {
        let frames = [
            (0, A, 2),
            (10, B, 3),
            (15, A, 2),
            (20, B, 3),
            (25, A, 2),
            (30, B, 3),
            (40, B, 3),
        ];
        // From B's first frame to the one after A's last.
        assert_eq!(of(&frames).two_masters_ns(), 20);
    }

    /// T-RED-9
    #[test]
    fn a_single_frame_of_another_master_counts_until_the_next_frame() {
        let frames = [(0, A, 2), (5, B, 3), (10, A, 2)];
        assert_eq!(of(&frames).two_masters_ns(), 5);
        // The time is not counted twice if a mastership with another term lies between.
        let frames = [(0, A, 2), (10, B, 3), (15, B, 5), (20, A, 2)];
        assert_eq!(of(&frames).two_masters_ns(), 10);
        let frames = [(0, A, 2), (1, A, 4), (10, B, 3), (20, A, 2), (25, A, 4)];
        assert_eq!(of(&frames).two_masters_ns(), 10);
    }

    #[test]
    fn an_endless_row_of_terms_needs_no_endless_memory() {
        let mut mastership = Mastership::default();
        for n in 0..1_000_u32 {
            mastership.accept(u64::from(n), (n % 2) as u8, n);
        }
        assert!(mastership.spans.len() <= MASTERSHIPS);
        assert_eq!(mastership.changes(), 999);
    }
}
