//! Self-contained pages (no fonts, no other files; scripts only for plots), and the files for
//! results.
//!
//! The report of a run and the benchmark share one template, one style and one set of charts. Their
//! command lines share the text about exit statuses, and the option `--json`.
#![forbid(unsafe_code)]

pub mod chart;
pub mod command_line;
pub mod format;
pub mod hgrm;
pub mod json;
pub mod output;
pub mod plot;
pub mod svg;

use maud::{DOCTYPE, Markup, PreEscaped, html};
use svg::Color;

/// The style of every page. [`Color`] names its colour variables.
pub const STYLE: &str = include_str!("style.css");

/// Returns a whole page.
#[must_use]
pub fn document(title: &str, content: &Markup) -> String {
    whole(title, &html! {}, content)
}

/// Allows a page its own scripts and styles, and nothing from outside.
const NOTHING_FROM_OUTSIDE: &str =
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; base-uri 'none'";

/// Returns a whole page with plots ([`chart::Chart::plot`]) and with this further script. A server
/// that has told the browser a `nonce` says it here. Without one the page tells the browser that it
/// may load nothing.
#[must_use]
pub fn document_with_plots(
    title: &str,
    content: &Markup,
    script: &str,
    nonce: Option<&str>,
) -> String {
    let head = html! {
        @if nonce.is_none() {
            meta http-equiv="Content-Security-Policy" content=(NOTHING_FROM_OUTSIDE);
        }
        @for style in plot::STYLE { style { (PreEscaped(style)) } }
    };
    let content = html! {
        noscript { p.note { "The plots of this page need JavaScript." } }
        (content)
        @for script in plot::SCRIPT.iter().copied().chain((!script.is_empty()).then_some(script)) {
            script nonce=[nonce] { (PreEscaped(script)) }
        }
    };
    whole(title, &head, &content)
}

fn whole(title: &str, head: &Markup, content: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "Tandem: " (title) }
                style { (PreEscaped(STYLE)) }
                (head)
            }
            body { main { (content) } }
        }
    };
    page.into_string()
}

/// Returns a section: a heading, text beside the heading, a note, and the content.
#[must_use]
pub fn section(title: &str, aside: &Markup, note: &str, content: &Markup) -> Markup {
    html! {
        section {
            div.head { h2 { (title) } (aside) }
            @if !note.is_empty() { p.note { (note) } }
            (content)
        }
    }
}

/// Returns a legend: names with their colours; a name without a colour has an empty box.
#[must_use]
pub fn legend<'a>(entries: impl Iterator<Item = (&'a str, Option<Color>)>) -> Markup {
    html! {
        div.legend {
            @for (name, color) in entries {
                span {
                    @match color {
                        Some(color) => i style=(format!("background:{}", color.css())) {},
                        None => i.off {},
                    }
                    (name)
                }
            }
        }
    }
}

/// Returns one main figure of the page: `state` is `good`, `bad` or empty.
#[must_use]
pub fn tile(name: &str, state: &str, value: &str, unit: &str, below: &Markup) -> Markup {
    html! {
        div class=(format!("tile {state}")) {
            div.name { (name) }
            div.value { (value) @if !unit.is_empty() { small { (unit) } } }
            (below)
        }
    }
}
