//! Profiles in XML against the document, a brute-force model, and the reader of Cyclone DDS.
#![allow(clippy::unwrap_used)]

mod wrong_files;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::{Command, Stdio};

use proptest::prelude::*;
use proptest::strategy::ValueTree as _;
use proptest::test_runner::TestRunner;
use tandem_qos_profiles::{ProfileError, Profiles, SOC};
use tandem_topics::{Durability, Qos, Reliability};

const D_5: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
/// What the standard gives to a writer that sets nothing. (DDS 1.4, 2.2.3)
const WRITER: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::Volatile,
    depth: 1,
};
/// The same for a reader.
const READER: Qos = Qos {
    reliability: Reliability::BestEffort,
    ..WRITER
};

/// Returns a file with these elements in the library `L`; they begin in line 3.
fn library(elements: &str) -> String {
    format!("<dds>\n<qos_library name=\"L\">\n{elements}\n</qos_library>\n</dds>\n")
}

fn load(text: &str) -> Profiles {
    Profiles::load(text, "p.xml").unwrap_or_else(|error| panic!("{error}\n{text}"))
}

/// D-5: the shipped profile has depth 3, is reliable and transient-local. A derived one overrides
/// one item of it.
#[test]
fn shipped_profiles_are_those_of_the_document() {
    let profiles = Profiles::load(SOC, "soc.xml").unwrap();
    let names: Vec<_> = profiles.names().collect();
    assert_eq!(names, ["Tandem::Soc", "Tandem::SocNewest"]);
    assert_eq!(profiles.writer("Tandem::Soc", "any").unwrap(), D_5);
    assert_eq!(profiles.reader("Tandem::Soc", "any").unwrap(), D_5);
    assert_eq!(profiles.writer("Tandem::SocNewest", "any").unwrap(), D_5);
    let newest = Qos { depth: 1, ..D_5 };
    assert_eq!(profiles.reader("Tandem::SocNewest", "any").unwrap(), newest);
}

/// All policies of the standard, each with its default.
const DEFAULTS: &str = "<dds xmlns=\"http://www.omg.org/dds/\"><qos_library name=\"L\">\
<qos_profile name=\"P\" is_default_qos=\"true\">\
<datareader_qos>\
<durability><kind>VOLATILE_DURABILITY_QOS</kind></durability>\
<deadline><period><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></period></deadline>\
<latency_budget><duration><sec>0</sec><nanosec>0</nanosec></duration></latency_budget>\
<liveliness><kind>AUTOMATIC_LIVELINESS_QOS</kind><lease_duration><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></lease_duration></liveliness>\
<reliability><kind>BEST_EFFORT_RELIABILITY_QOS</kind><max_blocking_time><sec>0</sec>\
<nanosec>100000000</nanosec></max_blocking_time></reliability>\
<destination_order><kind>BY_RECEPTION_TIMESTAMP_DESTINATIONORDER_QOS</kind></destination_order>\
<history><kind>KEEP_LAST_HISTORY_QOS</kind><depth>1</depth></history>\
<resource_limits><max_samples>LENGTH_UNLIMITED</max_samples>\
<max_instances>LENGTH_UNLIMITED</max_instances>\
<max_samples_per_instance>LENGTH_UNLIMITED</max_samples_per_instance></resource_limits>\
<ownership><kind>SHARED_OWNERSHIP_QOS</kind></ownership>\
<time_based_filter><minimum_separation><sec>0</sec><nanosec>0</nanosec></minimum_separation>\
</time_based_filter>\
<reader_data_lifecycle><autopurge_nowriter_samples_delay><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></autopurge_nowriter_samples_delay>\
<autopurge_disposed_samples_delay><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></autopurge_disposed_samples_delay>\
</reader_data_lifecycle>\
</datareader_qos>\
<datawriter_qos>\
<durability><kind>VOLATILE_DURABILITY_QOS</kind></durability>\
<durability_service><service_cleanup_delay><sec>0</sec><nanosec>0</nanosec>\
</service_cleanup_delay><history_kind>KEEP_LAST_HISTORY_QOS</history_kind>\
<history_depth>1</history_depth><max_samples>LENGTH_UNLIMITED</max_samples>\
<max_instances>LENGTH_UNLIMITED</max_instances>\
<max_samples_per_instance>LENGTH_UNLIMITED</max_samples_per_instance></durability_service>\
<deadline><period><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></period></deadline>\
<latency_budget><duration><sec>0</sec><nanosec>0</nanosec></duration></latency_budget>\
<liveliness><kind>AUTOMATIC_LIVELINESS_QOS</kind><lease_duration><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></lease_duration></liveliness>\
<reliability><kind>RELIABLE_RELIABILITY_QOS</kind><max_blocking_time><sec>0</sec>\
<nanosec>100000000</nanosec></max_blocking_time></reliability>\
<destination_order><kind>BY_RECEPTION_TIMESTAMP_DESTINATIONORDER_QOS</kind></destination_order>\
<history><kind>KEEP_LAST_HISTORY_QOS</kind><depth>1</depth></history>\
<resource_limits><max_samples>LENGTH_UNLIMITED</max_samples>\
<max_instances>LENGTH_UNLIMITED</max_instances>\
<max_samples_per_instance>LENGTH_UNLIMITED</max_samples_per_instance></resource_limits>\
<transport_priority><value>0</value></transport_priority>\
<lifespan><duration><sec>DURATION_INFINITE_SEC</sec>\
<nanosec>DURATION_INFINITE_NSEC</nanosec></duration></lifespan>\
<ownership><kind>SHARED_OWNERSHIP_QOS</kind></ownership>\
<ownership_strength><value>0</value></ownership_strength>\
<writer_data_lifecycle><autodispose_unregistered_instances>true\
</autodispose_unregistered_instances></writer_data_lifecycle>\
</datawriter_qos>\
<domainparticipant_qos>\
<entity_factory><autoenable_created_entities>true</autoenable_created_entities></entity_factory>\
</domainparticipant_qos>\
<publisher_qos><presentation><access_scope>INSTANCE_PRESENTATION_QOS</access_scope>\
<coherent_access>false</coherent_access><ordered_access>false</ordered_access></presentation>\
</publisher_qos>\
</qos_profile></qos_library></dds>";

/// A file that sets each policy to its default loads.
#[test]
fn policies_with_their_defaults_are_accepted() {
    let profiles = load(DEFAULTS);
    assert_eq!(profiles.writer("L::P", "T").unwrap(), WRITER);
    assert_eq!(profiles.reader("L::P", "T").unwrap(), READER);
}

/// Each byte of the shipped file is removed and replaced, and the file is cut there. The
/// result loads, or the error has a line of the file. Nothing panics.
#[test]
fn changed_files_are_read_or_refused_with_a_line() {
    let lines = SOC.lines().count() as u32;
    let mut counts = [0_u32; 3];
    let mut try_one = |text: &[u8]| {
        // An editor cannot save half a character.
        let Ok(text) = core::str::from_utf8(text) else {
            return;
        };
        match Profiles::load(text, "soc.xml") {
            Ok(profiles) => {
                for name in profiles.names() {
                    assert!(profiles.writer(name, "T").is_ok(), "{name}");
                    assert!(profiles.reader(name, "T").is_ok(), "{name}");
                }
                counts[0] += 1;
            }
            Err(ProfileError::Element { line, column, .. }) => {
                assert!(
                    (1..=lines).contains(&line) && column > 0,
                    "{line}:{column}\n{text}"
                );
                counts[1] += 1;
            }
            Err(ProfileError::Xml { line, column, .. }) => {
                assert!(
                    (1..=lines + 1).contains(&line) && column > 0,
                    "{line}:{column}\n{text}"
                );
                counts[2] += 1;
            }
            Err(error) => panic!("{error}\n{text}"),
        }
    };
    for at in 0..SOC.len() {
        let (before, after) = SOC.as_bytes().split_at(at);
        try_one(before);
        try_one(&[before, &after[1..]].concat());
        for byte in *b"<\"1" {
            try_one(&[before, &[byte], &after[1..]].concat());
        }
    }
    // Of each outcome there are many: the loop has reached beyond the parser of XML.
    assert!(counts.iter().all(|count| *count > 1_000), "{counts:?}");
}

/// The names of the items in the model, with their policies, and the values of their words.
const ITEMS: [(&str, &str, &[&str]); 5] = [
    (
        "reliability",
        "kind",
        &["BEST_EFFORT_RELIABILITY_QOS", "RELIABLE_RELIABILITY_QOS"],
    ),
    (
        "durability",
        "kind",
        &["VOLATILE_DURABILITY_QOS", "TRANSIENT_LOCAL_DURABILITY_QOS"],
    ),
    ("history", "depth", &["0", "1", "2", "3", "4"]),
    (
        "resource_limits",
        "max_samples",
        &["LENGTH_UNLIMITED", "1", "2", "3", "4"],
    ),
    (
        "resource_limits",
        "max_samples_per_instance",
        &["LENGTH_UNLIMITED", "1", "2", "3", "4"],
    ),
];
const FILTERS: [&str; 6] = ["*", "A*", "*B", "AB", "A*B*", "B"];
const TOPICS: [&str; 7] = ["", "A", "AB", "B", "xB", "AxB", "ABA"];

/// Indices into [`ITEMS`], by item.
type Values = [Option<usize>; 5];

/// An element of a profile in the model.
#[derive(Clone, Debug)]
struct Element {
    is_writer: bool,
    filter: Option<&'static str>,
    base: Option<usize>,
    values: Values,
}

/// A profile in the model: the index of its base, and its elements.
type Model = (Option<usize>, Vec<Element>);

fn values() -> impl Strategy<Value = Values> {
    let limit = || proptest::option::weighted(0.35, 0..5_usize);
    let depth = proptest::option::of(1..5_usize);
    let two = || proptest::option::of(0..2_usize);
    (two(), two(), depth, limit(), limit()).prop_map(|(a, b, c, d, e)| [a, b, c, d, e])
}

fn model() -> impl Strategy<Value = Vec<Model>> {
    let base = |share| proptest::option::weighted(share, 0..4_usize);
    let filter = proptest::option::of(proptest::sample::select(&FILTERS[..]));
    let element = (any::<bool>(), filter, base(0.2), values()).prop_map(
        |(is_writer, filter, base, values)| Element {
            is_writer,
            filter,
            base,
            values,
        },
    );
    let profile =
        (base(0.4), proptest::collection::vec(element, 0..5)).prop_map(|(base, mut elements)| {
            // One element of each kind has no filter.
            let mut has = [false; 2];
            elements.retain(|one| {
                let has = &mut has[usize::from(one.is_writer)];
                one.filter.is_some() || !core::mem::replace(has, true)
            });
            (base, elements)
        });
    proptest::collection::vec(profile, 4)
}

/// Returns the name of a profile: every second one is in another library.
fn name(index: usize) -> String {
    format!("{}::P{index}", ["L", "M"][index % 2])
}

fn base_name(base: Option<usize>) -> String {
    base.map_or(String::new(), |base| {
        format!(" base_name=\"{}\"", name(base))
    })
}

/// Writes an element with these values and attributes.
fn element(is_writer: bool, attributes: &str, values: &Values) -> String {
    let tag = ["datareader_qos", "datawriter_qos"][usize::from(is_writer)];
    let mut policies: BTreeMap<&str, String> = BTreeMap::new();
    for ((policy, item, words), value) in ITEMS.iter().zip(values) {
        if let Some(value) = value {
            let text = policies.entry(policy).or_default();
            write!(text, "<{item}>{}</{item}>", words[*value]).unwrap();
        }
    }
    let policies: String = policies
        .iter()
        .map(|(policy, items)| format!("<{policy}>{items}</{policy}>\n"))
        .collect();
    format!("<{tag}{attributes}>\n{policies}</{tag}>\n")
}

fn layered_file(model: &[Model]) -> String {
    let mut libraries = [String::new(), String::new()];
    for (index, (base, elements)) in model.iter().enumerate() {
        let text = &mut libraries[index % 2];
        let base = base_name(*base);
        writeln!(text, "<qos_profile name=\"P{index}\"{base}>").unwrap();
        for one in elements {
            let filter = one
                .filter
                .map(|filter| format!(" topic_filter=\"{filter}\""));
            let attributes = filter.unwrap_or_default() + &base_name(one.base);
            text.push_str(&element(one.is_writer, &attributes, &one.values));
        }
        text.push_str("</qos_profile>\n");
    }
    let [l, m] = libraries;
    format!(
        "<dds>\n<qos_library name=\"L\">\n{l}</qos_library>\n<qos_library name=\"M\">\n{m}\
         </qos_library>\n</dds>\n"
    )
}

/// A filter by its definition: `*` stands for any number of characters.
fn fits(filter: &[u8], topic: &[u8]) -> bool {
    match filter {
        [] => topic.is_empty(),
        [b'*', rest @ ..] => (0..=topic.len()).any(|at| fits(rest, &topic[at..])),
        [first, rest @ ..] => topic.first() == Some(first) && fits(rest, &topic[1..]),
    }
}

/// Returns the layers of a profile, its own first; `None` if they have no end.
fn layers(
    model: &[Model],
    at: usize,
    (is_writer, topic): (bool, &str),
    rest: usize,
) -> Option<Vec<Values>> {
    let rest = rest.checked_sub(1)?;
    let (base, elements) = &model[at];
    let mut fitting: Vec<&Element> = elements
        .iter()
        .filter(|one| one.is_writer == is_writer)
        .filter(|one| fits(one.filter.unwrap_or("*").as_bytes(), topic.as_bytes()))
        .collect();
    fitting.sort_by_key(|one| one.filter.is_none());
    let own = fitting.first();
    let mut all: Vec<Values> = own.map(|one| one.values).into_iter().collect();
    if let Some(below) = own.and_then(|one| one.base).or(*base) {
        all.extend(layers(model, below, (is_writer, topic), rest)?);
    }
    Some(all)
}

/// Returns the values of the topmost layers that set them; `None` if the layers have no end.
fn flattened(model: &[Model], at: usize, target: (bool, &str)) -> Option<Values> {
    let layers = layers(model, at, target, 1 + model.len())?;
    Some(core::array::from_fn(|item| {
        layers.iter().find_map(|values| values[item])
    }))
}

/// Returns the quality of service of flattened values; `None` if a limit is too small.
fn qos_of(is_writer: bool, values: Values) -> Option<Qos> {
    let [
        reliability,
        durability,
        depth,
        max_samples,
        max_samples_per_instance,
    ] = values;
    let depth = depth.unwrap_or(1);
    // Index 0 is no limit.
    let limit = |limit: Option<usize>| limit.filter(|limit| *limit > 0).unwrap_or(usize::MAX);
    let (all, one) = (limit(max_samples), limit(max_samples_per_instance));
    let fits = depth <= one && depth <= all && (one <= all || one == usize::MAX);
    let is_reliable = reliability.unwrap_or(usize::from(is_writer)) == 1;
    fits.then_some(Qos {
        reliability: [Reliability::BestEffort, Reliability::Reliable][usize::from(is_reliable)],
        durability: [Durability::Volatile, Durability::TransientLocal][durability.unwrap_or(0)],
        depth: depth as u8,
    })
}

fn lookup(profiles: &Profiles, at: usize, (is_writer, topic): (bool, &str)) -> Option<Qos> {
    let found = match is_writer {
        true => profiles.writer(&name(at), topic),
        false => profiles.reader(&name(at), topic),
    };
    found.ok()
}

/// Returns models; the same ones in each run.
fn models(count: usize) -> impl Iterator<Item = Vec<Model>> {
    let mut runner = TestRunner::deterministic();
    (0..count).map(move |_| model().new_tree(&mut runner).unwrap().current())
}

/// Layers, filters, bases and circles are those of a brute-force model, in 1,500 random files. A
/// file loads if the model has an end and fits for each topic that a filter describes.
#[test]
fn random_layers_are_those_of_a_model() {
    let (mut loaded, mut refused, mut late) = (0, 0, 0);
    for model in models(1_500) {
        let text = layered_file(&model);
        let expected = |at, target: (bool, &str)| {
            flattened(&model, at, target).and_then(|values| qos_of(target.0, values))
        };
        let elements = model.iter().flat_map(|(_, elements)| elements);
        let mut targets: Vec<(bool, String)> = elements
            .map(|one| (one.is_writer, one.filter.unwrap_or("").replace('*', "")))
            .collect();
        targets.extend([(true, String::new()), (false, String::new())]);
        let is_fine = |at| {
            let mut targets = targets.iter();
            targets.all(|(is_writer, topic)| expected(at, (*is_writer, topic)).is_some())
        };
        let result = Profiles::load(&text, "p.xml");
        assert_eq!(
            result.is_ok(),
            (0..model.len()).all(is_fine),
            "{result:?}\n{text}"
        );
        let Ok(profiles) = result else {
            refused += 1;
            continue;
        };
        loaded += 1;
        for (at, topic) in (0..model.len()).flat_map(|at| TOPICS.map(|topic| (at, topic))) {
            for target in [(true, topic), (false, topic)] {
                let expected = expected(at, target);
                late += u32::from(expected.is_none());
                assert_eq!(
                    lookup(&profiles, at, target),
                    expected,
                    "{at} {target:?}\n{text}"
                );
            }
        }
    }
    let counts = [loaded, refused, late];
    assert!(counts.iter().all(|count| *count > 10), "{counts:?}");
}

/// Loads profiles with the reader of Cyclone DDS, gives them to writers and readers, and prints
/// what these have, with Cyclone's defaults. Arguments: how many profiles.
const SCRIPT: &str = r#"
import os, sys
# The tag keeps it apart from other runs on this machine.
os.environ["CYCLONEDDS_URI"] = f"""<CycloneDDS><Domain id="any">
<General><Interfaces><NetworkInterface name="lo"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><Tag>{os.getpid()}</Tag></Discovery>
<Tracing><Verbosity>none</Verbosity></Tracing></Domain></CycloneDDS>"""
from dataclasses import dataclass
from cyclonedds.core import DDSException
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.qos_provider import QosProvider
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

@dataclass
class Sample(IdlStruct, typename="Sample"):
    number: int

provider = QosProvider(sys.stdin.read())
participant = DomainParticipant(100)
topic = Topic(participant, "oracle", Sample)
ends = (provider.get_datareader_qos, DataReader), (provider.get_datawriter_qos, DataWriter)
for index in range(int(sys.argv[1])):
    for read, end in ends:
        try:
            qos = end(participant, topic, qos=read(f"L::P{index}")).get_qos()
        except DDSException as error:
            print("refused", error.code)
            continue
        reliability = qos[Policy.Reliability] != Policy.Reliability.BestEffort
        durability = qos[Policy.Durability] == Policy.Durability.TransientLocal
        print(int(reliability), int(durability), qos[Policy.History].depth)
"#;

fn python() -> String {
    std::env::var("TANDEM_PYTHON").unwrap_or_else(|_| "python3".to_owned())
}

/// Returns whether Cyclone DDS is installed. Without it a test passes and prints that it was
/// skipped; with `TANDEM_REQUIRE_CYCLONEDDS=1` it fails.
fn cyclone_or_skip(test: &str) -> bool {
    let import = Command::new(python())
        .args(["-c", "import cyclonedds.qos_provider"])
        .output();
    if import.is_ok_and(|output| output.status.success()) {
        return true;
    }
    let required = std::env::var_os("TANDEM_REQUIRE_CYCLONEDDS").is_some_and(|value| value == "1");
    let lacks = "Python has no cyclonedds (pip install cyclonedds==11.0.1, TANDEM_PYTHON)";
    assert!(!required, "{test}: {lacks}");
    // The test runner does not capture this output, so a skipped test is visible.
    let _ = writeln!(std::io::stderr(), "SKIPPED: {test}: {lacks}");
    false
}

/// Returns what Cyclone DDS makes of the reader and the writer of each profile `L::P0`, `L::P1`, …;
/// `None` if it refuses to create it.
fn cyclone(text: &str, count: usize) -> Vec<[Option<Qos>; 2]> {
    let mut child = Command::new(python())
        .args(["-c", SCRIPT, &count.to_string()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // The script reads all of it before it writes.
    child
        .stdin
        .take()
        .unwrap()
        .write_all(text.as_bytes())
        .unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", output.status);
    let lines = String::from_utf8(output.stdout).unwrap();
    let all: Vec<Option<Qos>> = lines
        .lines()
        .map(|line| {
            let words: Vec<usize> = line
                .split(' ')
                .map_while(|word| word.parse().ok())
                .collect();
            let [reliability, durability, depth] = words[..] else {
                // DDS_RETCODE_INCONSISTENT_POLICY
                assert_eq!(line, "refused -8");
                return None;
            };
            Some(Qos {
                reliability: [Reliability::BestEffort, Reliability::Reliable][reliability],
                durability: [Durability::Volatile, Durability::TransientLocal][durability],
                depth: depth as u8,
            })
        })
        .collect();
    assert_eq!(all.len(), 2 * count, "{lines}");
    all.chunks_exact(2).map(|pair| [pair[0], pair[1]]).collect()
}

/// Returns a file with these elements as the profiles `L::P0`, `L::P1`, …
fn flat_file(profiles: &[String]) -> String {
    let profiles = profiles.iter().enumerate();
    let one =
        |(index, elements)| format!("<qos_profile name=\"P{index}\">\n{elements}</qos_profile>\n");
    library(&profiles.map(one).collect::<String>())
}

/// The shipped profiles, flattened by hand: Cyclone DDS 11.0.1 reads `base_name` and ignores it.
const FLAT_SOC: [[Values; 2]; 2] = {
    let d_5 = [Some(1), Some(1), Some(3), None, None];
    let newest = [Some(1), Some(1), Some(1), None, None];
    [[d_5, d_5], [newest, d_5]]
};

/// Cyclone DDS gives the shipped profiles and the standard's defaults the same values as we.
#[test]
fn cyclone_reads_the_shipped_profiles_alike() {
    if !cyclone_or_skip("cyclone_reads_the_shipped_profiles_alike") {
        return;
    }
    let soc =
        FLAT_SOC.map(|[reader, writer]| element(false, "", &reader) + &element(true, "", &writer));
    let text = flat_file(&soc);
    let profiles = Profiles::load(SOC, "soc.xml").unwrap();
    let ours = ["Tandem::Soc", "Tandem::SocNewest"].map(|name| {
        [
            profiles.reader(name, "T").ok(),
            profiles.writer(name, "T").ok(),
        ]
    });
    assert_eq!(cyclone(&text, 2), ours);

    let defaults = load(DEFAULTS);
    let ours = [
        defaults.reader("L::P", "T").ok(),
        defaults.writer("L::P", "T").ok(),
    ];
    let text = DEFAULTS.replace("name=\"P\" is_default_qos=\"true\"", "name=\"P0\"");
    assert_eq!(cyclone(&text, 1), [ours]);
}

/// Returns whether we refuse limits that Cyclone DDS accepts: a depth above `max_samples`.
fn are_refused_by_us_alone(values: Values) -> bool {
    let [_, _, depth, max_samples, max_samples_per_instance] = values;
    let is_limited = |limit: Option<usize>| limit.is_some_and(|limit| limit > 0);
    is_limited(max_samples) && !is_limited(max_samples_per_instance) && depth > max_samples
}

/// Cyclone DDS gives 200 flattened profiles the values that we give the layered ones, and refuses
/// the same limits.
#[test]
fn cyclone_reads_flattened_profiles_alike() {
    if !cyclone_or_skip("cyclone_reads_flattened_profiles_alike") {
        return;
    }
    let mut flat: Vec<[Values; 2]> = Vec::new();
    let mut ours = Vec::new();
    for model in models(1_000) {
        if flat.len() == 150 {
            break;
        }
        let Ok(profiles) = Profiles::load(&layered_file(&model), "p.xml") else {
            continue;
        };
        let at = flat.len() % model.len();
        let topic = TOPICS[flat.len() % TOPICS.len()];
        if let (Some(reader), Some(writer)) = (
            flattened(&model, at, (false, topic)),
            flattened(&model, at, (true, topic)),
        ) {
            flat.push([reader, writer]);
            ours.push([false, true].map(|is_writer| lookup(&profiles, at, (is_writer, topic))));
        }
    }
    // Further ones without layers, of which many do not fit together.
    let mut runner = TestRunner::deterministic();
    while flat.len() < 200 {
        let values = values().new_tree(&mut runner).unwrap().current();
        let one = |is_writer| {
            let text = flat_file(&[element(is_writer, "", &values)]);
            let profiles = Profiles::load(&text, "p.xml").ok()?;
            lookup(&profiles, 0, (is_writer, "T"))
        };
        flat.push([values; 2]);
        ours.push([one(false), one(true)]);
    }
    let files: Vec<String> = flat
        .iter()
        .map(|[reader, writer]| element(false, "", reader) + &element(true, "", writer))
        .collect();
    let theirs = cyclone(&flat_file(&files), files.len());
    let mut refused = 0;
    for (index, (theirs, ours)) in theirs.iter().zip(&ours).enumerate() {
        for end in 0..2 {
            if are_refused_by_us_alone(flat[index][end]) {
                assert!(
                    ours[end].is_none() && theirs[end].is_some(),
                    "{}",
                    files[index]
                );
            } else {
                assert_eq!(theirs[end], ours[end], "{}", files[index]);
                refused += u32::from(ours[end].is_none());
            }
        }
    }
    assert!((5..200).contains(&refused), "{refused}");
}
