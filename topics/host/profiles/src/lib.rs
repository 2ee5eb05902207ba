//! Quality of service from profiles in DDS-XML: libraries, bases, and items that override others.
//!
//! Format: OMG DDS-XML 1.0, building block QoS (7.3.2), with or without its namespace. What other
//! tools add to it is read as well: `<qos_profile>` without a library, `<participant_qos>`, an
//! element with a name of its own, and a base that the file defines after its use.
//!
//! **Layers.** A profile gives each kind of entity a stack of layers, and the first layer that sets
//! an item decides it:
//!
//! 1. One element of the profile: the first with a `topic_filter` that the topic matches, else the
//!    one without a filter, else none. In a filter, `*` stands for any text.
//! 2. The same in the base: the `base_name` of that element, or, if it has none, of the profile.
//! 3. And so on, from base to base.
//!
//! **Defaults** of the standard (DDS 1.4, 2.2.3), for what no layer sets:
//!
//! | item | writer | reader |
//! |---|---|---|
//! | `reliability/kind` | reliable | best effort |
//! | `durability/kind` | volatile | volatile |
//! | `history/depth` | 1 | 1 |
//! | `resource_limits` | unlimited | unlimited |
//!
//! Policies that the participant does not have are accepted with the default of the standard, and
//! refused with another value. `resource_limits` must allow what `history/depth` asks for.
//! `max_blocking_time` may have any value: a writer that keeps the last samples does not block.
//! `<topic_qos>` is checked and has no effect: writers and readers do not copy it. D-5
#![forbid(unsafe_code)]

use std::collections::{BTreeMap, BTreeSet};

use roxmltree::Document;
use tandem_topics::{Durability, Qos, Reliability};
use thiserror::Error;

mod policies;
mod reader;

use policies::{Items, Key, Kind, UNLIMITED};

/// The profiles that are shipped: `Tandem::Soc` for the topics of a SoC, and one derived from it.
/// D-5
pub const SOC: &str = include_str!("../soc.xml");
/// Largest accepted file, bytes.
pub const FILE_MAX: usize = 256 << 10;
/// Largest accepted number of attributes of an element: the parser compares all pairs.
const ATTRIBUTES_MAX: usize = 100;
/// Largest accepted number of bases below one profile.
const BASES_MAX: usize = 32;
/// Number of profiles that an error names.
const NAMES_MAX: usize = 10;

/// Why a file of profiles cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ProfileError {
    /// The file is larger than any file of profiles.
    #[error("{file}: larger than {most_kib} KiB; give a file with profiles alone")]
    TooLarge {
        /// Name of the file.
        file: String,
        /// KiB
        most_kib: usize,
    },
    /// The file is not well-formed XML.
    #[error("{file}:{line}:{column}: not well-formed XML: {problem}")]
    Xml {
        /// Name of the file.
        file: String,
        /// Counted from 1.
        line: u32,
        /// In characters, counted from 1.
        column: u32,
        /// The error of the XML parser.
        problem: String,
    },
    /// An element or an attribute is wrong.
    #[error("{file}:{line}:{column}: {element}: found {found}; expected {expected}")]
    Element {
        /// Name of the file.
        file: String,
        /// Counted from 1.
        line: u32,
        /// In characters, counted from 1.
        column: u32,
        /// Where it stands: the elements around it and itself, with their names in brackets.
        element: String,
        /// What the file has.
        found: String,
        /// What it should have.
        expected: String,
    },
}

/// Why a profile gives no quality of service for a topic.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum LookupError {
    /// The file does not have this profile.
    #[error("{file} has no profile {name:?}; it has {}", list(names))]
    NoProfile {
        /// Name of the file.
        file: String,
        /// What was asked for.
        name: String,
        /// The profiles of the file.
        names: Vec<String>,
    },
    /// The layers for this topic do not fit together. [`Profiles::load`] accepted the file, because
    /// only a topic that several filters match shows it.
    #[error(transparent)]
    Wrong(#[from] ProfileError),
}

/// The profiles of a file.
#[derive(Clone, Debug)]
pub struct Profiles {
    source: Source,
    /// By their full names, as in `Library::Profile`.
    profiles: BTreeMap<String, Profile>,
}

/// The file, for errors.
#[derive(Clone, Debug)]
struct Source {
    file: String,
    text: String,
}

#[derive(Clone, Debug)]
struct Profile {
    base: Option<Base>,
    /// In the order of the file.
    entities: Vec<Entity>,
}

/// The profile that another one, or an element of it, builds on.
#[derive(Clone, Debug)]
struct Base {
    /// Its full name.
    name: String,
    /// Offset in the text, bytes.
    at: usize,
}

/// An element such as `<datawriter_qos>`.
#[derive(Clone, Debug)]
struct Entity {
    kind: Kind,
    name: Option<String>,
    filter: Option<String>,
    base: Option<Base>,
    items: Items,
}

/// What a profile is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Target<'a> {
    kind: Kind,
    /// Name of the element, if it has one.
    name: Option<&'a str>,
    topic: &'a str,
}

impl Profiles {
    /// Reads the text of a DDS-XML file; errors name `file`.
    ///
    /// # Errors
    /// [`ProfileError`] says where the file is wrong, what it has there, and what was expected. It
    /// is also one if a base does not exist, if bases form a circle, and if the layers of a profile
    /// do not fit together for a topic without a filter, or for one that a filter of the file
    /// describes.
    pub fn load(text: &str, file: &str) -> Result<Self, ProfileError> {
        if text.len() > FILE_MAX {
            return Err(ProfileError::TooLarge {
                file: file.to_owned(),
                most_kib: FILE_MAX >> 10,
            });
        }
        let source = Source {
            file: file.to_owned(),
            text: text.to_owned(),
        };
        if let Some(at) = crowded(text) {
            let problem = format!("an element has more than {ATTRIBUTES_MAX} attributes");
            return Err(source.malformed(source.position(at), problem));
        }
        let document = Document::parse(text).map_err(|error| {
            let position = (error.pos().row, error.pos().col);
            source.malformed(position, error.to_string())
        })?;
        let profiles = reader::read(&source, &document)?;
        let all = Self { source, profiles };
        all.check()?;
        Ok(all)
    }

    /// Returns the full names of the profiles, in alphabetical order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.profiles.keys().map(String::as_str)
    }

    /// Returns what a writer of this topic offers. `profile`: as in `Library::Profile`, or
    /// `Library::Profile::Name` for a `<datawriter_qos>` that has a name.
    ///
    /// # Errors
    /// [`LookupError`]: there is no such profile, or its layers do not fit together for this topic.
    pub fn writer(&self, profile: &str, topic: &str) -> Result<Qos, LookupError> {
        self.lookup(profile, Kind::Writer, topic)
    }

    /// Returns what a reader of this topic asks for. `profile`: as for [`Profiles::writer`].
    ///
    /// # Errors
    /// [`LookupError`]: there is no such profile, or its layers do not fit together for this topic.
    pub fn reader(&self, profile: &str, topic: &str) -> Result<Qos, LookupError> {
        self.lookup(profile, Kind::Reader, topic)
    }

    fn lookup(&self, full: &str, kind: Kind, topic: &str) -> Result<Qos, LookupError> {
        let is_profile = self.profiles.contains_key(full);
        let (profile, name) = match full.rsplit_once("::").filter(|_| !is_profile) {
            Some((profile, name)) => (profile, Some(name)),
            None => (full, None),
        };
        let target = Target { kind, name, topic };
        let items = match self.profiles.contains_key(profile) {
            true => self.layered(profile, target)?,
            false => None,
        };
        let items = items.ok_or_else(|| LookupError::NoProfile {
            file: self.source.file.clone(),
            name: full.to_owned(),
            names: self.names().map(str::to_owned).collect(),
        })?;
        let is_reliable = items.value(Key::Reliability, u32::from(kind == Kind::Writer)) == 1;
        let is_kept = items.value(Key::Durability, 0) == 1;
        Ok(Qos {
            reliability: if is_reliable {
                Reliability::Reliable
            } else {
                Reliability::BestEffort
            },
            durability: if is_kept {
                Durability::TransientLocal
            } else {
                Durability::Volatile
            },
            depth: items.value(Key::Depth, 1).try_into().unwrap_or(u8::MAX),
        })
    }

    /// Follows all bases, for a topic that each filter of the file describes, and for one that no
    /// filter does.
    fn check(&self) -> Result<(), ProfileError> {
        let elements = || self.profiles.values().flat_map(|one| &one.entities);
        let topics: Vec<String> = elements()
            .map(|one| one.filter.as_deref().unwrap_or_default().replace('*', ""))
            .collect();
        let mut targets: BTreeSet<Target<'_>> = elements()
            .zip(&topics)
            .map(|(one, topic)| Target {
                kind: one.kind,
                name: one.name.as_deref(),
                topic: topic.as_str(),
            })
            .collect();
        targets.extend([Kind::Writer, Kind::Reader].map(|kind| Target {
            kind,
            name: None,
            topic: "",
        }));
        for profile in self.names() {
            for target in &targets {
                let _checked = self.layered(profile, *target)?;
            }
        }
        Ok(())
    }

    /// Lays the elements of a profile and its bases over one another, the profile's own on top.
    /// `None`: none of them has the name that is asked for.
    fn layered(&self, start: &str, target: Target<'_>) -> Result<Option<Items>, ProfileError> {
        let mut items = Items::default();
        let mut is_found = target.name.is_none();
        let mut passed: Vec<&str> = Vec::new();
        let mut next = self.profiles.get_key_value(start);
        while let Some((name, profile)) = next {
            passed.push(name);
            let entity = profile.select(target);
            if let Some(entity) = entity {
                items.fill(&entity.items);
                is_found = true;
            }
            let base = entity.and_then(|entity| entity.base.as_ref());
            next = match base.or(profile.base.as_ref()) {
                Some(base) => Some(self.follow(base, &passed)?),
                None => None,
            };
        }
        self.check_limits(&items, start)?;
        Ok(is_found.then_some(items))
    }

    fn follow(&self, base: &Base, passed: &[&str]) -> Result<(&String, &Profile), ProfileError> {
        if let Some(first) = passed.iter().position(|name| *name == base.name) {
            let circle = passed[first..].join(", ");
            let found = format!("a circle of bases: {circle}, {}", base.name);
            let expected = "a base that does not lead back to where it is named";
            return Err(self.source.wrong(base.at, found, expected));
        }
        if passed.len() > BASES_MAX {
            let found = format!("more than {BASES_MAX} bases below {:?}", passed[0]);
            return Err(self.source.wrong(base.at, found, "fewer"));
        }
        self.profiles.get_key_value(&base.name).ok_or_else(|| {
            let found = format!("the base {:?}, which is not in this file", base.name);
            let names: Vec<_> = self.names().collect();
            self.source
                .wrong(base.at, found, format!("one of {}", list(&names)))
        })
    }

    /// Checks that no limit is smaller than what must fit into it. (DDS 1.4, 2.2.3.18 and 2.2.3.19)
    fn check_limits(&self, items: &Items, profile: &str) -> Result<(), ProfileError> {
        let (samples, per_instance) = (Key::MaxSamples, Key::MaxSamplesPerInstance);
        let pairs = [
            (Key::Depth, per_instance, "max_samples_per_instance"),
            (Key::Depth, samples, "max_samples"),
            (per_instance, samples, "max_samples"),
        ];
        for (part, limit, name) in pairs {
            let (Some(part), Some(limit)) = (items.get(part), items.get(limit)) else {
                continue;
            };
            if part.value > limit.value && part.value != UNLIMITED {
                let (line, _) = self.source.position(limit.at);
                let found = format!("{} in the layers of {profile}", part.value);
                let expected = format!("at most {}, the {name} of line {line}", limit.value);
                return Err(self.source.wrong(part.at, found, expected));
            }
        }
        Ok(())
    }
}

impl Profile {
    /// Returns the element for a target: the first whose filter matches, else the one without.
    fn select(&self, target: Target<'_>) -> Option<&Entity> {
        let is_asked =
            |one: &&Entity| one.kind == target.kind && one.name.as_deref() == target.name;
        let filtered = self.entities.iter().filter(is_asked).find(|one| {
            let filter = one.filter.as_deref();
            filter.is_some_and(|filter| matches(filter, target.topic))
        });
        let mut plain = self.entities.iter().filter(is_asked);
        filtered.or_else(|| plain.find(|one| one.filter.is_none()))
    }
}

impl Source {
    /// Returns the line and the column of an offset, counted from 1.
    fn position(&self, at: usize) -> (u32, u32) {
        let before = self.text.get(..at).unwrap_or_default();
        let line = before.rsplit('\n').next().unwrap_or_default();
        let lines = before.matches('\n').count() + 1;
        (lines as u32, line.chars().count() as u32 + 1)
    }

    fn malformed(&self, (line, column): (u32, u32), problem: String) -> ProfileError {
        ProfileError::Xml {
            file: self.file.clone(),
            line,
            column,
            problem,
        }
    }

    /// Returns an error about the element that stands at this offset, or about its attribute.
    fn wrong(
        &self,
        at: usize,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> ProfileError {
        let (line, column) = self.position(at);
        ProfileError::Element {
            file: self.file.clone(),
            line,
            column,
            element: self.path(at),
            found: found.into(),
            expected: expected.into(),
        }
    }

    /// Returns the elements around an offset, from the root to the innermost.
    fn path(&self, at: usize) -> String {
        let Ok(document) = Document::parse(&self.text) else {
            return String::new();
        };
        let around = document
            .descendants()
            .filter(|node| node.is_element() && node.range().contains(&at));
        let words = around.map(|node| match node.attribute("name") {
            Some(name) => format!("{}[{name}]", node.tag_name().name()),
            None => node.tag_name().name().to_owned(),
        });
        words.collect::<Vec<_>>().join("/")
    }
}

/// Returns the offset of the first element with more than [`ATTRIBUTES_MAX`] attributes.
fn crowded(text: &str) -> Option<usize> {
    let is_value = |rest: &&str| rest.trim_start().starts_with(['"', '\'']);
    let mut starts = text.match_indices('<').map(|(at, _)| at);
    starts.find(|at| {
        // A value has no `<`: the tag ends before the next one.
        let tag = text[at + 1..].split('<').next().unwrap_or_default();
        tag.split('=').skip(1).filter(is_value).count() > ATTRIBUTES_MAX
    })
}

/// Returns the first names.
fn list(names: &[impl AsRef<str>]) -> String {
    let first: Vec<_> = names.iter().take(NAMES_MAX).map(AsRef::as_ref).collect();
    let rest = if names.len() > NAMES_MAX { ", …" } else { "" };
    first.join(", ") + rest
}

/// Returns whether a name matches a filter, in which `*` stands for any text.
fn matches(filter: &str, name: &str) -> bool {
    let Some((first, rest)) = filter.split_once('*') else {
        return filter == name;
    };
    let Some(mut left) = name.strip_prefix(first) else {
        return false;
    };
    let (middle, last) = rest.rsplit_once('*').unwrap_or(("", rest));
    for part in middle.split('*') {
        let Some((_, behind)) = left.split_once(part) else {
            return false;
        };
        left = behind;
    }
    left.ends_with(last)
}
