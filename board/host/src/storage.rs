//! iceoryx2's dynamic storage over POSIX shared memory whose pages are reserved at creation.
//!
//! iceoryx2's own storage (`dynamic_storage::posix_shared_memory`) sets the size of the file; the
//! kernel allocates a page only at its first access. In a full `/dev/shm` that access ends the
//! process with SIGBUS, even a process that only rings a doorbell. Here [`Builder::create`] calls
//! `fallocate` before any access to the memory: if there is not enough room, the creator gets an
//! error, and no other process fails later.
//!
//! A *lasting* storage belongs to the run, not to the process that created it: dropping it does not
//! remove it, and [`Builder::create`] takes over an existing one and initializes its value again,
//! in the same memory. Processes that have it mapped continue to use it, and must tolerate the
//! change.
//!
//! iceoryx2's test suite for a dynamic storage also tests this one: `tests/iceoryx2.rs`.

use core::fmt::Debug;
use core::marker::PhantomData;
use core::mem::MaybeUninit;
use core::ptr::NonNull;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::{Acquire, Release};
use core::time::Duration;
use std::os::fd::BorrowedFd;
use std::thread;
use std::time::Instant;

use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use iceoryx2_bb_memory::bump_allocator::BumpAllocator;
use iceoryx2_bb_posix::access_mode::AccessMode;
use iceoryx2_bb_posix::creation_mode::CreationMode;
use iceoryx2_bb_posix::file_descriptor::{FileDescriptorBased, FileDescriptorManagement};
use iceoryx2_bb_posix::permission::Permission;
use iceoryx2_bb_posix::shared_memory::{
    SharedMemory, SharedMemoryBuilder, SharedMemoryCreationError, SharedMemoryRemoveError,
};
use iceoryx2_bb_system_types::file_name::FileName;
use iceoryx2_bb_system_types::path::Path;
pub use iceoryx2_cal::dynamic_storage::posix_shared_memory::Configuration;
use iceoryx2_cal::dynamic_storage::posix_shared_memory::Storage as TouchedLater;
use iceoryx2_cal::dynamic_storage::{
    DynamicStorage, DynamicStorageBuilder, DynamicStorageCreateError, DynamicStorageOpenError,
    DynamicStorageOpenOrCreateError, Initializer,
};
use iceoryx2_cal::named_concept::{
    NamedConcept, NamedConceptBuilder, NamedConceptConfiguration, NamedConceptDoesExistError,
    NamedConceptListError, NamedConceptMgmt, NamedConceptPathHintRemoveError,
    NamedConceptRemoveError,
};
use rustix::fs::FallocateFlags;
use rustix::io::Errno;

/// Only root can read a storage that is still incomplete.
const UNFINISHED: Permission = Permission::OWNER_WRITE;
const FINISHED: Permission = Permission::OWNER_READ_WRITE;
const FINISHED_FOR_ALL: Permission = FINISHED
    .const_bitor(Permission::GROUP_READ_WRITE)
    .const_bitor(Permission::OTHERS_READ_WRITE);
/// Content of [`Content::complete`] when the value is complete: "TDMS" and the version of the
/// layout.
const COMPLETE: u32 = 0x5444_4D01;
const LOOK_AGAIN: Duration = Duration::from_millis(1);

/// Requirements on the `T` of a storage.
pub trait Value: Send + Sync + Debug + ZeroCopySend {}
impl<T: Send + Sync + Debug + ZeroCopySend> Value for T {}

/// The content of the memory.
#[repr(C)]
struct Content<T> {
    complete: AtomicU32,
    value: MaybeUninit<T>,
}

/// Why a storage could not be created.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CreateError {
    /// A storage with this name exists.
    AlreadyExists,
    /// This user may not create a storage.
    InsufficientPermissions,
    /// The file system does not have room for these bytes.
    NoSpace {
        /// The requested size.
        bytes: usize,
    },
    /// The initializer failed.
    InitializationFailed,
    /// The operating system refused another operation.
    Refused,
}

impl From<CreateError> for DynamicStorageCreateError {
    fn from(error: CreateError) -> Self {
        match error {
            CreateError::AlreadyExists => Self::AlreadyExists,
            CreateError::InsufficientPermissions => Self::InsufficientPermissions,
            CreateError::InitializationFailed => Self::InitializationFailed,
            CreateError::NoSpace { .. } | CreateError::Refused => Self::InternalError,
        }
    }
}

/// Creates or opens a [`Storage`].
#[derive(Debug)]
pub struct Builder<'builder, T: Value, const LASTING: bool = false> {
    name: FileName,
    config: Configuration<T>,
    supplementary_size: usize,
    for_all: bool,
    has_ownership: bool,
    timeout: Duration,
    initializer: Initializer<'builder, T>,
}

impl<T: Value, const LASTING: bool> Builder<'_, T, LASTING> {
    fn file_name(&self) -> FileName {
        self.config.path_for(&self.name).file_name()
    }

    /// Like [`DynamicStorageBuilder::create`], but the error says whether the room was too small.
    ///
    /// # Errors
    /// [`CreateError`]
    pub fn create_reserved(mut self) -> Result<Storage<T, LASTING>, CreateError> {
        let bytes = size_of::<Content<T>>() + self.supplementary_size;
        let created = SharedMemoryBuilder::new(&self.file_name())
            .creation_mode(CreationMode::CreateExclusive)
            .size(bytes)
            .permission(UNFINISHED)
            .zero_memory(false)
            .has_ownership(true)
            .create();
        let memory = match created {
            Ok(memory) => memory,
            Err(SharedMemoryCreationError::AlreadyExist) if LASTING => {
                return self.take_over(bytes);
            }
            Err(SharedMemoryCreationError::AlreadyExist) => {
                return Err(CreateError::AlreadyExists);
            }
            Err(SharedMemoryCreationError::InsufficientPermissions) => {
                return Err(CreateError::InsufficientPermissions);
            }
            Err(_) => return Err(CreateError::Refused),
        };
        // From here on, an error removes the file, because `memory` owns it.
        reserve(&memory, bytes)?;
        let mut storage = self.initialize(memory)?;
        let permission = if self.for_all {
            FINISHED_FOR_ALL
        } else {
            FINISHED
        };
        storage
            .memory
            .set_permission(permission)
            .map_err(|_| CreateError::Refused)?;
        if !self.has_ownership || LASTING {
            storage.release_ownership();
        }
        Ok(storage)
    }

    /// Initializes an existing storage again, in the same memory.
    fn take_over(mut self, bytes: usize) -> Result<Storage<T, LASTING>, CreateError> {
        let memory = SharedMemoryBuilder::new(&self.file_name())
            .open_existing(AccessMode::ReadWrite)
            .map_err(|_| CreateError::Refused)?;
        if memory.size() < bytes {
            return Err(CreateError::Refused);
        }
        self.initialize(memory)
    }

    fn initialize(&mut self, memory: SharedMemory) -> Result<Storage<T, LASTING>, CreateError> {
        let content = memory.base_address().cast::<Content<T>>();
        let beyond = size_of::<Content<T>>();
        // SAFETY: the memory is at least as large as a `Content`, aligned to a page, and mapped as
        // long as `memory` lives. New memory is zero, and any bit pattern is a valid `Content`. The
        // rest after it is in the mapping as well.
        let (content, rest) =
            unsafe { (&mut *content.as_ptr(), memory.base_address().add(beyond)) };
        let mut allocator = BumpAllocator::new(rest, memory.size() - beyond);
        if !self.initializer.call(&mut content.value, &mut allocator) {
            return Err(CreateError::InitializationFailed);
        }
        // Release pairs with the Acquire in `open_now`: a reader of COMPLETE also sees the value.
        content.complete.store(COMPLETE, Release);
        let name = self.name;
        Ok(Storage {
            memory,
            name,
            _value: PhantomData,
        })
    }

    /// Opens the storage in its present state; an incomplete storage is an error.
    fn open_now(&self, access: AccessMode) -> Result<Storage<T, LASTING>, DynamicStorageOpenError> {
        let unfinished = Err(DynamicStorageOpenError::InitializationNotYetFinalized);
        let memory = match SharedMemoryBuilder::new(&self.file_name()).open_existing(access) {
            Ok(memory) => memory,
            Err(SharedMemoryCreationError::DoesNotExist) => {
                return Err(DynamicStorageOpenError::DoesNotExist);
            }
            // The size of the file is still zero, or the file is still write-only.
            Err(
                SharedMemoryCreationError::InsufficientPermissions
                | SharedMemoryCreationError::MemoryMappingCreationError(_),
            ) => return unfinished,
            Err(_) => return Err(DynamicStorageOpenError::InternalError),
        };
        // Root can open an incomplete storage; other users cannot. Reject it, because no page may
        // be accessed before all pages are reserved.
        match memory.permission() {
            Ok(permission) if permission.has(Permission::OWNER_READ) => {}
            Ok(_) => return unfinished,
            Err(_) => return Err(DynamicStorageOpenError::InternalError),
        }
        if memory.size() < size_of::<Content<T>>() {
            return Err(DynamicStorageOpenError::VersionMismatch);
        }
        let name = self.name;
        let storage = Storage {
            memory,
            name,
            _value: PhantomData,
        };
        // Acquire pairs with the Release in `initialize`.
        match storage.content().complete.load(Acquire) {
            COMPLETE => Ok(storage),
            0 => unfinished,
            _ => Err(DynamicStorageOpenError::VersionMismatch),
        }
    }

    fn open_in_time(
        &self,
        access: AccessMode,
    ) -> Result<Storage<T, LASTING>, DynamicStorageOpenError> {
        let begun = Instant::now();
        loop {
            match self.open_now(access) {
                Err(DynamicStorageOpenError::InitializationNotYetFinalized)
                    if begun.elapsed() < self.timeout =>
                {
                    thread::sleep(LOOK_AGAIN);
                }
                settled => return settled,
            }
        }
    }
}

/// Reserves the pages for all bytes, or fails.
fn reserve(memory: &SharedMemory, bytes: usize) -> Result<(), CreateError> {
    // SAFETY: the descriptor is open as long as `memory` lives, and `memory` outlives the borrow.
    let file = unsafe { BorrowedFd::borrow_raw(memory.file_descriptor().native_handle()) };
    loop {
        match rustix::fs::fallocate(file, FallocateFlags::empty(), 0, bytes as u64) {
            Ok(()) => return Ok(()),
            Err(Errno::INTR) => {}
            Err(Errno::NOSPC | Errno::NOMEM | Errno::DQUOT) => {
                return Err(CreateError::NoSpace { bytes });
            }
            Err(_) => return Err(CreateError::Refused),
        }
    }
}

impl<T: Value, const LASTING: bool> NamedConceptBuilder<Storage<T, LASTING>>
    for Builder<'_, T, LASTING>
{
    fn new(name: &FileName) -> Self {
        Self {
            name: *name,
            config: Configuration::default(),
            supplementary_size: 0,
            for_all: false,
            has_ownership: true,
            timeout: Duration::ZERO,
            initializer: Initializer::new(|_, _| false),
        }
    }

    fn config(mut self, config: &Configuration<T>) -> Self {
        self.config = config.clone();
        self
    }
}

impl<'builder, T: Value, const LASTING: bool>
    DynamicStorageBuilder<'builder, T, Storage<T, LASTING>> for Builder<'builder, T, LASTING>
{
    fn has_ownership(mut self, value: bool) -> Self {
        self.has_ownership = value;
        self
    }

    fn enable_global_access(mut self, value: bool) -> Self {
        self.for_all = value;
        self
    }

    fn supplementary_size(mut self, value: usize) -> Self {
        self.supplementary_size = value;
        self
    }

    fn timeout(mut self, value: Duration) -> Self {
        self.timeout = value;
        self
    }

    fn initializer<F>(mut self, value: F) -> Self
    where
        F: FnMut(&mut MaybeUninit<T>, &mut BumpAllocator) -> bool + 'builder,
    {
        self.initializer = Initializer::new(value);
        self
    }

    fn create(self) -> Result<Storage<T, LASTING>, DynamicStorageCreateError> {
        Ok(self.create_reserved()?)
    }

    fn open(self, access: AccessMode) -> Result<Storage<T, LASTING>, DynamicStorageOpenError> {
        self.open_in_time(access)
    }

    fn open_or_create(self) -> Result<Storage<T, LASTING>, DynamicStorageOpenOrCreateError> {
        match self.open_in_time(AccessMode::ReadWrite) {
            Ok(storage) => Ok(storage),
            Err(DynamicStorageOpenError::DoesNotExist) => {
                let again = Builder {
                    initializer: Initializer::new(|_, _| false),
                    config: self.config.clone(),
                    ..self
                };
                match self.create_reserved() {
                    Err(CreateError::AlreadyExists) => {
                        Ok(again.open_in_time(AccessMode::ReadWrite)?)
                    }
                    created => Ok(created.map_err(DynamicStorageCreateError::from)?),
                }
            }
            Err(error) => Err(error.into()),
        }
    }
}

/// A value in shared memory.
#[derive(Debug)]
pub struct Storage<T, const LASTING: bool = false> {
    memory: SharedMemory,
    name: FileName,
    _value: PhantomData<T>,
}

// SAFETY: the storage gives out only shared references to a `T`, and `Value` requires that `T` is
// `Sync` and `Send`; the mapping belongs to the process, not to a thread.
unsafe impl<T: Value, const LASTING: bool> Send for Storage<T, LASTING> {}
// SAFETY: as above.
unsafe impl<T: Value, const LASTING: bool> Sync for Storage<T, LASTING> {}

impl<T, const LASTING: bool> Storage<T, LASTING> {
    fn content(&self) -> &Content<T> {
        let content = self.memory.base_address().cast::<Content<T>>();
        // SAFETY: the mapping is as large as a `Content`, which was checked when this storage was
        // built; all its pages are reserved; the mapping lives as long as `self.memory`.
        unsafe { content.as_ref() }
    }
}

impl<T, const LASTING: bool> Drop for Storage<T, LASTING> {
    fn drop(&mut self) {
        if self.memory.has_ownership() {
            let content = self.memory.base_address().cast::<Content<T>>();
            // SAFETY: this storage's builder has initialized the value. As in iceoryx2, the owner
            // is the last user.
            unsafe { (*content.as_ptr()).value.assume_init_drop() };
        }
    }
}

impl<T, const LASTING: bool> Abandonable for Storage<T, LASTING> {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller promises a valid, constructed `Self` that is not used afterwards.
        unsafe {
            SharedMemory::abandon_in_place(NonNull::from_mut(&mut this.as_mut().memory));
        }
    }
}

impl<T: Value, const LASTING: bool> NamedConcept for Storage<T, LASTING> {
    fn name(&self) -> &FileName {
        &self.name
    }
}

impl<T: Value, const LASTING: bool> NamedConceptMgmt for Storage<T, LASTING> {
    type Configuration = Configuration<T>;

    unsafe fn remove_cfg(
        name: &FileName,
        config: &Configuration<T>,
    ) -> Result<bool, NamedConceptRemoveError> {
        let file = config.path_for(name).file_name();
        SharedMemory::remove(&file).map_err(|error| match error {
            SharedMemoryRemoveError::InsufficientPermissions => {
                NamedConceptRemoveError::InsufficientPermissions
            }
            SharedMemoryRemoveError::UnknownError(_) => NamedConceptRemoveError::InternalError,
        })
    }

    fn does_exist_cfg(
        name: &FileName,
        config: &Configuration<T>,
    ) -> Result<bool, NamedConceptDoesExistError> {
        Ok(SharedMemory::does_exist(&config.path_for(name).file_name()))
    }

    fn list_cfg(config: &Configuration<T>) -> Result<Vec<FileName>, NamedConceptListError> {
        let all = SharedMemory::list();
        let ours = all
            .iter()
            .filter_map(|file| config.extract_name_from_file(file));
        Ok(ours.collect())
    }

    fn remove_path_hint(_: &Path) -> Result<(), NamedConceptPathHintRemoveError> {
        // POSIX shared memory has no folders.
        Ok(())
    }
}

impl<T: Value, const LASTING: bool> DynamicStorage<T> for Storage<T, LASTING> {
    type Builder<'builder> = Builder<'builder, T, LASTING>;

    fn does_support_persistency() -> bool {
        SharedMemory::does_support_persistency()
    }

    fn has_ownership(&self) -> bool {
        self.memory.has_ownership()
    }

    fn release_ownership(&self) {
        self.memory.release_ownership();
    }

    fn acquire_ownership(&self) {
        self.memory.acquire_ownership();
    }

    fn get(&self) -> &T {
        // SAFETY: a storage exists only when its value is complete, and the value stays complete.
        unsafe { self.content().value.assume_init_ref() }
    }

    unsafe fn __internal_set_type_name_in_config(config: &mut Configuration<T>, name: &str) {
        // SAFETY: this function's caller makes the same promise.
        unsafe { TouchedLater::<T>::__internal_set_type_name_in_config(config, name) };
    }
}
