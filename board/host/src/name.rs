//! The name of a run: each file name of the run begins with it.

use std::fmt;
use std::str::FromStr;

/// Prefix of the names of all runs.
const RUN_PREFIX: &str = "tandem-";

/// The name of one run on this machine: `tandem-` and up to 40 letters, digits and dashes.
/// All shared memory of a run has names that begin with it, so that two runs never share memory and
/// leftovers can be attributed to their run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RunName(String);

/// The text is not a valid run name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("“{0}” is not the name of a run")]
pub struct InvalidRunName(String);

impl RunName {
    /// Makes a name that is unique on this machine, from the process id and the time.
    #[must_use]
    pub fn unique() -> Self {
        let pid = std::process::id();
        let ns = crate::clock::now().as_ns();
        Self(format!("{RUN_PREFIX}{pid}-{ns:x}"))
    }

    /// Returns the name as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for RunName {
    type Err = InvalidRunName;

    fn from_str(text: &str) -> Result<Self, InvalidRunName> {
        let invalid = || InvalidRunName(text.to_owned());
        let rest = text.strip_prefix(RUN_PREFIX).ok_or_else(invalid)?;
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
        if rest.is_empty() || rest.len() > 40 || !rest.chars().all(plain) {
            return Err(invalid());
        }
        Ok(Self(text.to_owned()))
    }
}

impl fmt::Display for RunName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_unique_name_is_valid() {
        let name = RunName::unique();
        assert_eq!(name.as_str().parse(), Ok(name));
    }

    #[test]
    fn names_with_a_path_or_without_prefix_are_refused() {
        for text in [
            "",
            "tandem-",
            "run-1",
            "tandem-../x",
            "tandem-a b",
            "tandem-a/b",
        ] {
            assert!(text.parse::<RunName>().is_err(), "{text}");
        }
    }
}
