//! The signed list of parts: its text, and what it must be to be authentic.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use tandem_boot::ed25519;

use super::{Anchor, Reason};

const SIGNATURE_LINE: &str = "# signature ";
/// The version of the format.
const VERSION: u32 = 1;

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
    version: u32,
    /// Refused if below the anchor's, so that an old platform does not return.
    pub(super) security_counter: u32,
    #[serde(rename = "part")]
    pub(super) parts: Vec<PartEntry>,
}

impl List {
    pub(super) const fn new(security_counter: u32, parts: Vec<PartEntry>) -> Self {
        Self {
            version: VERSION,
            security_counter,
            parts,
        }
    }

    /// Returns the signed text. `sign` returns the signature of these bytes.
    pub(super) fn signed(
        &self,
        key: u8,
        sign: impl FnOnce(&[u8]) -> [u8; 64],
    ) -> Result<String, Reason> {
        self.check()?;
        let text = toml::to_string(self).map_err(|error| Reason::Format(error.to_string()))?;
        let signature = hex(&sign(text.as_bytes()));
        Ok(format!("{text}{SIGNATURE_LINE}{key} {signature}\n"))
    }

    /// Verifies the signature of a text, and only then reads it.
    pub(super) fn authentic(bytes: &[u8], anchor: &Anchor) -> Result<Self, Reason> {
        let text = std::str::from_utf8(bytes).map_err(|_| Reason::Format("not UTF-8".into()))?;
        let at = text.rfind(SIGNATURE_LINE).ok_or(Reason::Signature)?;
        let (message, line) = text.split_at(at);
        let line = &line[SIGNATURE_LINE.len()..];
        let (number, digits) = line.split_once(' ').ok_or(Reason::Signature)?;
        let key: u8 = number.parse().map_err(|_| Reason::Key)?;
        let digits = digits.strip_suffix('\n').ok_or(Reason::Signature)?;
        let signature: [u8; 64] = unhex(digits).ok_or(Reason::Signature)?;
        // Each list has one form: `+1` and `01` are no numbers of keys.
        let public = anchor.keys.get(usize::from(key));
        let public = public
            .filter(|_| key >= anchor.lowest_key && key.to_string() == number)
            .ok_or(Reason::Key)?;
        if !ed25519(public, message.as_bytes(), &signature) {
            return Err(Reason::Signature);
        }
        let list: Self =
            toml::from_str(message).map_err(|error| Reason::Format(error.to_string()))?;
        if list.security_counter < anchor.lowest_counter {
            return Err(Reason::Old);
        }
        list.check()?;
        Ok(list)
    }

    /// The rules for each list, also a signed one.
    fn check(&self) -> Result<(), Reason> {
        if self.version != VERSION {
            return Err(Reason::Format(format!("version {}", self.version)));
        }
        let mut names = BTreeSet::new();
        let mut manifests = 0;
        for part in &self.parts {
            if !names.insert((part.kind, part.name.as_str())) {
                return Err(Reason::Twice(part.name.clone()));
            }
            if part.path.split('/').any(|step| matches!(step, "." | ".."))
                || part.path.is_empty()
                || part.path.contains('\0')
            {
                return Err(Reason::Path(part.path.clone()));
            }
            if unhex::<32>(&part.sha256).is_none() {
                return Err(Reason::Format(format!("SHA-256 of {}", part.name)));
            }
            manifests += usize::from(part.kind == PartKind::Manifest);
        }
        if manifests != 1 {
            return Err(Reason::Format(format!("{manifests} manifests")));
        }
        Ok(())
    }

    /// Returns the index of a part.
    pub(super) fn find(&self, kind: PartKind, name: &str) -> Option<usize> {
        let is_it = |part: &PartEntry| part.kind == kind && part.name == name;
        self.parts.iter().position(is_it)
    }
}

/// Returns bytes as small hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Reads exactly `N` bytes in small hexadecimal digits. Each value has one form.
pub(super) fn unhex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let digit = |byte: u8| match byte {
        b'0'..=b'9' => Some(byte - b'0'),
        b'a'..=b'f' => Some(byte - b'a' + 10),
        _ => None,
    };
    let pairs = text.as_bytes().as_chunks::<2>();
    if pairs.0.len() != N || !pairs.1.is_empty() {
        return None;
    }
    let mut bytes = [0; N];
    for (byte, [high, low]) in bytes.iter_mut().zip(pairs.0) {
        *byte = digit(*high)? << 4 | digit(*low)?;
    }
    Some(bytes)
}
