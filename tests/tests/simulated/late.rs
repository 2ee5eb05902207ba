//! Tests of control frames that arrive late: the vehicle refuses them by their absolute age.

use crate::wrong::{MS, aside};
use tandem_board::{Duration, SystemId};
use tandem_board_sim::BusFault;
use tandem_sim::drive::Drive;

use SystemId::{A, B};

fn driving(s: u64) -> Drive {
    let mut drive = Drive::new("free-lane", 5);
    drive.run_for(MS(s * 1_000));
    drive
}

fn hold_up(drive: &mut Drive, late: Duration) {
    let fault = BusFault {
        late,
        ..BusFault::default()
    };
    drive.pair.disturb_bus(A, fault);
}

/// T-RED-9: A's frames wait in a queue that grows by 0.99 ms a second. Frames that are older than
/// 40 ms do not act, and B drives on.
#[test]
fn frames_of_a_queue_that_grows_slowly_do_not_act_when_they_are_old() {
    let mut drive = driving(6);
    let mut most = 0.0_f64;
    let mut refused_at = None;
    for second in 1..60_u64 {
        hold_up(&mut drive, Duration::from_us(990 * second));
        most = most.max(aside(&mut drive, MS(1_000)));
        if drive.seen.borrow().world.gate().counts().stale > 0 {
            refused_at.get_or_insert(990 * second);
        }
    }
    let (gap, masters) = (drive.gap_max(), drive.masters());
    println!("refused at {refused_at:?} us, gap {gap:?}, {masters:?}, {most:.2} m aside");
    assert!(refused_at.is_some_and(|us| us <= 40_000), "{refused_at:?}");
    // Two frames are refused before A stops sending.
    assert!(gap <= MS(31), "{gap:?}");
    assert_eq!(masters[..2], [A, B]);
    assert!(most < 0.2, "{most} m");
}

/// T-RED-9: A is alone. After a pause of 200 ms its frames are 160 ms late. None of them acts: A
/// itself finds that the vehicle refuses them.
#[test]
fn frames_that_are_late_after_a_pause_do_not_act() {
    let mut drive = driving(4);
    drive.pair.power_off(B);
    drive.run_for(MS(2_000));
    let silent = BusFault {
        lost_out: 1_000,
        ..BusFault::default()
    };
    drive.pair.disturb_bus(A, silent);
    drive.run_for(MS(200));
    let accepted = |drive: &Drive| drive.seen.borrow().world.gate().counts();
    let before = accepted(&drive);
    hold_up(&mut drive, MS(160));
    drive.run_for(MS(1_000));
    let after = accepted(&drive);
    println!("before {before:?}, after {after:?}");
    assert_eq!(after.accepted, before.accepted);
    assert!(after.stale > before.stale);
}
