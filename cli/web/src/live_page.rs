//! The page: what does not change while the run drives, the script, and places for the rest.

use maud::{Markup, PreEscaped, html};
use tandem_board::{CoreId, SystemId};
use tandem_page::section;
use tandem_watch::Hand;

const SCRIPT: &str = include_str!("page.js");
const STYLE: &str = include_str!("page.css");

/// Returns the page. Its script runs only if the browser is told the same `nonce`.
pub(crate) fn page(nonce: &str) -> String {
    let empty = html! {};
    let place = |id: &str| html! { div id=(id) {} };
    let plot = |id: &str| html! { div.plot id=(id) data-live {} };
    let content = html! {
        style { (PreEscaped(STYLE)) }
        h1 { "Live run" }
        div id="head" { p.sub { "waiting for the run" } }
        div.tiles id="tiles" {}
        (section("Hands", &empty,
            "The buttons inject faults into the run. They need the token that tandem has printed.",
            &html! {
                button.strong data-hand=(Hand::KillSupply) data-system="master"
                    { "kill the master's supply" }
                button data-hand=(Hand::Mend) data-system="A" { "mend all wires" }
                " token " input id="token" type="text" autocomplete="off" spellcheck="false";
                span id="said" role="status" {}
            }))
        div.two {
            (system(SystemId::A, "system_a"))
            (system(SystemId::B, "system_b"))
        }
        (section("The lane from above", &empty, "", &place("lane")))
        (section("Roles", &roles_legend(), "The last minute. A red line is a takeover.",
            &plot("roles")))
        (section("Gaps in control", &empty,
            "The longest time between two accepted control frames, in each tenth of a second.",
            &plot("gaps")))
        (section("Distance from the centre of the lane", &empty, "", &plot("lateral")))
        (section("Events", &empty, "The newest first.", &place("events")))
    };
    tandem_page::document_with_plots("live", &content, SCRIPT, Some(nonce))
}

fn roles_legend() -> Markup {
    use tandem_page::svg::Color;
    let entries = [
        ("master", Color::GOOD),
        ("degraded master", Color::WARN),
        ("standby", Color::CALM),
        ("starting", Color::PALE),
        ("safe stop", Color::B),
        ("suspended", Color::BAD),
        ("parking", Color::A),
    ];
    let entries = entries.map(|(name, color)| (name, Some(color)));
    tandem_page::legend(entries.into_iter().chain([("off", None)]))
}

fn system(system: SystemId, id: &str) -> Markup {
    let title = format!("System {system}");
    let content = html! {
        div id=(id) {}
        @for hand in Hand::ALL.into_iter().filter(|hand| *hand != Hand::Mend) {
            button data-hand=(hand) data-system=(system) { (label(hand)) }
        }
    };
    section(&title, &html! {}, "", &content)
}

fn label(hand: Hand) -> String {
    match hand {
        Hand::PowerOff => "power off".to_owned(),
        Hand::PowerOn => "power on".to_owned(),
        Hand::KillSupply => "kill supply".to_owned(),
        Hand::KillCore(core) => format!("kill core {}", CoreId::index(core)),
        Hand::Hang => "hang core 0".to_owned(),
        Hand::CutCan => "cut CAN".to_owned(),
        Hand::CutLink => "cut link".to_owned(),
        Hand::CutHeartbeats => "cut heartbeats".to_owned(),
        Hand::Mend => "mend all wires".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fragments::{Fragments, Plots};
    use crate::history::History;

    /// The page loads nothing, its script has the nonce, and it has a place for each part.
    #[test]
    fn the_page_is_one_file_with_a_place_for_each_part() {
        let page = page("0a1b");
        // uPlot names its home in a comment.
        let page = page.replace("https://github.com/leeoniya/uPlot", "");
        for external in ["http:", "https:", "src=", "@import", "url("] {
            assert!(!page.contains(external), "{external}");
        }
        assert_eq!(page.matches("<script nonce=\"0a1b\">").count(), 3);
        assert_eq!(page.matches("<script").count(), 3);
        let history = History::new("x");
        let parts = serde_json::to_value(Fragments::of(&history)).unwrap();
        let plots = Plots::of(&history);
        let plots = serde_json::to_value(plots.data()).unwrap();
        let names = [&parts, &plots].map(|it| it.as_object().unwrap().keys());
        for name in names.into_iter().flatten() {
            assert!(page.contains(&format!("id=\"{name}\"")), "{name}");
        }
    }
}
