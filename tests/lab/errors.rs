//! Tests that campaigns and experiments reject wrong arguments before they begin.

use std::fs;

use crate::fixture::{Fixture, refuses};

/// A long command does not begin if its results could not be written.
#[test]
fn a_result_that_cannot_be_written() {
    let fixture = Fixture::new();
    for (command, option) in [
        (&["sim", "--seeds", "1000000"][..], "--json"),
        (&["sim", "--only", "random:1"], "--save"),
        (&["thesis", "--board", "sim"], "--json"),
        (&["thesis", "--board", "sim"], "--svg"),
        (&["rtos-demo"], "--json"),
        (&["boot-demo"], "--json"),
        (&["judge", "--variants", "1"], "--json"),
    ] {
        for (place, why) in [(".", "it is a folder"), ("no/such/file", "create it first")] {
            let place = format!("{option}={place}");
            refuses(&fixture, &[command, &[&place]].concat(), &[why]);
        }
    }
    let twice = ["thesis", "--board", "sim", "--json=x", "--svg", "x"];
    refuses(&fixture, &twice, &["the same file"]);
}

/// An impossible campaign is rejected before a run starts.
#[test]
fn a_campaign_that_cannot_be() {
    let fixture = Fixture::new();
    for (name, text) in [
        ("none.toml", "mended-at-ms = 1.0\nfault = [{}]\n"),
        (
            "clock.toml",
            "mended-at-ms = 1.0\n[[fault]]\nwhat = \"clock\"\nof = \"a\"\nat-ms = 0.0\namount = 5\n",
        ),
        (
            "power-on.toml",
            "from-power-on = true\nmended-at-ms = 1.0\nfault = []\n",
        ),
        (
            "supply.toml",
            "mended-at-ms = 1.0\n[[fault]]\nwhat = \"supply-hangs\"\nof = \"a\"\nat-ms = 0.0\n\
             amount = 5\n",
        ),
    ] {
        fs::write(fixture.folder().join(name), text).unwrap();
    }
    for (args, word) in [
        (&["chaos", "--faults", "none.toml"][..], "missing field"),
        (
            &["chaos", "--faults", "clock.toml"],
            "clock: processes cannot suffer it",
        ),
        (&["chaos", "--faults", "power-on.toml"], "only `tandem sim`"),
        (&["chaos", "--matrix", "--only", "99999"], "no cell 99999"),
        (&["chaos", "--count", "0"], "no fault"),
        (&["chaos", "--json", "no/such/c.json"], "no/such"),
        (
            &["judge", "--variants", "1", "DIR", "--json"],
            "leave out --json",
        ),
        (
            &["sim", "--only", "random:1", "--json"],
            "cannot be used with",
        ),
        (&["judge", "DIR", "--json", "out"], "write --json=out"),
        (&["flash", "--json", "x.srec"], "--json is for --info"),
        (
            &["sim", "--faults", "supply.toml"],
            "the simulator cannot suffer it",
        ),
    ] {
        refuses(&fixture, args, &[word]);
    }
}
