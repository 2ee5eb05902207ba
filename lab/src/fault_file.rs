//! Reads a file of faults and checks that its site can inject them.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use tandem_faults::{CannotSuffer, Kind, Sequence, Site};

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
        if site == Site::Processes && forges_two_at_once(&sequence) {
            bail!(
                "{path}: two faults `forged` at the same time: the processes have one foreign \
                 node; let them follow each other, or try them with `tandem sim`"
            );
        }
        Ok(sequence)
    }

    /// Returns the path of the file, for messages and command lines.
    pub(crate) fn name(&self) -> String {
        self.path.display().to_string()
    }
}

/// Returns whether two faults forge frames at the same time.
fn forges_two_at_once(sequence: &Sequence) -> bool {
    let forging = sequence.faults.iter();
    let forging = forging.filter(|fault| matches!(fault.kind, Kind::Forged(_)));
    let mut spans: Vec<_> = forging
        .map(|fault| (fault.at, fault.lasts.map(|lasts| fault.at + lasts)))
        .collect();
    spans.sort();
    let mut pairs = spans.windows(2);
    pairs.any(|pair| pair[0].1.is_none_or(|end| end > pair[1].0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the processes would only half suffer is refused, with what to do.
    #[test]
    fn two_forgeries_at_the_same_time_need_the_simulator() {
        let file = |at_ms: u32, lasts: &str, site| {
            let forged = |at_ms, lasts: &str| {
                format!(
                    "[[fault]]\nwhat = \"forged\"\nof = \"both\"\nat-ms = {at_ms}\n{lasts}\n\
                     frame = \"StatusA\"\nfield = \"Term\"\nvalue = 7\n"
                )
            };
            let text = format!(
                "mended-at-ms = 500\n{}{}",
                forged(at_ms, ""),
                forged(10, lasts)
            );
            let path = PathBuf::from("faults.toml");
            FaultFile { path, text, site }.sequence(0)
        };
        let error = file(50, "", Site::Processes).expect_err("at the same time");
        assert!(error.to_string().contains("`tandem sim`"), "{error}");
        let one_by_one = file(50, "lasts-ms = 40", Site::Processes);
        assert!(one_by_one.is_ok(), "{one_by_one:?}");
        assert!(file(50, "", Site::Simulator).is_ok());
    }
}
