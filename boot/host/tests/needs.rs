//! What an image needs of others, and the counter in hardware below which nothing boots.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{configuration, factory, loader};
use tandem_board::{Instant, MonotonicCounter, NoCounter, TesterDesk};
use tandem_boot::{
    BootDesk, COUNTER_PAGES, EnvironmentStore, FlashRegion, ImageTarget, OneTimeWords, Refusal,
    Slot, TrustMode,
};
use tandem_boot_host::life::{End, Life, LifeOutcome};
use tandem_boot_host::{FlashTraits, Image, ReleaseInfo, SimulatedFlash, Tear, records};

fn application(release: ReleaseInfo) -> Image {
    fixture::application(Slot::B, release, &[7; 300])
}

fn needs(bootloader: u32, configuration: u32) -> Image {
    application(ReleaseInfo {
        version: 2,
        needs_bootloader: bootloader,
        needs_configuration: configuration,
        ..ReleaseInfo::default()
    })
}

fn sends(flash: &mut SimulatedFlash, images: &[&Image]) -> LifeOutcome {
    let lines = records("new", images);
    flash.power_on(3, None);
    Life::with_file(&lines, 8).live(flash)
}

/// U-3: an application runs with what it needs, or it is refused. The factory's bootloader and
/// configuration have version 1.
#[test]
fn an_application_gets_what_it_needs() {
    for (images, refused) in [
        (vec![needs(1, 1)], None),
        (vec![needs(2, 0)], Some(Refusal::Needs)),
        (vec![needs(0, 2)], Some(Refusal::Needs)),
        (vec![configuration(Slot::B, 2), needs(1, 2)], None),
        (
            vec![configuration(Slot::B, 2), needs(1, 3)],
            Some(Refusal::Needs),
        ),
    ] {
        let mut flash = factory();
        let images: Vec<_> = images.iter().collect();
        let outcome = sends(&mut flash, &images);
        assert_eq!(outcome.refused, refused, "{images:?}");
        let version = if refused.is_some() { 1 } else { 2 };
        assert!(matches!(outcome.end, End::Running(launch) if launch.version == version));
    }
}

/// U-3: what is refused for the bootloader is refused before anything is erased.
#[test]
fn a_missing_bootloader_costs_nothing() {
    let mut flash = factory();
    let before = flash.work();
    assert_eq!(
        sends(&mut flash, &[&needs(2, 0)]).refused,
        Some(Refusal::Needs)
    );
    assert_eq!(flash.work().0, before.0, "nothing was erased");
}

/// U-3: a configuration that is too old for the running application is refused.
#[test]
fn a_configuration_must_fit_the_application() {
    let mut flash = factory();
    let images = [configuration(Slot::B, 5), needs(1, 5)];
    assert!(sends(&mut flash, &[&images[0], &images[1]]).downloaded);
    let older = configuration(Slot::A, 4);
    // Its version is refused, and without that floor it does not fit.
    assert_eq!(
        sends(&mut flash, &[&older]).refused,
        Some(Refusal::Downgrade)
    );
    let mut flash = factory();
    flash.load(images[1].place(), &images[1].bytes);
    flash.power_on(4, None);
    let life = Life::plain().live(&mut flash);
    assert!(
        matches!(life.end, End::Running(launch) if launch.version == 1),
        "an image that does not fit is not started: {life:?}"
    );
}

/// U-4: an application that needs bootloader 2 runs once that is there.
#[test]
fn an_application_runs_under_the_bootloader_that_it_needs() {
    let mut flash = factory();
    assert!(sends(&mut flash, &[&loader(2)]).downloaded);
    flash.power_on(5, None);
    let _sealed = Life::plain().live(&mut flash);
    let lines = records("new", &[&needs(2, 0)]);
    flash.power_on(6, None);
    let life = Life {
        approves: false,
        ..Life::with_file(&lines, 8)
    };
    let outcome = life.live(&mut flash);
    assert!(outcome.downloaded);
    assert!(matches!(outcome.end, End::Running(launch) if launch.version == 2));
}

/// E-4: the counter rises with the approval, also when that was not finished, and images below it
/// are neither accepted nor started.
#[test]
fn nothing_below_the_counter_boots() {
    let revoking = |version, counter| {
        application(ReleaseInfo {
            version,
            security_counter: counter,
            ..ReleaseInfo::default()
        })
    };
    let mut flash = factory();
    assert!(sends(&mut flash, &[&revoking(2, 3)]).downloaded);
    // The desk of the approved application raises the counter.
    let mut desk = BootDesk::new(
        flash.clone(),
        OneTimeWords::new(flash, COUNTER_PAGES),
        fixture::desk(Slot::B),
        Instant::ORIGIN,
    );
    let now = |ms: u64| Instant::from_ns(ms * 1_000_000);
    for ms in [0, 300, 600] {
        let _told = desk.poll(now(ms), true);
    }
    let (_, mut counter) = desk.into_parts();
    assert_eq!(counter.value(), 3);
    let mut flash = counter.into_flash();
    flash.power_on(7, None);
    let at_counter = |counter| Life {
        counter,
        ..Life::plain()
    };
    let boots = |flash: &mut SimulatedFlash, counter| {
        flash.power_on(8, None);
        match at_counter(counter).live(flash).end {
            End::Running(launch) => Some(launch.version),
            _ => None,
        }
    };
    assert_eq!(boots(&mut flash, 3), Some(2));
    // Release 1 in slot A has the number 0: it is no fallback any more.
    let place = FlashRegion::Target(ImageTarget::Application(Slot::B)).range();
    let mut damaged = flash.clone();
    damaged.load(place.start + 300, &[0; 32]);
    assert_eq!(boots(&mut damaged.clone(), 0), Some(1), "without a counter");
    assert_eq!(boots(&mut damaged, 3), None);
    // A higher version with a lower number is refused.
    let mut flash = factory();
    for (number, refused) in [(3, Some(Refusal::Downgrade)), (4, None)] {
        let lines = records("new", &[&revoking(9, number)]);
        flash.power_on(9, None);
        let life = Life {
            counter: 4,
            ..Life::with_file(&lines, 8)
        };
        assert_eq!(life.live(&mut flash).refused, refused, "{number}");
    }
}

/// A counter that notes each attempt to raise it.
#[derive(Default)]
struct Attempts(Vec<u32>);

impl MonotonicCounter for Attempts {
    fn value(&mut self) -> u32 {
        0
    }

    fn raise(&mut self, to: u32) -> bool {
        self.0.push(to);
        true
    }
}

/// E-4: the desk raises the counter once in its life, and never if unsigned images may run.
#[test]
fn the_desk_raises_the_counter_once() {
    for (mode, expected) in [(TrustMode::Strict, vec![0]), (TrustMode::Monitor, vec![])] {
        let mut setup = fixture::desk(Slot::A);
        setup.trust.mode = mode;
        let mut desk = BootDesk::new(factory(), Attempts::default(), setup, Instant::ORIGIN);
        for ms in (0..4_000).step_by(50) {
            let _told = desk.poll(Instant::from_ns(ms * 1_000_000), true);
        }
        assert_eq!(desk.into_parts().1.0, expected, "{mode:?}");
    }
}

/// E-4: a number of the counter has two pages of its own. No other page changes.
#[test]
fn a_number_has_two_pages() {
    const USED: &[u8] = b"one-time programmed: counts as 1";
    for number in [1, 2, 64] {
        let mut flash = SimulatedFlash::new();
        flash.power_on(1, None);
        let mut counter = OneTimeWords::new(flash, COUNTER_PAGES);
        assert!(counter.raise(number));
        assert_eq!(counter.value(), number);
        let flash = counter.into_flash();
        let first = COUNTER_PAGES.start + 64 * (number - 1);
        assert_eq!(flash.firm(first, 64), Some(USED.repeat(2)));
        for at in [first - 32, first + 64] {
            assert_ne!(flash.firm(at, 32), Some(USED.to_vec()), "{number}");
        }
        assert_eq!(flash.work().1, 2, "pages programmed");
    }
    let mut counter = OneTimeWords::new(SimulatedFlash::new(), COUNTER_PAGES);
    assert!(!counter.raise(65), "there are 64 numbers");
}

/// E-4: the counter in one-time words has its old or its new value after any loss of power, does
/// not fall, and rises when it is raised again.
#[test]
fn the_counter_survives_each_loss_of_power() {
    use strum::VariantArray as _;
    for traits in [FlashTraits::default(), FlashTraits::AURIX] {
        for tear in Tear::VARIANTS {
            for tick in 0..70 {
                let mut flash = SimulatedFlash::new().with_traits(traits);
                flash.power_on(1, None);
                let mut counter = OneTimeWords::new(flash, COUNTER_PAGES);
                assert!(counter.raise(2));
                let mut flash = counter.into_flash();
                flash.power_on(2, Some((tick, *tear)));
                let mut counter = OneTimeWords::new(flash, COUNTER_PAGES);
                let _torn = counter.raise(5);
                let mut flash = counter.into_flash();
                flash.power_on(3, None);
                let mut counter = OneTimeWords::new(flash, COUNTER_PAGES);
                let value = counter.value();
                assert!([2, 5].contains(&value), "{tear:?} {tick}: {value}");
                assert!(counter.raise(5), "{tear:?} {tick}");
                for seed in 4..9 {
                    let mut flash = counter.into_flash();
                    flash.power_on(seed, None);
                    counter = OneTimeWords::new(flash, COUNTER_PAGES);
                    assert_eq!(counter.value(), 5, "{tear:?} {tick}");
                }
            }
        }
    }
    let mut counter = OneTimeWords::new(SimulatedFlash::new(), COUNTER_PAGES);
    assert!(!counter.raise(65), "64 numbers");
    assert!(counter.raise(64) && counter.raise(1) && counter.value() == 64);
    assert!(NoCounter.raise(0) && !NoCounter.raise(1) && NoCounter.value() == 0);
}

/// The environment of a controller with a counter is that of any other.
#[test]
fn the_counter_is_not_in_the_environment() {
    let mut flash = factory();
    let before = *EnvironmentStore::load(&mut flash).unwrap().get();
    let mut counter = OneTimeWords::new(flash, COUNTER_PAGES);
    assert!(counter.raise(7));
    let mut flash = counter.into_flash();
    assert_eq!(*EnvironmentStore::load(&mut flash).unwrap().get(), before);
}
