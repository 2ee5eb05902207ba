//! A copy of a file in memory that no process can change.

use std::fs::File;
use std::io::{self, Read as _};
use std::os::unix::fs::FileExt as _;
use std::path::Path;

use rustix::fs::{
    MemfdFlags, Mode, OFlags, ResolveFlags, SealFlags, fcntl_add_seals, memfd_create, openat2,
};
use sha2::{Digest as _, Sha256};

use super::list::hex;

/// One read of the hash: large enough that system calls do not count.
const CHUNK: usize = 64 * 1024;
/// The kernel takes names of up to 249 bytes.
const NAME_BYTES: usize = 64;

/// Copies a file once, seals the copy, and only then computes the digest of the sealed bytes.
/// Returns the copy, its length, and its SHA-256 in small hexadecimal digits. Of a file that is
/// longer than `limit` it takes one byte more than that.
pub(super) fn copy(source: &File, name: &str, limit: u64) -> io::Result<(File, u64, String)> {
    let mut file = create(&name.as_bytes()[..name.len().min(NAME_BYTES)])?;
    let length = io::copy(&mut source.take(limit.saturating_add(1)), &mut file)?;
    seal(&file)?;
    let sha256 = digest(&file)?;
    Ok((file, length, sha256))
}

/// Creates an empty file in memory that may be executed.
fn create(name: &[u8]) -> io::Result<File> {
    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    // Before Linux 6.3 every such file may be executed, and the flag is unknown.
    let created = memfd_create(name, flags | MemfdFlags::EXEC);
    Ok(created.or_else(|_| memfd_create(name, flags))?.into())
}

/// Forbids each later change. The kernel refuses with `EBUSY` if a process has the file mapped for
/// writing, so no earlier mapping can change it either.
fn seal(file: &File) -> rustix::io::Result<()> {
    let seals = SealFlags::WRITE | SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL;
    // Without the permission to execute, other processes could no longer start the copy. Linux
    // before 6.3 does not know that seal.
    fcntl_add_seals(file, seals | SealFlags::EXEC).or_else(|_| fcntl_add_seals(file, seals))
}

fn digest(file: &File) -> io::Result<String> {
    let mut hash = Sha256::new();
    let mut chunk = vec![0; CHUNK];
    let mut offset = 0;
    loop {
        let count = file.read_at(&mut chunk, offset)?;
        if count == 0 {
            return Ok(hex(&hash.finalize()));
        }
        hash.update(&chunk[..count]);
        offset += count as u64;
    }
}

/// Opens a regular file. No part of its path may be a symbolic link, and a relative path must not
/// leave `folder`.
pub(super) fn open(folder: &Path, path: &str) -> io::Result<File> {
    let mut resolve = ResolveFlags::NO_SYMLINKS | ResolveFlags::NO_MAGICLINKS;
    if !path.starts_with('/') {
        resolve |= ResolveFlags::BENEATH;
    }
    // A pipe must not block the launcher.
    let flags = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NOCTTY | OFlags::NONBLOCK;
    let folder = File::open(folder)?;
    let file = File::from(openat2(folder, path, flags, Mode::empty(), resolve)?);
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    Ok(file)
}

/// Reads a file of at most `limit` bytes.
pub(super) fn read(file: impl io::Read, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    match file.take(limit + 1).read_to_end(&mut bytes)? as u64 > limit {
        true => Err(io::ErrorKind::FileTooLarge.into()),
        false => Ok(bytes),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{FallocateFlags, fallocate, fchmod, ftruncate};
    use std::io::Write as _;
    use std::os::fd::AsRawFd as _;

    fn copied(bytes: &[u8], limit: u64) -> (File, u64, String) {
        let mut source = tempfile::tempfile().unwrap();
        source.write_all(bytes).unwrap();
        let source = File::open(format!("/proc/self/fd/{}", source.as_raw_fd())).unwrap();
        copy(&source, "part", limit).unwrap()
    }

    /// E-4: no process changes a checked copy, also not through a new descriptor for writing.
    #[test]
    fn a_sealed_copy_is_final() {
        let (sealed, _, sha256) = copied(b"bytes", 5);
        let path = format!("/proc/self/fd/{}", sealed.as_raw_fd());
        let again = File::options().read(true).write(true).open(path);
        for file in [&sealed, &again.unwrap()] {
            assert!(file.write_at(b"x", 0).is_err());
            assert!(file.write_at(b"x", 5).is_err());
            assert!(ftruncate(file, 0).is_err());
            assert!(ftruncate(file, 9).is_err());
            let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
            assert!(fallocate(file, hole, 0, 5).is_err());
            assert!(fcntl_add_seals(file, SealFlags::FUTURE_WRITE).is_err());
        }
        assert_eq!(digest(&sealed).unwrap(), sha256);
        let _ = fchmod(&sealed, Mode::from_raw_mode(0o666));
        let mode = sealed.metadata().unwrap();
        if rustix::fs::fcntl_get_seals(&sealed)
            .unwrap()
            .contains(SealFlags::EXEC)
        {
            use std::os::unix::fs::PermissionsExt as _;
            assert_eq!(mode.permissions().mode() & 0o111, 0o111);
        }
    }

    /// E-4: a file that is longer than stated is not read to its end, and its length shows it.
    #[test]
    fn a_longer_file_is_refused() {
        assert_eq!(copied(b"longer bytes", 4).1, 5);
        let (_, length, sha256) = copied(b"", 4);
        assert_eq!((length, &sha256[..4]), (0, "e3b0"));
    }
}
