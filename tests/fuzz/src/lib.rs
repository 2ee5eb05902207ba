//! Properties that must hold for any input of a reader: the bodies of the fuzz targets, their
//! corpora, and mutations of these for compilers without libFuzzer.
#![forbid(unsafe_code)]
#![allow(clippy::expect_used, reason = "a failure is what it is for")]

mod boot;
mod gptp;
mod mutation;
mod rtps;
mod text;
mod wire;

use std::fs;
use std::path::{Path, PathBuf};

pub use mutation::Mutator;

/// A reader, and the properties that must hold for it.
#[derive(Debug)]
pub struct Target {
    /// Name of the target and of its corpus.
    pub name: &'static str,
    /// Returns whether the input was accepted. Panics if a property does not hold.
    pub body: fn(&[u8]) -> bool,
    /// Whether its inputs are lines of text. Otherwise they are bytes.
    pub is_text: bool,
}

const fn bytes(name: &'static str, body: fn(&[u8]) -> bool) -> Target {
    let is_text = false;
    Target {
        name,
        body,
        is_text,
    }
}

const fn text(name: &'static str, body: fn(&[u8]) -> bool) -> Target {
    let is_text = true;
    Target {
        name,
        body,
        is_text,
    }
}

/// All targets.
pub const TARGETS: [Target; 13] = [
    text("srecord", boot::record),
    bytes("frames", boot::frames),
    bytes("manifest", boot::manifest),
    bytes("environment", boot::environment),
    text("scenario", text::scenario),
    text("faults", text::faults),
    bytes("candump", wire::candump),
    bytes("message", wire::message),
    bytes("link", wire::link),
    bytes("flash", wire::flash),
    bytes("recording", wire::recording),
    bytes("rtps", rtps::rtps),
    bytes("gptp", gptp::gptp),
];

/// Returns the target with this name.
#[must_use]
pub fn target(name: &str) -> Option<&'static Target> {
    const ALL: &[Target] = &TARGETS;
    ALL.iter().find(|target| target.name == name)
}

impl Target {
    /// Returns the folder of its inputs.
    #[must_use]
    pub fn folder(&self) -> PathBuf {
        let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
        corpus.join(self.name)
    }

    /// Returns its inputs with their paths, in the order of the paths.
    ///
    /// # Errors
    /// If the corpus cannot be read.
    pub fn corpus(&self) -> std::io::Result<Vec<(PathBuf, Vec<u8>)>> {
        let mut inputs = Vec::new();
        for entry in fs::read_dir(self.folder())? {
            let path = entry?.path();
            inputs.push((path.clone(), fs::read(path)?));
        }
        inputs.sort();
        Ok(inputs)
    }
}
