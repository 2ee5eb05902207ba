//! Named memory that several processes map read-write: words on reserved pages.

use core::fmt;
use core::sync::atomic::AtomicU32;
use core::time::Duration;

use iceoryx2_bb_container::semantic_string::SemanticString;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_bb_posix::access_mode::AccessMode;
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_cal::dynamic_storage::{
    DynamicStorage, DynamicStorageBuilder, DynamicStorageOpenError,
};
use iceoryx2_cal::named_concept::{NamedConceptBuilder, NamedConceptConfiguration};

use crate::name::RunName;
use crate::storage::{Builder, Configuration, CreateError, Storage};

/// `N` words on separate pages. The initial content is zero, as the kernel provides it.
#[repr(C, align(4096))]
pub(crate) struct Words<const N: usize>([AtomicU32; N]);

impl<const N: usize> Words<N> {
    pub(crate) fn as_slice(&self) -> &[AtomicU32] {
        &self.0
    }
}

impl<const N: usize> fmt::Debug for Words<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Words<{N}>")
    }
}

// SAFETY: an array of 32-bit atomics with a C layout: self-contained, the same in every process,
// and valid for any bit pattern.
unsafe impl<const N: usize> ZeroCopySend for Words<N> {}

/// Why a segment could not be created, opened or removed.
#[derive(Debug, thiserror::Error)]
pub enum SegmentError {
    /// The segment was never created, or was removed.
    #[error("shared memory “{name}” of run {run} does not exist")]
    DoesNotExist {
        /// The run.
        run: RunName,
        /// The segment.
        name: String,
    },
    /// The operating system refused an operation.
    #[error("shared memory “{name}” of run {run}: {reason}")]
    Refused {
        /// The run.
        run: RunName,
        /// The segment.
        name: String,
        /// Why it was refused.
        reason: String,
    },
}

/// A mapped segment of `N` words. Dropping it unmaps it; the memory remains until the segment is
/// removed by name or together with the run.
pub struct Segment<const N: usize> {
    storage: Storage<Words<N>>,
}

impl<const N: usize> Segment<N> {
    /// Creates the segment with all words zero, and reserves its pages.
    ///
    /// # Errors
    /// [`SegmentError`]
    pub fn create(run: &RunName, name: &str) -> Result<Self, SegmentError> {
        quiet();
        let built = Builder::new(&file(run, name)?)
            .config(&config(run))
            .has_ownership(false)
            // New shared memory is zero, and zero is a valid content.
            .initializer(|_, _| true)
            .create_reserved();
        match built {
            Ok(storage) => Ok(Self { storage }),
            Err(error) => Err(refused(run, name, create_reason(error))),
        }
    }

    /// Maps an existing segment. Does not wait until it exists.
    ///
    /// # Errors
    /// [`SegmentError`]
    pub fn open(run: &RunName, name: &str) -> Result<Self, SegmentError> {
        quiet();
        let built = Builder::<Words<N>>::new(&file(run, name)?)
            .config(&config(run))
            .timeout(Duration::ZERO)
            .open(AccessMode::ReadWrite);
        match built {
            Ok(storage) => Ok(Self { storage }),
            Err(DynamicStorageOpenError::DoesNotExist) => Err(SegmentError::DoesNotExist {
                run: run.clone(),
                name: name.to_owned(),
            }),
            Err(error) => Err(refused(run, name, error.to_string())),
        }
    }

    /// Returns the words. Other processes write them: they may hold anything.
    #[must_use]
    pub fn words(&self) -> &[AtomicU32] {
        self.storage.get().as_slice()
    }
}

impl<const N: usize> fmt::Debug for Segment<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Segment<{N}>")
    }
}

/// Silences iceoryx2's log, because it also reports expected outcomes such as "does not exist"; the
/// errors of this module already report these.
pub(crate) fn quiet() {
    iceoryx2_log::set_log_level(iceoryx2_log::LogLevel::Fatal);
}

fn config<const N: usize>(run: &RunName) -> Configuration<Words<N>> {
    Configuration::default().prefix(&prefix(run))
}

/// Used if a name cannot be formed. This never happens, because run names are short and plain.
// SAFETY: letters are a valid file name.
pub(crate) const FALLBACK: FileName = unsafe { FileName::new_unchecked_const(b"tandem") };

/// Returns the prefix of the file names of a run.
pub(crate) fn prefix(run: &RunName) -> FileName {
    FileName::new(format!("{run}_").as_bytes()).unwrap_or(FALLBACK)
}

fn file(run: &RunName, name: &str) -> Result<FileName, SegmentError> {
    FileName::new(name.as_bytes())
        .map_err(|_| refused(run, name, "is not a name that a file can have".to_owned()))
}

fn refused(run: &RunName, name: &str, reason: String) -> SegmentError {
    SegmentError::Refused {
        run: run.clone(),
        name: name.to_owned(),
        reason,
    }
}

fn create_reason(error: CreateError) -> String {
    match error {
        CreateError::AlreadyExists => "exists already".to_owned(),
        CreateError::InsufficientPermissions => "no permission to create it in /dev/shm".to_owned(),
        CreateError::NoSpace { bytes } => {
            format!(
                "/dev/shm has no room for its {} KiB; make room there",
                bytes.div_ceil(1024)
            )
        }
        CreateError::InitializationFailed | CreateError::Refused => {
            "could not be created in /dev/shm".to_owned()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::sync::atomic::Ordering::Relaxed;
    use iceoryx2_cal::named_concept::NamedConceptMgmt;

    impl<const N: usize> Segment<N> {
        /// Removes a segment that a test has created. No effect if it does not exist.
        pub(crate) fn remove(run: &RunName, name: &str) {
            // SAFETY: POSIX shared memory keeps its content for every process that has it mapped.
            unsafe { Storage::<Words<N>>::remove_cfg(&file(run, name).unwrap(), &config(run)) }
                .unwrap();
        }
    }

    #[test]
    fn what_one_mapping_writes_the_other_reads() {
        let run = RunName::unique();
        let a = Segment::<1024>::create(&run, "t").unwrap();
        let b = Segment::<1024>::open(&run, "t").unwrap();
        assert!(a.words().iter().all(|word| word.load(Relaxed) == 0));
        a.words()[1023].store(7, Relaxed);
        assert_eq!(b.words()[1023].load(Relaxed), 7);
        assert_eq!(b.words().as_ptr() as usize % 4096, 0);
        Segment::<1024>::remove(&run, "t");
        assert!(matches!(
            Segment::<1024>::open(&run, "t"),
            Err(SegmentError::DoesNotExist { .. })
        ));
    }

    #[test]
    fn a_name_is_created_once() {
        let run = RunName::unique();
        let _first = Segment::<16>::create(&run, "once").unwrap();
        let error = Segment::<16>::create(&run, "once").unwrap_err();
        assert!(error.to_string().contains("exists already"), "{error}");
        Segment::<16>::remove(&run, "once");
    }
}
