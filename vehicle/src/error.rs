//! Errors when a scenario is loaded.

use thiserror::Error;

/// Why a scenario cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ScenarioError {
    /// It is neither an embedded scenario nor a file.
    #[error(
        "there is no scenario or file {name:?}{}; the scenarios are {}",
        .nearest.map_or(String::new(), |n| format!(", did you mean {n:?}?")),
        .names.join(", ")
    )]
    Unknown {
        /// The requested name.
        name: String,
        /// An embedded scenario with a similar name.
        nearest: Option<&'static str>,
        /// The embedded scenarios.
        names: Vec<&'static str>,
    },
    /// The file cannot be read.
    #[error("cannot read the scenario file {file}: {problem}")]
    Read {
        /// Path of the file.
        file: String,
        /// The error of the operating system.
        problem: String,
    },
    /// The file is larger than any scenario.
    #[error("{file}: larger than {most_mib} MiB; give the part that is driven")]
    TooLarge {
        /// Path of the file.
        file: String,
        /// MiB
        most_mib: usize,
    },
    /// The total length of the lanes exceeds the limit.
    #[error(
        "{file}: its lanes together are {length_km:.0} km long; give a map with less than \
         {most_km} km, where every successor begins where its lanelet ends"
    )]
    TooLong {
        /// Path of the file.
        file: String,
        /// km
        length_km: f64,
        /// km
        most_km: f64,
    },
    /// The file is not well-formed XML.
    #[error("{file}:{line}: not well-formed XML: {problem}")]
    Xml {
        /// Path of the file.
        file: String,
        /// Counted from 1.
        line: u32,
        /// The error of the XML parser.
        problem: String,
    },
    /// The file lacks content that CommonRoad requires.
    #[error("{file}:{line}: {element} {problem}; {advice}")]
    Element {
        /// Path of the file.
        file: String,
        /// Counted from 1.
        line: u32,
        /// Which element, with its id.
        element: String,
        /// The fault in it.
        problem: String,
        /// The remedy.
        advice: String,
    },
}
