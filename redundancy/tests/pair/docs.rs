//! The tables in `docs/redundancy.md` are those of the implementation.

use crate::truth;
use std::fmt::Write;
use tandem_board::Duration;
use tandem_redundancy::{Config, Evidence, Mode, Phase, next};

fn transitions() -> String {
    let mut text = String::from("| evidence |");
    for phase in Phase::ALL {
        write!(text, " {phase:?} |").unwrap();
    }
    text.push_str("\n|---|");
    text.push_str(&"---|".repeat(Phase::ALL.len()));
    text.push('\n');
    for evidence in Evidence::ALL {
        write!(text, "| {evidence:?} |").unwrap();
        for phase in Phase::ALL {
            let stays = match (phase, evidence) {
                (Phase::Standby, Evidence::BeatsSilent) => "(report)",
                (Phase::DegradedMaster, Evidence::BeatsSilent | Evidence::PeerOff) => "(set flag)",
                (Phase::DegradedMaster, Evidence::BeatsBack) => "(clear flag)",
                (Phase::DegradedMaster, Evidence::FaultStop) => "(safe stop)",
                _ => "·",
            };
            let cell = next(phase, evidence).map_or(stays.into(), |to| format!("{to:?}"));
            write!(text, " {cell} |").unwrap();
        }
        text.push('\n');
    }
    text
}

fn bounds() -> String {
    let profiles = [Config::rt(), Config::desktop()];
    let mut text = String::from("| bound | how | rt | desktop |\n|---|---|---|---|\n");
    let mut row = |name: &str, how: &str, value: fn(&Config) -> Duration| {
        let [rt, desktop] = profiles.each_ref().map(|config| value(config).as_ms_f64());
        writeln!(text, "| {name} | {how} | {rt} ms | {desktop} ms |").unwrap();
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
        "third witness",
        "control period + margin",
        Config::witness_limit,
    );
    row(
        "mute master",
        "2 control periods + margin",
        Config::mute_limit,
    );
    row(
        "takeover on silence",
        "max(line silent, third witness) + poll",
        Config::takeover_bound,
    );
    row(
        "gap, power level falls",
        "control period + poll",
        Config::gap_bound_power,
    );
    row(
        "gap, silence",
        "max(control period + line silent, third witness) + poll",
        Config::gap_bound,
    );
    row(
        "gap, mute master",
        "mute master + poll",
        Config::gap_bound_mute,
    );
    row("lease", "line silent - heartbeat period", Config::lease);
    text
}

/// The part of `page` between the markers of `name`, replaced by `text`.
fn replaced(page: &str, name: &str, text: &str) -> String {
    let (begin, end) = (
        format!("<!-- {name}:begin -->\n"),
        format!("<!-- {name}:end -->"),
    );
    let from = page
        .find(&begin)
        .unwrap_or_else(|| panic!("{begin}missing"))
        + begin.len();
    let to = page.find(&end).unwrap_or_else(|| panic!("{end} missing"));
    format!("{}{}{}", &page[..from], text, &page[to..])
}

/// T-RED-9: the transition table, the bounds and the truth table of the docs are generated; set
/// `UPDATE_DOCS=1` to write them anew.
#[test]
fn tables_in_the_docs_are_those_of_the_code() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/redundancy.md");
    let page = std::fs::read_to_string(path).unwrap();
    let mut expected = page.clone();
    for (name, text) in [
        ("transitions", transitions()),
        ("bounds", bounds()),
        ("truth", truth::table()),
    ] {
        expected = replaced(&expected, name, &text);
    }
    if std::env::var_os("UPDATE_DOCS").is_some() {
        std::fs::write(path, expected).unwrap();
    } else {
        assert!(
            page == expected,
            "docs/redundancy.md is out of date: UPDATE_DOCS=1 cargo test"
        );
    }
}

/// T-RED-7, T-RED-9: properties of the whole table.
#[test]
fn the_table_as_a_whole() {
    for phase in Phase::ALL {
        // Only evidence of the other's failure, silence or absence, or of a finished start, opens
        // the output of a system; nothing opens that of a failed one.
        for evidence in Evidence::ALL {
            let Some(to) = next(phase, evidence) else {
                continue;
            };
            assert_ne!(to, phase, "a transition to itself is none");
            assert_ne!(to, Phase::Starting, "only a reset starts anew");
            if to.is_driving() && !phase.is_driving() {
                assert!(matches!(
                    (phase, evidence),
                    (
                        Phase::Starting,
                        Evidence::HandshakeDone | Evidence::NobodyThere | Evidence::PeerOff
                    ) | (
                        Phase::Standby,
                        Evidence::PeerOff | Evidence::PeerSilent | Evidence::MasterMute
                    ) | (Phase::Thawed, Evidence::ListenOver | Evidence::PeerOff)
                ));
            }
        }
        // From every phase but the last two a fault that stays leads to silence, and a higher term
        // closes every open output.
        if phase != Phase::Suspended {
            assert_eq!(next(phase, Evidence::FaultSuspend), Some(Phase::Suspended));
        }
        if phase.is_driving() {
            assert_eq!(next(phase, Evidence::HigherTerm), Some(Phase::Standby));
        }
        assert_eq!(next(Phase::Suspended, Evidence::PeerOff), None);
        assert!(phase.sends_heartbeats() || !phase.is_driving());
    }
    assert_eq!(Mode::ALL.map(Mode::code), [0, 1, 2, 3]);
}
