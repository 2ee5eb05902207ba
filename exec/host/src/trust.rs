//! Trust: what runs is what was checked (E-4).
//!
//! An *anchor* (TOML) holds public keys and the mode. Beside the manifest lies the *list of parts*,
//! `NAME.parts`: length and SHA-256 of the manifest, of each executable, script, interpreter and
//! loader, and of each library that these need, signed by Ed25519. [`sign()`] writes it. Its last
//! line is `# signature KEY HEX`, and the signature covers all bytes before that line, so OpenSSL
//! can make and check it.
//!
//! Each part is read once, into a file in memory. The copy is sealed, then hashed, then executed as
//! `/proc/self/fd/N`. The loader takes the copies of all libraries by `--preload`, so each
//! executable page is of a sealed copy, and a file that changes after its check has no effect. All
//! processes share one copy of a part. A started process has only the manifest's environment.
//!
//! *Strict* refuses what is not authentic. *Monitor* warns, and starts the file as it is.
//!
//! # Limits
//! - `dlopen`, also the C library's own (name services, character sets), reads files by their path.
//! - What a program reads is data and not checked: configuration, and scripts in its arguments. A
//!   script chooses what it executes.
//! - Root, and any process that may trace the launcher, can change memory, the anchor and the
//!   kernel. The anchor itself is the first link: who writes it decides.
//! - A process of the same user can take the read permission from a copy. Later starts then fail.
//! - Set-user-id bits and file capabilities have no effect. `ps` shows `N` of the descriptor as the
//!   name of the process.
//! - Libraries of the same name but different content cannot be in one list. The loader must be
//!   glibc's, 2.33 or later, and `/proc` must be mounted where the process starts.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io;
use std::os::fd::{AsRawFd as _, OwnedFd};
use std::os::unix::fs::MetadataExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

use serde::Deserialize;
use sha2::{Digest as _, Sha256};

mod form;
mod list;
mod sealed;
mod sign;

pub use list::{PartEntry, PartKind};
pub use sign::sign;

use form::{Elf, Form};
use list::{List, hex, unhex};
use sealed::Sealed;

/// A larger manifest, list or anchor is refused before it is read to its end.
const MAX_TEXT_BYTES: u64 = 4 << 20;

/// Variables by which the loader, the C library or an interpreter reads files that were not
/// checked (glibc, `sysdeps/generic/unsecvars.h`; manuals of the shells and of Python, Perl).
const FORBIDDEN: &str = "BASH_ENV ENV GCONV_PATH GETCONF_DIR GLIBC_TUNABLES HOSTALIASES IFS \
    LOCALDOMAIN LOCPATH MALLOC_TRACE NIS_PATH NLSPATH NODE_OPTIONS OPENSSL_CONF \
    OPENSSL_ENGINES OPENSSL_MODULES PERL5DB PERL5LIB PERL5OPT PYTHONHOME PYTHONPATH PYTHONSTARTUP \
    RESOLV_HOST_CONF RES_OPTIONS RUBYOPT TZDIR";

/// Why a platform, or one program of it, is not trusted.
#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    /// A part is not what was signed. In strict mode it does not start.
    #[error("IntegrityOrAuthenticityCheckFailed: {part}: {reason}")]
    IntegrityOrAuthenticityCheckFailed {
        /// The part, by its name in the list or its path.
        part: String,
        /// What is wrong with it.
        #[source]
        reason: Reason,
    },
    /// The anchor cannot be used. Correct it: without an anchor nothing can be checked.
    #[error("trust anchor {path}: {why}")]
    Anchor {
        /// Its path.
        path: String,
        /// What is wrong.
        why: String,
    },
    /// The manifest cannot be read.
    #[error("{path}: {source}")]
    Manifest {
        /// Its path.
        path: String,
        /// The system's answer.
        source: io::Error,
    },
}

/// Why a check failed.
#[derive(Debug, thiserror::Error)]
pub enum Reason {
    /// The list or a part cannot be read.
    #[error("cannot be read: {0}")]
    Unreadable(#[from] io::Error),
    /// The list has no signature, or one that does not verify.
    #[error("the signature does not verify")]
    Signature,
    /// The key of the signature is unknown or retired.
    #[error("signed by an unknown or a retired key")]
    Key,
    /// The security counter of the list is below the lowest of the anchor.
    #[error("its security counter is below the lowest that the anchor accepts")]
    Old,
    /// A signed list does not follow the format.
    #[error("not a list of parts: {0}")]
    Format(String),
    /// A signed list has two parts of one name.
    #[error("{0} stands in it twice")]
    Twice(String),
    /// A path of a signed list has `.` or `..` in it.
    #[error("{0:?} is no plain path")]
    Path(String),
    /// A part is not in the list.
    #[error("not in the list of parts")]
    NotListed,
    /// A part is shorter or longer than stated.
    #[error("its length is not the signed one")]
    Length,
    /// A part has other bytes than stated.
    #[error("its SHA-256 is not the signed one")]
    Digest,
    /// A part cannot be started from checked bytes.
    #[error("{0}")]
    Form(String),
    /// A variable of the environment would make the program read unchecked files.
    #[error("the variable {0} names files that are not checked")]
    Variable(String),
}

impl Reason {
    /// A loader would run whatever its arguments name.
    fn no_program() -> Self {
        Self::Form("a loader or a library is no program".into())
    }

    fn of(self, part: impl Into<String>) -> TrustError {
        TrustError::IntegrityOrAuthenticityCheckFailed {
            part: part.into(),
            reason: self,
        }
    }
}

/// The treatment of what is not authentic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Mode {
    Strict,
    Monitor,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct AnchorText {
    mode: Mode,
    keys: Vec<String>,
    #[serde(default)]
    lowest_key: u8,
    #[serde(default)]
    lowest_counter: u32,
}

/// The keys that may sign, and what follows a failed check.
#[derive(Debug)]
struct Anchor {
    mode: Mode,
    keys: Vec<[u8; 32]>,
    /// Keys below this number are retired.
    lowest_key: u8,
    /// Lists with a lower security counter are refused.
    lowest_counter: u32,
}

impl Anchor {
    fn read(path: &Path) -> Result<Self, String> {
        let file = File::open(path).map_err(|error| error.to_string())?;
        let metadata = file.metadata().map_err(|error| error.to_string())?;
        if metadata.mode() & 0o002 != 0 {
            return Err("every user may write it: chmod o-w".into());
        }
        let bytes = sealed::read(&file, MAX_TEXT_BYTES).map_err(|error| error.to_string())?;
        let text = String::from_utf8(bytes.ok_or("too long")?).map_err(|_| "not UTF-8")?;
        let text: AnchorText = toml::from_str(&text).map_err(|error| error.to_string())?;
        let keys = text.keys.iter().map(|key| {
            unhex(key).ok_or_else(|| format!("{key:?} is not a key of 64 small hexadecimal digits"))
        });
        let keys: Vec<[u8; 32]> = keys.collect::<Result<_, _>>()?;
        if keys.is_empty() || keys.len() > 256 {
            return Err("1 to 256 keys are needed".into());
        }
        // A second number of a retired key would bring it back.
        if keys.iter().collect::<BTreeSet<_>>().len() < keys.len() {
            return Err("a key is in it twice".into());
        }
        Ok(Self {
            mode: text.mode,
            keys,
            lowest_key: text.lowest_key,
            lowest_counter: text.lowest_counter,
        })
    }
}

/// A sealed copy of a part, and how it starts.
#[derive(Debug)]
struct Part {
    copy: Arc<OwnedFd>,
    form: Form,
    length: u64,
    digest: [u8; 32],
}

impl Part {
    /// `Ok(None)` if the file is longer than `limit`.
    fn read(folder: &File, path: &str, limit: u64) -> Result<Option<Sealed>, Reason> {
        let name = path.rsplit('/').next().unwrap_or(path);
        Ok(Sealed::copy(&sealed::open(folder, path)?, name, limit)?)
    }

    fn of(sealed: Sealed) -> Result<Self, Reason> {
        Ok(Self {
            form: Form::of(&sealed.file).map_err(Reason::Form)?,
            length: sealed.length,
            digest: sealed.digest,
            copy: Arc::new(sealed.file.into()),
        })
    }

    fn elf(&self) -> Result<&Elf, Reason> {
        match &self.form {
            Form::Elf(elf) => Ok(elf),
            Form::Script { .. } => Err(Reason::Form("a script where none is possible".into())),
        }
    }

    fn path(&self) -> String {
        format!("/proc/self/fd/{}", self.copy.as_raw_fd())
    }
}

/// Returns the libraries of a program in the loader's order: those that it needs, then those that
/// these need. `find` returns the library of this name that a part needs.
fn libraries(
    program: &Arc<Part>,
    loader: &Part,
    mut find: impl FnMut(&Part, &str) -> Result<Arc<Part>, TrustError>,
) -> Result<Vec<Arc<Part>>, TrustError> {
    let mut known = BTreeSet::new();
    // Libraries may need the loader itself, which is there already.
    known.extend(loader.elf().ok().and_then(|elf| elf.name.clone()));
    let mut queue = VecDeque::from([program.clone()]);
    let mut found = Vec::new();
    while let Some(part) = queue.pop_front() {
        for name in &part.elf().map_err(|reason| reason.of("a library"))?.needed {
            if known.insert(name.clone()) {
                let library = find(&part, name)?;
                queue.push_back(library.clone());
                found.push(library);
            }
        }
    }
    Ok(found)
}

/// A list that was signed by a key of the anchor, and the copies of its parts.
#[derive(Debug)]
struct Checked {
    list: List,
    folder: File,
    copies: Mutex<BTreeMap<usize, Arc<Part>>>,
}

impl Checked {
    /// Returns the one copy of a part. The first call reads and checks the file.
    fn part(&self, kind: PartKind, name: &str) -> Result<Arc<Part>, TrustError> {
        let index = self.list.find(kind, name);
        let index = index.ok_or_else(|| Reason::NotListed.of(name))?;
        let mut copies = self.copies.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(part) = copies.get(&index) {
            return Ok(part.clone());
        }
        let part = self.load(&self.list.parts[index]);
        let part = Arc::new(part.map_err(|reason| reason.of(name))?);
        copies.insert(index, part.clone());
        Ok(part)
    }

    fn load(&self, entry: &PartEntry) -> Result<Part, Reason> {
        let sealed = Part::read(&self.folder, &entry.path, entry.length)?;
        let sealed = sealed.filter(|sealed| sealed.length == entry.length);
        let sealed = sealed.ok_or(Reason::Length)?;
        if hex(&sealed.digest) != entry.sha256 {
            return Err(Reason::Digest);
        }
        let part = Part::of(sealed)?;
        // The loader takes a library that is there already only by the library's own name.
        if entry.kind == PartKind::Library && part.elf()?.name.as_ref() != Some(&entry.name) {
            return Err(Reason::Form("its own name is not the listed one".into()));
        }
        Ok(part)
    }

    /// Returns the words that start a program from checked bytes, and the descriptors that they
    /// name. `shown` is the program's name of itself.
    fn start(&self, name: &str, shown: &OsStr, may_be_script: bool) -> Result<Start, TrustError> {
        let program = self.part(PartKind::Program, name)?;
        let elf = match &program.form {
            Form::Elf(Elf { name: Some(_), .. }) => return Err(Reason::no_program().of(name)),
            Form::Elf(elf) => elf,
            Form::Script {
                interpreter,
                argument,
            } if may_be_script => {
                let mut start = self.start(interpreter, OsStr::new(interpreter), false)?;
                start.words.extend(argument.iter().map(OsString::from));
                start.words.push(program.path().into());
                start.keep.push(program.copy.clone());
                return Ok(start);
            }
            Form::Script { .. } => {
                return Err(Reason::Form("the interpreter is itself a script".into()).of(name));
            }
        };
        let mut keep = vec![program.copy.clone()];
        let Some(loader) = &elf.loader else {
            let words = vec![program.path().into()];
            return Ok(Start {
                words,
                keep,
                argv0: Some(shown.to_owned()),
            });
        };
        let loader = self.part(PartKind::Loader, loader)?;
        let find = |_: &Part, name: &str| self.part(PartKind::Library, name);
        let libraries = libraries(&program, &loader, find)?;
        let paths: Vec<String> = libraries.iter().map(|library| library.path()).collect();
        let mut words: Vec<OsString> = vec![loader.path().into(), "--argv0".into(), shown.into()];
        // The cache would lead `dlopen` to whatever the cache names.
        words.push("--inhibit-cache".into());
        if !paths.is_empty() {
            words.extend(["--preload".into(), paths.join(":").into()]);
        }
        words.push(program.path().into());
        keep.push(loader.copy.clone());
        keep.extend(libraries.iter().map(|library| library.copy.clone()));
        Ok(Start {
            words,
            keep,
            argv0: None,
        })
    }
}

/// How a program starts.
struct Start {
    words: Vec<OsString>,
    keep: Vec<Arc<OwnedFd>>,
    argv0: Option<OsString>,
}

/// A manifest whose platform was checked, or whose list was found wrong in monitor mode, or that
/// is not checked because there is no anchor.
#[derive(Debug)]
pub struct Platform {
    folder: PathBuf,
    manifest: Vec<u8>,
    mode: Option<Mode>,
    checked: Option<Checked>,
    warning: Option<TrustError>,
}

impl Platform {
    /// Reads a manifest once, and checks it and its list of parts. Without an anchor nothing is
    /// checked, and all programs start as they are. Blocks on files.
    ///
    /// # Errors
    /// [`TrustError::IntegrityOrAuthenticityCheckFailed`] in strict mode only. An anchor or a
    /// manifest that cannot be read is an error in each mode.
    pub fn open(manifest: &Path, anchor: Option<&Path>) -> Result<Self, TrustError> {
        let unreadable = |source| TrustError::Manifest {
            path: manifest.display().to_string(),
            source,
        };
        let anchor = anchor.map(|path| {
            Anchor::read(path).map_err(|why| TrustError::Anchor {
                path: path.display().to_string(),
                why,
            })
        });
        let anchor = anchor.transpose()?;
        let folder = std::path::absolute(manifest).map_err(unreadable)?;
        let folder = folder.parent().unwrap_or(Path::new("/")).to_owned();
        let mut platform = Self {
            folder,
            manifest: Vec::new(),
            mode: anchor.as_ref().map(|anchor| anchor.mode),
            checked: None,
            warning: None,
        };
        if let Some(anchor) = &anchor {
            match check(manifest, &platform.folder, anchor) {
                Ok((bytes, checked)) => {
                    platform.manifest = bytes;
                    platform.checked = Some(checked);
                    return Ok(platform);
                }
                Err(error) if anchor.mode == Mode::Strict => return Err(error),
                Err(error) => platform.warning = Some(error),
            }
        }
        let file = File::open(manifest).map_err(unreadable)?;
        let bytes = sealed::read(file, MAX_TEXT_BYTES).map_err(unreadable)?;
        platform.manifest = bytes.ok_or_else(|| unreadable(io::ErrorKind::FileTooLarge.into()))?;
        Ok(platform)
    }

    /// Returns the bytes of the manifest that were checked.
    #[must_use]
    pub fn manifest(&self) -> &[u8] {
        &self.manifest
    }

    /// Returns what is wrong with the list or the manifest, in monitor mode. Log it.
    #[must_use]
    pub const fn warning(&self) -> Option<&TrustError> {
        self.warning.as_ref()
    }

    /// Returns the list of parts; empty without an anchor.
    #[must_use]
    pub fn parts(&self) -> &[PartEntry] {
        self.checked
            .as_ref()
            .map_or(&[], |checked| &checked.list.parts)
    }

    /// Returns the command that runs a program of the manifest from its checked bytes. The first
    /// call for a program reads its files; later calls share the copies. Blocks on files.
    ///
    /// The environment of the command is empty. Add variables by [`TrustedCommand::set`]. In
    /// monitor mode [`TrustedCommand::warning`] says why the file starts as it is.
    ///
    /// # Errors
    /// [`TrustError::IntegrityOrAuthenticityCheckFailed`] in strict mode only.
    pub fn command(&self, program: &Path) -> Result<TrustedCommand, TrustError> {
        let path = self.folder.join(program);
        let name = program.strip_prefix(&self.folder).unwrap_or(program);
        let warning = match (&self.checked, self.mode) {
            (Some(checked), Some(mode)) => {
                match checked.start(&name.to_string_lossy(), path.as_os_str(), true) {
                    Ok(start) => return Ok(TrustedCommand::new(start, mode)),
                    Err(error) if mode == Mode::Strict => return Err(error),
                    Err(error) => Some(error.to_string()),
                }
            }
            _ => self.warning.as_ref().map(ToString::to_string),
        };
        let mut command = Command::new(path);
        if self.mode.is_some() {
            command.env_clear();
        }
        Ok(TrustedCommand {
            command,
            keep: Vec::new(),
            warning,
            mode: self.mode,
        })
    }
}

/// Checks the list and the manifest.
fn check(path: &Path, folder: &Path, anchor: &Anchor) -> Result<(Vec<u8>, Checked), TrustError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let list_name = format!("{name}.parts");
    let wrong_list = |reason: Reason| reason.of(&*list_name);
    let folder = File::open(folder).map_err(|error| wrong_list(error.into()))?;
    let read = |path: &str, limit| {
        let bytes = sealed::read(sealed::open(&folder, path)?, limit)?;
        bytes.ok_or(Reason::Length)
    };
    let list = read(&list_name, MAX_TEXT_BYTES).map_err(wrong_list)?;
    let list = List::authentic(&list, anchor).map_err(wrong_list)?;
    let wrong = |reason: Reason| reason.of(&*name);
    let index = list.find(PartKind::Manifest, &name);
    let entry = &list.parts[index.ok_or_else(|| wrong(Reason::NotListed))?];
    let manifest = read(&name, entry.length.min(MAX_TEXT_BYTES)).map_err(wrong)?;
    if manifest.len() as u64 != entry.length {
        return Err(wrong(Reason::Length));
    }
    if hex(&Sha256::digest(&manifest)) != entry.sha256 {
        return Err(wrong(Reason::Digest));
    }
    let copies = Mutex::default();
    Ok((
        manifest,
        Checked {
            list,
            folder,
            copies,
        },
    ))
}

/// A command that runs checked bytes.
#[derive(Debug)]
pub struct TrustedCommand {
    /// The command. Its first words belong to the trust; add arguments after these.
    pub command: Command,
    /// The descriptors that the process inherits, without close-on-exec.
    pub keep: Vec<Arc<OwnedFd>>,
    /// Why the file starts unchecked, in monitor mode. Log it.
    pub warning: Option<String>,
    mode: Option<Mode>,
}

impl TrustedCommand {
    fn new(start: Start, mode: Mode) -> Self {
        let mut words = start.words.into_iter();
        let mut command = Command::new(words.next().unwrap_or_default());
        command.args(words).env_clear();
        if let Some(argv0) = start.argv0 {
            command.arg0(argv0);
        }
        Self {
            command,
            keep: start.keep,
            warning: None,
            mode: Some(mode),
        }
    }

    /// Sets a variable of the environment.
    ///
    /// # Errors
    /// In strict mode, if the variable would make the loader, the C library or an interpreter read
    /// files that were not checked. Monitor mode sets it, and returns the warning in
    /// [`Self::warning`].
    pub fn set(&mut self, name: &str, value: &OsStr) -> Result<(), TrustError> {
        if self.mode.is_some() && is_forbidden(name) {
            let error = Reason::Variable(name.to_owned()).of(name);
            if self.mode == Some(Mode::Strict) {
                return Err(error);
            }
            self.warning.get_or_insert(error.to_string());
        }
        self.command.env(name, value);
        Ok(())
    }
}

fn is_forbidden(name: &str) -> bool {
    // `NAME=` would be a variable of the shorter name.
    name.contains('=')
        || name.starts_with("LD_")
        || name.starts_with("BASH_FUNC_")
        || FORBIDDEN.split(' ').any(|it| it == name)
}
