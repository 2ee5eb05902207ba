//! A control task that hangs while the more urgent tasks of its core continue.

use crate::one_flow;
use tandem_board::{Board, CoreId, Duration, SystemId};
use tandem_board_sim::{Poller, SimBoard};
use tandem_cores::Config;
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};

const MS: fn(u64) -> Duration = Duration::from_ms;
/// Time after the start of its system at which the control task hangs.
const HANGS: Duration = Duration::from_ms(10_000);

/// Creates core 0 with a control task that hangs in the first incarnation of its system.
fn hanging(board: &SimBoard) -> Poller {
    let hangs = board.identity().generation.0 == 1;
    let (clock, started) = (board.clone(), board.now());
    let runs = move || !hangs || clock.now().since(started) < HANGS;
    one_flow::core_0(board, runs, None, |_, _| ())
}

/// Starts a drive in which the control task of a system hangs.
pub(crate) fn drive(of: SystemId) -> Drive {
    let mut drive = Drive::with("free-lane", 4, move |board| {
        let id = board.identity();
        if (id.system, id.core) == (of, CoreId::CONTROL) {
            hanging(board)
        } else {
            poller(board, Config::rt())
        }
    });
    drive.run_for(MS(13_000));
    drive
}

/// T-CHIP-6, T-RED-3: a hanging control task is detected in the standby and in the master. Its
/// system stops its heartbeats, resets itself and returns, and the other system drives.
#[test]
fn a_control_task_that_hangs_is_noticed_in_the_standby_too() {
    for of in SystemId::ALL {
        let drive = drive(of);
        crate::print_story(&drive);
        let restarted = drive.events.iter().find(|(_, system, core, event)| {
            let again = matches!(event, Event::Started { generation: 2, .. });
            (*system, *core) == (of, CoreId::CONTROL) && again
        });
        let after_ms = restarted.map(|(at, ..)| at.as_ns() / 1_000_000 - HANGS.as_ns() / 1_000_000);
        println!("{of} restarts after {after_ms:?} ms");
        assert!(after_ms.is_some_and(|ms| ms < 100), "{of}: {after_ms:?}");
        let masters: &[SystemId] = match of {
            SystemId::A => &[SystemId::A, SystemId::B],
            SystemId::B => &[SystemId::A],
        };
        assert_eq!(drive.masters(), masters);
        assert!(drive.gap_max() < MS(40), "{:?}", drive.gap_max());
    }
}
