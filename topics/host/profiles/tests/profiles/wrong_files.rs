//! What is accepted, and what each wrong file is told.

use tandem_qos_profiles::{FILE_MAX, LookupError, Profiles};
use tandem_topics::{Qos, Reliability};

use crate::{READER, WRITER, library, load};

/// Returns a file with these policies in the writer of the profile `P`; they begin in line 5.
fn writer(policies: &str) -> String {
    library(&format!(
        "<qos_profile name=\"P\">\n<datawriter_qos>\n{policies}\n</datawriter_qos>\n</qos_profile>"
    ))
}

/// What no layer sets has the default of the standard. `<topic_qos>` has no effect.
#[test]
fn unset_items_have_the_defaults_of_the_standard() {
    let elements = [
        "",
        "<datawriter_qos/><datareader_qos/>",
        "<datawriter_qos><reliability/><durability/><history/></datawriter_qos>",
        "<topic_qos><history><depth>9</depth></history></topic_qos>",
        "<participant_qos/><domain_participant_qos name=\"N\"/>",
    ];
    for elements in elements {
        let text = library(&format!("<qos_profile name=\"P\">{elements}</qos_profile>"));
        let profiles = load(&text);
        assert_eq!(profiles.writer("L::P", "T").unwrap(), WRITER, "{elements}");
        assert_eq!(profiles.reader("L::P", "T").unwrap(), READER, "{elements}");
    }
}

/// A value may be written in each of the ways that the standard and other tools have.
#[test]
fn values_are_read_as_others_write_them() {
    let accepted = [
        "<history><depth> 0x3 </depth></history>",
        "<history><depth><!-- few -->3<!-- samples --></depth></history>",
        "<history><!-- few --><depth><![CDATA[3]]></depth></history>",
        "<history><depth>3</depth></history><user_data><value></value></user_data>",
        "<history><depth>3</depth></history>\
         <resource_limits><max_samples>3</max_samples><max_instances>0xFF</max_instances>\
         <max_samples_per_instance>3</max_samples_per_instance>\
         <initial_samples>3</initial_samples></resource_limits>",
        "<history><depth>3</depth></history>\
         <deadline><period><sec>DURATION_INFINITY</sec></period></deadline>",
        "<history><depth>3</depth></history>\
         <deadline><period><nanosec>DURATION_INFINITE_NSEC</nanosec></period></deadline>",
        "<history><depth>3</depth></history><latency_budget><duration>\
         <sec>DURATION_ZERO_SEC</sec><nanosec>DURATION_ZERO_NSEC</nanosec>\
         </duration></latency_budget>",
        "<history><depth>3</depth></history>\
         <reliability><max_blocking_time><sec>7</sec></max_blocking_time></reliability>",
    ];
    for policies in accepted {
        let qos = load(&writer(policies)).writer("L::P", "T").unwrap();
        assert_eq!(qos, Qos { depth: 3, ..WRITER }, "{policies}");
    }
}

/// Returns a `<datawriter_qos>` with this depth and these attributes.
fn depth(depth: u8, attributes: &str) -> String {
    format!(
        "<datawriter_qos {attributes}><history><depth>{depth}</depth></history></datawriter_qos>"
    )
}

/// The root, libraries and names may be written in each of the ways that tools have.
#[test]
fn profiles_are_found_by_their_names() {
    let three = depth(3, "");
    let files = [
        (
            library(&format!("<qos_profile name=\"P\">{three}</qos_profile>")),
            "L::P",
        ),
        // The root of the standard's own example. (DDS-XML 1.0, 7.3.2.3)
        (
            format!(
                "<qos_library xmlns=\"http://www.omg.org/spec/DDS-XML\" name=\"L\">\
                 <qos_profile name=\"P\">{three}</qos_profile></qos_library>"
            ),
            "L::P",
        ),
        // DDS4CCM has no libraries.
        (
            format!("<dds><qos_profile name=\"P\">{three}</qos_profile></dds>"),
            "P",
        ),
        // A profile with one element. (7.3.2.4.4)
        (library(&depth(3, "name=\"P\"")), "L::P"),
        // An element with a name, as in Cyclone DDS.
        (
            library(&format!(
                "<qos_profile name=\"P\">{}{}</qos_profile>",
                depth(5, ""),
                depth(3, "name=\"N\"")
            )),
            "L::P::N",
        ),
        (
            format!(
                "<?xml version=\"1.0\"?><!-- Here. --><d:dds xmlns:d=\"urn:x\" version=\"7.3.0\" \
                 xmlns:xsi=\"urn:y\" xsi:schemaLocation=\"z\"><types/><d:qos_library name=\"L\">\
                 <qos_profile name=\"P\">{three}</qos_profile></d:qos_library></d:dds>"
            ),
            "L::P",
        ),
    ];
    for (text, name) in files {
        assert_eq!(load(&text).writer(name, "T").unwrap().depth, 3, "{text}");
    }
}

/// A base is found before and after its profile, in its own library and in others, below a profile
/// and below an element. The base of an element takes the place of that of the profile.
#[test]
fn bases_are_followed() {
    let text = format!(
        "<dds><qos_library name=\"L\">\
         <qos_profile name=\"Bare\" base_name=\"Base\"/>\
         <qos_profile name=\"Full\" base_name=\"L::Base\"/>\
         <qos_profile name=\"Rooted\" base_name=\"::L::Base\"/>\
         <qos_profile name=\"Far\" base_name=\"M::Base\"/>\
         <qos_profile name=\"Element\" base_name=\"Base\">\
         <datawriter_qos base_name=\"M::Base\"/></qos_profile>\
         <datawriter_qos name=\"Single\" base_name=\"M::Base\"/>\
         <qos_profile name=\"Base\">{}</qos_profile></qos_library>\
         <qos_library name=\"M\"><qos_profile name=\"Base\" base_name=\"Root\">{}</qos_profile>\
         <qos_profile name=\"Root\"><datawriter_qos><reliability>\
         <kind>BEST_EFFORT_RELIABILITY_QOS</kind></reliability></datawriter_qos></qos_profile>\
         </qos_library></dds>",
        depth(3, ""),
        depth(5, ""),
    );
    let profiles = load(&text);
    let near = Qos { depth: 3, ..WRITER };
    let far = Qos {
        depth: 5,
        reliability: Reliability::BestEffort,
        ..WRITER
    };
    let expected = [
        ("L::Bare", near),
        ("L::Full", near),
        ("L::Rooted", near),
        ("L::Far", far),
        ("L::Element", far),
        ("L::Single", far),
        ("M::Base", far),
    ];
    for (name, qos) in expected {
        assert_eq!(profiles.writer(name, "T").unwrap(), qos, "{name}");
    }
}

/// The first element whose filter matches is selected, else the one without a filter. The same
/// holds in a base. (DDS-XML 1.0, 7.3.2.4.3)
#[test]
fn filters_select_an_element() {
    let text = library(&format!(
        "<qos_profile name=\"P\">{}{}{}{}</qos_profile>\
         <qos_profile name=\"Derived\" base_name=\"P\">{}</qos_profile>",
        depth(2, ""),
        depth(3, "topic_filter=\"A*\""),
        depth(4, "topic_filter=\"*a*b*\""),
        depth(5, "topic_filter=\"A*b\""),
        depth(6, "topic_filter=\"Aa\""),
    ));
    let profiles = load(&text);
    let expected = [
        ("T", 2, 2),
        ("A", 3, 3),
        ("Aab", 3, 3),
        ("Aa", 3, 6),
        ("xaxb", 4, 4),
        ("ab", 4, 4),
        ("ba", 2, 2),
        ("", 2, 2),
    ];
    for (topic, own, derived) in expected {
        assert_eq!(
            profiles.writer("L::P", topic).unwrap().depth,
            own,
            "{topic}"
        );
        let qos = profiles.writer("L::Derived", topic).unwrap();
        assert_eq!(qos.depth, derived, "{topic}");
    }
}

/// A profile that is not there is told with those that are.
#[test]
fn lookups_tell_what_there_is() {
    let profiles = load(&library(
        "<qos_profile name=\"P\"/><qos_profile name=\"Q\"/>",
    ));
    for name in ["P", "L", "L::X", "L::P::N", "M::P", ""] {
        let error = profiles.writer(name, "T").unwrap_err();
        let message = format!("p.xml has no profile {name:?}; it has L::P, L::Q");
        assert_eq!(error.to_string(), message);
    }
}

/// Layers that meet for one topic alone are checked when this topic is asked for.
#[test]
fn layers_of_one_topic_are_checked() {
    let limits = "<resource_limits><max_samples>2</max_samples></resource_limits>";
    let text = library(&format!(
        "<qos_profile name=\"Base\">\n{}\n</qos_profile>\n\
         <qos_profile name=\"P\" base_name=\"Base\">\n\
         <datawriter_qos topic_filter=\"*B\">{limits}</datawriter_qos>\n</qos_profile>",
        depth(3, "topic_filter=\"A*\"")
    ));
    let profiles = load(&text);
    assert_eq!(profiles.writer("L::P", "A").unwrap().depth, 3);
    assert_eq!(profiles.writer("L::P", "B").unwrap().depth, 1);
    let error = profiles.writer("L::P", "AB").unwrap_err();
    assert_eq!(
        error.to_string(),
        "p.xml:4:44: dds/qos_library[L]/qos_profile[Base]/datawriter_qos/history/depth: found 3 in \
         the layers of L::P; expected at most 2, the max_samples of line 7"
    );
    assert!(matches!(error, LookupError::Wrong(_)));
}

/// A wrong policy in the writer, the column of what is wrong, its element, and what is said.
const WRONG_POLICIES: &[(&str, u32, &str, &str)] = &[
    (
        "<history><kind>KEEP_ALL_HISTORY_QOS</kind></history>",
        10,
        "history/kind",
        "found \"KEEP_ALL_HISTORY_QOS\", which the participant does not support; expected \
         KEEP_LAST_HISTORY_QOS",
    ),
    (
        "<history><kind>KEEP_LAST</kind></history>",
        10,
        "history/kind",
        "found \"KEEP_LAST\"; expected KEEP_LAST_HISTORY_QOS",
    ),
    (
        "<durability><kind>PERSISTENT_DURABILITY_QOS</kind></durability>",
        13,
        "durability/kind",
        "found \"PERSISTENT_DURABILITY_QOS\", which the participant does not support; expected \
         VOLATILE_DURABILITY_QOS or TRANSIENT_LOCAL_DURABILITY_QOS",
    ),
    (
        "<reliability><kind></kind></reliability>",
        14,
        "reliability/kind",
        "found \"\"; expected BEST_EFFORT_RELIABILITY_QOS or RELIABLE_RELIABILITY_QOS",
    ),
    (
        "<history><depth>0</depth></history>",
        10,
        "history/depth",
        "found \"0\"; expected a whole number, 1 to 255",
    ),
    (
        "<history><depth>256</depth></history>",
        10,
        "history/depth",
        "found \"256\", which the participant does not support; expected a whole number, 1 to 255",
    ),
    (
        "<history><depth>3.0</depth></history>",
        10,
        "history/depth",
        "found \"3.0\"; expected a whole number, 1 to 255",
    ),
    (
        "<history><depth>3</depth><depth>3</depth></history>",
        26,
        "history/depth",
        "found a second <depth>; expected one",
    ),
    (
        "<history/><durability/><history/>",
        24,
        "history",
        "found a second <history>; expected one",
    ),
    (
        "<history><depht>3</depht></history>",
        10,
        "history/depht",
        "found <depht>; expected <kind> or <depth>",
    ),
    (
        "<history>KEEP_LAST_HISTORY_QOS</history>",
        1,
        "history",
        "found the text \"KEEP_LAST_HISTORY_QOS\"; expected elements",
    ),
    (
        "<history><depth><value>3</value></depth></history>",
        17,
        "history/depth/value",
        "found <value>; expected a text",
    ),
    (
        "<history depth=\"3\"/>",
        10,
        "history",
        "found the attribute \"depth\"; expected no attribute",
    ),
    (
        "<history><depth unit=\"1\">3</depth></history>",
        17,
        "history/depth",
        "found the attribute \"unit\"; expected no attribute",
    ),
    (
        "<time_based_filter/>",
        1,
        "time_based_filter",
        "found <time_based_filter>; expected <reliability> or <durability> or <history> or \
         <resource_limits> or <durability_service> or <deadline> or <latency_budget> or <lifespan> \
         or <liveliness> or <ownership> or <ownership_strength> or <destination_order> or \
         <transport_priority> or <writer_data_lifecycle> or <user_data>",
    ),
    (
        "<resource_limits><max_samples>-1</max_samples></resource_limits>",
        18,
        "resource_limits/max_samples",
        "found \"-1\"; expected a whole number, 1 to 2147483647, or LENGTH_UNLIMITED",
    ),
    (
        "<resource_limits><max_instances>2147483648</max_instances></resource_limits>",
        18,
        "resource_limits/max_instances",
        "found \"2147483648\"; expected a whole number, 1 to 2147483647, or LENGTH_UNLIMITED",
    ),
    (
        "<deadline><period><sec>1</sec><nanosec>500</nanosec></period></deadline>",
        11,
        "deadline/period",
        "found 1 s and 500 ns, which the participant does not support; expected an infinite time \
         (DURATION_INFINITE_SEC)",
    ),
    (
        "<latency_budget><duration><sec>2</sec></duration></latency_budget>",
        17,
        "latency_budget/duration",
        "found 2 s, which the participant does not support; expected 0 s",
    ),
    (
        "<lifespan><duration/></lifespan>",
        11,
        "lifespan/duration",
        "found no time; expected <sec>, <nanosec> or both",
    ),
    (
        "<reliability><max_blocking_time><sec>-1</sec></max_blocking_time></reliability>",
        33,
        "reliability/max_blocking_time/sec",
        "found \"-1\"; expected seconds, 0 to 2147483647, or DURATION_INFINITE_SEC",
    ),
    (
        "<reliability><max_blocking_time><nanosec>1000000000</nanosec></max_blocking_time>\
         </reliability>",
        33,
        "reliability/max_blocking_time/nanosec",
        "found \"1000000000\"; expected nanoseconds, 0 to 999999999, or DURATION_INFINITE_NSEC",
    ),
    (
        "<reliability><max_blocking_time><ms>1</ms></max_blocking_time></reliability>",
        33,
        "reliability/max_blocking_time/ms",
        "found <ms>; expected <sec> or <nanosec>",
    ),
    (
        "<reliability><max_blocking_time><sec>1</sec><sec>1</sec></max_blocking_time>\
         </reliability>",
        45,
        "reliability/max_blocking_time/sec",
        "found a second <sec>; expected one",
    ),
    (
        "<liveliness><kind>MANUAL_BY_TOPIC_LIVELINESS_QOS</kind></liveliness>",
        13,
        "liveliness/kind",
        "found \"MANUAL_BY_TOPIC_LIVELINESS_QOS\", which the participant does not support; \
         expected AUTOMATIC_LIVELINESS_QOS",
    ),
    (
        "<ownership><kind>EXCLUSIVE_OWNERSHIP_QOS</kind></ownership>",
        12,
        "ownership/kind",
        "found \"EXCLUSIVE_OWNERSHIP_QOS\", which the participant does not support; expected \
         SHARED_OWNERSHIP_QOS",
    ),
    (
        "<ownership_strength><value>7</value></ownership_strength>",
        21,
        "ownership_strength/value",
        "found \"7\", which the participant does not support; expected 0",
    ),
    (
        "<durability_service><history_depth>3</history_depth></durability_service>",
        21,
        "durability_service/history_depth",
        "found \"3\", which the participant does not support; expected 1",
    ),
    (
        "<durability_service><max_samples>3</max_samples></durability_service>",
        21,
        "durability_service/max_samples",
        "found \"3\", which the participant does not support; expected LENGTH_UNLIMITED",
    ),
    (
        "<writer_data_lifecycle><autodispose_unregistered_instances>false\
         </autodispose_unregistered_instances></writer_data_lifecycle>",
        24,
        "writer_data_lifecycle/autodispose_unregistered_instances",
        "found \"false\", which the participant does not support; expected true or 1",
    ),
    (
        "<writer_data_lifecycle><autodispose_unregistered_instances>True\
         </autodispose_unregistered_instances></writer_data_lifecycle>",
        24,
        "writer_data_lifecycle/autodispose_unregistered_instances",
        "found \"True\"; expected true or 1",
    ),
    (
        "<user_data><value>1, 2</value></user_data>",
        12,
        "user_data/value",
        "found \"1, 2\", which the participant does not support; expected nothing",
    ),
    (
        "<history><depth>4</depth></history> <resource_limits>\n\
         <max_samples_per_instance>3</max_samples_per_instance></resource_limits>",
        10,
        "history/depth",
        "found 4 in the layers of L::P; expected at most 3, the max_samples_per_instance of line 6",
    ),
    (
        "<resource_limits><max_samples_per_instance>3</max_samples_per_instance>\n\
         <max_samples>2</max_samples></resource_limits>",
        18,
        "resource_limits/max_samples_per_instance",
        "found 3 in the layers of L::P; expected at most 2, the max_samples of line 6",
    ),
];

#[test]
fn wrong_policies_are_told() {
    for (policies, column, element, says) in WRONG_POLICIES {
        let error = Profiles::load(&writer(policies), "p.xml").unwrap_err();
        let above = "dds/qos_library[L]/qos_profile[P]/datawriter_qos";
        let message = format!("p.xml:5:{column}: {above}/{element}: {says}");
        assert_eq!(error.to_string(), message, "{policies}");
    }
}

/// An error quotes the beginning of a long text, and names the first profiles.
#[test]
fn errors_are_short() {
    let error = Profiles::load(&library(&"é".repeat(1_000)), "p.xml").unwrap_err();
    assert!(error.to_string().len() < 300, "{error}");
    let one = |index| format!("<qos_profile name=\"P{index}\"/>");
    let profiles = load(&library(&(10..30).map(one).collect::<String>()));
    assert_eq!(
        profiles.writer("P", "T").unwrap_err().to_string(),
        "p.xml has no profile \"P\"; it has L::P10, L::P11, L::P12, L::P13, L::P14, L::P15, \
         L::P16, L::P17, L::P18, L::P19, …"
    );
}

/// A wrong library from line 3 on, where it is wrong, its element in the library, and what is said.
const WRONG_LIBRARIES: &[(&str, &str, &str, &str)] = &[
    (
        "<qos_profile/>",
        "3:1",
        "/qos_profile",
        "found no name; expected the attribute name=\"…\"",
    ),
    (
        "<qos_profile name=\"\"/>",
        "3:14",
        "/qos_profile[]",
        "found name=\"\"; expected letters, digits, '_', '.' and '-'",
    ),
    (
        "<qos_profile name=\"A::B\"/>",
        "3:14",
        "/qos_profile[A::B]",
        "found name=\"A::B\"; expected letters, digits, '_', '.' and '-'",
    ),
    (
        "<qos_profile name=\"P\" basename=\"Q\"/>",
        "3:23",
        "/qos_profile[P]",
        "found the attribute \"basename\"; expected one of name, base_name, is_default_qos, \
         is_default_participant_factory_profile",
    ),
    (
        "<qos_profile name=\"P\"/>\n<qos_profile name=\"P\"/>",
        "4:1",
        "/qos_profile[P]",
        "found a second profile L::P; expected a name that no other profile has",
    ),
    (
        "<qos_profile name=\"P\"/>\n\n<qos_profile name=\"Q\"\nbase_name=\"X\"/>",
        "6:1",
        "/qos_profile[Q]",
        "found the base \"L::X\", which is not in this file; expected one of L::P, L::Q",
    ),
    (
        "<qos_profile name=\"P\"><topic_qos base_name=\"X::Y\"/></qos_profile>",
        "3:34",
        "/qos_profile[P]/topic_qos",
        "found the base \"X::Y\", which is not in this file; expected one of L::P",
    ),
    (
        "<qos_profile name=\"P\" base_name=\"A B\"/>",
        "3:23",
        "/qos_profile[P]",
        "found base_name=\"A B\"; expected the name of a profile, as in Library::Profile",
    ),
    (
        "<qos_profile name=\"P\" base_name=\"P\"/>",
        "3:23",
        "/qos_profile[P]",
        "found a circle of bases: L::P, L::P; expected a base that does not lead back to where it \
         is named",
    ),
    (
        "<qos_profile name=\"A\" base_name=\"B\"/>\n<qos_profile name=\"B\" base_name=\"C\"/>\n\
         <qos_profile name=\"C\" base_name=\"B\"/>",
        "5:23",
        "/qos_profile[C]",
        "found a circle of bases: L::B, L::C, L::B; expected a base that does not lead back to \
         where it is named",
    ),
    (
        "<qos_profile name=\"A\"><datareader_qos topic_filter=\"T\" base_name=\"B\"/>\
         </qos_profile>\n\
         <qos_profile name=\"B\" base_name=\"A\"/>",
        "4:23",
        "/qos_profile[B]",
        "found a circle of bases: L::A, L::B, L::A; expected a base that does not lead back to \
         where it is named",
    ),
    (
        "<qos_profile name=\"P\"><datawriter_qos/>\n<datawriter_qos/></qos_profile>",
        "4:1",
        "/qos_profile[P]/datawriter_qos",
        "found a second <datawriter_qos> without topic_filter; expected a topic_filter that tells \
         them apart",
    ),
    (
        "<qos_profile name=\"P\"><datawriter_qos topic_filter=\"A?\"/></qos_profile>",
        "3:39",
        "/qos_profile[P]/datawriter_qos",
        "found topic_filter=\"A?\"; expected letters, digits, '/', '_', '.', ':', '-', ' ' and '*'",
    ),
    (
        "<datawriter_qos name=\"P\" topic_filter=\"A*\"/>",
        "3:26",
        "/datawriter_qos[P]",
        "found the attribute \"topic_filter\"; expected one of name, base_name",
    ),
    (
        "<datawriter_qos/>",
        "3:1",
        "/datawriter_qos",
        "found no name; expected the attribute name=\"…\"",
    ),
    (
        "<qos_profile name=\"P\"><data_writer/></qos_profile>",
        "3:23",
        "/qos_profile[P]/data_writer",
        "found <data_writer>; expected <datawriter_qos> or <datareader_qos> or <topic_qos> or \
         <publisher_qos> or <subscriber_qos> or <domain_participant_qos>",
    ),
    (
        "<qos_snippet name=\"S\"/>",
        "3:1",
        "/qos_snippet[S]",
        "found <qos_snippet>; expected <qos_profile> or <datawriter_qos> or <datareader_qos> or \
         <topic_qos> or <publisher_qos> or <subscriber_qos> or <domain_participant_qos>",
    ),
    (
        "Profiles: <qos_profile name=\"P\"/>",
        "2:1",
        "",
        "found the text \"Profiles:\"; expected elements",
    ),
    (
        "<qos_profile name=\"P\"><publisher_qos><partition><name><element>A</element></name>\
         </partition></publisher_qos></qos_profile>",
        "3:49",
        "/qos_profile[P]/publisher_qos/partition/name",
        "found <element>, which the participant does not support; expected nothing",
    ),
    (
        "<qos_profile name=\"P\"><participant_qos><history/></participant_qos></qos_profile>",
        "3:40",
        "/qos_profile[P]/participant_qos/history",
        "found <history>; expected <user_data> or <entity_factory>",
    ),
];

#[test]
fn wrong_libraries_are_told() {
    for (elements, place, element, says) in WRONG_LIBRARIES {
        let error = Profiles::load(&library(elements), "p.xml").unwrap_err();
        let message = format!("p.xml:{place}: dds/qos_library[L]{element}: {says}");
        assert_eq!(error.to_string(), message, "{elements}");
    }
}

#[test]
fn wrong_files_are_told() {
    let files = [
        (
            "",
            "p.xml:1:1: not well-formed XML: the document does not have a root node",
        ),
        (
            "<dds>\n<qos_library>\n</dds>",
            "p.xml:3:1: not well-formed XML: expected 'qos_library' tag, not 'dds' at 3:1",
        ),
        (
            "<dds>\n  <qos_library name=\"L\" name=\"M\"/>\n</dds>",
            "p.xml:2:25: not well-formed XML: attribute 'name' at 2:25 is already defined",
        ),
        (
            "<!DOCTYPE dds>\n<dds/>",
            "p.xml:1:1: not well-formed XML: XML with DTD detected",
        ),
        (
            "\n<profiles/>",
            "p.xml:2:1: profiles: found <profiles>; expected <dds> or <qos_library>",
        ),
        (
            "<dds>\n é <profiles/></dds>",
            "p.xml:1:1: dds: found the text \"é\"; expected elements",
        ),
        (
            "<dds>\n<!-- é --> <profiles/></dds>",
            "p.xml:2:12: dds/profiles: found <profiles>; expected <qos_library>",
        ),
        (
            "<dds>\n<qos_library name=\"L\"/>\n<types/></dds>",
            "p.xml:1:1: dds: found no profile; expected a <qos_profile> in a <qos_library>",
        ),
        (
            "<dds><qos_library/></dds>",
            "p.xml:1:6: dds/qos_library: found no name; expected the attribute name=\"…\"",
        ),
        (
            "<dds>\n<qos_library name=\"L\" base_name=\"M\"/></dds>",
            "p.xml:2:23: dds/qos_library[L]: found the attribute \"base_name\"; expected one of \
             name",
        ),
    ];
    for (text, message) in files {
        let error = Profiles::load(text, "p.xml").unwrap_err();
        assert_eq!(error.to_string(), message, "{text}");
    }
}

/// A file that would cost too much is refused.
#[test]
fn large_files_are_refused() {
    let spaces = " ".repeat(FILE_MAX);
    let error = Profiles::load(&library(&spaces), "p.xml").unwrap_err();
    assert_eq!(
        error.to_string(),
        "p.xml: larger than 256 KiB; give a file with profiles alone"
    );
    let attributes: String = (0..101).map(|index| format!(" a{index} = 'b'")).collect();
    let error =
        Profiles::load(&format!("<!-- a='b' -->\n<dds{attributes}/>"), "p.xml").unwrap_err();
    let says = "p.xml:2:1: not well-formed XML: an element has more than 100 attributes";
    assert_eq!(error.to_string(), says);
    let profiles = |count: u32| {
        let one = |index| format!("<qos_profile name=\"P{index}\"/>");
        library(&(0..count).map(one).collect::<String>())
    };
    load(&profiles(1_000));
    let error = Profiles::load(&profiles(1_001), "p.xml").unwrap_err();
    let says =
        "found more than 1000 profiles and elements in them; expected fewer, in several files";
    assert!(error.to_string().ends_with(says), "{error}");
    // Each profile has the next one as its base; the last one has none.
    let chain = |bases: u32| {
        let one = |index| {
            let next = index + 1;
            format!("<qos_profile name=\"P{index}\" base_name=\"P{next}\"/>")
        };
        let above: String = (0..bases).map(one).collect();
        library(&format!("{above}<qos_profile name=\"P{bases}\"/>"))
    };
    load(&chain(32));
    let error = Profiles::load(&chain(33), "p.xml").unwrap_err();
    let says = "found more than 32 bases below \"L::P0\"; expected fewer";
    assert!(error.to_string().ends_with(says), "{error}");
}
