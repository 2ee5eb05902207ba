//! The bootloader of an emulated machine runs from its bank of the program flash, and replaces
//! itself over CAN. U-4
#![allow(clippy::unwrap_used)]

use std::fs;
use std::path::{Path, PathBuf};
use tandem_board::{Duration, Instant, SystemId, VehicleBus, VehiclePort};
use tandem_board_qemu::{BootFrom, EmulatedWorld, LOADER_RAM_AT, PROGRAM_FLASH_AT};
use tandem_boot::{Answer, Bank, FlashRegion, ImageTarget, LoaderUpdate, LogEvent};
use tandem_boot_host::{
    FileSender, FlashFile, Image, Inquiry, ReleaseInfo, SigningKey, SystemInfo, ToDo, records,
};

const SYSTEM: SystemId = SystemId::A;
const KEY: SigningKey = SigningKey {
    number: 0,
    seed: [7; 32],
};
const TESTER: SigningKey = SigningKey {
    number: 0,
    seed: [9; 32],
};

fn elf(name: &str) -> (PathBuf, Vec<u8>) {
    let built = Path::new(env!("CARGO_BIN_EXE_tandem-lab"));
    let target = built.ancestors().nth(2).unwrap();
    let image = target.join("firmware/riscv32imac-unknown-none-elf/release");
    let image = fs::canonicalize(image.join(name)).unwrap();
    let bytes = fs::read(&image).unwrap();
    (image, bytes)
}

fn release(version: u32) -> ReleaseInfo {
    ReleaseInfo {
        version,
        ..ReleaseInfo::default()
    }
}

/// The real bootloader, with a version.
fn bootloader(version: u32) -> Image {
    let staging = FlashRegion::Target(ImageTarget::Staging).range().start;
    let at = LOADER_RAM_AT - staging;
    Image::of_elf(&elf("bank-loader").1, at, release(version), &KEY).unwrap()
}

/// A bootloader that sleeps for ever. It leaves the interrupt on by which this machine's carrier
/// resets a core.
fn hanging(version: u32) -> Image {
    let release = ReleaseInfo {
        version,
        entries: [256; 3],
        ..ReleaseInfo::default()
    };
    // lui sp, 0x80500; csrsi mie, 8; csrsi mstatus, 8; wfi; j to the wfi.
    let code: [u32; 5] = [
        0x8050_0137,
        0x3044_6073,
        0x3004_6073,
        0x1050_0073,
        0xFFDF_F06F,
    ];
    let bytes: Vec<u8> = code.iter().flat_map(|word| word.to_le_bytes()).collect();
    Image::sign(ImageTarget::Staging, release, &[(256, &bytes)], &KEY)
}

/// A machine with bootloader 1 in both banks, and the application that sends three frames.
struct Bench {
    world: EmulatedWorld,
    _folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("A.pflash");
        let flash = FlashFile::open(&path).unwrap();
        for bank in [Bank::Primary, Bank::Backup] {
            let place = FlashRegion::Bank(bank).range().start;
            flash.load(place, &bootloader(1).bytes).unwrap();
        }
        let application = elf("slot-frames").1;
        let application = Image::of_elf(&application, PROGRAM_FLASH_AT, release(1), &KEY).unwrap();
        flash.load(application.place(), &application.bytes).unwrap();
        let from = BootFrom {
            flash: path,
            public: KEY.public(),
            tester: Some(TESTER.public()),
        };
        let rom = elf("bootloader").0;
        let mut world = EmulatedWorld::start_booting(&rom, false, &[(SYSTEM, from)]).unwrap();
        world.set_ignition(true);
        Self {
            world,
            _folder: folder,
        }
    }

    /// Lets `host` talk to the machine until it returns a value, for at most a minute of its time.
    fn until<T>(&mut self, mut host: impl FnMut(&mut EmulatedWorld, Instant) -> Option<T>) -> T {
        let begin = self.world.now();
        loop {
            self.world.tick().unwrap();
            self.world.drain_trace(&mut |_| {});
            let now = self.world.now();
            if let Some(done) = host(&mut self.world, now) {
                return done;
            }
            let late = now.since(begin) > Duration::from_ms(60_000);
            assert!(!late, "nothing happens: {}", self.world.log());
            self.world.ring_receivers();
        }
    }

    fn download(&mut self, image: &Image) {
        let lines = records("loader", &[image]);
        let mut sender = FileSender::new(lines, Some(SYSTEM), 8).proving(SYSTEM, TESTER);
        let end = self.until(|world, now| {
            world.transmitted(&mut |_, _, sent| sender.on_frame(now, &sent.frame));
            for _ in 0..3 {
                match sender.next(now) {
                    ToDo::Send(frame) => {
                        world.broadcast(&frame);
                    }
                    ToDo::Wait(_) => return None,
                    end => return Some(end),
                }
            }
            None
        });
        assert_eq!(end, ToDo::Done, "{}", self.world.log());
    }

    /// Has the application leave for its bootloader, which nobody then connects.
    fn restart(&mut self) {
        let mut sender = FileSender::new(Vec::new(), Some(SYSTEM), 8).proving(SYSTEM, TESTER);
        self.until(|world, now| {
            let mut connected = None;
            world.transmitted(&mut |_, _, sent| {
                sender.on_frame(now, &sent.frame);
                let answer = Answer::decode(sent.frame.data());
                connected = connected.or(answer.filter(|it| *it == Answer::Connected));
            });
            if let ToDo::Send(frame) = sender.next(now) {
                world.broadcast(&frame);
            }
            connected.map(drop)
        });
    }

    /// Asks until a running application answers something that `is_good`.
    fn info(&mut self, what: &str, is_good: impl Fn(&SystemInfo) -> bool) -> SystemInfo {
        let (mut inquiry, mut last) = (Inquiry::new(SYSTEM), None);
        let mut polls = 0;
        self.until(|world, now| {
            world.transmitted(&mut |_, _, sent| inquiry.on_frame(now, &sent.frame));
            polls += 1;
            assert!(polls < 50_000, "{what}: {last:?}: {}", world.log());
            match inquiry.next(now) {
                ToDo::Send(frame) => {
                    world.broadcast(&frame);
                    None
                }
                ToDo::Wait(_) => None,
                _ => {
                    last = inquiry.info();
                    inquiry = Inquiry::new(SYSTEM);
                    let runs = |info: &SystemInfo| info.running.is_some() && is_good(info);
                    last.clone().filter(runs)
                }
            }
        })
    }
}

fn versions(info: &SystemInfo) -> [Option<u32>; 2] {
    [Bank::Primary, Bank::Backup].map(|bank| {
        let place = FlashRegion::Bank(bank);
        info.places.iter().find(|(at, _)| *at == place).unwrap().1
    })
}

/// U-4: bootloader 1, which runs from its bank, receives bootloader 2, writes it to the bank and
/// starts it. The application under it works, so the next start seals it. A bootloader that hangs
/// is then taken back by the backup.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn an_emulated_bootloader_replaces_itself() {
    let mut bench = Bench::new();
    let info = bench.info("it runs", |info| {
        info.environment.loader == LoaderUpdate::Idle
    });
    assert_eq!(versions(&info), [Some(1), Some(1)]);

    bench.download(&bootloader(2));
    let info = bench.info("approved by the application", |info| {
        info.environment.loader == LoaderUpdate::Sealing
    });
    assert_eq!(versions(&info), [None, Some(1)], "not sealed before that");
    bench.restart();
    let info = bench.info("sealed", |info| {
        info.environment.loader == LoaderUpdate::Idle
    });
    assert_eq!(versions(&info), [Some(2), Some(1)]);
    assert_eq!(info.environment.versions[2], 2);

    bench.download(&hanging(3));
    let restored = |info: &SystemInfo| info.log[0].0 == LogEvent::LoaderRestored;
    let info = bench.info("restored", restored);
    assert_eq!(versions(&info), [Some(2), Some(2)]);
    assert_eq!(info.environment.versions[2], 2, "3 was never approved");
}
