//! The desk beside a running application: a host without a key changes nothing and takes no system
//! out.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::desk_bench::DeskBench as Bench;
use fixture::proof::{TESTER, WRONG};
use fixture::{Images, application, factory, image, loader};
use tandem_board::{CanFrame, DeskAction, Instant, NoCounter, ResetRequest, SystemId, TesterDesk};
use tandem_boot::{
    Answer, BootDesk, EnvironmentStore, FlashRegion, HostRequest, ImageTarget, LOG_ANSWERS,
    LoaderUpdate, Question, Refusal, ReleaseStage, Slot, read_log,
};
use tandem_boot_host::life::Life;
use tandem_boot_host::{FileSender, Inquiry, ReleaseInfo, ToDo, records};

const A: Option<SystemId> = Some(SystemId::A);
const CONNECT: HostRequest<'_> = HostRequest::Connect {
    system: A,
    resume: false,
};
const ROLL_BACK: HostRequest<'_> = HostRequest::RollBack { system: A };
const LEAVE: Option<DeskAction> = Some(DeskAction::Leave(ResetRequest::Download));

/// T-BOOT-1, E-4: without a proof no frame takes the standby out; with one it leaves, for as long
/// as the proof holds.
#[test]
fn only_a_tester_takes_a_system_out() {
    let mut bench = Bench::new(factory());
    let refused = Some(Answer::Refused(Refusal::Tester));
    for request in [CONNECT, ROLL_BACK] {
        assert_eq!(bench.answer(request), refused);
    }
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    assert_eq!(bench.hear(CONNECT), LEAVE);
    bench.wait(9_900);
    assert_eq!(bench.hear(CONNECT), LEAVE);
    bench.wait(200);
    assert_eq!(bench.answer(CONNECT), refused, "the proof holds for 10 s");
}

/// E-4: a wrong key takes no system out. It locks the desk, also that of the next start.
#[test]
fn a_wrong_key_locks_the_desk() {
    let mut bench = Bench::new(factory());
    assert_eq!(bench.prove(&WRONG), Some(Answer::Unproved));
    assert!(matches!(bench.prove(&TESTER), Some(Answer::Locked { .. })));
    let (flash, NoCounter) = bench.desk.into_parts();
    let mut bench = Bench::new(flash);
    assert!(matches!(bench.prove(&TESTER), Some(Answer::Locked { .. })));
    bench.wait(3_000);
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    assert_eq!(bench.hear(CONNECT), LEAVE);
}

/// T-BOOT-1: the desk ignores what is for another system, for a bootloader, or a download's data.
/// It writes nothing for anybody.
#[test]
fn what_names_another_system_is_ignored() {
    let mut bench = Bench::new(factory());
    let before = bench.desk.flash().work();
    for system in [None, Some(SystemId::B)] {
        for request in [
            HostRequest::Connect {
                system,
                resume: false,
            },
            HostRequest::RollBack { system },
            HostRequest::Info {
                system,
                question: 0,
            },
            HostRequest::Challenge {
                system,
                key: 0,
                part: 0,
            },
            HostRequest::Proof {
                system,
                part: 0,
                bytes: [0; 5],
            },
            HostRequest::Offer { records: 4 },
            HostRequest::GoBack { record: 0 },
            HostRequest::Data(b"S1130000"),
        ] {
            assert_eq!(bench.hear(request), None, "{request:?}");
        }
    }
    assert_eq!(bench.desk.flash().work(), before);
}

/// U-2: everybody may ask. The answers are those of the flash.
#[test]
fn the_desk_answers_questions() {
    let mut bench = Bench::new(Images::updated().flash);
    let place = FlashRegion::Target(ImageTarget::Application(Slot::B));
    let request = HostRequest::Info {
        system: A,
        question: Question::Place(place).code().unwrap(),
    };
    let answer = bench.answer(request);
    assert!(matches!(
        answer,
        Some(Answer::Info {
            detail: 1,
            value: 2,
            ..
        })
    ));
    // One answer in 20 ms: `hear` takes one.
    assert_eq!(bench.answer(request), None);
    bench.wait(18);
    assert!(bench.answer(request).is_some());
    for code in [0x10 + 7, 0x30, 0xFF] {
        bench.wait(20);
        let request = HostRequest::Info {
            system: A,
            question: code,
        };
        assert_eq!(bench.answer(request), None, "{code:#x}");
    }
    for question in [Question::Environment(16), Question::Log(LOG_ANSWERS)] {
        assert_eq!(question.code(), None, "{question:?}");
    }
    let mut inquiry = Inquiry::new(SystemId::A);
    let info = loop {
        bench.wait(1);
        match inquiry.next(bench.now) {
            ToDo::Send(frame) => {
                if let Some(DeskAction::Send(answer)) = bench.desk.hear(bench.now, &frame) {
                    inquiry.on_frame(bench.now, &answer);
                }
            }
            ToDo::Wait(_) => {
                if let Some(DeskAction::Send(told)) = bench.desk.poll(bench.now, true) {
                    inquiry.on_frame(bench.now, &told);
                }
            }
            _ => break inquiry.info().unwrap(),
        }
    };
    assert_eq!(info.running, Some((ReleaseStage::Approved, 2)));
    assert_eq!(info.environment.active.application, Some(Slot::B));
    assert_eq!(info.environment.versions, [2, 1, 0]);
    let versions: Vec<_> = info.places.iter().map(|(_, version)| *version).collect();
    let expected = [Some(1), Some(2), Some(1), None, None, Some(1), Some(1)];
    assert_eq!(versions, expected);
}

/// U-2: a question gets the newest entries of the log, the newest first.
#[test]
fn the_newest_entries_of_the_log_are_told() {
    let mut bench = Bench::new(factory());
    for attempts in 0..20 {
        let mut entries = Vec::new();
        read_log(&mut bench.desk.flash().clone(), &mut |entry| {
            entries.push((entry.event as u8, entry.value));
        });
        for age in 0..LOG_ANSWERS {
            bench.wait(20);
            let answer = bench.answer(HostRequest::Info {
                system: A,
                question: Question::Log(age).code().unwrap(),
            });
            let Some(Answer::Info { detail, value, .. }) = answer else {
                panic!("{attempts} {age}: {answer:?}");
            };
            let newest = entries.iter().rev().nth(age.into());
            let expected = newest.copied().unwrap_or((0, 0));
            assert_eq!((detail, value), expected, "{attempts} {age}");
        }
        bench.wait(100_000_000);
        assert_eq!(bench.prove(&WRONG), Some(Answer::Unproved));
    }
}

/// T-BOOT-1: the host's sender proves itself to the application, and then to the bootloader.
#[test]
fn a_sender_goes_from_the_application_to_its_bootloader() {
    let mut bench = Bench::new(factory());
    let lines = records("new", &[&image(Slot::B, 2, 40)]);
    let mut sender = FileSender::new(lines, A, 8).proving(SystemId::A, TESTER);
    let mut leaves = false;
    while !leaves {
        bench.wait(1);
        if let ToDo::Send(frame) = sender.next(bench.now) {
            match bench.desk.hear(bench.now, &frame) {
                Some(DeskAction::Send(answer)) => sender.on_frame(bench.now, &answer),
                action => leaves = action == LEAVE,
            }
        }
    }
    // A sender without a key ends with the refusal.
    let mut sender = FileSender::new(Vec::new(), A, 8);
    let refused = Answer::Refused(Refusal::Tester).frame().unwrap();
    let ToDo::Send(_) = sender.next(bench.now) else {
        panic!("it connects");
    };
    sender.on_frame(bench.now, &refused);
    assert_eq!(sender.next(bench.now), ToDo::Refused(Refusal::Tester));
}

/// U-3: a tester has a release on trial given up: the next start boots the old one. There is
/// nothing to give up when it is approved.
#[test]
fn a_release_on_trial_is_given_up() {
    let mut flash = factory();
    let lines = records("new", &[&image(Slot::B, 2, 40)]);
    let life = Life {
        approves: false,
        ..Life::with_file(&lines, 0)
    };
    assert!(life.live(&mut flash).downloaded);
    let mut bench = Bench::new(flash);
    let told = |action: Option<DeskAction>| match action {
        Some(DeskAction::Send(frame)) => Answer::decode(frame.data()),
        _ => None,
    };
    let release = Some(Answer::Release {
        system: SystemId::A,
        stage: ReleaseStage::Trial,
        version: 2,
    });
    assert_eq!(told(bench.desk.poll(bench.now, true)), release);
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    let leave = DeskAction::Leave(ResetRequest::Software);
    let before = bench.desk.flash().work();
    assert_eq!(bench.hear(ROLL_BACK), Some(leave));
    assert_eq!(bench.desk.flash().work(), before, "the next start knows it");
    bench.wait(200);
    assert_eq!(
        bench.desk.poll(bench.now, true),
        Some(leave),
        "until it left"
    );
    let (mut flash, NoCounter) = bench.desk.into_parts();
    fixture::lives(&mut flash, 1);
    let environment = *EnvironmentStore::load(&mut flash).unwrap().get();
    assert_eq!(environment.active.application, Some(Slot::A));

    let mut bench = Bench::new(flash);
    let _reads = bench.desk.poll(bench.now, true);
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    assert_eq!(bench.hear(ROLL_BACK), None, "it is approved");
}

/// U-3, U-4: after a second in a role without a break, the desk confirms the start, once, and
/// approves the application and the bootloader that started it. Not before.
#[test]
fn what_has_had_a_role_for_a_second_works() {
    let mut flash = factory();
    let lines = records("new", &[&loader(2), &image(Slot::B, 2, 40)]);
    let life = Life {
        approves: false,
        ..Life::with_file(&lines, 0)
    };
    assert!(life.live(&mut flash).downloaded);
    let mut bench = Bench::new(flash);
    let mut confirmed = Vec::new();
    let mut stages = Vec::new();
    let mut states = Vec::new();
    for ms in (0..4_000).step_by(50) {
        bench.now = Instant::from_ns(ms * 1_000_000);
        // The role is lost for a moment at 900 ms: the second begins again at 950 ms.
        match bench.desk.poll(bench.now, ms != 900) {
            Some(DeskAction::ConfirmStart) => confirmed.push(ms),
            Some(DeskAction::Send(frame)) => {
                if let Some(Answer::Release { stage, .. }) = Answer::decode(frame.data()) {
                    stages.push((ms, stage));
                    let store = EnvironmentStore::load(&mut bench.desk.flash().clone()).unwrap();
                    states.push((ms, store.get().loader));
                }
            }
            Some(other) => panic!("{other:?}"),
            None => {}
        }
    }
    assert_eq!(confirmed, [1_950, 2_000, 2_050, 2_100, 2_150]);
    let since = |stage| {
        stages
            .iter()
            .find(|(_, told)| *told == stage)
            .map(|(ms, _)| *ms)
    };
    assert_eq!(since(ReleaseStage::Trial), Some(0));
    let approved = since(ReleaseStage::Approved);
    assert!(
        approved.is_some_and(|ms| (1_950..2_500).contains(&ms)),
        "{approved:?}"
    );
    let sealing = states
        .iter()
        .find(|(_, state)| *state == LoaderUpdate::Sealing);
    assert!(
        sealing.is_some_and(|(ms, _)| (1_950..2_500).contains(ms)),
        "{sealing:?}"
    );
    assert_eq!(states[0].1, LoaderUpdate::TrialExecuted);
    let told: Vec<_> = stages.iter().map(|(ms, _)| *ms).collect();
    assert_eq!(told[..4], [0, 200, 400, 600]);
    let periods = told.windows(2).map(|pair| pair[1] - pair[0]);
    assert!(
        periods.into_iter().all(|ms| (200..=500).contains(&ms)),
        "{told:?}"
    );
}

/// A desk whose application of a paired release 2 is on trial.
fn on_trial() -> Bench {
    let mut flash = factory();
    let release = ReleaseInfo {
        version: 2,
        paired: true,
        ..ReleaseInfo::default()
    };
    let image = application(Slot::B, release, &[7; 40]);
    let lines = records("new", &[&image]);
    let life = Life {
        approves: false,
        ..Life::with_file(&lines, 0)
    };
    assert!(life.live(&mut flash).downloaded);
    Bench::new(flash)
}

impl Bench {
    /// Runs for 10 s with a role. `peer`: what the other system tells at a time in ms. Returns the
    /// highest stage that the desk told, and whether it wanted to leave.
    fn beside(&mut self, peer: impl Fn(u64) -> Vec<(ReleaseStage, u32)>) -> (ReleaseStage, bool) {
        let (mut highest, mut leaves) = (ReleaseStage::Trial, false);
        for ms in (0..10_000).step_by(50) {
            self.now = Instant::from_ns(ms * 1_000_000);
            for (stage, version) in peer(ms) {
                let told = Answer::Release {
                    system: SystemId::B,
                    stage,
                    version,
                };
                assert_eq!(self.desk.hear(self.now, &told.frame().unwrap()), None);
            }
            match self.desk.poll(self.now, true) {
                Some(DeskAction::Send(frame)) => {
                    if let Some(Answer::Release { stage, .. }) = Answer::decode(frame.data()) {
                        highest = if stage > highest { stage } else { highest };
                    }
                }
                action => leaves |= matches!(action, Some(DeskAction::Leave(_))),
            }
        }
        (highest, leaves)
    }
}

/// U-3: forged release frames between the true ones of a system at the old release neither advance
/// a release nor have it given up.
#[test]
fn forged_release_frames_move_nothing() {
    use ReleaseStage::{Approved, Ready, Works};
    let truth = |ms: u64| ms.is_multiple_of(200).then_some((Approved, 1));
    for forged in [(Works, 2), (Ready, 2), (Approved, 2), (Approved, 7)] {
        let seen = on_trial().beside(|ms| truth(ms).into_iter().chain([forged]).collect());
        assert_eq!(seen, (Works, false), "{forged:?}");
    }
    // Without forgeries, and with a system that has the release too.
    let alone = on_trial().beside(|ms| truth(ms).into_iter().collect());
    assert_eq!(alone, (Works, false));
    let both = on_trial().beside(|ms| match ms % 200 {
        0 if ms < 4_000 => vec![(Works, 2)],
        0 => vec![(Ready, 2)],
        _ => vec![],
    });
    assert_eq!(both, (Approved, false));
    // It had the release, and has rolled it back: this one gives it up.
    let back = on_trial().beside(|ms| match ms % 200 {
        0 if ms < 4_000 => vec![(Works, 2)],
        0 => vec![(Approved, 1)],
        _ => vec![],
    });
    assert_eq!(back, (Ready, true));
    // It tries another release, which it may give up as well.
    let tries = on_trial().beside(|ms| match ms % 200 {
        0 if ms < 4_000 => vec![(Works, 2)],
        0 => vec![(ReleaseStage::Trial, 3)],
        _ => vec![],
    });
    assert_eq!(tries, (Ready, false));
    // It has told nothing for more than a second.
    let silent = on_trial().beside(|ms| match ms % 200 {
        0 if ms < 100 => vec![(Works, 2)],
        _ => vec![],
    });
    assert_eq!(silent, (Works, false));
}

/// U-3: a system that has told that it is ready does not give up alone, not even for a
/// proven tester.
#[test]
fn who_is_ready_does_not_give_up_alone() {
    let mut bench = on_trial();
    let both = bench.beside(|ms| match ms % 200 {
        0 => vec![(ReleaseStage::Works, 2)],
        _ => vec![],
    });
    assert_eq!(both, (ReleaseStage::Ready, false));
    assert_eq!(bench.prove(&TESTER), Some(Answer::Proved));
    assert_eq!(bench.hear(ROLL_BACK), None);
    let trial = EnvironmentStore::load(&mut bench.desk.flash().clone()).unwrap();
    assert!(trial.get().trial.is_some_and(|trial| trial.ready));
}

/// T-BOOT-3: a host asks for a release to be given up each 0.1 s, as `docs/boot.md` says.
#[test]
fn a_host_asks_again_each_100_ms() {
    let mut sender = FileSender::rolling_back(SystemId::A);
    let asks: Vec<u64> = (0..1_000)
        .filter(|ms| match sender.next(Instant::from_ns(ms * 1_000_000)) {
            ToDo::Send(frame) => ROLL_BACK.frame() == Some(frame),
            _ => false,
        })
        .collect();
    assert_eq!(asks, (0..1_000).step_by(100).collect::<Vec<u64>>());
}

/// U-3: a release that is on trial but does not run, because the flash did not record that it had
/// failed, is not approved by the good work of the old one.
#[test]
fn what_does_not_run_is_not_approved() {
    let bench = on_trial();
    let (flash, NoCounter) = bench.desk.into_parts();
    let setup = fixture::desk(Slot::A);
    let mut desk = BootDesk::new(flash, NoCounter, setup, Instant::ORIGIN);
    for ms in (0..4_000).step_by(50) {
        let action = desk.poll(Instant::from_ns(ms * 1_000_000), true);
        if let Some(DeskAction::Send(frame)) = action {
            let told = Answer::decode(frame.data());
            let old = Answer::Release {
                system: SystemId::A,
                stage: ReleaseStage::Approved,
                version: 1,
            };
            assert_eq!(told, Some(old));
        }
    }
    let (mut flash, NoCounter) = desk.into_parts();
    let environment = *EnvironmentStore::load(&mut flash).unwrap().get();
    assert_eq!(environment.active.application, Some(Slot::A));
}

/// A frame of the other system that is forged or too short changes nothing.
#[test]
fn strange_release_frames_are_ignored() {
    let mut bench = Bench::new(factory());
    for data in [&[0x57, 0x86, 2, 9, 1, 0, 0, 0][..], &[0x57, 0x86], &[]] {
        let frame = CanFrame::new(tandem_boot::RELEASES, false, data).unwrap();
        assert_eq!(bench.desk.hear(bench.now, &frame), None);
    }
}
