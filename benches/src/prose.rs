//! What the page says in words.

use crate::result::{Results, Row};
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

/// How it was measured, and what the figures do not say.
pub(crate) fn explanations(results: &Results) -> Markup {
    html! {
        (section("How to read this page", &html! {}, "", &html! {
            div.two {
                div {
                    h3 { "What a ratio means" }
                    p {
                        "Each group does one thing in several ways. Its floor is the bare mechanism, \
                         such as a cache line or a futex, between the same CPUs in the same run. "
                        b { "1.2×" } " means: what is compared adds a fifth to what hardware and \
                         kernel need anyway. Quote ratios, not times: the times belong to this \
                         machine, its load and the place of its CPUs. Even a ratio to a tail \
                         (p99.9) moves with the machine's noise: run it again before you trust it."
                    }
                    h3 { "The curves" }
                    p {
                        "To the right it gets rarer: at 99.9 %, one message in a thousand takes \
                         longer. A flat line means that nothing special happens; a step is \
                         something that does, such as a timer interrupt. Both axes are \
                         logarithmic. A curve ends where fewer than ten samples lie beyond it; \
                         figures in the tables that rest on fewer are grey and slanted."
                    }
                    h3 { "Whether something changed" }
                    p {
                        code { "tandem bench compare --against OLD" } " runs two builds in turn. Two \
                         pages side by side prove nothing: runs differ even if the code does not."
                    }
                }
                div {
                    h3 { "How it was measured" }
                    p {
                        "All cases take turns in batches of some 10 to 50 ms, so that each sees the \
                         same of the machine's moods. The ends are processes (libraries that only \
                         work between threads: threads), each pinned to a CPU. A message carries \
                         its time stamp; the receiver subtracts it from the time at which its code \
                         holds the value. The first tenth of each batch warms up and does not \
                         count. Percentiles are HdrHistogram's, to three digits."
                    }
                    h3 { "Coordinated omission" }
                    p {
                        "In a ping-pong the next message waits for the last one. If the machine \
                         stalls for 10 ms, a sender with a schedule of 10,000 messages a second is \
                         late with a hundred of them; the ping-pong notes one slow message and \
                         leaves the others out. " (rate_sentence(results))
                    }
                    h3 { "What this is not" }
                    p {
                        "These are processes of a host. On a TriCore no kernel stands between a \
                         signal and its handler, and memory, caches and clock are others: none of \
                         these times carries over. What carries over is how much Tandem adds to \
                         the bare mechanism, and that is why every group has a floor."
                    }
                }
            }
        }))
    }
}

fn rate_sentence(results: &Results) -> Markup {
    let rate = |row: &&Row| row.group == "rate";
    if results.results.iter().any(|row| rate(&row)) {
        html! {
            "The group " a href="#rate" { "fixed rate" } " sends by the schedule and counts from \
             the intended time, so nothing is left out; the naive figures stand beside it."
        }
    } else {
        html! { "The group " code { "rate" } " counts from the intended time; it is not in this run." }
    }
}
