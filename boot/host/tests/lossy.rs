//! Downloads a file over a bus that loses frames in both directions and changes records.
#![allow(clippy::unwrap_used)]

mod fixture;

use chacha20::ChaCha8Rng;
use fixture::{factory, image};
use proptest::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use tandem_board::{CanFrame, Duration, Instant, ResetCause, SystemId};
use tandem_boot::{Loader, Next, Setup, Slot};
use tandem_boot_host::life::TEST_PUBLIC;
use tandem_boot_host::{FileSender, ToDo, records};

/// Returns the frame as it arrives, or `None` if it is lost. Changes some frames to the loader,
/// because a record has its own checksum; changes no answer, which has only the checksum of CAN.
fn noisy(frame: &CanFrame, per_mille: u32, chance: &mut ChaCha8Rng) -> Option<CanFrame> {
    let is_answer = frame.id() == tandem_boot::TO_HOST;
    let dice = chance.random_range(0..1000);
    if dice < per_mille {
        return None;
    }
    let mut data = frame.data().to_vec();
    if !is_answer && dice < per_mille * 3 / 2 && !data.is_empty() {
        let place = chance.random_range(0..data.len());
        data[place] ^= 1 << (chance.next_u32() % 7);
    }
    CanFrame::new(frame.id(), false, &data).ok()
}

fn download(window: u8, per_mille: u32, seed: u64) -> (ToDo, bool, u64) {
    let mut flash = factory();
    let new = image(Slot::B, 2, 700);
    let mut host = FileSender::new(records("new", &[&new]), None, window);
    let keys = [TEST_PUBLIC];
    let setup = Setup {
        cause: ResetCause::Download,
        ..fixture::setup(&keys)
    };
    let mut chance = ChaCha8Rng::seed_from_u64(seed);
    let mut now = Instant::ORIGIN;
    let mut loader = Loader::start(&mut flash, setup, now);
    let end = loop {
        match loader.next(now) {
            Next::Send(frame) => {
                if let Some(frame) = noisy(&frame, per_mille, &mut chance) {
                    host.on_frame(now, &frame);
                }
                continue;
            }
            Next::Wait(until) => match host.next(now) {
                ToDo::Send(frame) => {
                    now = Instant::from_ns(now.as_ns() + 270_000);
                    if let Some(frame) = noisy(&frame, per_mille, &mut chance) {
                        loader.on_frame(now, &frame);
                    }
                }
                ToDo::Wait(other) => now = until.min(other),
                end => break end,
            },
            // The loader's farewell time ended before the host received the last answer.
            _ => break ToDo::Silent,
        }
    };
    let resends = host.resends();
    let whole = flash.firm(new.place(), new.bytes.len() as u32) == Some(new.bytes);
    (end, whole, resends)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// T-BOOT-3, T-BOOT-4: up to 1 % of the frames are lost, and half as many are changed. If the
    /// host reports that it is done, the image is complete.
    #[test]
    fn a_download_survives_a_noisy_bus(
        window in prop::sample::select(&[0u8, 1, 4, 16][..]),
        per_mille in 0u32..10,
        seed: u64,
    ) {
        let (end, whole, _) = download(window, per_mille, seed);
        prop_assert!(whole || end != ToDo::Done, "{end:?}");
        let lost_only_the_end = end == ToDo::Silent && whole;
        prop_assert!(end == ToDo::Done || lost_only_the_end, "window {window}: {end:?}");
    }
}

/// T-BOOT-3, T-BOOT-4: the noise changes the type of a record, which the checksum does not cover.
/// The record is requested again.
#[test]
fn a_changed_type_of_a_record_is_no_refusal() {
    let seeds = [17406014069381691132, 2330320115466193060];
    for (window, seed) in [0, 1].into_iter().zip(seeds) {
        let (end, whole, _) = download(window, 8, seed);
        assert_eq!((end, whole), (ToDo::Done, true), "window {window}");
    }
}

/// T-BOOT-3: the loader requests a lost frame again.
#[test]
fn what_is_lost_is_asked_for_again() {
    for window in [0, 8] {
        let (end, whole, resends) = download(window, 10, 5);
        assert_eq!((end, whole), (ToDo::Done, true));
        assert!(resends > 0);
    }
}

/// T-BOOT-3, U-5: the controller loses power in the middle of a download. Ten seconds later it
/// starts with its connect window of 20 ms, and the host, which was not informed, sends the file
/// from its beginning.
#[test]
fn a_download_goes_on_after_a_loss_of_power() {
    let mut flash = factory();
    let new = image(Slot::B, 2, 3000);
    let mut host = FileSender::new(records("new", &[&new]), Some(SystemId::A), 16);
    let keys = [TEST_PUBLIC];
    let setup = fixture::setup(&keys);
    let mut now = Instant::ORIGIN;
    let mut lost = false;
    let end = loop {
        let mut loader = Loader::start(&mut flash, setup, now);
        let end = loop {
            if !lost && host.progress().0 > 100 {
                break None;
            }
            match loader.next(now) {
                Next::Send(frame) => host.on_frame(now, &frame),
                Next::Wait(until) => match host.next(now) {
                    ToDo::Send(frame) => {
                        now = Instant::from_ns(now.as_ns() + 270_000);
                        loader.on_frame(now, &frame);
                    }
                    ToDo::Wait(other) => now = until.min(other),
                    end => break Some(end),
                },
                next => panic!("{next:?}: the host is not heard"),
            }
        };
        if let Some(end) = end {
            break end;
        }
        lost = true;
        flash.power_on(7, None);
        let back = now + Duration::from_ms(10_000);
        while now < back {
            match host.next(now) {
                ToDo::Send(_) => now = Instant::from_ns(now.as_ns() + 270_000),
                ToDo::Wait(until) => now = until.min(back),
                end => panic!("the host gives up: {end:?}"),
            }
        }
    };
    assert!(lost && end == ToDo::Done, "{end:?}");
    let len = new.bytes.len() as u32;
    assert_eq!(flash.firm(new.place(), len), Some(new.bytes));
}
