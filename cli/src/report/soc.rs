//! The part of the report about the SoC: how it parked, and what it heard on the topics.

use maud::{Markup, html};

use crate::soc::SocFigures;
use crate::topics::IdFigures;

/// Returns the section: the phases of parking, and the frames by id.
pub(super) fn topics(soc: &SocFigures) -> Markup {
    let driven = format!("{:.2} of {} m driven", soc.driven_m, soc.way_m);
    html! {
        section {
            h2 { "Topics" }
            p.note {
                "What the SoC did and heard over DDS: each frame of both systems once. "
                "Lost: neither system has published it."
            }
            @match &soc.not_parked {
                None => div.verdict.good { "Parked, " (driven) },
                Some(why) => div.verdict.warn { "Not parked: " (why) },
            }
            table {
                tr { th { "at" } th { "phase" } th.num { "driven" } }
                @for phase in &soc.phases {
                    tr {
                        td.time { (format!("{:.3} s", phase.at_s)) }
                        td { (phase.phase) }
                        td.num { (format!("{:.2} m", phase.driven_m)) }
                    }
                }
            }
            table {
                tr {
                    th { "id" } th { "name" }
                    @for name in [
                        "period, ms", "frames", "a second", "of A", "of B", "lost", "jumps",
                        "longest age, ms",
                    ] {
                        th.num { (name) }
                    }
                }
                @for id in &soc.ids { (row(id)) }
            }
        }
    }
}

fn row(id: &IdFigures) -> Markup {
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".to_owned());
    let period = (id.period_ms > 0).then(|| id.period_ms.to_string());
    html! {
        tr {
            td.time { (id.id) }
            td { (or_dash(id.name.clone())) }
            td.num { (or_dash(period)) }
            td.num { (id.frames) }
            td.num { (or_dash(id.rate_hz.map(|rate| format!("{rate:.1}")))) }
            td.num { (id.samples.a) }
            td.num { (id.samples.b) }
            td.num.bad[id.lost > 0] { (id.lost) }
            td.num { (id.jumps) }
            td.num { (format!("{:.1}", id.longest_ms.max(id.age_ms))) }
        }
    }
}
