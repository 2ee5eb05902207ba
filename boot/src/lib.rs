//! Bootloader: S-records over CAN, slots, trust: sans-IO (no_std).
//!
//! [`start`] runs it on a board. [`Loader`] does the work: it receives the time and the frames of
//! the bus, and returns [`Next`]. It uses no part of the machine except the flash, through
//! `embedded_storage::nor_flash::NorFlash`. The application calls [`approve`] once it works.
//! A function is `#[inline(never)]` where that alone made the bootloader smaller.
//!
//! `docs/boot.md` describes the protocol, the storage map, the states, and the effect of each loss
//! of power.
//!
//! # Example
//!
//! ```
#![doc = include_str!("../examples/blank_flash.rs")]
//! ```
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

mod desk;
mod download;
mod environment;
mod flash_access;
mod info;
mod loader;
mod log;
mod manifest;
mod map;
mod one_time_words;
mod page;
mod protocol;
mod session;
mod srec;
mod start;
mod tester;
mod three_frames;
mod trust;

pub use desk::{BootDesk, DeskSetup, PROVES_ITSELF};
pub use environment::{
    Environment, EnvironmentStore, LoaderUpdate, RECORD_BYTES, Selection, Trial,
};
pub use flash_access::{FlashFault, rom_choice};
pub use info::{LOG_ANSWERS, PLACES, Question};
pub use loader::{
    CONNECT_WINDOW, HOST_SILENCE, Launch, Loader, Next, Setup, approve, bootloader_works,
};
pub use log::{LogEntry, LogEvent, read_log};
pub use manifest::{
    BODY_OFFSET, HARDWARE, ImagePart, MANIFEST_BYTES, MAX_PARTS, Manifest, ManifestError,
    SIGNED_BYTES,
};
pub use map::{
    Bank, COUNTER_PAGES, FLASH_BYTES, FlashRegion, ImageKind, ImageTarget, PAGE_BYTES, SECTORS,
    SMALLEST_SECTOR, Slot, offset_of, sector, sector_at,
};
pub use one_time_words::OneTimeWords;
pub use protocol::{
    Answer, CHALLENGE_BYTES, HostRequest, RELEASES, Refusal, ReleaseStage, TO_HOST, TO_LOADER,
};
pub use session::{MAX_WINDOW, RESEND_AFTER};
pub use srec::{Assembler, MAX_DATA, SRecord, SRecordError, SRecordType};
pub use start::{BetweenSteps, Keeper, Leave, Security, first_service, next_service, start};
pub use tester::{TESTER_MESSAGE_BYTES, tester_message};
pub use three_frames::{FIRST_ID, three_frames};
pub use trust::{Trust, TrustMode, Verify, ed25519};
