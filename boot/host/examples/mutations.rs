//! Mutates valid files in many ways, and counts those that are accepted wrongly: `cargo xtask
//! campaign mutations`.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line prints")]

use anyhow::{Context, Result, bail};
use chacha20::ChaCha8Rng;
use clap::Parser;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;
use std::num::NonZero;
use std::path::PathBuf;
use std::process::ExitCode;
use std::thread;
use tandem_board::{Instant, ResetCause, SystemId};
use tandem_boot::{
    Answer, Bank, FlashRegion, HostRequest, ImageTarget, Loader, Manifest, Next, Setup, Slot,
    Trust, TrustMode, ed25519,
};
use tandem_boot_host::life::{Life, TEST_KEY, TEST_PUBLIC};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash, line, records};

#[derive(Parser)]
#[command(about = "Changes good files and counts what is accepted wrongly")]
struct Arguments {
    /// How many files
    #[arg(long, default_value_t = 100_000)]
    count: u64,
    /// Number of the first file. The same number always produces the same file
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Write {files, wrong} to this file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Accept unsigned files; some must then be accepted wrongly
    #[arg(long)]
    monitor: bool,
}

/// Counts of the results.
#[derive(Default)]
struct Tally {
    /// Files for each result; `wrong` lists accepted files that left no signed image in the slot.
    fates: BTreeMap<String, u64>,
    wrong: Vec<u64>,
}

fn main() -> Result<ExitCode> {
    let arguments = Arguments::parse();
    let workers = thread::available_parallelism().map_or(1, NonZero::get) as u64;
    let (first, count, monitor) = (arguments.seed, arguments.count, arguments.monitor);
    let work = |worker: u64| {
        let numbers = (worker..count).step_by(workers as usize);
        try_all(numbers.map(|number| first + number), monitor)
    };
    let total = thread::scope(|scope| -> Result<Tally> {
        let work = &work;
        let workers = (0..workers).map(|worker| scope.spawn(move || work(worker)));
        let workers: Vec<_> = workers.collect();
        let mut total = Tally::default();
        for worker in workers {
            let Ok(tally) = worker.join() else {
                bail!("a worker panicked")
            };
            let tally = tally?;
            for (fate, count) in tally.fates {
                *total.fates.entry(fate).or_default() += count;
            }
            total.wrong.extend(tally.wrong);
        }
        Ok(total)
    })?;
    for (fate, count) in &total.fates {
        println!("{count:>8} {fate}");
    }
    let wrong = total.wrong.len();
    println!(
        "{} files, {wrong} accepted wrongly {:?}",
        arguments.count,
        {
            let few: Vec<_> = total.wrong.iter().take(9).collect();
            few
        }
    );
    if let Some(path) = &arguments.json {
        let json = serde_json::json!({ "files": arguments.count, "wrong": wrong });
        std::fs::write(path, json.to_string()).with_context(|| path.display().to_string())?;
    }
    let expected = arguments.monitor != total.wrong.is_empty();
    Ok(if expected {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    })
}

fn image(slot: Slot, version: u32) -> Image {
    let body: Vec<u8> = (0..200u32).map(|at| (at * 11 + version) as u8).collect();
    let release = ReleaseInfo {
        version,
        entries: [256; 3],
        lowest_key: 0,
        ..ReleaseInfo::default()
    };
    Image::sign(
        ImageTarget::Application(slot),
        release,
        &[(256, &body)],
        &TEST_KEY,
    )
}

/// Returns a controller that runs an image in slot A.
fn controller() -> SimulatedFlash {
    let mut flash = SimulatedFlash::new();
    let driving = image(Slot::A, 3);
    flash.load(driving.place(), &driving.bytes);
    let release = ReleaseInfo {
        version: 1,
        entries: [256, 0, 0],
        lowest_key: 0,
        ..ReleaseInfo::default()
    };
    let loader = Image::sign(ImageTarget::Staging, release, &[(256, &[1; 64])], &TEST_KEY);
    flash.load(0, &loader.bytes);
    Life::plain().live(&mut flash);
    flash
}

fn try_all(numbers: impl Iterator<Item = u64>, monitor: bool) -> Result<Tally> {
    let mode = if monitor {
        TrustMode::Monitor
    } else {
        TrustMode::Strict
    };
    let keys = [TEST_PUBLIC];
    let setup = Setup {
        trust: Trust {
            keys: &keys,
            testers: &[],
            mode,
            verify: ed25519,
        },
        system: SystemId::A,
        bank: Bank::Primary,
        cause: ResetCause::PowerOn,
        starts: 1,
        counter: 0,
        noise: [0; 32],
    };
    // Versions 5 and 6 are valid; 2 is older than the running version 3.
    let images = [image(Slot::B, 5), image(Slot::B, 6), image(Slot::B, 2)];
    let base = controller();
    let fresh = || Loader::start(base.clone(), setup, Instant::ORIGIN);
    let mut loader = fresh();
    let mut tally = Tally::default();
    for number in numbers {
        let mut chance = ChaCha8Rng::seed_from_u64(number);
        let lines = mutate(&images, &mut chance);
        let fate = match send(&mut loader, &lines) {
            Some(Answer::Refused(refusal)) => format!("{refusal:?}"),
            Some(Answer::Accepted { .. }) => {
                let mut flash = std::mem::replace(&mut loader, fresh()).into_flash();
                let place = FlashRegion::Target(ImageTarget::Application(Slot::B))
                    .range()
                    .start;
                let held = |image: &Image| {
                    let bytes = flash.firm(place, image.bytes.len() as u32);
                    bytes.is_some_and(|bytes| bytes == image.bytes)
                };
                if !images[..2].iter().any(held) {
                    tally.wrong.push(number);
                }
                flash.power_on(0, None);
                "accepted".into()
            }
            _ => "no end".into(),
        };
        *tally.fates.entry(fate).or_default() += 1;
    }
    Ok(tally)
}

/// Sends every line once. Returns the last answer if the file was accepted to its end or refused.
fn send(loader: &mut Loader<'_, SimulatedFlash>, lines: &[String]) -> Option<Answer> {
    let now = Instant::ORIGIN;
    let connect = HostRequest::Connect {
        system: None,
        resume: false,
    };
    loader.on_frame(now, &connect.frame()?);
    let mut last = None;
    for line in lines {
        // A line without its end receives no answer.
        last = None;
        for piece in line.as_bytes().chunks(8) {
            while let Next::Send(frame) = loader.next(now) {
                last = Answer::decode(frame.data());
            }
            loader.on_frame(now, &HostRequest::Data(piece).frame()?);
        }
        while let Next::Send(frame) = loader.next(now) {
            last = Answer::decode(frame.data());
        }
        if let Some(Answer::Refused(_)) = last {
            return last;
        }
    }
    let ended = lines.last().is_some_and(|line| line.starts_with("S7"));
    last.filter(|last| ended && matches!(last, Answer::Accepted { .. }))
}

/// Returns a valid file with one to three changes.
fn mutate(images: &[Image; 3], chance: &mut ChaCha8Rng) -> Vec<String> {
    let mut image = images[chance.random_range(0..3)].clone();
    if chance.random_ratio(1, 3) {
        change_image(&mut image, images, chance);
    }
    let mut lines = records("file", &[&image]);
    for _ in 0..chance.random_range(1..4) {
        let at = chance.random_range(0..lines.len());
        match chance.random_range(0..10) {
            0 => drop(lines.remove(at)),
            1 => lines.insert(at, lines[chance.random_range(0..lines.len())].clone()),
            2 => {
                let other = chance.random_range(0..lines.len());
                lines.swap(at, other);
            }
            3 => lines.truncate(at.max(1)),
            4 | 5 => {
                let mut bytes = lines[at].clone().into_bytes();
                let place = chance.random_range(0..bytes.len());
                bytes[place] = chance.random_range(b' '..b'~');
                lines[at] = String::from_utf8(bytes).unwrap_or_default();
            }
            6 | 7 => lines[at] = changed_record(&lines[at], chance),
            8 => lines[at] = lines[at].to_lowercase().replacen('s', "S", 1),
            _ => {}
        }
        if lines.is_empty() {
            break;
        }
    }
    lines
}

/// Returns a record with changed content and a matching checksum.
fn changed_record(text: &str, chance: &mut ChaCha8Rng) -> String {
    let Ok(record) = tandem_boot::SRecord::parse(text.trim_end().as_bytes()) else {
        return text.to_owned();
    };
    let (mut address, mut data) = (record.address, record.data().to_vec());
    match chance.random_range(0..3) {
        0 => address ^= 1 << chance.random_range(0..32),
        1 if !data.is_empty() => data.truncate(chance.random_range(0..data.len())),
        _ if !data.is_empty() => {
            let place = chance.random_range(0..data.len());
            data[place] ^= 1 << chance.random_range(0..8);
        }
        _ => {}
    }
    line(3, &address.to_be_bytes(), &data)
}

/// Changes an image so that its records stay valid: only digests and signature reveal the change.
fn change_image(image: &mut Image, images: &[Image; 3], chance: &mut ChaCha8Rng) {
    let other = &images[chance.random_range(0..3)];
    match chance.random_range(0..4) {
        0 => {
            let mut manifest = image.manifest;
            match chance.random_range(0..6) {
                0 => manifest.version += 1 << chance.random_range(0..31),
                1 => manifest.key = chance.random_range(0..3),
                2 => manifest.entries[0] += chance.random_range(0..200),
                3 => manifest.parts[0].sha256[chance.random_range(0..32)] ^= 1,
                4 => manifest.lowest_key = chance.random_range(0..3),
                _ => manifest.crc ^= 1,
            }
            let signed: &[u8] = &Manifest::encode(&manifest);
            image.bytes[..signed.len()].copy_from_slice(signed);
        }
        1 => {
            let place = chance.random_range(192..256);
            image.bytes[place] ^= 1 << chance.random_range(0..8);
        }
        2 => image.bytes[256..].copy_from_slice(&other.bytes[256..]),
        _ => image.bytes[192..256].copy_from_slice(&other.bytes[192..256]),
    }
}
