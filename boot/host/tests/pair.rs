//! An update of two systems: both approve a paired release, or both boot the old one again. Each
//! flash loses power at every byte that it programs, and frames are lost.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{application, body, factory};
use strum::VariantArray as _;
use tandem_board::{
    CanFrame, DeskAction, Duration, Instant, NoCounter, ResetRequest, SystemId, TesterDesk,
};
use tandem_boot::{Answer, BootDesk, DeskSetup, EnvironmentStore, Launch, ReleaseStage, Slot};
use tandem_boot_host::life::{End, Life};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash, Tear, records};

const STEP: Duration = Duration::from_ms(50);
/// A system has a role this long after its start.
const STARTS_IN: Duration = Duration::from_ms(400);

type Desk = BootDesk<'static, SimulatedFlash, NoCounter>;

fn paired(version: u32) -> Image {
    let release = ReleaseInfo {
        version,
        paired: true,
        ..ReleaseInfo::default()
    };
    application(Slot::B, release, &body(version, 300))
}

/// A controller that runs release 1 and has downloaded release 2, or has not.
fn controller(downloads: bool) -> SimulatedFlash {
    let mut flash = factory();
    if downloads {
        let lines = records("new", &[&paired(2)]);
        let life = Life {
            approves: false,
            ..Life::with_file(&lines, 0)
        };
        flash.power_on(1, None);
        // The life ends with the first start of release 2: the world below continues it.
        assert!(life.live(&mut flash).downloaded);
    }
    flash
}

enum Power {
    Off(SimulatedFlash, Instant),
    On(Box<Desk>, Launch, Instant),
}

struct World {
    now: Instant,
    systems: [Option<Power>; 2],
    /// The stage and the version that each system told last.
    told: [Option<(ReleaseStage, u32)>; 2],
    /// Frames are lost by this rule.
    loses: fn(u32) -> bool,
    sent: u32,
    seed: u64,
}

fn desk_of(system: SystemId, flash: SimulatedFlash, running: Slot, now: Instant) -> Box<Desk> {
    let setup = DeskSetup {
        system,
        ..fixture::desk(running)
    };
    Box::new(BootDesk::new(flash, NoCounter, setup, now))
}

impl World {
    /// Both systems run what they have downloaded, for the first time. `cuts`: after how much work
    /// each flash loses power, and how it tears.
    fn new(flashes: [SimulatedFlash; 2], cuts: [Option<(u64, Tear)>; 2]) -> Self {
        let mut world = Self {
            now: Instant::ORIGIN,
            systems: [None, None],
            told: [None; 2],
            loses: |_| false,
            sent: 0,
            seed: 50,
        };
        for ((system, mut flash), cut) in SystemId::ALL.into_iter().zip(flashes).zip(cuts) {
            flash.power_on(2, cut);
            let launch = launch_of(&mut flash);
            let desk = desk_of(system, flash, launch.application, world.now);
            world.systems[system.index()] = Some(Power::On(desk, launch, world.now));
        }
        world
    }

    fn start(&mut self, system: SystemId, mut flash: SimulatedFlash) -> Power {
        self.seed += 1;
        flash.power_on(self.seed, None);
        let life = Life {
            approves: false,
            ..Life::plain()
        };
        let End::Running(launch) = life.live(&mut flash).end else {
            panic!("{system} does not boot");
        };
        Power::On(
            desk_of(system, flash, launch.application, self.now),
            launch,
            self.now,
        )
    }

    fn step(&mut self) {
        self.now += STEP;
        let mut frames: Vec<(SystemId, CanFrame)> = Vec::new();
        for system in SystemId::ALL {
            let power = self.systems[system.index()].take().unwrap();
            let next = match power {
                Power::Off(flash, until) if self.now >= until => self.start(system, flash),
                Power::On(mut desk, launch, since) => {
                    let has_role = self.now.since(since) >= STARTS_IN;
                    let action = desk.poll(self.now, has_role);
                    self.after(system, (desk, launch, since), action, &mut frames)
                }
                off => off,
            };
            self.systems[system.index()] = Some(next);
        }
        for (from, frame) in frames {
            if let Some(Answer::Release { stage, version, .. }) = Answer::decode(frame.data()) {
                self.told[from.index()] = Some((stage, version));
            }
            self.sent += 1;
            let peer = &mut self.systems[from.peer().index()];
            if let Some(Power::On(desk, ..)) = peer
                && !(self.loses)(self.sent)
            {
                assert_eq!(desk.hear(self.now, &frame), None);
            }
        }
    }

    fn after(
        &mut self,
        system: SystemId,
        (desk, launch, since): (Box<Desk>, Launch, Instant),
        action: Option<DeskAction>,
        frames: &mut Vec<(SystemId, CanFrame)>,
    ) -> Power {
        let leaves = match action {
            Some(DeskAction::Send(frame)) => {
                frames.push((system, frame));
                false
            }
            Some(DeskAction::Leave(request)) => {
                assert_eq!(request, ResetRequest::Software);
                true
            }
            Some(DeskAction::ConfirmStart) | None => false,
        };
        let is_on = desk.flash().is_on();
        if leaves || !is_on {
            // What was told before the power was lost reached the other system.
            let (flash, NoCounter) = desk.into_parts();
            let until = self.now + if is_on { STEP } else { Duration::from_ms(700) };
            return Power::Off(flash, until);
        }
        Power::On(desk, launch, since)
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms / (STEP.as_ns() / 1_000_000) {
            self.step();
        }
    }

    /// Returns what each system boots from now on: the active slot and the lowest version, and
    /// whether anything is still on trial.
    fn boots(self) -> [(Option<Slot>, u32, bool); 2] {
        self.systems.map(|power| {
            let mut flash = match power.unwrap() {
                Power::Off(flash, _) => flash,
                Power::On(desk, ..) => desk.into_parts().0,
            };
            let environment = *EnvironmentStore::load(&mut flash).unwrap().get();
            let lowest = environment.versions[0];
            (
                environment.active.application,
                lowest,
                environment.trial.is_some(),
            )
        })
    }
}

fn launch_of(flash: &mut SimulatedFlash) -> Launch {
    let environment = *EnvironmentStore::load(flash).unwrap().get();
    let trial = environment.trial.map(|trial| trial.selection);
    let selection = trial.unwrap_or_default().over(environment.active);
    Launch {
        application: selection.application.unwrap(),
        configuration: None,
        version: 0,
        entries: [None; 3],
    }
}

const OLD: (Option<Slot>, u32, bool) = (Some(Slot::A), 1, false);
const NEW: (Option<Slot>, u32, bool) = (Some(Slot::B), 2, false);

/// U-3: both systems run release 2 for the stated time, record that, and approve it.
#[test]
fn both_approve_a_release_that_works_on_both() {
    let mut world = World::new([controller(true), controller(true)], [None; 2]);
    world.run(1_300);
    let trial = Some((ReleaseStage::Trial, 2));
    assert_eq!(
        world.told, [trial; 2],
        "not before the stated time in a role"
    );
    world.run(3_700);
    assert_eq!(world.told, [Some((ReleaseStage::Approved, 2)); 2]);
    assert_eq!(world.boots(), [NEW; 2]);
}

/// U-3: a system whose peer keeps its release approves nothing, and a start rolls it back.
#[test]
fn one_alone_gets_its_release_back() {
    let mut world = World::new([controller(true), controller(false)], [None; 2]);
    world.run(60_000);
    let [a, b] = world.told;
    assert_eq!(a, Some((ReleaseStage::Works, 2)), "it works, and waits");
    assert_eq!(b, Some((ReleaseStage::Approved, 1)));
    let Some(Power::On(desk, ..)) = world.systems[0].take() else {
        panic!("A is off");
    };
    world.systems[0] = Some(Power::Off(desk.into_parts().0, world.now));
    world.run(5_000);
    assert_eq!(world.boots(), [OLD; 2]);
}

/// Frames that are lost delay the approval, and do not divide the pair.
#[test]
fn lost_frames_do_not_divide_the_pair() {
    let rules: [fn(u32) -> bool; 3] = [
        |sent| sent % 3 != 0,
        |sent| sent.wrapping_mul(0x9E37_79B9) >> 30 != 0,
        |sent| (sent / 9) % 2 == 0,
    ];
    for loses in rules {
        let mut world = World::new([controller(true), controller(true)], [None; 2]);
        world.loses = loses;
        world.run(30_000);
        assert_eq!(world.boots(), [NEW; 2]);
    }
}

/// Returns the points at which power can be lost from the start of release 2 to its approval.
fn ticks_of_an_approval() -> u64 {
    let mut world = World::new([controller(true), controller(true)], [None; 2]);
    world.run(5_000);
    let Some(Power::On(desk, ..)) = world.systems[0].take() else {
        panic!("A is off");
    };
    desk.flash().ticks()
}

fn same(cuts: [Option<(u64, Tear)>; 2], flashes: &[SimulatedFlash; 2]) -> bool {
    let mut world = World::new(flashes.clone(), cuts);
    world.run(20_000);
    let boots = world.boots();
    assert!(
        boots == [OLD; 2] || boots == [NEW; 2],
        "{cuts:?}: {boots:?}"
    );
    boots == [NEW; 2]
}

/// U-3, U-5: whichever system loses its power at whichever byte, both end with the same release.
#[test]
fn no_cut_divides_the_pair() {
    let flashes = [controller(true), controller(true)];
    let ticks = ticks_of_an_approval();
    let (mut points, mut new) = (0, 0);
    for tick in (0..=ticks).step_by(3) {
        for tear in Tear::VARIANTS.iter().copied() {
            for cuts in [[Some((tick, tear)), None], [None, Some((tick, tear))]] {
                points += 1;
                new += u32::from(same(cuts, &flashes));
            }
        }
    }
    assert!(
        new > 0 && new < points,
        "{new} of {points}: both ends occur"
    );
}

/// The same if both systems lose their power, each at its own byte.
#[test]
fn no_two_cuts_divide_the_pair() {
    let flashes = [controller(true), controller(true)];
    let ticks = ticks_of_an_approval();
    for a in (0..=ticks).step_by(41) {
        for b in (0..=ticks).step_by(37) {
            let tear = |tick: u64| Tear::VARIANTS[(tick % Tear::VARIANTS.len() as u64) as usize];
            same([Some((a, tear(a))), Some((b, tear(b + 1)))], &flashes);
        }
    }
}
