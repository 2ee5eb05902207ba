//! The file of all trace records of a run, which the vehicle's process writes during the run.
//!
//! Seven words a record, little endian: who, the time in ns (low word first), the board's four
//! words. Records of one source are in their order; sources come interleaved.

use std::io::{self, Read as _, Write};
use std::path::Path;

use anyhow::Context as _;
use tandem_board::{CoreId, Instant, SystemId, TraceRecord};

const WORDS: usize = 7;
const BYTES: usize = 4 * WORDS;
/// A file does not grow beyond this, as it lies in shared memory: about six minutes of a run.
pub(crate) const LIMIT_BYTES: u64 = 64 << 20;

/// Who wrote a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Source {
    /// A core.
    Core(SystemId, CoreId),
    /// A supply.
    Supply(SystemId),
}

impl Source {
    const fn code(self) -> u32 {
        match self {
            Self::Core(system, core) => (system.index() * CoreId::COUNT + core.index()) as u32,
            Self::Supply(system) => (2 * CoreId::COUNT + system.index()) as u32,
        }
    }

    fn from_code(code: u32) -> Option<Self> {
        let cores = 2 * CoreId::COUNT;
        let code = code as usize;
        if code < cores {
            let system = SystemId::from_index(code / CoreId::COUNT)?;
            let core = CoreId::new((code % CoreId::COUNT) as u8)?;
            Some(Self::Core(system, core))
        } else {
            SystemId::from_index(code - cores).map(Self::Supply)
        }
    }
}

/// One record with its time and its writer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Entry {
    /// When it was written.
    pub(crate) at: Instant,
    /// By whom.
    pub(crate) source: Source,
    /// What.
    pub(crate) record: TraceRecord,
}

impl Entry {
    /// Appends the entry.
    ///
    /// # Errors
    /// Those of the writer.
    pub(crate) fn write(&self, into: &mut impl Write) -> io::Result<()> {
        let [low, high] = self.at.to_words();
        let [a, b, c, d] = self.record;
        for word in [self.source.code(), low, high, a, b, c, d] {
            into.write_all(&word.to_le_bytes())?;
        }
        Ok(())
    }

    fn read(bytes: &[u8]) -> Option<Self> {
        let mut words = [0; WORDS];
        for (word, four) in words.iter_mut().zip(bytes.chunks_exact(4)) {
            *word = u32::from_le_bytes(four.try_into().ok()?);
        }
        let [source, low, high, a, b, c, d] = words;
        Some(Self {
            at: Instant::from_words([low, high]),
            source: Source::from_code(source)?,
            record: [a, b, c, d],
        })
    }
}

/// All whole entries of a file; the last one may be cut, as its writer may have been killed.
///
/// # Errors
/// If the file cannot be read.
pub(crate) fn read(path: &Path) -> anyhow::Result<Vec<Entry>> {
    let mut bytes = Vec::new();
    std::fs::File::open(path)
        .and_then(|mut file| file.read_to_end(&mut bytes))
        .with_context(|| format!("the vehicle left no trace at {}", path.display()))?;
    Ok(bytes.chunks_exact(BYTES).filter_map(Entry::read).collect())
}

/// Bytes of so many entries.
pub(crate) const fn bytes(entries: usize) -> u64 {
    (entries * BYTES) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_source_survives_the_file_and_a_cut_end_is_left_out() {
        let mut entries = Vec::new();
        for system in SystemId::ALL {
            let cores = CoreId::ALL.map(|core| Source::Core(system, core));
            for source in cores.into_iter().chain([Source::Supply(system)]) {
                entries.push(Entry {
                    at: Instant::from_ns(0x1_2345_6789_ABCD),
                    source,
                    record: [1, 2, 3, u32::MAX],
                });
            }
        }
        let mut file = tempfile::NamedTempFile::new().unwrap();
        for entry in &entries {
            entry.write(file.as_file_mut()).unwrap();
        }
        file.as_file_mut().write_all(&[7; 27]).unwrap();
        assert_eq!(read(file.path()).unwrap(), entries);
        assert_eq!(Entry::read(&[9; BYTES]), None);
    }
}
