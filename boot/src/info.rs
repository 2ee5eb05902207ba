//! Answers to questions about versions, slots and the log, by the bootloader and by a running
//! application. Nothing in them is secret. U-2

use crate::environment::Environment;
use crate::flash_access::read;
use crate::log::read_log;
use crate::manifest::Manifest;
use crate::map::{Bank, FlashRegion, ImageTarget, Slot};
use crate::page::{Page, word};
use crate::protocol::Answer;
use embedded_storage::nor_flash::NorFlash;

/// The log's newest entries that can be asked for.
pub const LOG_ANSWERS: u8 = 16;

/// What a host may ask. The high half of its code says what, the low half which one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Question {
    /// Value: this word of the present [`Environment`], as [`Environment::encode`] writes it with
    /// the sequence number 0. Detail: the starts since power-on or since one has worked, this
    /// one included.
    Environment(u8),
    /// Detail: 1 if it begins with a manifest, 0 if not. Value: the version.
    Place(FlashRegion),
    /// The entry that is older than this many others, below [`LOG_ANSWERS`]. Detail:
    /// [`LogEvent`](crate::LogEvent), 0 if there is none. Value: that of the event.
    Log(u8),
}

/// The places in the order of their codes.
pub const PLACES: [FlashRegion; 7] = [
    FlashRegion::Target(ImageTarget::Application(Slot::A)),
    FlashRegion::Target(ImageTarget::Application(Slot::B)),
    FlashRegion::Target(ImageTarget::Configuration(Slot::A)),
    FlashRegion::Target(ImageTarget::Configuration(Slot::B)),
    FlashRegion::Target(ImageTarget::Staging),
    FlashRegion::Bank(Bank::Primary),
    FlashRegion::Bank(Bank::Backup),
];

impl Question {
    /// Returns the code in the frame; `None` if this place or entry cannot be asked for.
    #[must_use]
    pub fn code(self) -> Option<u8> {
        match self {
            Self::Environment(word) => (word < 16).then_some(word),
            Self::Place(region) => {
                let index = PLACES.iter().position(|place| *place == region)?;
                Some(0x10 + index as u8)
            }
            Self::Log(age) => (age < LOG_ANSWERS).then_some(0x20 + age),
        }
    }
}

/// Answers the question with this code; `None` if there is none.
pub(crate) fn answer(
    flash: &mut impl NorFlash,
    environment: &Environment,
    starts: u8,
    question: u8,
) -> Option<Answer> {
    let index = usize::from(question & 0xF);
    let (detail, value) = match question >> 4 {
        0 => (starts, word(&environment.encode(0), 4 * index)),
        1 => {
            let page = read(flash, PLACES.get(index)?.range().start).ok();
            let version = |page: Page| (1, word(&page, 12));
            let page = page.filter(|page| Manifest::seal(page).is_some());
            page.map_or((0, 0), version)
        }
        2 => {
            let (mut newest, mut count) = ([(0, 0); LOG_ANSWERS as usize], 0usize);
            read_log(flash, &mut |entry| {
                newest[count % newest.len()] = (entry.event as u8, entry.value);
                count += 1;
            });
            let age = count.wrapping_sub(1 + index);
            newest[age % newest.len()]
        }
        _ => return None,
    };
    Some(Answer::Info {
        question,
        detail,
        value,
    })
}
