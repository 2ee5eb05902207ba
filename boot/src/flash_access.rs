//! Operations of the bootloader on any `NorFlash` with the TC297's geometry.

use crate::manifest::{BODY_OFFSET, HARDWARE, MANIFEST_BYTES, Manifest, SIGNED_BYTES};
use crate::map::{Bank, FlashRegion, ImageTarget, PAGE_BYTES, sector_at};
use crate::page::{Crc32, Page};
use core::ops::Range;
use embedded_storage::nor_flash::NorFlash;
use sha2::{Digest, Sha256};

/// An operation of the flash failed, or programmed data did not read back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct FlashFault;

impl core::fmt::Display for FlashFault {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("an operation of the flash failed")
    }
}

impl core::error::Error for FlashFault {}

/// Reads bytes. Only a failed read is an error: the caller must check for noise.
pub(crate) fn read<const N: usize>(
    flash: &mut impl NorFlash,
    offset: u32,
) -> Result<[u8; N], FlashFault> {
    let mut bytes = [0; N];
    flash.read(offset, &mut bytes).map_err(|_| FlashFault)?;
    Ok(bytes)
}

/// Erases a range of whole sectors.
pub(crate) fn erase(flash: &mut impl NorFlash, range: Range<u32>) -> Result<(), FlashFault> {
    let mut at = range.start;
    while at < range.end {
        let sector = sector_at(at).ok_or(FlashFault)?;
        flash
            .erase(sector.start, sector.end)
            .map_err(|_| FlashFault)?;
        at = sector.end;
    }
    Ok(())
}

/// Programs one page and reads it back.
pub(crate) fn program(
    flash: &mut impl NorFlash,
    offset: u32,
    page: &Page,
) -> Result<(), FlashFault> {
    flash.write(offset, page).map_err(|_| FlashFault)?;
    let back: Page = read(flash, offset)?;
    if back == *page {
        Ok(())
    } else {
        Err(FlashFault)
    }
}

/// Adds bytes to a digest.
#[inline(never)]
fn hash(digest: &mut Sha256, bytes: &[u8]) {
    digest.update(bytes);
}

/// Returns the digest.
#[inline(never)]
fn finish(digest: Sha256) -> [u8; 32] {
    digest.finalize().into()
}

/// Returns the digest of bytes.
#[inline(never)]
pub(crate) fn sha256(bytes: &[u8]) -> [u8; 32] {
    let mut digest = Sha256::new();
    hash(&mut digest, bytes);
    finish(digest)
}

/// Returns whether every part of an image has the digest in its manifest.
pub(crate) fn is_intact(
    flash: &mut impl NorFlash,
    place: u32,
    manifest: &Manifest,
) -> Result<bool, FlashFault> {
    for part in manifest.parts() {
        let mut digest = Sha256::new();
        let mut chunk = [0; 256];
        let (mut at, end) = (place + part.offset, place + part.offset + part.length);
        while at < end {
            let len = chunk.len().min((end - at) as usize);
            let chunk = &mut chunk[..len];
            flash.read(at, chunk).map_err(|_| FlashFault)?;
            hash(&mut digest, chunk);
            at += len as u32;
        }
        if finish(digest) != part.sha256 {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Returns the manifest at the start of a place.
#[inline(never)]
pub(crate) fn manifest_at(flash: &mut impl NorFlash, target: ImageTarget) -> Option<Manifest> {
    read_manifest(flash, target, &mut [0; MANIFEST_BYTES])
}

/// Reads the manifest at the start of a place.
#[inline(never)]
pub(crate) fn read_manifest(
    flash: &mut impl NorFlash,
    target: ImageTarget,
    bytes: &mut [u8; MANIFEST_BYTES],
) -> Option<Manifest> {
    let range = FlashRegion::Target(target).range();
    flash.read(range.start, bytes).ok()?;
    let manifest = Manifest::decode(bytes.first_chunk::<SIGNED_BYTES>()?).ok()?;
    let fits = range.start + BODY_OFFSET + manifest.length <= range.end;
    let ours = manifest.kind == target.kind() && manifest.hardware == HARDWARE;
    (fits && ours).then_some(manifest)
}

/// Returns the CRC-32 of the `length` bytes after a manifest, as the boot ROM computes it.
pub(crate) fn body_crc(
    flash: &mut impl NorFlash,
    place: u32,
    length: u32,
) -> Result<u32, FlashFault> {
    let mut crc = Crc32::new();
    let end = place + BODY_OFFSET + length;
    for at in (place + BODY_OFFSET..end).step_by(PAGE_BYTES) {
        let page: Page = read(flash, at)?;
        crc.update(&page[..PAGE_BYTES.min((end - at) as usize)]);
    }
    Ok(crc.value())
}

/// Copies a bootloader to a bank: all pages except the first, then, with `seal`, the first page.
/// The boot ROM does not start a bank without its first page, so a partial copy never runs.
pub(crate) fn copy_to_bank(
    flash: &mut impl NorFlash,
    from: u32,
    bank: Bank,
    end: u32,
    seal: bool,
) -> Result<(), FlashFault> {
    let to = FlashRegion::Bank(bank).range();
    erase(flash, to.clone())?;
    let end = end.next_multiple_of(PAGE_BYTES as u32);
    for at in (PAGE_BYTES as u32..end).step_by(PAGE_BYTES) {
        let page: Page = read(flash, from + at)?;
        program(flash, to.start + at, &page)?;
    }
    if seal {
        let page: Page = read(flash, from)?;
        program(flash, to.start, &page)?;
    }
    Ok(())
}

/// Chooses the bank to start, as the boot ROM does at every start: the first bank with a valid
/// first page whose checksum matches the body. `None` means a bricked controller.
///
/// On the TC297 this is the evaluation of the boot mode headers: pages of 32 bytes with a checksum
/// over a range, tried in a fixed order.
pub fn rom_choice(flash: &mut impl NorFlash) -> Option<Bank> {
    [Bank::Primary, Bank::Backup].into_iter().find(|bank| {
        let place = FlashRegion::Bank(*bank).range();
        let Ok(page) = read::<PAGE_BYTES>(flash, place.start) else {
            return false;
        };
        let Some((length, crc)) = Manifest::seal(&page) else {
            return false;
        };
        let fits = u64::from(BODY_OFFSET) + u64::from(length) <= place.len() as u64;
        fits && body_crc(flash, place.start, length) == Ok(crc)
    })
}
