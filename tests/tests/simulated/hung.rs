//! A control task that hangs while the more urgent tasks of its core go on.

use crate::one_flow;
use tandem_board::{Board, CoreId, Duration, SystemId};
use tandem_board_sim::{Poller, SimBoard};
use tandem_cores::Config;
use tandem_cores::trace::Event;
use tandem_sim::drive::{Drive, poller};

const MS: fn(u64) -> Duration = Duration::from_ms;
/// The control task hangs from this time of its system's life on.
const HANGS: Duration = Duration::from_ms(10_000);

/// Core 0 whose control task hangs in the first life of its system.
fn hanging(board: &SimBoard) -> Poller {
    let hangs = board.identity().generation.0 == 1;
    let (clock, started) = (board.clone(), board.now());
    let runs = move || !hangs || clock.now().since(started) < HANGS;
    one_flow::core_0(board, runs, None, |_, _| ())
}

/// A drive in which the control task of a system hangs.
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

/// T-CHIP-6, T-RED-3: a control task that hangs is noticed in the standby as in the master: its
/// system stops its heartbeats, resets itself and comes back; the other drives.
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
