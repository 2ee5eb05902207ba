//! How old a control frame may be: one rule for the vehicle and for the standby. T-RED-9

use crate::Control;

impl Control {
    /// A frame that was made this long ago is refused, ms: four control periods.
    pub const MAX_DELAY_MS: u16 = 40;
    /// A frame whose time is further in the future is refused, ms: its sender's clock is wrong.
    pub const EARLY_MS: u16 = 20;

    /// Returns whether the frame was made less than [`Self::MAX_DELAY_MS`] before `now_ms`, a time
    /// on the vehicle's clock modulo 2^16. A frame whose time is unknown (0) is fresh.
    #[must_use]
    pub const fn is_fresh(&self, now_ms: u16) -> bool {
        let age_ms = now_ms.wrapping_sub(self.sent_at) as i16;
        self.sent_at == 0
            || age_ms >= -(Self::EARLY_MS as i16) && age_ms < Self::MAX_DELAY_MS as i16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The limits hold also where the time wraps around; 0 is no time.
    #[test]
    fn a_frame_is_fresh_for_40_ms() {
        for sent_at in [1_u16, 500, 0x7FFF, 0x8000, u16::MAX] {
            let control = Control {
                sent_at,
                ..Control::default()
            };
            let fresh = |age_ms: i16| control.is_fresh(sent_at.wrapping_add_signed(age_ms));
            assert!(fresh(-20) && fresh(0) && fresh(39), "{sent_at}");
            let old = [-21, 40, 1_000, -1_000, i16::MAX, i16::MIN];
            assert!(!old.into_iter().any(fresh), "{sent_at}");
        }
        assert!(Control::default().is_fresh(12_345));
    }
}
