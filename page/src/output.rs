//! Files for results. A path is checked before anything is measured, and nothing is created before
//! there are results to write.
//!
//! The path `-` stands for stdout.
//!
//! A run may get a private `/dev/shm`, where the caller's paths would name other files. So the
//! place is opened at the check and stays open until the results are written.

use rustix::fs::{AtFlags, Mode, OFlags, fchmod, mkdirat, openat, renameat, statat, unlinkat};
use rustix::process::geteuid;
use std::ffi::{OsStr, OsString};
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::os::fd::OwnedFd;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// The path that stands for stdout.
pub const STDOUT: &str = "-";

/// The reason why results cannot be written to a place.
#[derive(Debug, thiserror::Error)]
#[error("{option} {path}: {why}")]
pub struct OutputError {
    option: &'static str,
    path: PathBuf,
    why: String,
}

/// A file that will be written.
#[derive(Debug)]
pub struct OutputFile(Place);

/// A folder that will receive files.
#[derive(Debug)]
pub struct OutputFolder(Place);

/// The place that an option names.
#[derive(Debug)]
struct Place {
    option: &'static str,
    path: PathBuf,
    target: Target,
}

impl Place {
    fn new(option: &'static str, path: &Path, target: Why) -> Result<Self, OutputError> {
        let path = path.to_owned();
        match target {
            Ok(target) => Ok(Self {
                option,
                path,
                target,
            }),
            Err(why) => Err(OutputError { option, path, why }),
        }
    }

    fn write(self, write: impl FnOnce(Target) -> io::Result<()>) -> Result<(), OutputError> {
        let (option, path) = (self.option, self.path);
        write(self.target).map_err(|error| OutputError {
            option,
            path,
            why: error.to_string(),
        })
    }
}

#[derive(Debug)]
enum Target {
    /// Stdout. A closed pipe is no error.
    Stdout,
    /// The place exists and is open: a file, a folder, or a device such as a terminal.
    Present(File),
    /// The place does not exist, or is a file to replace; the folder that will contain it is open.
    Absent(File, OsString),
}

/// A checked target, or the reason why results cannot be written to it.
type Why = Result<Target, String>;

impl OutputFile {
    /// Checks that a file can be written at `path`, and changes nothing.
    ///
    /// # Errors
    /// [`OutputError`] names the obstacle.
    pub fn check(option: &'static str, path: &Path) -> Result<Self, OutputError> {
        let target = match fs::metadata(path) {
            _ if path == Path::new(STDOUT) => Ok(Target::Stdout),
            Ok(found) if found.is_dir() => Err("it is a folder; name a file".to_owned()),
            Ok(found) => {
                let file = OpenOptions::new().write(true).open(path);
                let file = file.map_err(|error| error.to_string());
                file.map(|file| replaceable(path, &found).unwrap_or(Target::Present(file)))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => absent(path),
            Err(error) => Err(error.to_string()),
        };
        Ok(Self(Place::new(option, path, target)?))
    }

    /// Checks the file of each option that names one, and changes nothing.
    ///
    /// # Errors
    /// [`OutputError`] names the obstacle, such as two options for one file.
    pub fn check_all<const N: usize>(
        options: [(&'static str, Option<&Path>); N],
    ) -> Result<[Option<Self>; N], OutputError> {
        let mut places = [const { None }; N];
        for (place, (option, path)) in places.iter_mut().zip(options) {
            *place = path.map(|path| Self::check(option, path)).transpose()?;
        }
        let named: Vec<&Self> = places.iter().flatten().collect();
        distinct(&named)?;
        Ok(places)
    }

    /// Returns whether this is stdout. Then the command prints nothing else there.
    #[must_use]
    pub const fn is_stdout(&self) -> bool {
        matches!(self.0.target, Target::Stdout)
    }

    /// Returns the error of this place for this reason.
    pub(crate) fn error(&self, why: &impl ToString) -> OutputError {
        let Place { option, path, .. } = &self.0;
        OutputError {
            option,
            path: path.clone(),
            why: why.to_string(),
        }
    }

    /// Writes the file as a whole: it is never left half-written, except for a device.
    ///
    /// # Errors
    /// [`OutputError`], such as a full disk.
    pub fn write(self, content: &(impl AsRef<[u8]> + ?Sized)) -> Result<(), OutputError> {
        let content = content.as_ref();
        self.0.write(|target| match target {
            Target::Stdout => print(content),
            Target::Present(file) => overwrite(file, content),
            Target::Absent(folder, name) => create(&folder, &name, content),
        })
    }
}

impl OutputFolder {
    /// Checks that files can be written to the folder at `path`, which may not exist yet, and
    /// changes nothing.
    ///
    /// # Errors
    /// [`OutputError`] names the obstacle.
    pub fn check(option: &'static str, path: &Path) -> Result<Self, OutputError> {
        let target = match fs::metadata(path) {
            Ok(found) if found.is_dir() => open_folder(path).map(Target::Present),
            Ok(_) => Err("it is a file; name a folder".to_owned()),
            Err(error) if error.kind() == io::ErrorKind::NotFound => absent(path),
            Err(error) => Err(error.to_string()),
        };
        Ok(Self(Place::new(option, path, target)?))
    }

    /// Writes these files (name, text). Creates the folder if needed, and keeps its other files.
    ///
    /// # Errors
    /// [`OutputError`], such as a full disk.
    pub fn fill(self, files: &[(String, String)]) -> Result<(), OutputError> {
        self.0.write(|target| {
            let folder = match target {
                // `check` does not make it of a folder.
                Target::Stdout => return Err(io::ErrorKind::NotADirectory.into()),
                Target::Present(folder) => folder,
                Target::Absent(parent, name) => {
                    mkdirat(&parent, &name, Mode::from_raw_mode(0o777))?;
                    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
                    File::from(openat(&parent, &name, flags, Mode::empty())?)
                }
            };
            for (name, text) in files {
                create(&folder, name.as_ref(), text.as_bytes())?;
            }
            Ok(())
        })
    }
}

/// Refuses two outputs that would go to the same file.
pub(crate) fn distinct(places: &[&OutputFile]) -> Result<(), OutputError> {
    for (i, place) in places.iter().enumerate() {
        let same = |other: &&&OutputFile| same(&other.0.path, &place.0.path);
        if let Some(other) = places[..i].iter().find(same) {
            return Err(OutputError {
                option: place.0.option,
                path: place.0.path.clone(),
                why: format!("{} goes to the same file", other.0.option),
            });
        }
    }
    Ok(())
}

fn same(a: &Path, b: &Path) -> bool {
    let full = |path: &Path| {
        let folder = fs::canonicalize(parent(path)).ok()?;
        Some(folder.join(path.file_name()?))
    };
    a == b || full(a).is_some_and(|a| Some(a) == full(b))
}

fn parent(path: &Path) -> &Path {
    let parent = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty());
    parent.unwrap_or(Path::new("."))
}

/// Returns a target that does not exist yet. Its folder must exist and be writable.
fn absent(path: &Path) -> Why {
    if path.symlink_metadata().is_ok() {
        return Err("a symbolic link that leads nowhere".to_owned());
    }
    let name = path.file_name().ok_or("not the name of a file")?;
    let folder = parent(path);
    if !folder.is_dir() {
        let folder = folder.display();
        return Err(format!("there is no folder {folder}; create it first"));
    }
    Ok(Target::Absent(open_folder(folder)?, name.to_owned()))
}

/// Returns a target that replaces this file, if it is an ordinary one with a name in a folder that
/// can be written to. Symbolic links to it stay.
fn replaceable(path: &Path, found: &fs::Metadata) -> Option<Target> {
    let full = fs::canonicalize(path).ok().filter(|_| found.is_file())?;
    // A path such as /dev/stdin leads to a file that may have no name any more.
    let named = fs::metadata(&full).ok()?;
    let is_same = (named.dev(), named.ino()) == (found.dev(), found.ino());
    // Another name of the same file would keep the old content. In a folder such as /tmp only the
    // owner can replace a file.
    let is_own = found.nlink() == 1 && found.uid() == geteuid().as_raw();
    let folder = open_folder(parent(&full)).ok()?;
    (is_same && is_own)
        .then(|| Target::Absent(folder, full.file_name().unwrap_or_default().to_owned()))
}

/// Opens a folder that can be written to. Only an attempt reveals missing permissions, read-only
/// file systems and full disks, so this creates an unnamed file, which vanishes at once.
fn open_folder(path: &Path) -> Result<File, String> {
    let tried = tempfile::tempfile_in(path).and_then(|_| File::open(path));
    tried.map_err(|error| format!("cannot write in {}: {}", path.display(), error))
}

fn print(content: &[u8]) -> io::Result<()> {
    match io::stdout().write_all(content) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written,
    }
}

fn overwrite(mut file: File, content: &[u8]) -> io::Result<()> {
    // A device has no length that could be set.
    if file.metadata()?.is_file() {
        file.set_len(0)?;
    }
    file.write_all(content)
}

/// Writes a file under another name first: a reader sees the whole file, or the old one.
fn create(folder: &File, name: &OsStr, content: &[u8]) -> io::Result<()> {
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
    let mut other = OsString::from(format!(".tandem-{}-", std::process::id()));
    other.push(name);
    let file: OwnedFd = openat(folder, &other, flags, Mode::from_raw_mode(0o666))?;
    let file = File::from(file);
    let written = keep_mode(folder, name, &file)
        .and_then(|()| (&file).write_all(content))
        .and_then(|()| Ok(renameat(folder, &other, folder, name)?));
    written.inspect_err(|_| {
        // The caller gets the write error, so an error of this removal is ignored.
        let _ = unlinkat(folder, &other, AtFlags::empty());
    })
}

/// Gives a file the permissions of the one that it replaces, if there is one.
fn keep_mode(folder: &File, name: &OsStr, file: &File) -> io::Result<()> {
    match statat(folder, name, AtFlags::empty()) {
        Ok(old) => Ok(fchmod(file, Mode::from_raw_mode(old.st_mode & 0o777))?),
        Err(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<OsString> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<OsString> = entries.map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        names
    }

    #[test]
    fn a_check_leaves_nothing_behind() {
        let root = tempfile::tempdir().unwrap();
        let full = root.path().join("old.json");
        fs::write(&full, "old").unwrap();
        OutputFile::check("--json", &full).unwrap();
        OutputFile::check("--json", &root.path().join("new.json")).unwrap();
        OutputFolder::check("--hgrm", &root.path().join("new")).unwrap();
        assert_eq!(names(root.path()), ["old.json"]);
        assert_eq!(fs::read_to_string(full).unwrap(), "old");
    }

    #[test]
    fn what_is_written_replaces_what_was_there() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a.json");
        for text in ["something longer", "short"] {
            OutputFile::check("--json", &path)
                .unwrap()
                .write(text)
                .unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
    }

    /// A write that fails leaves the old content, and nothing beside it.
    #[test]
    fn what_fails_changes_nothing() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a.json");
        let link = root.path().join("link");
        fs::write(&path, "old").unwrap();
        std::os::unix::fs::symlink(&path, &link).unwrap();
        let place = OutputFile::check("--json", &link).unwrap();
        place.write("new").unwrap();
        assert!(link.is_symlink());
        assert_eq!(fs::read_to_string(&path).unwrap(), "new");
        let place = OutputFile::check("--json", &path).unwrap();
        // Nothing can replace a folder that holds something by a file.
        fs::remove_file(&path).unwrap();
        fs::create_dir_all(path.join("inner")).unwrap();
        assert!(place.write("newer").is_err());
        assert_eq!(names(root.path()), ["a.json", "link"]);
    }

    #[test]
    fn a_folder_is_created_when_there_is_something_for_it() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("h");
        for text in ["one", "two"] {
            let files = [("x.hgrm".to_owned(), text.to_owned())];
            OutputFolder::check("--hgrm", &path)
                .unwrap()
                .fill(&files)
                .unwrap();
            assert_eq!(fs::read_to_string(path.join("x.hgrm")).unwrap(), text);
        }
        assert_eq!(names(&path), ["x.hgrm"]);
    }

    #[test]
    fn what_cannot_be_is_said_before() {
        let root = tempfile::tempdir().unwrap();
        let (root, file) = (root.path(), root.path().join("file"));
        fs::write(&file, "x").unwrap();
        let link = root.join("link");
        std::os::unix::fs::symlink(root.join("nowhere"), &link).unwrap();
        for (path, why) in [
            (root.to_owned(), "name a file"),
            (root.join("no/such/a.json"), "create it first"),
            (file.join("a.json"), "Not a directory"),
            (link, "leads nowhere"),
            (PathBuf::from("/proc/a.json"), "cannot write"),
        ] {
            let error = OutputFile::check("--json", &path).unwrap_err().to_string();
            assert!(
                error.contains(why) && error.starts_with("--json"),
                "{error}"
            );
        }
        let error = OutputFolder::check("--hgrm", &file)
            .unwrap_err()
            .to_string();
        assert!(error.contains("name a folder"), "{error}");
        assert_eq!(names(root), ["file", "link"]);
    }

    #[test]
    fn a_dash_is_stdout() {
        let is_stdout = |path: &str| {
            let place = OutputFile::check("--json", Path::new(path));
            place.unwrap().is_stdout()
        };
        assert!(is_stdout("-"));
        assert!(!is_stdout("./-"));
    }

    #[test]
    fn two_outputs_do_not_share_a_file() {
        let root = tempfile::tempdir().unwrap();
        let check = |name: &str| OutputFile::check("--json", &root.path().join(name)).unwrap();
        let places = ["a", "b", "./a"].map(check);
        assert!(distinct(&[&places[0], &places[1]]).is_ok());
        assert!(distinct(&[&places[0], &places[2]]).is_err());
    }
}
