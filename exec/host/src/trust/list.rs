//! The signed list of parts: its text, and what it must be to be authentic.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use tandem_boot::ed25519;

use super::{Anchor, Why};

const SIGNATURE_LINE: &str = "# signature ";
const NOT_VERIFIED: &str = "the signature does not verify";
/// The version of the format.
pub(super) const VERSION: u32 = 1;

/// The use of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PartKind {
    /// The manifest that the list belongs to.
    Manifest,
    /// An executable, a script or the interpreter of one.
    Program,
    /// The program that loads the libraries of others.
    Loader,
    /// A shared library.
    Library,
}

/// One file of the list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartEntry {
    /// Its use.
    pub kind: PartKind,
    /// What other parts and the manifest call it: a path, or the name of a library.
    pub name: String,
    /// Its place: an absolute path, or one from the folder of the manifest.
    pub path: String,
    /// Bytes.
    pub length: u64,
    /// SHA-256 in 64 small hexadecimal digits.
    pub sha256: String,
}

/// The list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub(super) struct List {
    pub(super) version: u32,
    /// Refused if below the anchor's, so that an old platform does not return.
    pub(super) security_counter: u32,
    #[serde(rename = "part")]
    pub(super) parts: Vec<PartEntry>,
}

impl List {
    /// Returns the signed text. `sign` returns the signature of these bytes.
    pub(super) fn signed(
        &self,
        key: u8,
        sign: impl FnOnce(&[u8]) -> [u8; 64],
    ) -> Result<String, Why> {
        self.check()?;
        let text = toml::to_string(self)?;
        let signature = hex(&sign(text.as_bytes()));
        Ok(format!("{text}{SIGNATURE_LINE}{key} {signature}\n"))
    }

    /// Verifies the signature of a text, and only then reads it.
    pub(super) fn authentic(bytes: &[u8], anchor: &Anchor) -> Result<Self, Why> {
        let (message, line) = str::from_utf8(bytes)?
            .rsplit_once(SIGNATURE_LINE)
            .ok_or(NOT_VERIFIED)?;
        let line = line.strip_suffix('\n').and_then(|it| it.split_once(' '));
        let (number, digits) = line.ok_or(NOT_VERIFIED)?;
        let signature = unhex(digits).ok_or(NOT_VERIFIED)?;
        // Each list has one form: `+1` and `01` are no numbers of keys.
        let keys = anchor.keys.iter().enumerate();
        let key = keys
            .skip(anchor.lowest_key.into())
            .find(|(at, _)| at.to_string() == number)
            .and_then(|(_, key)| unhex(key))
            .ok_or("signed by an unknown or a retired key")?;
        if !ed25519(&key, message.as_bytes(), &signature) {
            return Err(NOT_VERIFIED.into());
        }
        let list = toml::from_str(message);
        let list: Self = list.map_err(|error| format!("not a list of parts: {error}"))?;
        if list.security_counter < anchor.lowest_counter {
            return Err("its security counter is below the lowest that the anchor accepts".into());
        }
        list.check()?;
        Ok(list)
    }

    /// The rules for each list, also a signed one.
    fn check(&self) -> Result<(), Why> {
        let mut names = BTreeSet::new();
        let is_manifest = |part: &&PartEntry| part.kind == PartKind::Manifest;
        let manifests = self.parts.iter().filter(is_manifest).count();
        if self.version != VERSION || manifests != 1 {
            let version = self.version;
            return Err(format!("it is of version {version}, with {manifests} manifests").into());
        }
        for PartEntry {
            kind, name, path, ..
        } in &self.parts
        {
            if !names.insert((kind, name)) {
                return Err(format!("{name} stands in it twice").into());
            }
            let is_plain = path.split('/').all(|step| step != "." && step != "..");
            if !is_plain || path.is_empty() || path.contains('\0') {
                return Err(format!("{path:?} is no plain path").into());
            }
        }
        Ok(())
    }
}

/// Returns bytes as small hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Reads exactly `N` bytes in small hexadecimal digits. Each value has one form.
pub(super) fn unhex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let pairs = text.as_bytes().as_chunks::<2>().0.iter();
    let byte = |pair: &[u8; 2]| u8::from_str_radix(str::from_utf8(pair).ok()?, 16).ok();
    let bytes: Option<Vec<u8>> = pairs.map(byte).collect();
    let bytes: [u8; N] = bytes?.try_into().ok()?;
    (hex(&bytes) == text).then_some(bytes)
}
