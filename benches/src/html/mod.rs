//! The results as one HTML page that needs nothing else: no scripts, no fonts, no files beside it.

mod curves;
mod overview;
mod prose;
mod scale;
mod tables;

use crate::family::{Family, Headline};
use crate::figures;
use crate::result::{Results, Row};
use maud::{DOCTYPE, Markup, PreEscaped, html};

const STYLE: &str = include_str!("style.css");

/// The page.
#[must_use]
pub fn page(results: &Results) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "Tandem: time from core to core" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    (header(results))
                    (strip(results))
                    (overview_card(results))
                    @for (name, rows) in results.groups() { (group(name, &rows)) }
                    (noise(results))
                    (conditions(results))
                    (prose::explanations(results))
                }
            }
        }
    };
    page.into_string()
}

fn header(results: &Results) -> Markup {
    let machine = &results.machine;
    let cases = results.results.len();
    let samples: u64 = results.results.iter().map(|row| row.samples).sum();
    html! {
        h1 { "Time from core to core" }
        p.sub {
            (machine.cpu) @if machine.hypervisor { " under a hypervisor" }
            " · Linux " (machine.kernel) " · " (cases) " cases · "
            (figures::count(samples as f64)) " samples in "
            (format!("{:.0}", results.duration_s)) " s"
        }
        p.sub { (results.noise_in_words()) }
        @if results.interrupted {
            div.verdict.bad { "Interrupted: fewer samples than planned" }
        }
        @if machine.build != "release" {
            div.verdict.bad { "A " (machine.build) " build: its figures say nothing about Tandem" }
        }
    }
}

/// For each group Tandem beside its floor and the best peer.
fn strip(results: &Results) -> Markup {
    html! {
        div.tiles {
            @for (name, rows) in results.groups() {
                @if let Some(headline) = Headline::of(&rows) { (tile(name, headline)) }
            }
        }
    }
}

fn tile(group: &str, headline: Headline<'_>) -> Markup {
    let tandem = headline.tandem;
    let bars: Vec<&Row> = [headline.floor, Some(tandem), headline.peer]
        .into_iter()
        .flatten()
        .collect();
    let largest = bars.iter().map(|row| row.p50_ns).fold(0.0, f64::max);
    // Sizes are compared by eye, hence a linear scale from 0.
    let width = |row: &Row| format!("width:{:.1}%", 100.0 * row.p50_ns / largest.max(1e-9));
    html! {
        a.tile href=(format!("#{group}")) {
            div.name { (prose::about(group).title) }
            @match tandem.ratio_to_floor_p50 {
                Some(ratio) => {
                    div.value { (figures::ratio(ratio)) "×" small { "the floor" } }
                }
                None => { div.value { (figures::time(tandem.p50_ns)) } }
            }
            div.bars {
                @for row in bars {
                    span.who { (row.case()) }
                    span.bar { i class=(Family::of(row).class()) style=(width(row)) {} }
                    span.what { (figures::time(row.p50_ns)) }
                }
            }
        }
    }
}

fn overview_card(results: &Results) -> Markup {
    let Some(svg) = overview::svg(&results.groups()) else {
        return html! {};
    };
    html! {
        section {
            div.head { h2 { "Medians over the floor" } (legend()) }
            p.note {
                "Each dot is a case; further left is faster. Named are Tandem and the best of the \
                 peers. The line at 1× is what hardware and kernel need without any library. \
                 Arrows at the edges lie further out."
            }
            (svg)
        }
    }
}

fn legend() -> Markup {
    html! {
        div.legend {
            @for family in Family::ALL {
                span { i class=(family.class()) {} (family.name()) }
            }
        }
    }
}

fn group(name: &str, rows: &[&Row]) -> Markup {
    let about = prose::about(name);
    html! {
        section id=(name) {
            div.head { h2 { (about.title) } span.unit { (about.measures) } }
            p.note { (about.note) }
            @if let Some(svg) = curves::svg(rows) { (svg) }
            (tables::group(rows))
        }
    }
}

fn noise(results: &Results) -> Markup {
    if results.noise.is_empty() {
        return html! {};
    }
    let rows: Vec<&Row> = results.noise.iter().collect();
    html! {
        section id="noise" {
            div.head { h2 { "The machine's own noise" } }
            p.note { (results.noise_in_words()) }
            (tables::noise(&rows))
        }
    }
}

fn conditions(results: &Results) -> Markup {
    html! {
        section id="machine" {
            div.head { h2 { "Machine" } }
            table.facts {
                @for (what, value) in results.machine.facts() {
                    tr { th { (what) } td { (value) } }
                }
            }
        }
        @if !results.skipped.is_empty() {
            section id="skipped" {
                div.head { h2 { "Not measured" } }
                table.facts {
                    @for case in &results.skipped {
                        tr { th { code { (case.name) } } td { (case.why) } }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;
