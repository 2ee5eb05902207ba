//! The update of the bootloader itself, through its backup bank. U-4

use super::{Loader, Next, raise};
use crate::environment::{Environment, EnvironmentStore, LoaderUpdate};
use crate::flash_access::{FlashFault, copy_to_bank, manifest_at, read, read_manifest};
use crate::log::{LogEvent, append};
use crate::manifest::{BODY_OFFSET, MANIFEST_BYTES, Manifest};
use crate::map::{Bank, FlashRegion, ImageKind, ImageTarget, PAGE_BYTES};
use embedded_storage::nor_flash::NorFlash;

impl<F: NorFlash> Loader<'_, F> {
    /// Takes the next steps of an update of the bootloader. Returns the next action, or `None` if
    /// the loader may continue, also because the flash fails for good: the backup then runs. U-4
    #[inline(never)]
    pub(super) fn continue_update(&mut self) -> Option<Next> {
        let next = self.update_bootloader();
        next.or_else(|FlashFault| self.update_bootloader())
            .unwrap_or_else(|FlashFault| {
                let failed = self.ground.store.get().loader;
                let next = match failed {
                    // The backup bank, or the environment. The running bootloader is whole.
                    LoaderUpdate::Staged => LoaderUpdate::Idle,
                    _ => LoaderUpdate::BackupOnly,
                };
                let _unwritten = self.set_loader(next);
                self.log(LogEvent::LoaderNotWritten, failed as u32);
                None
            })
    }

    fn update_bootloader(&mut self) -> Result<Option<Next>, FlashFault> {
        let staging = FlashRegion::Target(ImageTarget::Staging).range().start;
        let backup = FlashRegion::Bank(Bank::Backup).range().start;
        match (self.ground.store.get().loader, self.setup.bank) {
            (LoaderUpdate::Idle, Bank::Primary) | (LoaderUpdate::BackupOnly, Bank::Backup) => {
                Ok(None)
            }
            // The bank can be read again.
            (LoaderUpdate::BackupOnly, Bank::Primary) => {
                self.set_loader(LoaderUpdate::Idle)?;
                Ok(None)
            }
            // The ROM found the primary bank damaged: write it again.
            (LoaderUpdate::Idle, Bank::Backup) => {
                let lowest = self.ground.lowest_version(ImageKind::Bootloader);
                let staged = manifest_at(&mut self.flash, ImageTarget::Staging);
                let is_newest = staged.is_some_and(|it| it.version == lowest)
                    && self.can_boot(ImageTarget::Staging);
                self.set_loader(match is_newest {
                    true => LoaderUpdate::Sealing,
                    false => LoaderUpdate::Restoring,
                })?;
                self.update_bootloader()
            }
            (LoaderUpdate::Staged, bank) => {
                let old = manifest_at(&mut self.flash, ImageTarget::Staging).is_some_and(|it| {
                    it.version < self.ground.lowest_version(ImageKind::Bootloader)
                });
                if old || !self.can_boot(ImageTarget::Staging) {
                    self.log(LogEvent::SlotDamaged, ImageKind::Bootloader as u32);
                    self.set_loader(LoaderUpdate::Idle)?;
                    return self.update_bootloader();
                }
                if bank == Bank::Primary {
                    let primary = FlashRegion::Bank(Bank::Primary).range().start;
                    self.copy(primary, Bank::Backup, true)?;
                }
                self.set_loader(LoaderUpdate::Installing)?;
                self.update_bootloader()
            }
            // A bootloader does not overwrite itself, and does not trust what was not finished,
            // although the ROM has found its seal.
            (
                LoaderUpdate::Installing | LoaderUpdate::Sealing | LoaderUpdate::Restoring,
                Bank::Primary,
            ) => Ok(Some(Next::StartBank(Bank::Backup))),
            (LoaderUpdate::Installing, Bank::Backup) => {
                self.copy(staging, Bank::Primary, false)?;
                self.set_loader(LoaderUpdate::Trial)?;
                self.log(LogEvent::LoaderInstalled, 0);
                Ok(Some(Next::Reset))
            }
            // The ROM starts only the backup: the primary bank is not sealed.
            (LoaderUpdate::Trial, Bank::Backup) => {
                self.set_loader(LoaderUpdate::TrialExecuted)?;
                Ok(Some(Next::StartBank(Bank::Primary)))
            }
            (LoaderUpdate::Trial | LoaderUpdate::TrialExecuted, Bank::Primary) => Ok(None),
            (LoaderUpdate::TrialExecuted, Bank::Backup) => {
                self.set_loader(LoaderUpdate::Restoring)?;
                self.update_bootloader()
            }
            (LoaderUpdate::Sealing, Bank::Backup) => {
                self.copy(staging, Bank::Primary, true)?;
                self.end_update()?;
                Ok(Some(Next::Reset))
            }
            (LoaderUpdate::Restoring, Bank::Backup) => {
                self.copy(backup, Bank::Primary, true)?;
                self.set_loader(LoaderUpdate::Idle)?;
                self.log(LogEvent::LoaderRestored, 0);
                Ok(Some(Next::Reset))
            }
        }
    }

    /// Ends an update. From now on bootloaders older than the new one are refused.
    fn end_update(&mut self) -> Result<(), FlashFault> {
        let mut environment = *self.ground.store.get();
        let mut bytes = [0; MANIFEST_BYTES];
        let staged = read_manifest(&mut self.flash, ImageTarget::Staging, &mut bytes);
        if let Some(manifest) = staged.filter(|_| self.setup.trust.is_authentic(&bytes, 0)) {
            raise(&mut environment, &manifest);
        }
        environment.loader = LoaderUpdate::Idle;
        self.write(environment)
    }

    fn copy(&mut self, from: u32, bank: Bank, seal: bool) -> Result<(), FlashFault> {
        let page = read::<PAGE_BYTES>(&mut self.flash, from)?;
        let (length, _) = Manifest::seal(&page).ok_or(FlashFault)?;
        copy_to_bank(&mut self.flash, from, bank, BODY_OFFSET + length, seal)
    }

    fn set_loader(&mut self, loader: LoaderUpdate) -> Result<(), FlashFault> {
        self.write(Environment {
            loader,
            ..*self.ground.store.get()
        })
    }
}

/// Approves a bootloader on trial, which a host or an application has shown to work. The backup
/// seals it at the next start. U-4
#[inline(never)]
pub(crate) fn approve_bootloader(
    flash: &mut impl NorFlash,
    store: &mut EnvironmentStore,
) -> Result<(), FlashFault> {
    let mut environment = *store.get();
    if environment.loader != LoaderUpdate::TrialExecuted {
        return Ok(());
    }
    environment.loader = LoaderUpdate::Sealing;
    store.write(flash, environment)?;
    // Nothing depends on the log.
    let _unlogged = append(flash, LogEvent::LoaderApproved, 0);
    Ok(())
}

/// Approves the bootloader that started this application, if it is on trial. The application's desk
/// calls it once the application works. Blocks while the flash is busy.
///
/// # Errors
/// [`FlashFault`] if the flash cannot be read or written; try again.
pub fn bootloader_works(flash: &mut impl NorFlash) -> Result<(), FlashFault> {
    let mut store = EnvironmentStore::load(flash).ok_or(FlashFault)?;
    approve_bootloader(flash, &mut store)
}
