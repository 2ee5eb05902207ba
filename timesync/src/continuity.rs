//! Whether a pair of local and global time lies in line with the pairs before it.

use crate::{Sample, Scale};
use tandem_board::Duration;

/// The largest difference of rate between the two clocks, in parts per million: drift of both, and
/// the slewing of the master's time.
const MAX_RATE_PPM: u64 = 1_000;
/// The tolerance grows with the span between two pairs: after this one it says nothing any more.
const MAX_SPAN: Duration = Duration::from_ms(1_000);
/// A pair counts if this many pairs before it lie in line with it.
const LEARNED: u8 = 2;
/// This many pairs out of line in a row begin a new line: a clock has leapt, or a master restarted.
const NEW_LINE: u8 = 3;

/// What became of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// In line with at least [`LEARNED`] pairs before it.
    InLine,
    /// In line so far, or the first one. It is the newest of the line.
    Learning,
    /// The global time is this much later than the line says, ns.
    Out(i64),
}

/// The newest pair of a line of pairs, with what its protocol knows of it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Continuity<S: Scale, K> {
    newest: Option<(Sample<S>, K)>,
    /// Pairs in line after the first, up to [`LEARNED`].
    in_line: u8,
    /// Pairs out of line since the newest one.
    misses: u8,
}

impl<S: Scale, K: Copy> Continuity<S, K> {
    pub(crate) const NEW: Self = Self {
        newest: None,
        in_line: 0,
        misses: 0,
    };

    /// Returns what the protocol knows of the newest pair of the line.
    pub(crate) fn newest(&self) -> Option<K> {
        self.newest.map(|(_, key)| key)
    }

    /// Returns whether the next pair in line will be given on.
    pub(crate) fn is_learned(&self) -> bool {
        self.in_line >= LEARNED
    }

    /// Judges the next pair. `noise`: what the stamps of two pairs may differ besides their stated
    /// errors. `follows`: whether the protocol takes it for a successor of [`Continuity::newest`].
    pub(crate) fn judge(
        &mut self,
        sample: Sample<S>,
        key: K,
        noise: Duration,
        follows: bool,
    ) -> Verdict {
        let last = self.newest.map(|(last, _)| last);
        let Some(last) = last.filter(|last| sample.local.since(last.local) <= MAX_SPAN) else {
            self.begin(sample, key);
            return Verdict::Learning;
        };
        let span = sample.local.since(last.local);
        let by = sample.global.after(last.global);
        let by = by.saturating_sub(span.as_ns() as i64);
        let drift = Duration::from_ns(span.as_ns() * MAX_RATE_PPM / 1_000_000);
        let tolerance = drift + noise + sample.error + last.error;
        if follows && sample.local > last.local && by.unsigned_abs() <= tolerance.as_ns() {
            self.newest = Some((sample, key));
            self.in_line = (self.in_line + 1).min(LEARNED);
            self.misses = 0;
            return if self.is_learned() {
                Verdict::InLine
            } else {
                Verdict::Learning
            };
        }
        self.misses += 1;
        if !self.is_learned() || self.misses >= NEW_LINE {
            self.begin(sample, key);
        }
        Verdict::Out(by)
    }

    fn begin(&mut self, sample: Sample<S>, key: K) {
        self.newest = Some((sample, key));
        self.in_line = 0;
        self.misses = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Arbitrary, GlobalTime};
    use tandem_board::Instant;

    type Line = Continuity<Arbitrary, ()>;

    /// Judges the pair of these times, us, with a noise of 10 us.
    fn judge(line: &mut Line, local_us: u64, global_us: u64) -> Verdict {
        let sample = Sample {
            local: Instant::from_ns(local_us * 1_000),
            global: GlobalTime::from_ns(global_us * 1_000),
            error: Duration::from_us(5),
        };
        line.judge(sample, (), Duration::from_us(10), true)
    }

    /// Returns a line of three pairs, 100 ms apart; the newest at 200 ms is 1,200 ms.
    fn learned() -> Line {
        let mut line = Line::NEW;
        assert_eq!(judge(&mut line, 0, 1_000_000), Verdict::Learning);
        assert_eq!(judge(&mut line, 100_000, 1_100_000), Verdict::Learning);
        assert_eq!(judge(&mut line, 200_000, 1_200_000), Verdict::InLine);
        line
    }

    /// S-5: over 100 ms the rate explains 100 us, the stamps 10 us, the stated errors 5 us each.
    #[test]
    fn the_tolerance_is_rate_noise_and_errors() {
        for (by, is_in_line) in [(120, true), (121, false), (-120, true), (-121, false)] {
            let verdict = judge(
                &mut learned(),
                300_000,
                1_300_000u64.wrapping_add_signed(by),
            );
            let out = Verdict::Out(by * 1_000);
            assert_eq!(verdict, if is_in_line { Verdict::InLine } else { out });
        }
    }

    /// S-5: a leap is followed after three pairs that tell of it and two in line with the third.
    #[test]
    fn a_leap_is_told_before_it_is_followed() {
        let mut line = learned();
        let verdicts = [3, 4, 5, 6, 7, 8].map(|n| judge(&mut line, n * 100_000, n * 100_000));
        let out = Verdict::Out(-1_000_000_000);
        let learning = Verdict::Learning;
        assert_eq!(
            verdicts,
            [out, out, out, learning, Verdict::InLine, Verdict::InLine]
        );
    }

    /// S-5: after two wrong pairs the line holds; the third right one finds no old misses.
    #[test]
    fn single_wrong_pairs_do_not_break_the_line() {
        let mut line = learned();
        for n in 1..4 {
            let at = 200_000 + n * 300_000;
            assert!(matches!(judge(&mut line, at - 200_000, 0), Verdict::Out(_)));
            assert!(matches!(judge(&mut line, at - 100_000, 0), Verdict::Out(_)));
            assert_eq!(judge(&mut line, at, at + 1_000_000), Verdict::InLine);
        }
    }

    /// S-5: nothing is known after a long silence, nor of a clock that stands or goes back.
    #[test]
    fn an_old_line_ends() {
        let mut line = learned();
        assert_eq!(judge(&mut line, 1_200_000, 2_200_000), Verdict::InLine);
        assert_eq!(judge(&mut line, 2_200_001, 3_200_001), Verdict::Learning);
        let mut line = learned();
        assert_eq!(judge(&mut line, 200_000, 1_200_000), Verdict::Out(0));
        assert_eq!(judge(&mut line, 100_000, 1_200_000), Verdict::Out(0));
    }
}
