//! Runs `tandem-board-conformance` on this board: each case is a run, each role runs in the process
//! of its core.
//!
//! A role writes its result to a file, because the trace may be full and the core may be reset.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Duration;

use tandem_board::{Board, CoreId, Supply, SystemId, VehiclePort, watchdog_answer};
use tandem_board_conformance as suite;
use tandem_board_conformance::Setting;
use tandem_board_host::{CoreArgs, HostBoard};

use crate::fixture::{Case, Script, idle};

const PASSED: &str = "passed";

pub(crate) fn cases() -> impl Iterator<Item = Case> {
    let all = suite::cases::<HostBoard>();
    all.into_iter().map(|case| Case {
        name: case.name,
        core: nothing,
        vehicle: judge,
    })
}

/// Unused: the cores of these cases run [`play`], which needs more than the board.
fn nothing(_: &HostBoard) {}

fn find(name: &str) -> Option<(usize, suite::Case<HostBoard>)> {
    suite::cases()
        .into_iter()
        .enumerate()
        .find(|(_, case)| case.name == name)
}

/// Runs the core's part if `name` is a case of the suite; returns whether it is one.
pub(crate) fn play(name: &str, args: &CoreArgs) -> bool {
    let Some((number, case)) = find(name) else {
        return false;
    };
    let me = args.identity;
    let part = case
        .parts
        .iter()
        .position(|part| part.place == me.address());
    // Cores without a part must not run, except core 0: without it the system would be reset.
    if part.is_none() && me.core != CoreId::CONTROL {
        return true;
    }
    let board: Arc<HostBoard> = Arc::new(HostBoard::attach(args).expect("a board"));
    let watched = case.setting.watches();
    let serves = Arc::new(AtomicBool::new(part.is_none() || !watched));
    if me.core == CoreId::CONTROL {
        let (board, serves) = (Arc::clone(&board), Arc::clone(&serves));
        thread::spawn(move || serve_while(&board, &serves));
    }
    if let Some(part) = part {
        let result = suite::run_role(number, part, &*board);
        let said = match result {
            Ok(()) => PASSED.to_owned(),
            Err(failure) => failure.to_string(),
        };
        report(&result_file(&args.flash, part), &said);
        serves.store(true, Ordering::Relaxed);
    }
    idle(&board);
    true
}

fn serve_while(board: &HostBoard, serves: &AtomicBool) {
    loop {
        thread::sleep(Duration::from_millis(5));
        if serves.load(Ordering::Relaxed) {
            let question = board.supply().watchdog_question();
            board.supply().service_watchdog(watchdog_answer(question));
        }
    }
}

/// Writes the file completely or not at all, because the core may be reset while it writes.
fn report(file: &Path, said: &str) {
    let draft = file.with_extension("draft");
    fs::write(&draft, said)
        .and_then(|()| fs::rename(&draft, file))
        .expect("a result file");
}

fn result_file(flash: &Path, part: usize) -> PathBuf {
    flash.with_file_name(format!("part-{part}"))
}

fn judge(script: &mut Script) {
    let (_, case) = find(&script.case).expect("a case of the suite");
    let flash = PathBuf::from(&script.folder).join("dflash");
    for (number, part) in case.parts.iter().enumerate() {
        if case.setting == Setting::Suspends && part.place.system == SystemId::A {
            continue;
        }
        let file = result_file(&flash, number);
        let mut said = String::new();
        script.until(&format!("{} ends its part", part.place), |script| {
            script.port.drain_trace(&mut |_| {});
            said = fs::read_to_string(&file).unwrap_or_default();
            !said.is_empty()
        });
        assert_eq!(said, PASSED, "core {}", part.place);
    }
    if matches!(case.setting, Setting::Plain | Setting::Watchdog) {
        for part in case.parts {
            let incarnations = script.generation(part.place.system, part.place.core).0;
            assert_eq!(incarnations, 1, "nothing resets {}", part.place);
        }
    }
}
