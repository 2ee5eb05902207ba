//! `tandem flash` signs a file, sends it to a bootloader over CAN, and shows the progress. `tandem
//! bootloader` runs a bootloader on this machine. `docs/boot.md` describes the protocol.

use crate::boot_args::{BootloaderArgs, FlashArgs};
use crate::flash_info;
use anyhow::{Context as _, anyhow, bail};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use std::time::Instant as Clock;
use tandem::failure::Failure;
use tandem_board::{Duration, Instant, MonotonicCounter as _, ResetCause};
use tandem_boot::{
    Bank, COUNTER_PAGES, Launch, Loader, Manifest, Next, OneTimeWords, Setup, Trust, TrustMode,
    approve, ed25519, offset_of, rom_choice,
};
use tandem_boot_host::{
    Content, FileSender, FlashFile, Image, ReleaseInfo, SigningKey, delta, records, send_file,
    serve,
};
use tandem_page::json::JsonOutput;
use tandem_processes::boot::{PRIVATE_DER, key};

/// The DER header of a public Ed25519 key (RFC 8410); its 32 bytes follow.
const PUBLIC_DER: [u8; 12] = *b"\x30\x2a\x30\x05\x06\x03\x2b\x65\x70\x03\x21\x00";

/// Sends a file, or only signs it, as the arguments request.
pub(crate) fn run(args: &FlashArgs) -> Result<(), Failure> {
    if args.json.is_given() && !args.info {
        let what = anyhow!("--json is for --info: a download prints text alone");
        return Err(Failure::Usage(what));
    }
    let Some(file) = &args.file else {
        let json_to = args.json.check().map_err(Failure::usage)?;
        return flash_info::run(args, json_to).map_err(Failure::Run);
    };
    let lines = lines(args, file).map_err(Failure::Usage)?;
    if let Some(path) = &args.sign_only {
        let text = lines.concat();
        return fs::write(path, text)
            .with_context(|| path.display().to_string())
            .map_err(Failure::Run);
    }
    send(args, lines).map_err(Failure::Run)
}

/// Returns the records to send. Signs them unless the file is already signed.
fn lines(args: &FlashArgs, file: &Path) -> anyhow::Result<Vec<String>> {
    let name = file.display();
    let text = fs::read_to_string(file).with_context(|| name.to_string())?;
    let as_it_is = || {
        let lines = text.lines().filter(|line| !line.trim().is_empty());
        lines.map(|line| format!("{}\r\n", line.trim())).collect()
    };
    if text.lines().any(|line| line.starts_with("S4")) {
        // A difference, which is made after the signature.
        return Ok(as_it_is());
    }
    let content = Content::parse(&text).with_context(|| name.to_string())?;
    let begins_signed = |(_, bytes): &(u32, Vec<u8>)| {
        bytes
            .first_chunk()
            .is_some_and(|page| Manifest::seal(page).is_some())
    };
    if content.runs.iter().any(begins_signed) {
        let Some(old) = &args.from else {
            return Ok(as_it_is());
        };
        let image = Image::of_signed(&content).with_context(|| name.to_string())?;
        return difference(&name.to_string(), &image, old);
    }
    let Some(path) = &args.key else {
        bail!(
            "{name} is not signed: give a key with --key (openssl genpkey -algorithm ed25519 \
             -outform DER)"
        );
    };
    let key = SigningKey {
        number: args.key_number,
        seed: key(path, &PRIVATE_DER)?,
    };
    let release = ReleaseInfo {
        version: args.release,
        paired: args.paired,
        security_counter: args.security_counter,
        needs_bootloader: args.needs_bootloader,
        needs_configuration: args.needs_configuration,
        ..ReleaseInfo::default()
    };
    let image = match args.every_core {
        true => Image::of_every_core(&content, release, &key),
        false => Image::of(&content, release, &key),
    };
    let image = image.with_context(|| name.to_string())?;
    match &args.from {
        Some(old) => difference(&name.to_string(), &image, old),
        None => Ok(records(&name.to_string(), &[&image])),
    }
}

/// Returns the records of an image as a difference to the application in a file.
fn difference(name: &str, image: &Image, old: &Path) -> anyhow::Result<Vec<String>> {
    let old_name = || old.display().to_string();
    let text = fs::read_to_string(old).with_context(old_name)?;
    let content = Content::parse(&text).with_context(old_name)?;
    let (at, bytes) = content.runs.first().with_context(old_name)?;
    let at = offset_of(*at).with_context(|| format!("{}: outside the flash", old_name()))?;
    Ok(delta(name, image, bytes, at))
}

fn send(args: &FlashArgs, lines: Vec<String>) -> anyhow::Result<()> {
    let wire = args.bus.join()?;
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} records, {eta} left");
    let bar = ProgressBar::new(lines.len() as u64).with_style(style?);
    let mut sender = FileSender::new(lines, args.to, args.window);
    if args.resume {
        sender = sender.resuming();
    }
    if let Some(path) = &args.tester_key {
        let number = args.tester_key_number;
        let seed = key(path, &PRIVATE_DER)?;
        let system = args
            .to
            .context("a tester signs for one system: name it with --to")?;
        sender = sender.proving(system, SigningKey { number, seed });
    }
    let within = Duration::from_ms(u64::from(args.wait) * 1_000);
    let sent = send_file(&wire, sender, within, |done, _| {
        bar.set_position(done.into())
    });
    bar.finish_and_clear();
    sent?;
    tandem::print("verified by the bootloader, on trial from its next start\n")
}

/// Runs a system's bootloader on its flash file, until it has decided which image to start.
///
/// # Errors
/// [`Failure::Usage`] if the file of `--json` cannot be written; else [`Failure::Run`].
pub(crate) fn bootloader(args: &BootloaderArgs) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    decide(args, json_to).map_err(Failure::Run)
}

fn decide(args: &BootloaderArgs, json_to: JsonOutput) -> anyhow::Result<()> {
    let name = args.flash.display();
    let mut flash = FlashFile::open(&args.flash).with_context(|| name.to_string())?;
    if args.approve {
        return approve(&mut flash).map_err(|fault| anyhow!("{name}: {fault:?}"));
    }
    let keys = args.public.iter().map(|path| key(path, &PUBLIC_DER));
    let keys = keys.collect::<anyhow::Result<Vec<_>>>()?;
    let testers = args.tester_public.iter().map(|path| key(path, &PUBLIC_DER));
    let testers = testers.collect::<anyhow::Result<Vec<_>>>()?;
    let wire = args.bus.join()?;
    let mut setup = Setup {
        trust: Trust {
            keys: &keys,
            testers: &testers,
            mode: if args.monitor {
                TrustMode::Monitor
            } else {
                TrustMode::Strict
            },
            verify: ed25519,
        },
        system: args.system,
        bank: bank(&mut flash),
        cause: if args.requested {
            ResetCause::Download
        } else {
            ResetCause::PowerOn
        },
        starts: 1,
        counter: OneTimeWords::new(FlashFile::open(&args.flash)?, COUNTER_PAGES).value(),
        noise: tandem_processes::boot::noise()?,
    };
    loop {
        let clock = Clock::now();
        let mut loader = Loader::start(&mut flash, setup, Instant::ORIGIN);
        match serve(&wire, clock, &mut loader)? {
            Next::Jump(launch) => {
                let text = || shown(&launch);
                return tandem::print(&json_to.write(&as_json(&launch), text)?);
            }
            Next::StartBank(other) => setup.bank = other,
            _ => {
                setup.cause = ResetCause::Software;
                setup.starts = setup.starts.saturating_add(1);
                setup.bank = bank(&mut flash);
            }
        }
    }
}

/// Returns the bank that the boot ROM starts. If the file contains no bootloader, this program
/// acts as the primary one.
fn bank(flash: &mut FlashFile) -> Bank {
    rom_choice(flash).unwrap_or(Bank::Primary)
}

fn as_json(launch: &Launch) -> Value {
    json!({
        "slot": format!("{:?}", launch.application),
        "release": launch.version,
        "entries": launch.entries,
    })
}

fn shown(launch: &Launch) -> String {
    let entry = |entry: &Option<u32>| entry.map_or("-".into(), |entry| format!("{entry:#08x}"));
    let entries: Vec<String> = launch.entries.iter().map(entry).collect();
    let slot = launch.application;
    format!(
        "slot {slot:?}, version {}, entries {}\n",
        launch.version,
        entries.join(" ")
    )
}
