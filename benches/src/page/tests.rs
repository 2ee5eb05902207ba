//! Tests that the page is complete, self-contained, and well-formed.

use super::*;
use crate::result::Skipped;
use crate::synthetic::{results, row};

fn run() -> Results {
    let mut rows = vec![
        row("spin/floor", 75.0),
        row("spin/tandem", 84.0),
        row("spin/iceoryx2-pubsub", 420.0),
        row("throughput/fifo-8B", 8.3),
        row("a-group-of-later/something", 5.0e6),
    ];
    rows[1].ratio_to_floor_p50 = Some(1.12);
    rows[2].ratio_to_floor_p50 = Some(5.6);
    rows[2].ratio_to_floor_p99_9 = Some(5.6);
    rows[3].messages_per_second = Some(120e6);
    rows[4].facts.insert("longest wait, ns".to_owned(), 3.0e6);
    let mut run = results(rows);
    run.noise.push(row("noise/cpu0", 12.0));
    run.skipped.push(Skipped {
        name: "sleep/ddsperf".to_owned(),
        why: "not <installed> & not found".to_owned(),
    });
    run
}

#[test]
fn the_page_holds_every_case_and_needs_nothing_from_outside() {
    let mut run = run();
    assert!(!page(&run).contains("Interrupted"));
    run.interrupted = true;
    let page = page(&run);
    for row in run.results.iter().chain(&run.noise) {
        let case = format!("<b>{}</b>", row.case());
        assert!(page.contains(&case) && page.contains(&row.what), "{case}");
    }
    let skipped = ["sleep/ddsperf", "not &lt;installed&gt; &amp; not"];
    for part in [
        &skipped[..],
        &["Interrupted", "1.12×", "longest wait: 3.00 ms"],
    ]
    .concat()
    {
        assert!(page.contains(part), "{part}");
    }
    let outside = "http: https: <script <link <img @import url( src=";
    for outside in outside.split(' ') {
        assert!(!page.to_lowercase().contains(outside), "{outside}");
    }
}

#[test]
fn the_pictures_are_well_formed_and_hold_numbers_only() {
    let page = page(&run());
    let pictures: Vec<&str> = page.split("<svg").skip(1).collect();
    // A curve for each group, and the dots of the groups with a floor.
    assert!(pictures.len() > 4, "{}", pictures.len());
    for picture in pictures {
        let end = picture.find("</svg>").unwrap();
        let svg = format!("<svg{}</svg>", &picture[..end]);
        roxmltree::Document::parse(&svg).unwrap();
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}

#[test]
fn a_percentile_that_rests_on_chance_is_marked() {
    let mut run = run();
    assert!(!page(&run).contains("num rare"));
    // Only two samples lie beyond p99.9, so it and its ratio are unreliable.
    run.results[0].samples = 2_000;
    assert_eq!(page(&run).matches("num rare").count(), 2);
    // The floor's p99.9 comes from a stall (ten times the median), so the ratio is unreliable.
    let tandem = &mut run.results[1];
    tandem.p99_9_ns = 10.1 * tandem.p50_ns;
    tandem.ratio_to_floor_p50 = Some(1.0);
    assert_eq!(page(&run).matches("num rare").count(), 3);
    run.results[1].p99_9_ns *= 0.98;
    assert_eq!(page(&run).matches("num rare").count(), 2);
    run.results[1].batch_p50_ns.truncate(9);
    assert_eq!(page(&run).matches("num rare").count(), 3);
}

#[test]
fn a_case_with_hardly_a_sample_does_no_harm() {
    let mut run = run();
    for row in &mut run.results {
        row.curve.clear();
        row.ratio_to_floor_p50 = None;
        row.ratio_to_floor_p99_9 = None;
        row.p50_ns = 0.0;
    }
    run.results[0].curve = vec![(0.0, 0.0), (0.5, 0.0), (0.9, 0.0)];
    assert!(!page(&run).contains("NaN"));
    run.results.clear();
    run.noise.clear();
    assert!(page(&run).contains("</html>"));
}
