//! The bootloader and the smallest application on a board in virtual time, with a watchdog that
//! resets the system if a service is early or late.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::factory;
use std::sync::{Arc, Mutex};
use tandem_board::{
    Board, CanFrame, CanId, CoreId, DeskAction, Duration, Instant, ResetCause, ResetRequest,
    Supply, SystemId, TesterDesk,
};
use tandem_board_sim::{Config, SimBoard, SimPair, SystemEventKind, blocking};
use tandem_boot::{
    Bank, BetweenSteps, Environment, EnvironmentStore, FIRST_ID, Keeper, Leave, LoaderUpdate,
    Security, Slot, Trust, TrustMode, ed25519, first_service, next_service, start, three_frames,
};
use tandem_boot_host::SimulatedFlash;
use tandem_boot_host::life::TEST_PUBLIC;

/// The period of the application's frames; it lies in the window of the watchdog.
const PERIOD: Duration = Duration::from_ms(12);
const A: SystemId = SystemId::A;

/// What core 0 has done, over all its starts.
#[derive(Clone, Default)]
struct Seen(Arc<Mutex<Vec<(Instant, Leave)>>>);

fn trust() -> Trust<'static> {
    static KEYS: [[u8; 32]; 1] = [TEST_PUBLIC];
    Trust {
        keys: &KEYS,
        testers: &[],
        mode: TrustMode::Strict,
        verify: ed25519,
    }
}

/// Leaves for a download a second after the first start, and confirms the others at once.
struct Desk {
    leaves: bool,
}

impl TesterDesk for Desk {
    fn hear(&mut self, _now: Instant, frame: &CanFrame) -> Option<DeskAction> {
        // It answers core 1's frames.
        let is_core_1 = frame.id() == CanId::Standard(FIRST_ID + 1);
        let answer = CanFrame::new(CanId::Standard(0x123), false, frame.data()).unwrap();
        is_core_1.then_some(DeskAction::Send(answer))
    }

    fn poll(&mut self, now: Instant, _has_role: bool) -> Option<DeskAction> {
        if !self.leaves {
            return Some(DeskAction::ConfirmStart);
        }
        let is_due = now.since(Instant::ORIGIN) >= Duration::from_ms(1_000);
        is_due.then_some(DeskAction::Leave(ResetRequest::Download))
    }
}

/// System A with this flash; core 0 runs the bootloader and then the application.
fn pair(flash: SimulatedFlash, seen: &Seen) -> SimPair {
    let seen = seen.clone();
    let mut pair = SimPair::new(Config::default(), move |board| {
        let (mut flash, seen) = (flash.clone(), seen.clone());
        flash.power_on(3, None);
        match (board.identity().system, board.identity().core) {
            (A, CoreId::CONTROL) => blocking(board, move |board| control(board, flash, &seen)),
            (A, _) => blocking(board, |board| three_frames(board, PERIOD, &mut ())),
            _ => Box::new(|_| Instant::NEVER),
        }
    });
    pair.power_on(A);
    pair
}

fn control(board: &SimBoard, flash: SimulatedFlash, seen: &Seen) {
    let keeper = BetweenSteps::new(board);
    let security = Security::default();
    let left = start(board, flash, trust(), Bank::Primary, &keeper, security);
    seen.0.lock().unwrap().push((board.now(), left));
    let leaves = board.supply().reset_cause() == ResetCause::PowerOn;
    three_frames(board, PERIOD, &mut Desk { leaves });
}

fn resets(pair: &SimPair) -> Vec<ResetCause> {
    let events = pair.events().into_iter().filter(|event| event.system == A);
    let resets = events.filter_map(|event| match event.kind {
        SystemEventKind::Reset(cause) => Some(cause),
        _ => None,
    });
    resets.collect()
}

/// T-BOOT-1, T-BOOT-7, T-BOOT-8: an application starts from a bootloader that has not served the
/// watchdog. One that waited for a host has, and resets the system first.
#[test]
fn the_application_starts_from_an_unserved_watchdog() {
    let seen = Seen::default();
    let mut pair = pair(factory(), &seen);
    pair.run_for(Duration::from_ms(900));
    assert_eq!(resets(&pair), []);
    let frames = pair.take_bus_log();
    let with = |id| {
        let all = frames.iter();
        let of_id: Vec<_> = all
            .filter(|it| it.frame.id() == CanId::Standard(id))
            .collect();
        of_id
    };
    for core in 0..3u16 {
        let sent = with(FIRST_ID + core);
        assert!((50..=75).contains(&sent.len()), "{core}: {}", sent.len());
        assert!(sent.iter().all(|it| it.frame.data() == [core as u8]));
        for two in sent.windows(2) {
            let apart = two[1].at.since(two[0].at).as_us();
            assert!((11_000..14_000).contains(&apart), "{core}: {apart} us");
        }
    }
    let answered = with(0x123).len();
    assert!(
        answered + 2 >= with(FIRST_ID + 1).len(),
        "{answered} answers"
    );
    // The desk leaves for a download; no host comes, so the loader waits for ten seconds.
    pair.run_for(Duration::from_ms(15_000));
    assert_eq!(resets(&pair), [ResetCause::Download, ResetCause::Software]);
    let seen = seen.0.lock().unwrap();
    let times: Vec<_> = seen.iter().map(|(at, _)| at.as_ns() / 1_000_000).collect();
    assert_eq!(seen.len(), 2, "{times:?}");
    for (_, left) in seen.iter() {
        let Leave::Jump(launch) = left else {
            panic!("{left:?}");
        };
        assert_eq!((launch.application, launch.version), (Slot::A, 1));
    }
    assert_eq!(
        pair.board(A, CoreId::CONTROL).supply().starts(),
        0,
        "confirmed"
    );
}

/// A bootloader serves the watchdog in the middle of its window: both edges are as far away.
#[test]
fn the_watchdog_is_served_in_the_middle_of_its_window() {
    type Watchdog = <SimBoard as Board>::Supply;
    let (opens, closes) = (Watchdog::WINDOW_OPENS_US, Watchdog::WINDOW_CLOSES_US);
    let next = next_service::<Watchdog>().as_us() as u32;
    assert_eq!(next - opens, closes - next);
    let first = first_service::<Watchdog>().as_us() as u32;
    assert_eq!(2 * first, Watchdog::FIRST_SERVICE_US);
}

/// T-BOOT-1: a bootloader that finds nothing to boot serves the watchdog for as long as it waits.
#[test]
fn a_bootloader_that_waits_serves_the_watchdog() {
    let seen = Seen::default();
    let mut pair = pair(SimulatedFlash::new(), &seen);
    pair.run_for(Duration::from_ms(20_000));
    assert_eq!(resets(&pair), []);
    assert!(seen.0.lock().unwrap().is_empty());
}

/// A keeper that never has to serve.
struct Says(bool);

impl Keeper for Says {
    fn keep(&self) -> Instant {
        Instant::NEVER
    }

    fn hand_over(&self) -> bool {
        self.0
    }
}

/// T-BOOT-7, U-4: core 0 leaves for an application or for another bank if the keeper permits it.
/// Otherwise the system is reset.
#[test]
fn without_the_keepers_word_the_system_is_reset() {
    let mut on_trial = factory();
    on_trial.power_on(1, None);
    let mut store = EnvironmentStore::load(&mut on_trial).unwrap();
    let environment = Environment {
        loader: LoaderUpdate::Trial,
        ..*store.get()
    };
    store.write(&mut on_trial, environment).unwrap();
    for (flash, bank) in [(factory(), Bank::Primary), (on_trial, Bank::Backup)] {
        for permits in [true, false] {
            let seen = Seen::default();
            let (flash, told) = (flash.clone(), seen.clone());
            let config = Config {
                watchdog: false,
                ..Config::default()
            };
            let mut pair = SimPair::new(config, move |board| {
                let (mut flash, seen) = (flash.clone(), told.clone());
                flash.power_on(3, None);
                let identity = board.identity();
                if (identity.system, identity.core) != (A, CoreId::CONTROL) {
                    return Box::new(|_| Instant::NEVER);
                }
                blocking(board, move |board| {
                    let security = Security::default();
                    let left = start(board, flash, trust(), bank, &Says(permits), security);
                    seen.0.lock().unwrap().push((board.now(), left));
                })
            });
            pair.power_on(A);
            pair.run_for(Duration::from_ms(150));
            let seen = seen.0.lock().unwrap();
            let left = seen.first().map(|(_, left)| *left);
            match (permits, bank) {
                (true, Bank::Primary) => assert!(matches!(left, Some(Leave::Jump(_)))),
                (true, Bank::Backup) => assert_eq!(left, Some(Leave::StartBank(Bank::Primary))),
                (false, _) => assert_eq!(left, None),
            }
            let expected: &[_] = if permits {
                &[]
            } else {
                &[ResetCause::Software]
            };
            assert!(resets(&pair).starts_with(expected), "{bank:?} {permits}");
            assert_eq!(resets(&pair).is_empty(), permits);
        }
    }
}
