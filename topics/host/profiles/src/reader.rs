//! Reads the elements of a document into profiles, and says where it is wrong.

use std::collections::BTreeMap;

use roxmltree::{Attribute, Document, Node};

use super::policies::{Items, Key, Kind, MOST, Refusal, Rule, Set};
use super::{Base, Entity, Profile, ProfileError, Source};

/// Largest accepted number of profiles and elements in them: each profile is checked with each.
const ELEMENTS_MAX: usize = 1_000;
/// Longest text that an error quotes, in characters.
const QUOTED_MAX: usize = 60;
/// Elements of the other building blocks of the standard, which a file may have beside libraries.
const OTHER_BLOCKS: [&str; 5] = [
    "types",
    "domain_library",
    "domain_participant_library",
    "participant_library",
    "application_library",
];

type Result<T> = core::result::Result<T, ProfileError>;

/// Reads the profiles of a document, by their full names. Bases are not followed.
pub(super) fn read(source: &Source, document: &Document<'_>) -> Result<BTreeMap<String, Profile>> {
    let root = document.root_element();
    let mut reader = Reader {
        source,
        profiles: BTreeMap::new(),
        elements: 0,
    };
    match name_of(root) {
        "dds" => {
            reader.check_attributes(root, &["version"])?;
            for node in reader.elements(root)? {
                match name_of(node) {
                    "qos_library" => reader.library(node)?,
                    "qos_profile" => reader.profile(node, "")?,
                    name if OTHER_BLOCKS.contains(&name) => {}
                    _ => return Err(reader.unknown(node, ["qos_library"])),
                }
            }
        }
        "qos_library" => reader.library(root)?,
        _ => return Err(reader.unknown(root, ["dds", "qos_library"])),
    }
    if reader.profiles.is_empty() {
        return Err(reader.wrong(root, "no profile", "a <qos_profile> in a <qos_library>"));
    }
    Ok(reader.profiles)
}

struct Reader<'a> {
    source: &'a Source,
    profiles: BTreeMap<String, Profile>,
    /// How many profiles and elements in them were read.
    elements: usize,
}

type Element<'a, 'input> = Node<'a, 'input>;

impl Reader<'_> {
    fn library(&mut self, node: Element<'_, '_>) -> Result<()> {
        self.check_attributes(node, &["name"])?;
        let library = self.own_name(node)?;
        for child in self.elements(node)? {
            if name_of(child) == "qos_profile" {
                self.profile(child, &library)?;
            } else if Kind::of(name_of(child)).is_some() {
                // A profile with this element alone. (7.3.2.4.4)
                let full = full(&library, &self.own_name(child)?);
                let mut entity = self.entity(child, &library, &["name", "base_name"])?;
                let base = entity.base.take();
                entity.name = None;
                self.add(child, full, base, vec![entity])?;
            } else {
                let expected = ["qos_profile"].into_iter().chain(Kind::ELEMENTS);
                return Err(self.unknown(child, expected));
            }
        }
        Ok(())
    }

    fn profile(&mut self, node: Element<'_, '_>, library: &str) -> Result<()> {
        let attributes = [
            "name",
            "base_name",
            // Other tools use a profile without being told its name. Here it is always told.
            "is_default_qos",
            "is_default_participant_factory_profile",
        ];
        self.check_attributes(node, &attributes)?;
        let full = full(library, &self.own_name(node)?);
        let base = self.base(node, library)?;
        let mut entities: Vec<Entity> = Vec::new();
        for child in self.elements(node)? {
            let entity = self.entity(child, library, &["name", "base_name", "topic_filter"])?;
            let is_same = |one: &Entity| {
                one.filter.is_none() && (one.kind, &one.name) == (entity.kind, &entity.name)
            };
            if entity.filter.is_none() && entities.iter().any(is_same) {
                let found = format!("a second <{}> without topic_filter", name_of(child));
                return Err(self.wrong(child, found, "a topic_filter that tells them apart"));
            }
            entities.push(entity);
        }
        self.add(node, full, base, entities)
    }

    fn add(
        &mut self,
        node: Element<'_, '_>,
        full: String,
        base: Option<Base>,
        entities: Vec<Entity>,
    ) -> Result<()> {
        self.elements += 1 + entities.len();
        if self.elements > ELEMENTS_MAX {
            let found = format!("more than {ELEMENTS_MAX} profiles and elements in them");
            return Err(self.wrong(node, found, "fewer, in several files"));
        }
        if self.profiles.contains_key(&full) {
            let found = format!("a second profile {full}");
            return Err(self.wrong(node, found, "a name that no other profile has"));
        }
        self.profiles.insert(full, Profile { base, entities });
        Ok(())
    }

    fn entity(&self, node: Element<'_, '_>, library: &str, attributes: &[&str]) -> Result<Entity> {
        let Some(kind) = Kind::of(name_of(node)) else {
            return Err(self.unknown(node, Kind::ELEMENTS));
        };
        self.check_attributes(node, attributes)?;
        let name = match node.attribute("name") {
            Some(_) => Some(self.own_name(node)?),
            None => None,
        };
        let filter = match node.attribute_node("topic_filter") {
            Some(filter) => {
                let expected = "letters, digits, '/', '_', '.', ':', '-', ' ' and '*'";
                Some(self.word(&filter, "/_.:- *", expected)?)
            }
            None => None,
        };
        Ok(Entity {
            kind,
            name,
            filter,
            base: self.base(node, library)?,
            items: self.items(node, kind)?,
        })
    }

    fn items(&self, node: Element<'_, '_>, kind: Kind) -> Result<Items> {
        let mut items = Items::default();
        let mut before = Vec::new();
        for policy in self.elements(node)? {
            let rows: Vec<_> = kind.rows().filter(|row| row.0 == name_of(policy)).collect();
            if rows.is_empty() {
                let mut policies: Vec<_> = kind.rows().map(|row| row.0).collect();
                policies.dedup();
                return Err(self.unknown(policy, policies));
            }
            self.check_plain(policy, &mut before)?;
            let mut before = Vec::new();
            for item in self.elements(policy)? {
                let Some((policy, name, _, rule)) = rows.iter().find(|row| row.1 == name_of(item))
                else {
                    return Err(self.unknown(item, rows.iter().map(|row| row.1)));
                };
                self.check_plain(item, &mut before)?;
                let value = match rule {
                    Rule::Time(_) => self.time(item, *rule)?,
                    _ => self.value(item, *rule)?,
                };
                if let Some(key) = Key::of(policy, name) {
                    let at = item.range().start;
                    items.set(key, Set { value, at });
                }
            }
        }
        Ok(items)
    }

    /// Reads an element that has no elements.
    fn value(&self, node: Element<'_, '_>, rule: Rule) -> Result<u32> {
        let element = node.children().find(Node::is_element);
        let (found, value) = match (element, rule) {
            (None, _) => {
                let texts = node.children().filter(Node::is_text);
                let text: String = texts.filter_map(|text| text.text()).collect();
                (quoted(text.trim()), rule.read(text.trim()))
            }
            (Some(element), Rule::Empty) => {
                (format!("<{}>", name_of(element)), Err(Refusal::Unsupported))
            }
            (Some(element), _) => {
                let found = format!("<{}>", name_of(element));
                return Err(self.wrong(element, found, "a text"));
            }
        };
        value.map_err(|refusal| self.refused(node, &found, refusal, rule))
    }

    /// Reads a time. Its value has no effect.
    fn time(&self, node: Element<'_, '_>, rule: Rule) -> Result<u32> {
        let (mut sec, mut nanosec) = (0, 0);
        let mut before = Vec::new();
        for part in self.elements(node)? {
            match name_of(part) {
                "sec" => sec = self.value(part, Rule::Sec)?,
                "nanosec" => nanosec = self.value(part, Rule::Nanosec)?,
                _ => return Err(self.unknown(part, ["sec", "nanosec"])),
            }
            self.check_plain(part, &mut before)?;
        }
        if before.is_empty() {
            return Err(self.wrong(node, "no time", "<sec>, <nanosec> or both"));
        }
        let time = match (sec, nanosec) {
            (MOST, _) | (_, MOST) => (MOST, MOST),
            time => time,
        };
        match rule {
            Rule::Time(Some(only)) if time != only => {
                let found = Rule::Time(Some(time)).to_string();
                Err(self.refused(node, &found, Refusal::Unsupported, rule))
            }
            _ => Ok(0),
        }
    }

    fn refused(
        &self,
        node: Element<'_, '_>,
        value: &str,
        refusal: Refusal,
        rule: Rule,
    ) -> ProfileError {
        let found = match refusal {
            Refusal::Wrong => value.to_owned(),
            Refusal::Unsupported => format!("{value}, which the participant does not support"),
        };
        self.wrong(node, found, rule.to_string())
    }

    /// Returns the base that an element names.
    fn base(&self, node: Element<'_, '_>, library: &str) -> Result<Option<Base>> {
        let Some(attribute) = node.attribute_node("base_name") else {
            return Ok(None);
        };
        let expected = "the name of a profile, as in Library::Profile";
        let name = self.word(&attribute, "_.-:", expected)?;
        let name = match name.strip_prefix("::") {
            Some(from_root) => from_root.to_owned(),
            None if name.contains("::") => name,
            None => full(library, &name),
        };
        let at = attribute.range().start;
        Ok(Some(Base { name, at }))
    }

    /// Returns the attribute `name` of an element.
    fn own_name(&self, node: Element<'_, '_>) -> Result<String> {
        let Some(name) = node.attribute_node("name") else {
            return Err(self.wrong(node, "no name", "the attribute name=\"…\""));
        };
        self.word(&name, "_.-", "letters, digits, '_', '.' and '-'")
    }

    /// Returns the value of an attribute: letters, digits, and these other characters.
    fn word(&self, attribute: &Attribute<'_, '_>, others: &str, expected: &str) -> Result<String> {
        let word = attribute.value().trim();
        let is_fine = |one: char| one.is_ascii_alphanumeric() || others.contains(one);
        if word.is_empty() || !word.chars().all(is_fine) {
            let found = format!("{}={}", attribute.name(), quoted(word));
            return Err(self.source.wrong(attribute.range().start, found, expected));
        }
        Ok(word.to_owned())
    }

    /// Refuses attributes that an element does not have. Those of other namespaces are not ours.
    fn check_attributes(&self, node: Element<'_, '_>, names: &[&str]) -> Result<()> {
        let mut own = node.attributes().filter(|one| one.namespace().is_none());
        let Some(unknown) = own.find(|one| !names.contains(&one.name())) else {
            return Ok(());
        };
        let found = format!("the attribute {:?}", unknown.name());
        let expected = match names {
            [] => "no attribute".to_owned(),
            names => format!("one of {}", names.join(", ")),
        };
        Err(self.source.wrong(unknown.range().start, found, expected))
    }

    /// Refuses an element that has attributes, or stands there for the second time.
    fn check_plain<'n>(&self, node: Element<'_, 'n>, before: &mut Vec<&'n str>) -> Result<()> {
        self.check_attributes(node, &[])?;
        let name = node.tag_name().name();
        if before.contains(&name) {
            let found = format!("a second <{name}>");
            return Err(self.wrong(node, found, "one"));
        }
        before.push(name);
        Ok(())
    }

    /// Returns the elements in an element that has no text.
    fn elements<'a, 'input>(&self, node: Element<'a, 'input>) -> Result<Vec<Element<'a, 'input>>> {
        let texts = node
            .children()
            .filter_map(|child| child.text().filter(|_| child.is_text()));
        if let Some(text) = texts.map(str::trim).find(|text| !text.is_empty()) {
            return Err(self.wrong(node, format!("the text {}", quoted(text)), "elements"));
        }
        Ok(node.children().filter(Node::is_element).collect())
    }

    fn unknown<'n>(
        &self,
        node: Element<'_, '_>,
        names: impl IntoIterator<Item = &'n str>,
    ) -> ProfileError {
        let names: Vec<String> = names.into_iter().map(|name| format!("<{name}>")).collect();
        let found = format!("<{}>", name_of(node));
        self.wrong(node, found, names.join(" or "))
    }

    fn wrong(
        &self,
        node: Element<'_, '_>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> ProfileError {
        self.source.wrong(node.range().start, found, expected)
    }
}

fn name_of<'a>(node: Element<'a, '_>) -> &'a str {
    node.tag_name().name()
}

/// Returns a text in quotation marks, and no more than its beginning.
fn quoted(text: &str) -> String {
    match text.char_indices().nth(QUOTED_MAX) {
        Some((end, _)) => format!("{:?}…", &text[..end]),
        None => format!("{text:?}"),
    }
}

/// Returns the full name of a profile.
fn full(library: &str, name: &str) -> String {
    match library {
        "" => name.to_owned(),
        library => format!("{library}::{name}"),
    }
}
