//! A download of the difference to the running application.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{factory, image};
use tandem_boot::{FlashRegion, ImageTarget, Refusal, Slot};
use tandem_boot_host::life::{End, Life};
use tandem_boot_host::{Image, ReleaseInfo, SimulatedFlash, delta, records};

/// Two releases for the two slots: one instruction in fifty differs, and one function is new.
fn releases() -> [Image; 2] {
    let mut old: Vec<u8> = (0..40_000_u32)
        .flat_map(|at| (at.wrapping_mul(0x9E37_79B9) >> 7).to_le_bytes())
        .collect();
    let mut new = old.clone();
    for at in (0..new.len()).step_by(200) {
        new[at] ^= 0x55;
    }
    new.splice(50_000..50_000, [7; 300]);
    old.truncate(150_000);
    let sign = |slot, version, body: &[u8]| {
        let release = ReleaseInfo {
            version,
            entries: [256; 3],
            ..ReleaseInfo::default()
        };
        let target = ImageTarget::Application(slot);
        Image::sign(
            target,
            release,
            &[(256, body)],
            &tandem_boot_host::life::TEST_KEY,
        )
    };
    [sign(Slot::A, 1, &old), sign(Slot::B, 2, &new)]
}

fn with(old: &Image) -> SimulatedFlash {
    let mut flash = factory();
    flash.load(old.place(), &old.bytes);
    flash
}

fn text_bytes(lines: &[String]) -> usize {
    lines.iter().map(String::len).sum()
}

/// U-5: the difference is a fraction of the file, and gives the same image, with each window.
#[test]
fn a_difference_gives_the_whole_image() {
    let [old, new] = releases();
    let lines = delta("new", &new, &old.bytes, old.place());
    let whole = text_bytes(&records("new", &[&new]));
    let part = text_bytes(&lines);
    assert!(part * 5 < whole, "{part} of {whole} characters");
    for window in [0, 8] {
        let mut flash = with(&old);
        flash.power_on(1, None);
        let outcome = Life::with_file(&lines, window).live(&mut flash);
        assert!(outcome.downloaded, "{outcome:?}");
        assert!(matches!(outcome.end, End::Running(launch) if launch.version == 2));
        let written = flash.firm(new.place(), new.bytes.len() as u32);
        assert!(written == Some(new.bytes.clone()), "window {window}");
    }
}

/// U-5, E-4: a difference to another image than the controller has is refused by its digest, and
/// one with a source outside the flash by the flash. The old application boots.
#[test]
fn a_difference_to_another_image_is_refused() {
    let [old, new] = releases();
    let other = image(Slot::A, 1, 300);
    let to_other = delta("new", &new, &old.bytes, old.place());
    let outside = delta("new", &new, &old.bytes, 0x1F_F000);
    for (lines, refusal) in [(&to_other, Refusal::Digest), (&outside, Refusal::Flash)] {
        let mut flash = with(&other);
        flash.power_on(1, None);
        let outcome = Life::with_file(lines, 8).live(&mut flash);
        assert_eq!(outcome.refused, Some(refusal));
        assert!(matches!(outcome.end, End::Running(launch) if launch.version == 1));
        let active = FlashRegion::Target(ImageTarget::Application(Slot::A)).range();
        let kept = flash.firm(active.start, other.bytes.len() as u32);
        assert_eq!(kept, Some(other.bytes.clone()));
    }
}
