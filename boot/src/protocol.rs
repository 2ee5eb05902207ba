//! The frames of a download: ids, values, and an extension that old hosts do not use. T-BOOT-3
//!
//! All values are little endian. `docs/boot.md` has the same tables for authors of host tools.

use strum::{FromRepr, VariantArray};
use tandem_board::tester_desk::{CONNECT, EXTENSION};
pub use tandem_board::tester_desk::{RELEASES, TO_HOST, TO_LOADER};
use tandem_board::{CanFrame, SystemId};

const CONNECTED: u64 = 0x0706_0504_0302_0100;
const ACCEPTED: u32 = 0x0021_4B1D;
const RESEND: u32 = 0x0053_4F53;
const REFUSED: u32 = 0x0044_454E;
const OFFER: u8 = 1;
const GO_BACK: u8 = 2;
const CHALLENGE: u8 = 3;
const PROOF: u8 = 4;
const INFO: u8 = 5;
const ROLL_BACK: u8 = 6;
const RELEASE: u8 = NO_WINDOW | 6;
/// Answers of the extension that are no window have this bit in their second byte.
const NO_WINDOW: u8 = 0x80;

/// The byte of a frame that names a system; 0 for none.
fn code_of(system: Option<SystemId>) -> u8 {
    system.map_or(0, |system| system.index() as u8 + 1)
}

/// The inverse of [`code_of`]; `None` for bytes that name nothing.
const fn system_of(code: u8) -> Option<Option<SystemId>> {
    match code {
        0 => Some(None),
        1 => Some(Some(SystemId::A)),
        2 => Some(Some(SystemId::B)),
        _ => None,
    }
}

/// Bytes of a challenge, and of the signature that answers it.
pub const CHALLENGE_BYTES: usize = 15;
pub(crate) const PROOF_BYTES: usize = 64;
/// Bytes of both in one frame, and frames of the signature.
pub(crate) const PROOF_PIECE: usize = 5;
pub(crate) const PROOF_PARTS: usize = PROOF_BYTES.div_ceil(PROOF_PIECE);

/// Why a download was refused. Nothing that boots has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, FromRepr, VariantArray)]
#[repr(u32)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Refusal {
    /// An address outside the flash, or in a sector that no image owns.
    Address = 1,
    /// An address of the bootloader, the boot environment or the log.
    Protected,
    /// The slot that boots; download to the other one.
    SlotInUse,
    /// The data of a slot do not begin with a manifest: sign the file first.
    NoManifest,
    /// The manifest is damaged, of another kind, for other hardware, too large, or retires its key.
    BadManifest,
    /// The signature was not made with an accepted key. Only in strict mode. E-4
    Untrusted,
    /// The version is older than an approved one.
    Downgrade,
    /// Data are missing before this record.
    Gap,
    /// The record overlaps the one before it.
    Overlap,
    /// The record's address is lower than that of an earlier record.
    Order,
    /// Data that the manifest does not name.
    Unannounced,
    /// The count record differs from the number of data records.
    Count,
    /// The file ends before all data have arrived.
    Incomplete,
    /// The digest of the written data differs from the manifest's.
    Digest,
    /// The entry in the file differs from the manifest's.
    Entry,
    /// The data are not S-records, even after repeats.
    Record,
    /// The flash fails.
    Flash,
    /// A record follows the end of the file. What the file brought is forgotten.
    AfterEnd,
    /// The tester has not proved that it has a key.
    Tester,
    /// The application needs a newer bootloader or a newer configuration.
    Needs,
}

impl core::fmt::Display for Refusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::Address => "the address is in no sector of an image",
            Self::Protected => "the address belongs to the bootloader, its environment or its log",
            Self::SlotInUse => "the slot boots: download to the other one",
            Self::NoManifest => "the data begin with no manifest: sign the file first",
            Self::BadManifest => "the manifest is damaged, or does not fit this hardware or image",
            Self::Untrusted => "no accepted key made the signature",
            Self::Downgrade => "the version is older than an approved one",
            Self::Gap => "data are missing before a record",
            Self::Overlap => "a record overlaps the one before it",
            Self::Order => "the address of a record is lower than that of an earlier one",
            Self::Unannounced => "the manifest does not name these data",
            Self::Count => "the count record differs from the number of data records",
            Self::Incomplete => "the file ends before all data have arrived",
            Self::Digest => "the digest of the written data is not that of the manifest",
            Self::Entry => "the entry of the file is not that of the manifest",
            Self::Record => "the data are no S-records",
            Self::Flash => "an operation of the flash failed",
            Self::AfterEnd => "a record follows the end of the file",
            Self::Tester => "the tester has not proved that it has a key",
            Self::Needs => "the application needs a newer bootloader or configuration",
        })
    }
}

impl core::error::Error for Refusal {}

/// How far a system is with the release that it runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, FromRepr, VariantArray)]
#[repr(u8)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ReleaseStage {
    /// On trial.
    Trial,
    /// On trial, and it has had a role for the stated time.
    Works,
    /// Both systems have found that it works, and this one has recorded that.
    Ready,
    /// It boots from now on.
    Approved,
}

/// An answer of the bootloader.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Answer {
    /// The connection is established.
    Connected,
    /// The record was accepted.
    Accepted {
        /// With a window, the records of all types accepted since the connection; otherwise 0.
        records: u32,
    },
    /// The record is wrong or incomplete.
    Resend {
        /// With a window, the first record to send again, counted from 0; otherwise 0.
        record: u32,
    },
    /// The download and the connection have ended.
    Refused(Refusal),
    /// Answer to an offer of a window.
    Window {
        /// Number of records to send without waiting for an answer, at least 1.
        records: u8,
        /// The writable slot of the application: 0 A, 1 B, 2 either.
        application: u8,
        /// The writable slot of the configuration, likewise.
        configuration: u8,
        /// Records accepted since the connection.
        accepted: u32,
    },
    /// A part of a challenge.
    Challenge {
        /// 0 to 2.
        part: u8,
        /// The bytes.
        bytes: [u8; 5],
    },
    /// The signature is right: the tester may program.
    Proved,
    /// The signature is wrong.
    Unproved,
    /// After a wrong signature no challenge is given for this time.
    Locked {
        /// Rounded up.
        seconds: u16,
    },
    /// An answer to a question.
    Info {
        /// The code of the [`Question`](crate::Question).
        question: u8,
        /// What it means depends on the question.
        detail: u8,
        /// Likewise.
        value: u32,
    },
    /// An application tells, five times a second, which release it runs.
    Release {
        /// The system.
        system: SystemId,
        /// How far it is with that.
        stage: ReleaseStage,
        /// Its version.
        version: u32,
    },
}

impl Answer {
    /// Encodes the data of the frame.
    #[must_use]
    pub fn encode(self) -> [u8; 8] {
        let pair = |low: u32, high: u32| u64::from(low) | u64::from(high) << 32;
        let proof = |code: u8, seconds: u16| {
            let low = [EXTENSION, NO_WINDOW | PROOF, code, 0];
            pair(u32::from_le_bytes(low), seconds.into())
        };
        let value = match self {
            Self::Connected => CONNECTED,
            Self::Accepted { records } => pair(ACCEPTED, records),
            Self::Resend { record } => pair(RESEND, record),
            Self::Refused(refusal) => pair(REFUSED, refusal as u32),
            Self::Window {
                records,
                application,
                configuration,
                accepted,
            } => pair(
                u32::from_le_bytes([EXTENSION, records, application, configuration]),
                accepted,
            ),
            Self::Challenge { part, bytes } => {
                let [b0, rest @ ..] = bytes;
                let low = [EXTENSION, NO_WINDOW | CHALLENGE, part, b0];
                pair(u32::from_le_bytes(low), u32::from_le_bytes(rest))
            }
            Self::Proved => proof(0, 0),
            Self::Unproved => proof(1, 0),
            Self::Locked { seconds } => proof(2, seconds),
            Self::Info {
                question,
                detail,
                value,
            } => {
                let low = [EXTENSION, NO_WINDOW | INFO, question, detail];
                pair(u32::from_le_bytes(low), value)
            }
            Self::Release {
                system,
                stage,
                version,
            } => {
                let low = [EXTENSION, RELEASE, code_of(Some(system)), stage as u8];
                pair(u32::from_le_bytes(low), version)
            }
        };
        value.to_le_bytes()
    }

    /// Decodes the data of a frame; `None` if it is not an answer.
    #[must_use]
    pub fn decode(data: &[u8]) -> Option<Self> {
        let value = u64::from_le_bytes(data.try_into().ok()?);
        let (low, high) = (value as u32, (value >> 32) as u32);
        match low {
            _ if value == CONNECTED => Some(Self::Connected),
            ACCEPTED => Some(Self::Accepted { records: high }),
            RESEND => Some(Self::Resend { record: high }),
            REFUSED => Refusal::from_repr(high).map(Self::Refused),
            _ => match low.to_le_bytes() {
                [EXTENSION, second, part, b0] if second == NO_WINDOW | CHALLENGE => {
                    let [b1, b2, b3, b4] = high.to_le_bytes();
                    let bytes = [b0, b1, b2, b3, b4];
                    Some(Self::Challenge { part, bytes })
                }
                [EXTENSION, second, code, 0] if second == NO_WINDOW | PROOF => match code {
                    0 if high == 0 => Some(Self::Proved),
                    1 if high == 0 => Some(Self::Unproved),
                    2 => Some(Self::Locked {
                        seconds: high.try_into().ok()?,
                    }),
                    _ => None,
                },
                [EXTENSION, second, question, detail] if second == NO_WINDOW | INFO => {
                    Some(Self::Info {
                        question,
                        detail,
                        value: high,
                    })
                }
                [EXTENSION, RELEASE, system, stage] => Some(Self::Release {
                    system: system_of(system)??,
                    stage: ReleaseStage::from_repr(stage)?,
                    version: high,
                }),
                [EXTENSION, records, application, configuration] => Some(Self::Window {
                    records,
                    application,
                    configuration,
                    accepted: high,
                }),
                _ => None,
            },
        }
    }

    /// Returns the frame.
    #[must_use]
    pub fn frame(self) -> Option<CanFrame> {
        let id = match self {
            Self::Release { .. } => RELEASES,
            _ => TO_HOST,
        };
        CanFrame::new(id, false, &self.encode()).ok()
    }
}

/// A request of a host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HostRequest<'a> {
    /// Connect.
    Connect {
        /// The system; `None`, as sent by old hosts, means any system that listens.
        system: Option<SystemId>,
        /// Continue after the records accepted before the connection broke.
        resume: bool,
    },
    /// Extension: the number of records that the host would send without waiting for an answer.
    Offer {
        /// At least 1.
        records: u8,
    },
    /// Extension: announces the next record.
    GoBack {
        /// Its number, counted from 0, as the loader requested.
        record: u32,
    },
    /// Extension: asks for a part of the challenge.
    Challenge {
        /// The system; `None` means the bootloader that is connected.
        system: Option<SystemId>,
        /// The number of the tester's key.
        key: u8,
        /// 0 to 2.
        part: u8,
    },
    /// Extension: a part of the signature of the challenge.
    Proof {
        /// As in [`HostRequest::Challenge`].
        system: Option<SystemId>,
        /// 0 to 12; the last byte of the last part is 0.
        part: u8,
        /// The bytes.
        bytes: [u8; 5],
    },
    /// Extension: asks a question, also of a running application.
    Info {
        /// The system; `None` means the bootloader that is connected.
        system: Option<SystemId>,
        /// The code of the [`Question`](crate::Question).
        question: u8,
    },
    /// Extension, to a running application: give up the release on trial.
    RollBack {
        /// The system.
        system: Option<SystemId>,
    },
    /// A piece of a record.
    Data(&'a [u8]),
}

impl<'a> HostRequest<'a> {
    /// Decodes the data of a frame.
    #[must_use]
    pub fn decode(data: &'a [u8]) -> Self {
        let Ok(bytes) = <[u8; 8]>::try_from(data) else {
            return Self::Data(data);
        };
        let [b0, b1, b2, b3, high @ ..] = bytes;
        let low = u32::from_le_bytes([b0, b1, b2, b3]);
        match (b0, b1, system_of(high[0]), &high[1..]) {
            (_, _, Some(system), [resume @ (0 | 1), 0, 0]) if low == CONNECT => Self::Connect {
                system,
                resume: *resume == 1,
            },
            (EXTENSION, OFFER, ..) if b2 > 0 => Self::Offer { records: b2 },
            (EXTENSION, GO_BACK, ..) => Self::GoBack {
                record: u32::from_le_bytes(high),
            },
            (EXTENSION, CHALLENGE, Some(system), _) => Self::Challenge {
                system,
                key: b2,
                part: b3,
            },
            (EXTENSION, INFO, Some(system), _) => Self::Info {
                system,
                question: b2,
            },
            (EXTENSION, ROLL_BACK, Some(system), _) => Self::RollBack { system },
            (EXTENSION, PROOF, ..) => match system_of(b2 >> 4) {
                Some(system) => {
                    let [b4, b5, b6, b7] = high;
                    Self::Proof {
                        system,
                        part: b2 & 0xF,
                        bytes: [b3, b4, b5, b6, b7],
                    }
                }
                None => Self::Data(data),
            },
            _ => Self::Data(data),
        }
    }

    /// Returns the frame; `None` if the data are more than 8 bytes.
    #[must_use]
    pub fn frame(self) -> Option<CanFrame> {
        let mut bytes = [0; 8];
        let data = match self {
            Self::Connect { system, resume } => {
                bytes[..4].copy_from_slice(&CONNECT.to_le_bytes());
                bytes[4] = code_of(system);
                bytes[5] = u8::from(resume);
                &bytes[..]
            }
            Self::Offer { records } => {
                bytes[..3].copy_from_slice(&[EXTENSION, OFFER, records]);
                &bytes[..]
            }
            Self::GoBack { record } => {
                bytes[..2].copy_from_slice(&[EXTENSION, GO_BACK]);
                bytes[4..].copy_from_slice(&record.to_le_bytes());
                &bytes[..]
            }
            Self::Challenge { system, key, part } => {
                bytes[..5].copy_from_slice(&[EXTENSION, CHALLENGE, key, part, code_of(system)]);
                &bytes[..]
            }
            Self::Info { system, question } => {
                bytes[..5].copy_from_slice(&[EXTENSION, INFO, question, 0, code_of(system)]);
                &bytes[..]
            }
            Self::RollBack { system } => {
                bytes[..5].copy_from_slice(&[EXTENSION, ROLL_BACK, 0, 0, code_of(system)]);
                &bytes[..]
            }
            Self::Proof {
                system,
                part,
                bytes: piece,
            } => {
                bytes[..3].copy_from_slice(&[EXTENSION, PROOF, part | code_of(system) << 4]);
                bytes[3..].copy_from_slice(&piece);
                &bytes[..]
            }
            Self::Data(data) => data,
        };
        CanFrame::new(TO_LOADER, false, data).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::CanId;

    /// T-BOOT-3: the bytes on the bus are those of the thesis.
    #[test]
    fn frames_of_the_thesis() {
        assert_eq!(Answer::Connected.encode(), [0, 1, 2, 3, 4, 5, 6, 7]);
        let accepted = Answer::Accepted { records: 0 };
        assert_eq!(accepted.encode(), 0x21_4B1Du64.to_le_bytes());
        let resend = Answer::Resend { record: 0 };
        assert_eq!(resend.encode(), 0x53_4F53u64.to_le_bytes());
        let connect = HostRequest::Connect {
            system: None,
            resume: false,
        };
        let frame = connect.frame().unwrap();
        assert_eq!(frame.data(), 0x083E_572Du64.to_le_bytes());
        assert_eq!(frame.id(), CanId::Extended(0x0CFF_0126));
        assert_eq!(accepted.frame().unwrap().id(), CanId::Extended(0x0CFF_0127));
    }

    /// T-BOOT-3: each frame decodes to what was encoded.
    #[test]
    fn what_is_encoded_is_decoded() {
        let refused = Refusal::VARIANTS.iter().copied().map(Answer::Refused);
        let answers = [
            Answer::Connected,
            Answer::Accepted { records: 9 },
            Answer::Resend { record: 70_000 },
            Answer::Window {
                records: 16,
                application: 1,
                configuration: 2,
                accepted: 5,
            },
            Answer::Challenge {
                part: 2,
                bytes: [1, 2, 3, 4, 0xFF],
            },
            Answer::Proved,
            Answer::Unproved,
            Answer::Locked { seconds: 4_096 },
            Answer::Info {
                question: 0x23,
                detail: 9,
                value: u32::MAX,
            },
            Answer::Release {
                system: SystemId::B,
                stage: ReleaseStage::Ready,
                version: 70_000,
            },
        ];
        for answer in answers.into_iter().chain(refused) {
            assert_eq!(Answer::decode(&answer.encode()), Some(answer));
        }
        for strange in [
            0x1_0000_8457_u64,
            0x1_0001_8457,
            0x1_0000_0002_8457,
            0x0003_8457,
        ] {
            let answer = Answer::decode(&strange.to_le_bytes());
            assert_eq!(answer, None, "{strange:X}");
        }
        let systems = [None, Some(SystemId::A), Some(SystemId::B)];
        let connects = systems.map(|system| [false, true].map(|resume| (system, resume)));
        let connects = connects.into_iter().flatten();
        let connects = connects.map(|(system, resume)| HostRequest::Connect { system, resume });
        let others = [
            HostRequest::Offer { records: 16 },
            HostRequest::GoBack { record: 70_000 },
            HostRequest::Challenge {
                system: None,
                key: 3,
                part: 2,
            },
            HostRequest::Info {
                system: Some(SystemId::A),
                question: 0x3F,
            },
            HostRequest::RollBack {
                system: Some(SystemId::B),
            },
            HostRequest::Proof {
                system: Some(SystemId::B),
                part: 12,
                bytes: [9, 8, 7, 6, 0],
            },
            HostRequest::Data(b"S1130000"),
            HostRequest::Data(b"\r\n"),
        ];
        for request in connects.chain(others) {
            assert_eq!(
                HostRequest::decode(request.frame().unwrap().data()),
                request
            );
        }
    }
}
