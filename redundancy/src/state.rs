//! The state that survives power loss, and its 32 bytes in data flash. T-RED-1

use crate::Term;
use crc::{CRC_32_ISO_HDLC, Crc};
use strum::{FromRepr, VariantArray};
use tandem_board::SystemId;

pub(crate) const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
/// "TSS1": Tandem system state, layout 1.
const MAGIC: u32 = u32::from_le_bytes(*b"TSS1");

/// The fault that a system found in itself. Its number is stored in flash and sent in the status
/// frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum FailureMode {
    /// No fault.
    #[default]
    None = 0,
    /// Too many abnormal resets in a row. T-RED-5
    AbnormalResets = 1,
    /// No frame is received on a CAN bus that is alive. T-RED-6
    CanOpenCircuit = 2,
    /// The output driver's diagnosis register reports a fault. T-RED-6
    IoModule = 3,
    /// Core 1 does not answer.
    PerceptionCore = 4,
    /// Core 2 does not answer.
    PlanningCore = 5,
    /// Control cycles are late repeatedly.
    Deadline = 6,
    /// No mastership term is left.
    TermsExhausted = 7,
    /// The system's command differs from what its own inputs demand, or from what reaches the
    /// vehicle.
    WrongCommand = 8,
    /// Its clock has drifted away from the vehicle's and the other system's.
    Clock = 9,
    /// The CAN controller was bus-off: the bus destroyed 32 of its frames in a row. T-RED-6
    CanBusOff = 10,
    /// Its scene or plan contradicts the sensors' frames.
    WrongScene = 11,
    /// A number that this software does not know.
    Unknown = 255,
}

impl FailureMode {
    /// All modes, in the order of their numbers.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// Returns the mode with this number in flash or in the status frame; [`FailureMode::Unknown`]
    /// for a number that this software does not know.
    #[must_use]
    pub fn from_code(code: u8) -> Self {
        Self::from_repr(code).unwrap_or(Self::Unknown)
    }

    /// Returns whether a reset may cure it: the system then returns as standby, not suspended.
    #[must_use]
    pub const fn reset_may_cure(self) -> bool {
        matches!(
            self,
            Self::PerceptionCore
                | Self::PlanningCore
                | Self::Deadline
                | Self::CanOpenCircuit
                | Self::WrongCommand
                | Self::Clock
                | Self::CanBusOff
                | Self::WrongScene
        )
    }

    /// Returns whether a system that has suspended for this fault gets one more attempt after a
    /// power cycle. Faults that a diagnosis has found in the hardware stay until they are repaired.
    #[must_use]
    pub const fn power_cycle_may_cure(self) -> bool {
        self.reset_may_cure() || matches!(self, Self::AbnormalResets)
    }
}

/// What a system knows about itself and the other system, kept across restarts. T-RED-1
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct SystemState {
    /// This system was master last, or was initialised as master.
    pub is_master: bool,
    /// This system has failed and stays suspended.
    pub sys_failure: bool,
    /// The fault of this system.
    pub failure_mode: FailureMode,
    /// The other system counts as failed.
    pub cpsys_failure: bool,
    /// Abnormal resets so far; saturates.
    pub abn_resets: u32,
    /// Starts so far, for any cause; saturates.
    pub total_resets: u32,
    /// Abnormal resets, minus one for each `Config::healthy_after` without a reset; saturates.
    pub abn_in_a_row: u8,
    /// Incarnations that found their own command or scene wrong, minus one for each
    /// `Config::healthy_after` without a reset; saturates.
    pub wrong_in_a_row: u8,
    /// The highest mastership term seen or used.
    pub term: Term,
}

/// The reason why bytes from the flash are not a valid state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum StateDecodeError {
    /// All ones: erased flash.
    Blank,
    /// Any other bytes that are not a complete record of this layout.
    Invalid,
}

impl core::fmt::Display for StateDecodeError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Blank => "erased flash",
            Self::Invalid => "not a complete record of this layout",
        })
    }
}

impl core::error::Error for StateDecodeError {}

impl SystemState {
    /// Length of a record in flash: four pages of 8 bytes.
    pub const BYTES: usize = 32;

    /// Returns the state with which a new system is initialised: A is master, B is standby, the
    /// rest is zero.
    #[must_use]
    pub const fn factory(system: SystemId) -> Self {
        Self {
            is_master: matches!(system, SystemId::A),
            sys_failure: false,
            failure_mode: FailureMode::None,
            cpsys_failure: false,
            abn_resets: 0,
            total_resets: 0,
            abn_in_a_row: 0,
            wrong_in_a_row: 0,
            term: Term::NONE,
        }
    }

    /// Encodes the record for the flash: magic, sequence, flags, counters, term, CRC-32; little
    /// endian.
    #[must_use]
    pub fn encode(&self, sequence: u32) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        bytes[0..4].copy_from_slice(&MAGIC.to_le_bytes());
        bytes[4..8].copy_from_slice(&sequence.to_le_bytes());
        bytes[8] = u8::from(self.is_master)
            | u8::from(self.sys_failure) << 1
            | u8::from(self.cpsys_failure) << 2;
        bytes[9] = self.failure_mode as u8;
        bytes[10] = self.abn_in_a_row;
        bytes[11] = self.wrong_in_a_row;
        bytes[12..16].copy_from_slice(&self.abn_resets.to_le_bytes());
        bytes[16..20].copy_from_slice(&self.total_resets.to_le_bytes());
        bytes[20..24].copy_from_slice(&self.term.bits().to_le_bytes());
        let crc = CRC.checksum(&bytes[..28]);
        bytes[28..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Returns the state and its sequence number, from a record.
    ///
    /// # Errors
    /// [`StateDecodeError::Blank`] for erased flash, [`StateDecodeError::Invalid`] for any other
    /// bytes that [`SystemState::encode`] cannot have written.
    pub fn decode(bytes: &[u8; Self::BYTES]) -> Result<(Self, u32), StateDecodeError> {
        if bytes.iter().all(|&byte| byte == 0xFF) {
            return Err(StateDecodeError::Blank);
        }
        let word = |at: usize| {
            u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
        };
        let reserved_zero = bytes[8] & !0b111 == 0 && word(24) == 0;
        if word(0) != MAGIC || word(28) != CRC.checksum(&bytes[..28]) || !reserved_zero {
            return Err(StateDecodeError::Invalid);
        }
        let state = Self {
            is_master: bytes[8] & 1 != 0,
            sys_failure: bytes[8] & 2 != 0,
            cpsys_failure: bytes[8] & 4 != 0,
            failure_mode: FailureMode::from_code(bytes[9]),
            abn_in_a_row: bytes[10],
            wrong_in_a_row: bytes[11],
            abn_resets: word(12),
            total_resets: word(16),
            term: Term::from_bits(word(20)),
        };
        Ok((state, word(4)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    prop_compose! {
        fn any_state()(
            flags in 0u8..8, mode in 0usize..FailureMode::ALL.len(), abn: u32, total: u32,
            row: u8, wrong: u8, term: u32,
        ) -> SystemState {
            SystemState {
                is_master: flags & 1 != 0,
                sys_failure: flags & 2 != 0,
                cpsys_failure: flags & 4 != 0,
                failure_mode: FailureMode::ALL[mode],
                abn_resets: abn,
                total_resets: total,
                abn_in_a_row: row,
                wrong_in_a_row: wrong,
                term: Term::from_bits(term),
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        /// T-RED-1: a written state is read back unchanged.
        #[test]
        fn a_record_round_trips(state in any_state(), sequence: u32) {
            prop_assert_eq!(SystemState::decode(&state.encode(sequence)), Ok((state, sequence)));
        }

        /// T-RED-1: a record with up to three wrong bits is refused, never misread.
        #[test]
        fn flipped_bits_are_refused(
            state in any_state(),
            sequence: u32,
            bits in prop::collection::btree_set(0usize..256, 1..=3),
        ) {
            let mut bytes = state.encode(sequence);
            for bit in bits {
                bytes[bit / 8] ^= 1 << (bit % 8);
            }
            prop_assert_eq!(SystemState::decode(&bytes), Err(StateDecodeError::Invalid));
        }
    }

    /// T-RED-1: one system is initialised as master, the other as slave, the rest as zero.
    #[test]
    fn factory_state() {
        let a = SystemState::factory(SystemId::A);
        let b = SystemState::factory(SystemId::B);
        assert!(a.is_master && !b.is_master);
        assert_eq!(
            SystemState {
                is_master: false,
                ..a
            },
            b
        );
        assert_eq!(
            (b.abn_resets, b.total_resets, b.failure_mode),
            (0, 0, FailureMode::None)
        );
    }

    #[test]
    fn erased_flash_is_blank() {
        assert_eq!(
            SystemState::decode(&[0xFF; 32]),
            Err(StateDecodeError::Blank)
        );
        assert_eq!(
            SystemState::decode(&[0; 32]),
            Err(StateDecodeError::Invalid)
        );
    }

    /// T-RED-1: a record that sets a bit unused in this layout is of another layout and is refused.
    #[test]
    fn a_record_of_another_layout_is_refused() {
        let good = SystemState::factory(SystemId::A).encode(7);
        for (byte, bit) in [(0, 1), (8, 8), (8, 0x80), (24, 1), (27, 0x80)] {
            let mut bytes = good;
            bytes[byte] ^= bit;
            let crc = CRC.checksum(&bytes[..28]);
            bytes[28..].copy_from_slice(&crc.to_le_bytes());
            let decoded = SystemState::decode(&bytes);
            assert_eq!(decoded, Err(StateDecodeError::Invalid), "byte {byte}");
        }
    }

    #[test]
    fn failure_modes_have_their_own_codes() {
        for &mode in FailureMode::ALL {
            assert_eq!(FailureMode::from_code(mode as u8), mode);
        }
        assert_eq!(FailureMode::from_code(99), FailureMode::Unknown);
    }
}
