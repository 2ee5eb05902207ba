//! `tandem topics list`: topics, their writers and readers, and which of them do not fit.

use std::io::Write;

use serde::Serialize;
use tandem_topics_host::listing::{ListedEndpoint, Listing};
use tandem_topics_host::node::Node;

use super::{Out, Watch, at, no_participant, nothing, turn};
use crate::args::TopicsPlace;
use crate::failure::Failure;

/// An endpoint in the output of `--json`.
#[derive(Serialize)]
struct Row<'a> {
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'a str,
    role: &'static str,
    from: &'a str,
    reliability: &'static str,
    durability: u32,
    depth: Option<u32>,
    /// Of a reader: the writers that do not fit, and why.
    incompatible: Vec<Misfit>,
}

/// A writer that does not fit a reader.
#[derive(Serialize)]
struct Misfit {
    writer: String,
    reason: String,
}

pub(super) fn run(
    place: &TopicsPlace,
    watch: &Watch<'_>,
    out: &mut Out<impl Write>,
) -> Result<(), Failure> {
    let at = at(place)?;
    let opened: Result<Node<0, 0>, _> = Node::open(at, &[], &[]);
    let mut node = opened.map_err(|error| no_participant(at, &error))?;
    let mut listing = Listing::default();
    while !watch.is_over() {
        turn(&mut node, &mut listing)?;
    }
    out.document(&rows(&listing), || text(&listing))?;
    if node.participant.refused > 0 {
        eprintln!("there are more participants than this one hears: endpoints may be missing");
    }
    if watch.is_interrupted() {
        return Err(Failure::CutShort);
    }
    match listing.participants().next() {
        Some(_) => Ok(()),
        None => Err(Failure::NothingHeard(nothing(place, None, &listing))),
    }
}

fn misfits(listing: &Listing, endpoint: &ListedEndpoint) -> Vec<(String, String)> {
    match endpoint.writes {
        true => Vec::new(),
        false => listing.misfits(endpoint),
    }
}

const fn role(endpoint: &ListedEndpoint) -> &'static str {
    if endpoint.writes { "writer" } else { "reader" }
}

fn text(listing: &Listing) -> String {
    let mut text = String::new();
    let mut topic = None;
    for endpoint in listing.endpoints() {
        let this = (&endpoint.topic, &endpoint.type_name);
        if topic.replace(this) != Some(this) {
            text += &format!("{}  {}\n", endpoint.topic, endpoint.type_name);
        }
        let (role, from) = (role(endpoint), &endpoint.from);
        text += &format!("  {role}  {from:18}  {}\n", endpoint.quality());
        for (writer, reason) in misfits(listing, endpoint) {
            text += &format!("          INCOMPATIBLE with {writer}: {reason}\n");
        }
    }
    let endpoints = listing.endpoints();
    let is_silent = |name: &&str| !endpoints.iter().any(|one| one.from == *name);
    for name in listing.participants().filter(is_silent) {
        text += &format!("{name} has announced no topic\n");
    }
    text
}

fn rows(listing: &Listing) -> Vec<Row<'_>> {
    listing
        .endpoints()
        .into_iter()
        .map(|endpoint| Row {
            topic: &endpoint.topic,
            type_name: &endpoint.type_name,
            role: role(endpoint),
            from: &endpoint.from,
            reliability: if endpoint.is_reliable {
                "reliable"
            } else {
                "best effort"
            },
            durability: endpoint.durability,
            depth: endpoint.depth,
            incompatible: misfits(listing, endpoint)
                .into_iter()
                .map(|(writer, reason)| Misfit { writer, reason })
                .collect(),
        })
        .collect()
}
