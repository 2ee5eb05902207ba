//! The supply of a system: a TLF35584 with its watchdogs, reset generator and reset cause. T-CHIP-6

/// Numbers the variants of an enum, in the order of their declaration.
macro_rules! coded {
    ($name:ident: $($variant:ident),+) => {
        impl $name {
            /// All variants, in the order of their codes.
            pub const ALL: [Self; [$(Self::$variant),+].len()] = [$(Self::$variant),+];

            /// Returns the number that encodes the variant.
            #[must_use]
            pub const fn code(self) -> u32 {
                self as u32
            }

            /// The inverse of `code`.
            #[must_use]
            pub fn from_code(code: u32) -> Option<Self> {
                Self::ALL.get(code as usize).copied()
            }
        }
    };
}

/// Why the system (or this core) started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ResetCause {
    /// Power was switched on.
    PowerOn,
    /// The software requested a reset.
    Software,
    /// A watchdog service was missing, late, early, or had a wrong answer.
    Watchdog,
    /// A core trapped, died, or was reset by the supply because another core reported it dead.
    Trap,
    /// The software requested a reset in order to receive a download.
    Download,
    /// The chip's safety unit signalled an error on the error pin.
    ErrorPin,
    /// The voltage of a supply rail was too low.
    Undervoltage,
}

impl ResetCause {
    /// Returns true for every cause except power-on and resets that the software requested. T-RED-5
    #[must_use]
    pub const fn is_abnormal(self) -> bool {
        matches!(
            self,
            Self::Watchdog | Self::Trap | Self::ErrorPin | Self::Undervoltage
        )
    }
}

coded!(ResetCause: PowerOn, Software, Watchdog, Trap, Download, ErrorPin, Undervoltage);

/// A core's request to the reset generator. Each request resets all three cores of the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ResetRequest {
    /// An orderly restart; the next reset cause is [`ResetCause::Software`].
    Software,
    /// A core of this system does not answer; the next reset cause is [`ResetCause::Trap`].
    CoreDead,
    /// Hold the system in reset until the next power-on: it has failed and is suspended (T-RED-5).
    Suspend,
    /// An orderly restart after which the bootloader waits for a download; the next reset cause is
    /// [`ResetCause::Download`].
    Download,
}

coded!(ResetRequest: Software, CoreDead, Suspend, Download);

/// The system's role, shown on its digital outputs for people and oscilloscopes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum RoleLamp {
    /// Has no role yet.
    Starting,
    /// Drives the vehicle.
    Master,
    /// Drives the vehicle alone, degraded.
    DegradedMaster,
    /// Computes silently.
    Standby,
    /// Has failed and keeps silent.
    Suspended,
}

coded!(RoleLamp: Starting, Master, DegradedMaster, Standby, Suspended);

/// Returns the answer that the functional watchdog expects to a question (0 ..= 15): a fixed
/// permutation of bytes.
///
/// A core that only repeats one store to the watchdog register cannot answer correctly.
#[must_use]
pub const fn watchdog_answer(question: u8) -> u8 {
    let q = question & 0xF;
    // Multiplication by an odd number permutes the bytes. 0xA5 prevents answer 0 to question 0.
    q.wrapping_mul(0x1D).rotate_left(3) ^ 0xA5
}

/// The supply, as core 0 of its system sees it.
pub trait Supply {
    /// Returns why this incarnation of the system began. Any context.
    fn reset_cause(&self) -> ResetCause;

    /// Returns how many incarnations have begun since power-on, or since one of them called
    /// [`Supply::confirm_start`], this one included: 1 after power-on, at most 255. A register that
    /// survives a reset keeps it. The bootloader finds a reset loop by it. Any context.
    fn starts(&self) -> u8;

    /// Notes that this incarnation works: [`Supply::starts`] counts from 0 again. Any context.
    fn confirm_start(&self);

    /// Reads the current question of the functional watchdog, 0 ..= 15. One at a time. The question
    /// changes with each service.
    fn watchdog_question(&self) -> u8;

    /// Services the window watchdog and the functional watchdog with the answer to the current
    /// question. One at a time, core 0 only.
    ///
    /// The call must be within the open window: not before [`Supply::WINDOW_OPENS_US`] and not
    /// after [`Supply::WINDOW_CLOSES_US`] since the last service. The first service may be
    /// immediate and must be within [`Supply::FIRST_SERVICE_US`] of the start. Otherwise the supply
    /// resets the system.
    fn service_watchdog(&self, answer: u8);

    /// Earliest service after the previous one, in microseconds.
    const WINDOW_OPENS_US: u32;
    /// Latest service after the previous one, in microseconds.
    const WINDOW_CLOSES_US: u32;
    /// Latest first service after a start, in microseconds.
    const FIRST_SERVICE_US: u32;

    /// Requests a reset. Any context. The call returns before the reset happens; the caller must
    /// then do nothing more.
    fn request_reset(&self, request: ResetRequest);

    /// Shows the role on the system's digital outputs. Any context.
    fn show_role(&self, lamp: RoleLamp);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_unambiguous() {
        for code in 0..=u32::from(u8::MAX) {
            let cause = ResetCause::from_code(code);
            assert!(cause.is_none_or(|cause| cause.code() == code));
            let request = ResetRequest::from_code(code);
            assert!(request.is_none_or(|request| request.code() == code));
            let lamp = RoleLamp::from_code(code);
            assert!(lamp.is_none_or(|lamp| lamp.code() == code));
        }
        let last = (ResetCause::Trap, ResetRequest::Suspend, RoleLamp::Suspended);
        assert_eq!(ResetCause::from_code(3), Some(last.0));
        assert_eq!(ResetRequest::from_code(2), Some(last.1));
        assert_eq!(RoleLamp::from_code(4), Some(last.2));
    }
}
