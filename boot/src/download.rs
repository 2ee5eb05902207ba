//! Receives the records of a file, checks each one, and writes images to free slots.
//!
//! The manifest of an image arrives first and is checked before anything is erased. It is written
//! last, after the body has been read back. So a slot with a readable manifest has a firm body (no
//! bit of it is weak), even if power was lost while the manifest was written. Finally, one write of
//! the boot environment changes which slot boots. T-BOOT-5, U-3, U-5

use crate::environment::{EnvironmentStore, LoaderUpdate, Selection, Trial};
use crate::flash_access::{FlashFault, body_crc, erase, is_intact, manifest_at, program, read};
use crate::manifest::{HARDWARE, MAGIC, MANIFEST_BYTES, Manifest, SIGNED_BYTES};
use crate::map::{
    FlashRegion, ImageKind, ImageTarget, PAGE_BYTES, Slot, offset_of, sector, sector_at,
};
use crate::page::{Page, PageBuffer};
use crate::protocol::Refusal;
use crate::srec::{SRecord, SRecordType};
use crate::tester::Tester;
use crate::trust::{Trust, TrustMode};
use core::ops::Range;
use embedded_storage::nor_flash::NorFlash;

/// The most images in one file: application, configuration, bootloader.
const MAX_IMAGES: usize = 3;

/// The state of the controller that a download uses.
#[derive(Debug)]
pub(crate) struct Ground<'k> {
    pub(crate) trust: Trust<'k>,
    pub(crate) store: EnvironmentStore,
    /// The slots that boot. No download may touch them.
    pub(crate) keep: Selection,
    /// The manifest of the running bootloader; `None` if it cannot be read.
    pub(crate) running: Option<[u8; MANIFEST_BYTES]>,
    pub(crate) tester: Tester,
    /// As in [`Setup::counter`](crate::Setup::counter).
    pub(crate) counter: u32,
}

impl Ground<'_> {
    /// Returns whether a download may erase this place.
    #[inline(never)]
    fn is_free(&self, target: ImageTarget) -> bool {
        // The other system may have approved what is ready.
        let is_ready = self.store.get().trial.is_some_and(|trial| trial.ready);
        match target {
            ImageTarget::Application(slot) => !is_ready && self.keep.application != Some(slot),
            ImageTarget::Configuration(slot) => !is_ready && self.keep.configuration != Some(slot),
            ImageTarget::Staging => matches!(
                self.store.get().loader,
                LoaderUpdate::Idle | LoaderUpdate::BackupOnly
            ),
        }
    }

    /// Returns the lowest version that may be downloaded. The running bootloader counts as
    /// approved.
    pub(crate) fn lowest_version(&self, kind: ImageKind) -> u32 {
        let approved = self.store.get().versions[kind as usize];
        match kind {
            ImageKind::Bootloader => approved.max(self.running_version()),
            _ => approved,
        }
    }

    /// Returns whether the board's counter permits an image.
    pub(crate) fn counter_permits(&self, kind: ImageKind, security_counter: u8) -> bool {
        kind != ImageKind::Application || u32::from(security_counter) >= self.counter
    }

    /// Returns the version of the running bootloader; 0 if its manifest cannot be read.
    #[inline(never)]
    fn running_version(&self) -> u32 {
        let signed = self.running.as_ref().and_then(|bytes| bytes.first_chunk());
        let manifest = signed.and_then(|bytes| Manifest::decode(bytes).ok());
        manifest.map_or(0, |manifest| manifest.version)
    }

    /// Returns whether these images may run together, under the running bootloader.
    #[inline(never)]
    pub(crate) fn fit(&self, flash: &mut impl NorFlash, selection: Selection) -> bool {
        let [_, bootloader, lowest] = selection.application.map_or([0; 3], |slot| {
            version_and_needs(flash, ImageTarget::Application(slot))
        });
        let [configuration, ..] = selection.configuration.map_or([0; 3], |slot| {
            version_and_needs(flash, ImageTarget::Configuration(slot))
        });
        bootloader <= self.running_version() && lowest <= configuration
    }

    /// Removes a trial from the environment if it names the target, which is about to be erased.
    fn forget(&mut self, flash: &mut impl NorFlash, target: ImageTarget) -> Result<(), FlashFault> {
        let mut environment = *self.store.get();
        let selection = environment.trial.map(|trial| trial.selection);
        let selection = selection.unwrap_or_default();
        let named = match target {
            ImageTarget::Application(slot) => selection.application == Some(slot),
            ImageTarget::Configuration(slot) => selection.configuration == Some(slot),
            ImageTarget::Staging => false,
        };
        if named {
            environment.trial = None;
            self.store.write(flash, environment)?;
        }
        Ok(())
    }
}

/// Returns the version of the image in a place, and the lowest bootloader and configuration that it
/// needs; 0 without an image.
#[inline(never)]
fn version_and_needs(flash: &mut impl NorFlash, target: ImageTarget) -> [u32; 3] {
    manifest_at(flash, target).map_or([0; 3], |it| {
        [it.version, it.needs_bootloader, it.needs_configuration]
    })
}

/// One image of the file.
#[derive(Clone, Debug)]
struct Image {
    target: ImageTarget,
    manifest_bytes: [u8; MANIFEST_BYTES],
    /// Received bytes of the manifest.
    filled: usize,
    /// The manifest, once it is complete and accepted.
    manifest: Option<Manifest>,
    /// Whether its signature is that of an accepted key.
    is_authentic: bool,
    /// Whether the place holds this image already. Then nothing is erased or written.
    is_there: bool,
    /// Index of the part being received, and its received bytes.
    part: usize,
    done: u32,
}

impl Image {
    const fn place(&self) -> u32 {
        FlashRegion::Target(self.target).range().start
    }

    /// Returns the offset of the next data; `None` if all have been received.
    fn expects(&self) -> Option<u32> {
        let Some(manifest) = &self.manifest else {
            return Some(self.place() + self.filled as u32);
        };
        let part = manifest.parts().nth(self.part)?;
        Some(self.place() + part.offset + self.done)
    }

    /// Returns how many bytes may follow at the offset of [`expects`](Self::expects).
    fn room(&self) -> usize {
        let part = self
            .manifest
            .as_ref()
            .map(|manifest| manifest.parts[self.part].length);
        part.map_or(MANIFEST_BYTES - self.filled, |length| {
            (length - self.done) as usize
        })
    }
}

/// A download under way.
#[derive(Clone, Debug, Default)]
pub(crate) struct Download {
    images: [Option<Image>; MAX_IMAGES],
    /// Index of the image being received.
    current: usize,
    /// Range of the last record.
    last: Range<u32>,
    /// Number of data records so far.
    count: u32,
    /// The sector that was erased last.
    erased: Range<u32>,
    buffer: PageBuffer,
}

impl Download {
    /// Returns the offset behind the received bytes.
    pub(crate) const fn received(&self) -> u32 {
        self.last.end
    }

    /// Processes a record. Returns `Ok(true)` if the file has ended and is on trial.
    pub(crate) fn take(
        &mut self,
        record: &SRecord,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Result<bool, Refusal> {
        match record.record_type {
            SRecordType::Header => Ok(false),
            SRecordType::Data => {
                self.data(record.address, record.data(), flash, ground)?;
                self.count += 1;
                Ok(false)
            }
            SRecordType::Copy => {
                self.copy(record, flash, ground)?;
                self.count += 1;
                Ok(false)
            }
            SRecordType::Count if record.address == self.count => Ok(false),
            SRecordType::Count => Err(Refusal::Count),
            SRecordType::Entry => {
                self.finish(record.address, flash, ground)?;
                Ok(true)
            }
        }
    }

    /// Takes bytes from the flash, usually of the running application, instead of from the host.
    fn copy(
        &mut self,
        record: &SRecord,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Result<(), Refusal> {
        let (mut from, mut left) = record.copied();
        let mut to = record.address;
        while left > 0 {
            let page: Page = read(flash, from).map_err(|FlashFault| Refusal::Flash)?;
            let length = left.min(PAGE_BYTES as u32);
            self.data(to, &page[..length as usize], flash, ground)?;
            (from, to, left) = (from + length, to + length, left - length);
        }
        Ok(())
    }

    fn data(
        &mut self,
        address: u32,
        mut data: &[u8],
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Result<(), Refusal> {
        let mut at = offset_of(address).ok_or(Refusal::Address)?;
        let length = data.len() as u32;
        let end = at + data.len() as u32;
        while !data.is_empty() {
            let image = match &mut self.images[self.current] {
                Some(image) if image.expects().is_some() => image,
                before => {
                    let begun = begin(before.as_ref(), at, end, &self.last, ground)?;
                    self.current += usize::from(before.is_some());
                    let place = self.images.get_mut(self.current);
                    place.ok_or(Refusal::Unannounced)?.insert(begun)
                }
            };
            match image.expects() {
                Some(expected) if at > expected => return Err(Refusal::Gap),
                Some(expected) if at < expected => return Err(behind(end, &self.last)),
                _ => {}
            }
            let (now, rest) = data.split_at(image.room().min(data.len()));
            if let Some(manifest) = &image.manifest {
                let erased = &mut self.erased;
                if !image.is_there {
                    self.buffer
                        .put(at, now, |at, page| program_in(flash, erased, at, page))
                        .map_err(|FlashFault| Refusal::Flash)?;
                }
                image.done += now.len() as u32;
                if image.done == manifest.parts[image.part].length {
                    (image.part, image.done) = (image.part + 1, 0);
                }
            } else {
                image.manifest_bytes[image.filled..][..now.len()].copy_from_slice(now);
                image.filled += now.len();
                let begins = image.filled.min(MAGIC.len());
                if image.manifest_bytes[..begins] != MAGIC[..begins] {
                    return Err(Refusal::NoManifest);
                }
                if image.filled == MANIFEST_BYTES {
                    let (manifest, authentic) =
                        accept(&image.manifest_bytes, image.target, ground)?;
                    image.is_authentic = authentic;
                    image.is_there = holds(flash, image.place(), &image.manifest_bytes, &manifest);
                    image.manifest = Some(manifest);
                    let place = (!image.is_there).then(|| (image.target, image.place()));
                    self.prepare(place, flash, ground)
                        .map_err(|FlashFault| Refusal::Flash)?;
                }
            }
            at += now.len() as u32;
            data = rest;
        }
        self.last = end - length..end;
        Ok(())
    }

    /// Programs the page in the buffer. If an image is to be written to a `place`, forgets a trial
    /// of that, and erases its first sector.
    fn prepare(
        &mut self,
        place: Option<(ImageTarget, u32)>,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Result<(), FlashFault> {
        let erased = &mut self.erased;
        self.buffer
            .flush(|at, page| program_in(flash, erased, at, page))?;
        let Some((target, at)) = place else {
            return Ok(());
        };
        ground.forget(flash, target)?;
        self.erased = sector_at(at).ok_or(FlashFault)?;
        erase(flash, self.erased.clone())
    }

    fn finish(
        &mut self,
        entry: u32,
        flash: &mut impl NorFlash,
        ground: &mut Ground<'_>,
    ) -> Result<(), Refusal> {
        let fault = |FlashFault| Refusal::Flash;
        let images = self.images.iter().flatten();
        let complete = images.clone().all(|image| image.expects().is_none());
        if !complete || images.clone().next().is_none() {
            return Err(Refusal::Incomplete);
        }
        // An entry of 0 in the last record means that the file has no entry.
        let entry_of = |image: &Image| Some(image.place() + image.manifest?.entries[0]);
        let known = images
            .clone()
            .any(|image| entry_of(image) == offset_of(entry));
        if entry != 0 && !known {
            return Err(Refusal::Entry);
        }
        let erased = &mut self.erased;
        self.buffer
            .flush(|at, page| program_in(flash, erased, at, page))
            .map_err(fault)?;
        let mut environment = *ground.store.get();
        // In a reset loop the fallback runs, and the file may have replaced what was active.
        environment.active = ground.keep.over(environment.active);
        let before = environment.trial;
        let mut selection = before.map_or(Selection::default(), |trial| trial.selection);
        let mut authentic = before.is_none_or(|trial| trial.authentic);
        for image in self.images.iter().flatten() {
            let manifest = image.manifest.as_ref().ok_or(Refusal::Incomplete)?;
            let place = image.place();
            // Only the boot ROM uses the checksum, and only that of a bootloader.
            let right = is_intact(flash, place, manifest).map_err(fault)?
                && (image.target != ImageTarget::Staging
                    || body_crc(flash, place, manifest.length).map_err(fault)? == manifest.crc);
            if !right {
                return Err(Refusal::Digest);
            }
            let (pages, _) = image.manifest_bytes.as_chunks::<PAGE_BYTES>();
            for (page, at) in pages.iter().zip((place..).step_by(PAGE_BYTES)) {
                if !image.is_there {
                    program(flash, at, page).map_err(fault)?;
                }
            }
            authentic &= image.is_authentic;
            match image.target {
                ImageTarget::Application(slot) => selection.application = Some(slot),
                ImageTarget::Configuration(slot) => selection.configuration = Some(slot),
                // It runs already.
                ImageTarget::Staging if ground.running == Some(image.manifest_bytes) => {}
                ImageTarget::Staging => environment.loader = LoaderUpdate::Staged,
            }
        }
        if !ground.fit(flash, selection.over(ground.keep)) {
            return Err(Refusal::Needs);
        }
        environment.trial = (selection != Selection::default()).then_some(Trial {
            selection,
            executed: false,
            ready: false,
            authentic,
        });
        if environment == *ground.store.get() {
            return Ok(());
        }
        ground.store.write(flash, environment).map_err(fault)
    }
}

/// Finds the place that begins at an address, and checks that it may be written.
fn begin(
    before: Option<&Image>,
    at: u32,
    end: u32,
    last: &Range<u32>,
    ground: &Ground<'_>,
) -> Result<Image, Refusal> {
    if at < last.end {
        return Err(behind(end, last));
    }
    let Some(target) = ImageTarget::at(at) else {
        let below = sector(4).is_some_and(|environment| at < environment.start);
        let region = [
            FlashRegion::Environment(0),
            FlashRegion::Environment(1),
            FlashRegion::Log(0),
        ];
        let kept = region.into_iter().chain([FlashRegion::Log(1)]);
        let kept = kept
            .map(FlashRegion::range)
            .any(|range| range.contains(&at));
        return Err(if below || kept {
            Refusal::Protected
        } else {
            Refusal::Address
        });
    };
    if before.is_some_and(|image| image.target == target) {
        return Err(Refusal::Unannounced);
    }
    if !ground.is_free(target) {
        return Err(Refusal::SlotInUse);
    }
    if at != FlashRegion::Target(target).range().start {
        return Err(Refusal::NoManifest);
    }
    Ok(Image {
        target,
        manifest_bytes: [0; MANIFEST_BYTES],
        filled: 0,
        manifest: None,
        is_authentic: false,
        is_there: false,
        part: 0,
        done: 0,
    })
}

/// Returns whether a place holds this image, whole.
fn holds(
    flash: &mut impl NorFlash,
    place: u32,
    bytes: &[u8; MANIFEST_BYTES],
    manifest: &Manifest,
) -> bool {
    read(flash, place) == Ok(*bytes) && is_intact(flash, place, manifest) == Ok(true)
}

/// Checks a manifest. Nothing was erased for it yet. Returns it, and whether it is authentic.
fn accept(
    bytes: &[u8; MANIFEST_BYTES],
    target: ImageTarget,
    ground: &Ground<'_>,
) -> Result<(Manifest, bool), Refusal> {
    let signed = bytes.first_chunk::<SIGNED_BYTES>();
    let manifest = signed.and_then(|signed| Manifest::decode(signed).ok());
    let manifest = manifest.ok_or(Refusal::BadManifest)?;
    let range = FlashRegion::Target(target).range();
    let room = range.end - range.start - MANIFEST_BYTES as u32;
    let fits = manifest.kind == target.kind() && manifest.hardware == HARDWARE;
    // A key that retires itself would lock out every later download.
    if !fits || manifest.length > room || manifest.lowest_key > manifest.key {
        return Err(Refusal::BadManifest);
    }
    let environment = ground.store.get();
    let authentic = ground.trust.is_authentic(bytes, environment.lowest_key);
    if !authentic && ground.trust.mode == TrustMode::Strict {
        return Err(Refusal::Untrusted);
    }
    let permitted = ground.counter_permits(manifest.kind, manifest.security_counter);
    if manifest.version < ground.lowest_version(manifest.kind) || !permitted {
        return Err(Refusal::Downgrade);
    }
    if manifest.needs_bootloader > ground.running_version() {
        return Err(Refusal::Needs);
    }
    Ok((manifest, authentic))
}

/// Returns the refusal for a record that begins before the end of the received data.
fn behind(end: u32, last: &Range<u32>) -> Refusal {
    if end > last.start {
        Refusal::Overlap
    } else {
        Refusal::Order
    }
}

/// Programs a page. Erases its sector first, unless that is the sector that was erased last.
fn program_in(
    flash: &mut impl NorFlash,
    erased: &mut Range<u32>,
    at: u32,
    page: &[u8; PAGE_BYTES],
) -> Result<(), FlashFault> {
    if !erased.contains(&at) {
        *erased = sector_at(at).ok_or(FlashFault)?;
        erase(flash, erased.clone())?;
    }
    program(flash, at, page)
}

/// Returns the slot that is free, given the kept one: 0 for A, 1 for B, 2 for either.
pub(crate) const fn free_slot(keep: Option<Slot>) -> u8 {
    match keep {
        Some(kept) => kept.other() as u8,
        None => 2,
    }
}
