//! Reads a file of faults and checks that its site can inject them.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use tandem_faults::{CannotSuffer, Sequence, Site};

/// A file of faults. It is read once, so all processes of a campaign try the same faults.
pub(crate) struct FaultFile {
    path: PathBuf,
    text: String,
    site: Site,
}

impl FaultFile {
    /// Reads the file.
    ///
    /// # Errors
    /// If the file cannot be read, or a fault in it is not possible at `site`.
    pub(crate) fn read(path: &Path, site: Site) -> anyhow::Result<Self> {
        let file = Self {
            text: std::fs::read_to_string(path).with_context(|| path.display().to_string())?,
            path: path.to_owned(),
            site,
        };
        file.sequence(0)?;
        Ok(file)
    }

    /// Returns the faults of the file. `number` is the seed of their random values.
    ///
    /// # Errors
    /// See [`FaultFile::read`].
    pub(crate) fn sequence(&self, number: u64) -> anyhow::Result<Sequence> {
        let (path, site) = (self.name(), self.site);
        let sequence = Sequence::from_toml(&self.text, number).with_context(|| path.clone())?;
        let mut kinds = sequence.faults.iter().map(|fault| fault.kind);
        if let Some(kind) = kinds.find(|kind| !kind.is_for(site)) {
            return Err(anyhow::Error::new(CannotSuffer { kind, site }).context(path));
        }
        if sequence.from_power_on && site != Site::Simulator {
            bail!("{path}: from-power-on: only `tandem sim`");
        }
        Ok(sequence)
    }

    /// Returns the path of the file, for messages and command lines.
    pub(crate) fn name(&self) -> String {
        self.path.display().to_string()
    }
}
