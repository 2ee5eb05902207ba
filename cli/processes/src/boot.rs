//! The first program of each core of a run (the bootloader on core 0, a jump to the slot on the
//! others), and the program flashes that they start from. T-BOOT-1, T-BOOT-2

use std::fs::File;
use std::io::{Read as _, Write as _};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow};
use embedded_storage::nor_flash::ReadNorFlash as _;
use serde::{Deserialize, Serialize};
use tandem_board::{Board, CoreId, MonotonicCounter as _, Supply as _, SystemId};
use tandem_board_host::{CoreArgs, HostBoard, jump};
use tandem_boot::{
    BODY_OFFSET, Bank, BetweenSteps, BootDesk, COUNTER_PAGES, DeskSetup, EnvironmentStore,
    FlashRegion, ImageTarget, Leave, Manifest, OneTimeWords, SIGNED_BYTES, Security, Slot, Trust,
    TrustMode, ed25519, rom_choice, start,
};
use tandem_boot_host::{FlashFile, Image, ReleaseInfo, SigningKey, records};

/// The DER header of a private Ed25519 key (RFC 8410); the 32 bytes of the key follow.
pub const PRIVATE_DER: [u8; 16] =
    *b"\x30\x2e\x02\x01\x00\x30\x05\x06\x03\x2b\x65\x70\x04\x22\x04\x20";
/// Name of the controller in the slots of a run.
pub const CONTROLLER: &str = "controller";

/// The program flashes of a run, as its processes receive them.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProgramFlashes {
    /// One file for each system, by [`SystemId::index`].
    pub files: [PathBuf; 2],
    /// The public key that the bootloaders trust.
    public: [u8; 32],
    /// The public keys of testers.
    pub testers: Vec<[u8; 32]>,
}

impl ProgramFlashes {
    /// Opens the flashes in these files. Creates each missing file with factory content: release 1
    /// of the controller, signed with this key.
    ///
    /// # Errors
    /// If a file cannot be read or created, or is not a flash.
    pub fn of(files: [PathBuf; 2], key: &SigningKey, tester: &SigningKey) -> anyhow::Result<Self> {
        for file in files.iter().filter(|file| !file.exists()) {
            let image = application(CONTROLLER, Slot::A, 1, key);
            FlashFile::open(file)
                .and_then(|flash| flash.load(image.place(), &image.bytes))
                .with_context(|| file.display().to_string())?;
        }
        Self::empty(files, key, Some(tester))
    }

    /// Opens the flashes in these files. Creates each missing file as an erased flash. Without a
    /// tester, everybody may program them.
    ///
    /// # Errors
    /// If a file cannot be read or created, or is not a flash.
    pub fn empty(
        files: [PathBuf; 2],
        key: &SigningKey,
        tester: Option<&SigningKey>,
    ) -> anyhow::Result<Self> {
        for file in &files {
            FlashFile::open(file).with_context(|| file.display().to_string())?;
        }
        Ok(Self {
            files,
            public: key.public(),
            testers: tester.map(SigningKey::public).into_iter().collect(),
        })
    }

    fn open(&self, system: SystemId) -> anyhow::Result<FlashFile> {
        let path = &self.files[system.index()];
        FlashFile::open(path).with_context(|| path.display().to_string())
    }

    /// Returns the records that update a system to this release of the controller. They are for
    /// the slot that does not boot.
    ///
    /// # Errors
    /// If the flash cannot be read.
    pub fn update(
        &self,
        system: SystemId,
        release: u32,
        key: &SigningKey,
    ) -> anyhow::Result<Vec<String>> {
        let store = EnvironmentStore::load(&mut self.open(system)?);
        let active = store.and_then(|store| store.get().active.application);
        let slot = active.unwrap_or(Slot::A).other();
        let image = application(CONTROLLER, slot, release, key);
        Ok(records(CONTROLLER, &[&image]))
    }
}

/// Builds and signs the image that starts an application of this executable from a slot. Both
/// systems approve it, or none.
pub fn application(name: &str, slot: Slot, version: u32, key: &SigningKey) -> Image {
    let release = ReleaseInfo {
        version,
        entries: [BODY_OFFSET; CoreId::COUNT],
        paired: name == CONTROLLER,
        ..ReleaseInfo::default()
    };
    let script = jump::script(name);
    Image::sign(
        ImageTarget::Application(slot),
        release,
        &[(BODY_OFFSET, &script)],
        key,
    )
}

/// Reads the key in this file. Creates the file with a new key if it is missing.
///
/// # Errors
/// If the file cannot be read or written, or does not hold a key.
pub fn key_in(path: &Path) -> anyhow::Result<SigningKey> {
    if !path.exists() {
        let key = new_key()?;
        let mut options = File::options();
        let mut file = options
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(path)
            .with_context(|| path.display().to_string())?;
        file.write_all(&[&PRIVATE_DER[..], &key.seed].concat())
            .with_context(|| path.display().to_string())?;
    }
    let seed = key(path, &PRIVATE_DER)?;
    Ok(SigningKey { number: 0, seed })
}

/// Reads the 32 bytes of a key from a DER file that begins with `prefix`.
///
/// # Errors
/// If the file cannot be read, or does not hold such a key.
pub fn key(path: &Path, prefix: &[u8]) -> anyhow::Result<[u8; 32]> {
    let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
    let key = bytes
        .strip_prefix(prefix)
        .and_then(|key| key.try_into().ok());
    key.ok_or_else(|| anyhow!("{} is not an Ed25519 key in DER", path.display()))
}

/// Generates a key.
///
/// # Errors
/// If the operating system does not provide random numbers.
pub fn new_key() -> anyhow::Result<SigningKey> {
    Ok(SigningKey {
        number: 0,
        seed: noise()?,
    })
}

/// Returns random bytes.
///
/// # Errors
/// If the operating system does not provide random numbers.
pub fn noise() -> anyhow::Result<[u8; 32]> {
    let mut bytes = [0; 32];
    let mut random = File::open("/dev/urandom").context("/dev/urandom")?;
    random.read_exact(&mut bytes).context("/dev/urandom")?;
    Ok(bytes)
}

/// Runs the first program of a core, and then replaces the process by the application in a slot.
/// Returns only on failure.
///
/// # Errors
/// If the run has ended, or the slot cannot be read or executed.
pub fn run(args: &CoreArgs, flash: &ProgramFlashes) -> anyhow::Result<()> {
    let system = args.identity.system;
    let mut file = flash.open(system)?;
    let slot = if args.identity.core == CoreId::CONTROL {
        let slot = boot(args, &mut file, flash)?;
        jump::set_booted(args, slot as u32)?;
        slot
    } else {
        booted(args)?
    };
    let program = program(&mut file, slot, args.identity.core)?;
    Err(jump::jump(&program, args)).with_context(|| format!("executing slot {slot:?}"))
}

/// Returns the slot that core 0's bootloader has started.
fn booted(args: &CoreArgs) -> anyhow::Result<Slot> {
    Ok(match jump::booted(args)? == Slot::B as u32 {
        true => Slot::B,
        false => Slot::A,
    })
}

/// Runs the bootloader until core 0 starts an application. Returns the slot of that application.
fn boot(args: &CoreArgs, file: &mut FlashFile, flash: &ProgramFlashes) -> anyhow::Result<Slot> {
    let board = HostBoard::attach(args).context("the bootloader cannot attach to its board")?;
    let trust = Trust {
        keys: &[flash.public],
        testers: &flash.testers,
        mode: TrustMode::Strict,
        verify: ed25519,
    };
    let keeper = BetweenSteps::new(&board);
    let counter = OneTimeWords::new(flash.open(board.identity().system)?, COUNTER_PAGES).value();
    // If the file contains no bootloader, this program acts as the primary one.
    let mut bank = rom_choice(file).unwrap_or(Bank::Primary);
    loop {
        let noise = noise()?;
        let security = Security { noise, counter };
        match start(&board, &mut *file, trust, bank, &keeper, security) {
            Leave::Jump(launch) => return Ok(launch.application),
            Leave::StartBank(other) => bank = other,
        }
    }
}

/// Returns the program of a core in a slot: the bytes from its entry to the end of that part.
fn program(file: &mut FlashFile, slot: Slot, core: CoreId) -> anyhow::Result<Vec<u8>> {
    let place = FlashRegion::Target(ImageTarget::Application(slot))
        .range()
        .start;
    let unreadable = |_| anyhow!("the program flash cannot be read");
    let mut bytes = [0; SIGNED_BYTES];
    file.read(place, &mut bytes).map_err(unreadable)?;
    let manifest = Manifest::decode(&bytes).map_err(|why| anyhow!("slot {slot:?}: {why:?}"))?;
    let entry = manifest.entries[core.index()];
    let holds =
        |part: &&tandem_boot::ImagePart| (part.offset..part.offset + part.length).contains(&entry);
    let part = manifest.parts().find(holds);
    let part = part.with_context(|| format!("slot {slot:?} has nothing for core {core}"))?;
    let mut program = vec![0; (part.offset + part.length - entry) as usize];
    file.read(place + entry, &mut program).map_err(unreadable)?;
    Ok(program)
}

/// Returns the desk of the application that runs from this system's flash. `testers`: the public
/// keys of [`ProgramFlashes::testers`].
///
/// # Errors
/// If the flash cannot be opened, or the operating system does not provide random numbers.
pub fn desk<'k>(
    board: &HostBoard,
    args: &CoreArgs,
    flash: &ProgramFlashes,
    testers: &'k [[u8; 32]],
) -> anyhow::Result<BootDesk<'k, FlashFile, OneTimeWords<FlashFile>>> {
    let (system, supply) = (board.identity().system, board.supply());
    let setup = DeskSetup {
        trust: Trust {
            keys: &[],
            testers,
            mode: TrustMode::Strict,
            verify: ed25519,
        },
        system,
        running: booted(args)?,
        starts: supply.starts(),
        noise: noise()?,
    };
    let counter = OneTimeWords::new(flash.open(system)?, COUNTER_PAGES);
    Ok(BootDesk::new(
        flash.open(system)?,
        counter,
        setup,
        board.now(),
    ))
}
