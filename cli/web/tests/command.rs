//! Tests the command line of `tandem web` without a run.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

#[path = "../../../tests/json/schema.rs"]
mod schema;

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};

use tandem_page::command_line::EXIT_STATUS;

const WEB: &str = env!("CARGO_BIN_EXE_tandem-web");

/// With `--json` the first line is a document of its schema.
#[test]
fn the_address_fits_its_schema() {
    let mut web = Command::new(WEB)
        .args(["web", "--wait", "--json", "--run", "none"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let said = BufReader::new(web.stdout.take().unwrap()).read_line(&mut line);
    web.kill().unwrap();
    web.wait().unwrap();
    said.unwrap();
    schema::fits("web", line.as_bytes());
}

#[test]
fn the_help_has_the_exit_statuses() {
    let output = Command::new(WEB).args(["web", "--help"]).output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    assert!(help.contains(EXIT_STATUS), "{help}");
}
