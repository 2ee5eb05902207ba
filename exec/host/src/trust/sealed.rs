//! A copy of a file in memory that no process can change.

use std::fs::File;
use std::io::{self, Read as _};
use std::os::unix::fs::FileExt as _;

use rustix::fs::{
    MemfdFlags, Mode, OFlags, ResolveFlags, SealFlags, fcntl_add_seals, memfd_create, openat2,
};
use rustix::io::Errno;
use sha2::{Digest as _, Sha256};

/// One read of the hash: large enough that system calls do not count.
const CHUNK: usize = 64 * 1024;
/// The kernel takes names of up to 249 bytes.
const NAME_BYTES: usize = 64;

/// A sealed copy, its length and its SHA-256.
#[derive(Debug)]
pub(super) struct Sealed {
    pub(super) file: File,
    pub(super) length: u64,
    pub(super) digest: [u8; 32],
}

impl Sealed {
    /// Copies a file once, seals the copy, and only then computes the digest of the sealed bytes.
    /// Returns `None` if the file is longer than `limit`.
    pub(super) fn copy(source: &File, name: &str, limit: u64) -> io::Result<Option<Self>> {
        let mut end = name.len().min(NAME_BYTES);
        while !name.is_char_boundary(end) {
            end -= 1;
        }
        let mut file = create(&name[..end])?;
        let length = io::copy(&mut source.take(limit.saturating_add(1)), &mut file)?;
        if length > limit {
            return Ok(None);
        }
        seal(&file)?;
        let digest = digest(&file)?;
        Ok(Some(Self {
            file,
            length,
            digest,
        }))
    }
}

/// Creates an empty file in memory that may be executed.
fn create(name: &str) -> io::Result<File> {
    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    let created = match memfd_create(name, flags | MemfdFlags::EXEC) {
        // Before Linux 6.3 every such file may be executed, and the flag is unknown.
        Err(Errno::INVAL) => memfd_create(name, flags),
        created => created,
    };
    Ok(created?.into())
}

/// Forbids each later change. The kernel refuses with `EBUSY` if a process has the file mapped for
/// writing, so no earlier mapping can change it either.
fn seal(file: &File) -> io::Result<()> {
    let seals = SealFlags::WRITE | SealFlags::SHRINK | SealFlags::GROW;
    // Without the permission to execute, other processes could no longer start the copy.
    match fcntl_add_seals(file, seals | SealFlags::EXEC | SealFlags::SEAL) {
        Err(Errno::INVAL) => fcntl_add_seals(file, seals | SealFlags::SEAL)?,
        sealed => sealed?,
    }
    Ok(())
}

fn digest(file: &File) -> io::Result<[u8; 32]> {
    let mut hash = Sha256::new();
    let mut chunk = vec![0; CHUNK];
    let mut offset = 0;
    loop {
        let count = file.read_at(&mut chunk, offset)?;
        if count == 0 {
            return Ok(hash.finalize().into());
        }
        hash.update(&chunk[..count]);
        offset += count as u64;
    }
}

/// Opens a regular file. No part of its path may be a symbolic link, and a relative path must not
/// leave `folder`.
pub(super) fn open(folder: &File, path: &str) -> io::Result<File> {
    let mut resolve = ResolveFlags::NO_SYMLINKS | ResolveFlags::NO_MAGICLINKS;
    if !path.starts_with('/') {
        resolve |= ResolveFlags::BENEATH;
    }
    // A pipe must not block the launcher.
    let flags = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NOCTTY | OFlags::NONBLOCK;
    let file = File::from(openat2(folder, path, flags, Mode::empty(), resolve)?);
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    Ok(file)
}

/// Reads a file of at most `limit` bytes. Returns `None` if it is longer.
pub(super) fn read(mut file: impl io::Read, limit: u64) -> io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    file.by_ref()
        .take(limit.saturating_add(1))
        .read_to_end(&mut bytes)?;
    Ok((bytes.len() as u64 <= limit).then_some(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{FallocateFlags, fallocate, fchmod, ftruncate};
    use std::io::Write as _;
    use std::os::fd::AsRawFd as _;

    fn copy(bytes: &[u8], limit: u64) -> Option<Sealed> {
        let mut source = tempfile::tempfile().unwrap();
        source.write_all(bytes).unwrap();
        let source = File::open(format!("/proc/self/fd/{}", source.as_raw_fd())).unwrap();
        Sealed::copy(&source, "part", limit).unwrap()
    }

    /// E-4: no process changes a checked copy, also not through a new descriptor for writing.
    #[test]
    fn a_sealed_copy_is_final() {
        let sealed = copy(b"bytes", 5).unwrap();
        let path = format!("/proc/self/fd/{}", sealed.file.as_raw_fd());
        let again = File::options().read(true).write(true).open(path);
        for file in [&sealed.file, &again.unwrap()] {
            assert!(file.write_at(b"x", 0).is_err());
            assert!(file.write_at(b"x", 5).is_err());
            assert!(ftruncate(file, 0).is_err());
            assert!(ftruncate(file, 9).is_err());
            let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
            assert!(fallocate(file, hole, 0, 5).is_err());
            assert!(fcntl_add_seals(file, SealFlags::FUTURE_WRITE).is_err());
        }
        assert_eq!(digest(&sealed.file).unwrap(), sealed.digest);
        let _ = fchmod(&sealed.file, Mode::from_raw_mode(0o666));
        let mode = sealed.file.metadata().unwrap();
        if rustix::fs::fcntl_get_seals(&sealed.file)
            .unwrap()
            .contains(SealFlags::EXEC)
        {
            use std::os::unix::fs::PermissionsExt as _;
            assert_eq!(mode.permissions().mode() & 0o111, 0o111);
        }
    }

    /// E-4: a file that is longer than stated is not read to its end.
    #[test]
    fn a_longer_file_is_refused() {
        assert!(copy(b"bytes", 4).is_none());
        let sealed = copy(b"", 4).unwrap();
        assert_eq!((sealed.length, sealed.digest[0]), (0, 0xE3));
    }
}
