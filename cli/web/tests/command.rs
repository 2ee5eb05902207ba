//! Tests the command line of `tandem web` without a run.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::process::Command;

use tandem_page::command_line::EXIT_STATUS;

const WEB: &str = env!("CARGO_BIN_EXE_tandem-web");

#[test]
fn the_help_has_the_exit_statuses() {
    let output = Command::new(WEB).args(["web", "--help"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    assert!(help.contains(EXIT_STATUS), "{help}");
}
