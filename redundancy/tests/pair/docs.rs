//! The tables in `docs/redundancy.md` agree with the implementation.

use crate::{page, truth};
use std::fmt::Write;
use tandem_board::Duration;
use tandem_redundancy::{Budget, Config};

fn bounds() -> String {
    let profiles = [Config::chip(), Config::rt(), Config::desktop()];
    let mut text = String::from("| bound | how | chip | rt | desktop |\n|---|---|---|---|---|\n");
    let mut row = |name: &str, how: &str, value: fn(&Config) -> Duration| {
        let [chip, rt, desktop] = profiles.each_ref().map(|config| value(config).as_ms_f64());
        writeln!(
            text,
            "| {name} | {how} | {chip} ms | {rt} ms | {desktop} ms |"
        )
        .unwrap();
    };
    row(
        "line silent",
        "misses × period + jitter",
        Config::silent_limit,
    );
    row(
        "detection",
        "line silent + poll interval",
        Config::detection_bound,
    );
    row(
        "low level believed",
        "heartbeat period + min(jitter, poll interval)",
        Config::level_limit,
    );
    row(
        "third witness",
        "control period + margin",
        Config::witness_limit,
    );
    row(
        "link silent",
        "misses × report period + jitter",
        Config::link_limit,
    );
    row(
        "vehicle unheard, own CAN deaf",
        "2 control periods + margin",
        Config::mute_limit,
    );
    row(
        "takeover on silence",
        "max(line silent, min(third witness, link silent)) + poll",
        Config::takeover_bound,
    );
    row(
        "gap, power level falls",
        "control period + low level believed + poll",
        Config::gap_bound_power,
    );
    row(
        "gap, silence",
        "max(control period + line silent, min(third witness, control period + link silent)) + poll",
        Config::gap_bound,
    );
    row(
        "gap, mute master",
        "third witness + echo of an overdue frame + poll",
        Config::gap_bound_mute,
    );
    row("lease", "line silent - heartbeat period", Config::lease);
    row(
        "standby unheard on CAN",
        "3 status periods + half of one",
        |config| config.status_limit,
    );
    row("first hold-down", "10 control periods", |config| {
        config.hold_down
    });
    text
}

fn budget() -> String {
    let mut text = String::from(
        "| profile | heartbeats each | polls each | reports each | late by | stall | tolerated | line silent | third witness |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    for (name, budget) in [
        ("chip", Budget::CHIP),
        ("rt", Budget::RT),
        ("desktop", Budget::DESKTOP),
    ] {
        let config = budget.config();
        let [
            beats,
            polls,
            reports,
            late,
            stall,
            tolerated,
            silent,
            witness,
        ] = [
            budget.heartbeat_period,
            budget.poll_interval,
            budget.report_period,
            budget.lateness,
            budget.stall,
            budget.tolerated_stall(),
            config.silent_limit(),
            config.witness_limit(),
        ]
        .map(|time| time.as_ms_f64());
        writeln!(
            text,
            "| {name} | {beats} ms | {polls} ms | {reports} ms | {late} ms | {stall} ms | {tolerated} ms | {silent} ms | {witness} ms |"
        )
        .unwrap();
    }
    text
}

/// T-RED-9: the bounds and the truth table of the docs are generated; `UPDATE_DOCS=1` writes them
/// again.
#[test]
fn tables_in_the_docs_are_those_of_the_code() {
    page::check(&[
        ("budget", budget()),
        ("bounds", bounds()),
        ("truth", truth::table()),
    ]);
}
