//! What the page says in words.

use crate::result::Results;
use maud::{Markup, html};
use tandem_page::section;

/// What a group is about.
#[derive(Clone, Copy, Debug)]
pub(crate) struct About {
    /// Its heading.
    pub(crate) title: &'static str,
    /// What one sample is.
    pub(crate) measures: &'static str,
    /// What to look for.
    pub(crate) note: &'static str,
}

const ABOUT: [(&str, About); 7] = [
    (
        "spin",
        About {
            title: "Spinning, two CPUs",
            measures: "one way, from send to the running handler",
            note: "The receiver polls on a CPU of its own. The floor is one cache \
                   line that two processes write in turn.",
        },
    ),
    (
        "sleep",
        About {
            title: "Sleeping, two CPUs",
            measures: "one way, from send to the running handler",
            note: "The receiver sleeps in the kernel until it is woken, on a CPU of its own. The \
                   floor is a futex. What spins a while before it sleeps (adaptive) can be faster \
                   than the floor: it never sleeps if the answer comes soon.",
        },
    ),
    (
        "one-cpu",
        About {
            title: "Sleeping, one CPU",
            measures: "one way, from send to the running handler",
            note: "Both ends share one CPU, so each message is a change of process. Spinning only \
                   keeps the other from running.",
        },
    ),
    (
        "size",
        About {
            title: "Payload size",
            measures: "one way, by bytes of payload",
            note: "Without a copy the time does not depend on the size: the payload stays where it \
                   was written, and only its place is told.",
        },
    ),
    (
        "throughput",
        About {
            title: "Throughput",
            measures: "time per message, messages in a row",
            note: "As many messages as go, one after the other. Less time is more messages.",
        },
    ),
    (
        "lock",
        About {
            title: "Lock",
            measures: "time to take and give back",
            note: "The floor is a compare-and-swap and a store. Contended: the others want it all \
                   the time. Recovery: from the death of its owner to the next one that has it.",
        },
    ),
    (
        "rate",
        About {
            title: "Fixed rate",
            measures: "one way, from the intended time of sending",
            note: "Messages are due on a schedule, whether the last one has arrived or not. Naive \
                   figures count from the actual sending: they hide what the schedule has lost.",
        },
    ),
];

/// What this group is about; one that is not known here explains itself by its cases.
pub(crate) fn about(group: &str) -> About {
    let known = ABOUT.into_iter().find(|(name, _)| *name == group);
    known.map_or(
        About {
            title: match group {
                "rtos" => "Real-time operating system",
                _ => "Further cases",
            },
            measures: "time per operation",
            note: "What each case is stands beside its name.",
        },
        |(_, about)| about,
    )
}

/// How to read the page.
pub(crate) fn explanations(results: &Results) -> Markup {
    let content = html! {
        p {
            "Each group does one thing in several ways. Its floor is the bare mechanism between the \
             same CPUs in the same run: 1.2× means that a fifth is added to it. Quote ratios: the \
             times belong to this machine. All cases take turns in batches of 10 to 50 ms. A curve \
             ends where fewer than ten samples lie beyond it; figures that rest on fewer are grey \
             and slanted. These are processes of a host; on a TriCore no kernel stands between a \
             signal and its handler, and only the ratios carry over. "
            (rate_sentence(results))
        }
        p {
            code { "tandem bench compare --against OLD" } " tells whether a change of the code made a \
             difference: two pages side by side prove nothing. More is in docs/performance.md."
        }
    };
    section("How to read this page", &html! {}, "", &content)
}

fn rate_sentence(results: &Results) -> &'static str {
    if results.results.iter().any(|row| row.group == "rate") {
        "A ping-pong leaves out the messages that a stall would have delayed; the group at a fixed \
         rate counts them."
    } else {
        ""
    }
}
