//! A monotonic counter in one-time programmable pages. E-4

use crate::flash_access::{program, read};
use crate::map::PAGE_BYTES;
use crate::page::Page;
use core::ops::Range;
use embedded_storage::nor_flash::NorFlash;
use tandem_board::MonotonicCounter;

/// The content of a used page.
const USED: Page = *b"one-time programmed: counts as 1";
/// Pages of a number: a loss of power tears one of them at most.
const COPIES: u32 = 2;
/// Bytes of a number.
const NUMBER_BYTES: u32 = COPIES * PAGE_BYTES as u32;

/// Two pages for each number from 1 on; the value is the highest number with a used page. A page
/// that was torn, or cannot be read, is not used.
#[derive(Debug)]
pub struct OneTimeWords<F> {
    flash: F,
    pages: Range<u32>,
}

impl<F: NorFlash> OneTimeWords<F> {
    /// `pages`: offsets of whole pages that nothing ever erases.
    pub const fn new(flash: F, pages: Range<u32>) -> Self {
        Self { flash, pages }
    }

    /// Returns the flash.
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// Returns the offsets of the pages of a number from 1 on; `None` if it is too large.
    fn pages_of(&self, number: u32) -> Option<[u32; COPIES as usize]> {
        let first = number.checked_sub(1)?.checked_mul(NUMBER_BYTES)?;
        let first = self.pages.start.checked_add(first)?;
        let fits = first.checked_add(NUMBER_BYTES)? <= self.pages.end;
        fits.then_some([first, first + PAGE_BYTES as u32])
    }

    fn is_used(&mut self, at: u32) -> bool {
        read(&mut self.flash, at) == Ok(USED)
    }
}

impl<F: NorFlash> MonotonicCounter for OneTimeWords<F> {
    fn value(&mut self) -> u32 {
        let numbers = 1..=(self.pages.len() as u32 / NUMBER_BYTES);
        let mut highest_first = numbers.rev();
        let used = highest_first.find(|number| {
            let pages = self.pages_of(*number).into_iter().flatten();
            pages.into_iter().any(|at| self.is_used(at))
        });
        used.unwrap_or(0)
    }

    fn raise(&mut self, to: u32) -> bool {
        if to == 0 {
            return true;
        }
        let Some(pages) = self.pages_of(to) else {
            return false;
        };
        let mut is_raised = false;
        for at in pages {
            is_raised |= self.is_used(at) || program(&mut self.flash, at, &USED).is_ok();
        }
        is_raised
    }
}
