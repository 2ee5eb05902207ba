//! Tests `tandem top` without a terminal.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::process::{Command, Stdio};

/// Without a terminal the command fails, and reports that it needs one.
#[test]
fn top_says_what_it_needs() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-top"));
    let output = command.arg("top").stdin(Stdio::null()).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("needs a terminal"));
}

#[test]
fn the_help_has_the_exit_statuses() {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tandem-top"));
    let output = command.args(["top", "--help"]).output().unwrap();
    let help = String::from_utf8_lossy(&output.stdout);
    assert!(
        help.contains(tandem_page::command_line::EXIT_STATUS),
        "{help}"
    );
}
