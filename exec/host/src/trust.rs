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
use std::ffi::OsStr;
use std::fs::File;
use std::os::fd::{AsRawFd as _, OwnedFd};
use std::os::unix::fs::MetadataExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};

use serde::Deserialize;

mod form;
mod list;
mod sealed;
mod sign;

pub use list::{PartEntry, PartKind};
pub use sign::sign;

use form::Form;
use list::{List, unhex};

/// A larger manifest, list or anchor is refused before it is read to its end.
const MAX_TEXT_BYTES: u64 = 4 << 20;

/// Variables by which the loader, the C library or an interpreter reads files that were not
/// checked (glibc, `sysdeps/generic/unsecvars.h`; manuals of the shells and of Python, Perl).
const FORBIDDEN: &str = "BASH_ENV ENV GCONV_PATH GETCONF_DIR GLIBC_TUNABLES HOSTALIASES IFS \
    LOCALDOMAIN LOCPATH MALLOC_TRACE NIS_PATH NLSPATH NODE_OPTIONS OPENSSL_CONF \
    OPENSSL_ENGINES OPENSSL_MODULES PERL5DB PERL5LIB PERL5OPT PYTHONHOME PYTHONPATH PYTHONSTARTUP \
    RESOLV_HOST_CONF RES_OPTIONS RUBYOPT TZDIR";

/// What is wrong with a file.
type Why = Box<dyn std::error::Error + Send + Sync>;

/// Why a platform, or one program of it, is not trusted.
#[derive(Debug, thiserror::Error)]
pub enum TrustError {
    /// A part is not what was signed. In strict mode it does not start.
    #[error("IntegrityOrAuthenticityCheckFailed: {part}: {why}")]
    IntegrityOrAuthenticityCheckFailed {
        /// The part, by its name in the list or its path.
        part: String,
        /// What is wrong with it.
        #[source]
        why: Why,
    },
    /// The anchor or the manifest cannot be used. Correct it: without it nothing can be checked.
    #[error("{path}: {why}")]
    Unusable {
        /// Its path.
        path: String,
        /// What is wrong.
        #[source]
        why: Why,
    },
}

fn failed<E: Into<Why>>(part: &str) -> impl FnOnce(E) -> TrustError {
    |why| TrustError::IntegrityOrAuthenticityCheckFailed {
        part: part.to_owned(),
        why: why.into(),
    }
}

fn unusable<E: Into<Why>>(path: &Path) -> impl FnOnce(E) -> TrustError {
    |why| TrustError::Unusable {
        path: path.display().to_string(),
        why: why.into(),
    }
}

/// The treatment of what is not authentic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Mode {
    Strict,
    Monitor,
}

/// The keys that may sign, and what follows a failed check.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
struct Anchor {
    mode: Mode,
    keys: Vec<String>,
    /// Keys below this number are retired.
    #[serde(default)]
    lowest_key: u8,
    /// Lists with a lower security counter are refused.
    #[serde(default)]
    lowest_counter: u32,
}

impl Anchor {
    fn read(path: &Path) -> Result<Self, Why> {
        let file = File::open(path)?;
        if file.metadata()?.mode() & 0o002 != 0 {
            return Err("every user may write it: chmod o-w".into());
        }
        let anchor: Self = toml::from_slice(&sealed::read(file, MAX_TEXT_BYTES)?)?;
        let keys = &anchor.keys;
        if let Some(key) = keys.iter().find(|key| unhex::<32>(key).is_none()) {
            return Err(format!("{key:?} is not a key of 64 small hexadecimal digits").into());
        }
        if keys.is_empty() || keys.len() > 256 {
            return Err("1 to 256 keys are needed".into());
        }
        // A second number of a retired key would bring it back.
        if keys.iter().collect::<BTreeSet<_>>().len() < keys.len() {
            return Err("a key is in it twice".into());
        }
        Ok(anchor)
    }
}

/// A sealed copy of a part, and how it starts.
#[derive(Clone, Debug)]
struct Part {
    copy: Arc<OwnedFd>,
    form: Form,
}

impl Part {
    fn path(&self) -> String {
        format!("/proc/self/fd/{}", self.copy.as_raw_fd())
    }
}

/// A list that was signed by a key of the anchor, and the copies of its parts.
#[derive(Debug)]
struct Checked {
    list: List,
    folder: PathBuf,
    copies: Mutex<BTreeMap<usize, Part>>,
}

impl Checked {
    /// Checks the list and the manifest. Returns the copy of the manifest, too.
    fn open(folder: &Path, name: &str, anchor: &Anchor) -> Result<(Self, Part), TrustError> {
        let path = format!("{name}.parts");
        let text = sealed::open(folder, &path).and_then(|it| sealed::read(it, MAX_TEXT_BYTES));
        let list = List::authentic(&text.map_err(failed(&path))?, anchor);
        let checked = Self {
            list: list.map_err(failed(&path))?,
            folder: folder.to_owned(),
            copies: Mutex::default(),
        };
        let manifest = checked.part(PartKind::Manifest, name)?;
        Ok((checked, manifest))
    }

    /// Returns the one copy of a part. The first call reads and checks the file.
    fn part(&self, kind: PartKind, name: &str) -> Result<Part, TrustError> {
        let mut parts = self.list.parts.iter();
        let index = parts.position(|it| it.kind == kind && it.name == name);
        let index = index
            .ok_or("not in the list of parts")
            .map_err(failed(name))?;
        let mut copies = self.copies.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(part) = copies.get(&index) {
            return Ok(part.clone());
        }
        let part = self.load(&self.list.parts[index]).map_err(failed(name))?;
        copies.insert(index, part.clone());
        Ok(part)
    }

    fn load(&self, entry: &PartEntry) -> Result<Part, Why> {
        let name = entry.path.rsplit('/').next().unwrap_or_default();
        let file = sealed::open(&self.folder, &entry.path)?;
        let (file, length, sha256) = sealed::copy(&file, name, entry.length)?;
        if length != entry.length {
            return Err("its length is not the signed one".into());
        }
        if sha256 != entry.sha256 {
            return Err("its SHA-256 is not the signed one".into());
        }
        let form = match entry.kind {
            PartKind::Manifest => Form::default(),
            _ => Form::of(&file)?,
        };
        match (entry.kind, &form.name) {
            // The loader takes a library that is there already only by the library's own name.
            (PartKind::Library, name) if name.as_ref() != Some(&entry.name) => {
                return Err("its own name is not the listed one".into());
            }
            // The kernel would start a script by an interpreter that was not checked.
            (PartKind::Loader, None) => return Err("it is no loader of glibc".into()),
            _ => {}
        }
        let copy = Arc::new(file.into());
        Ok(Part { copy, form })
    }

    /// Returns the command that starts a program from checked bytes, and the descriptors that it
    /// names. `shown` is the program's name of itself.
    fn start(&self, name: &str, shown: &OsStr) -> Result<(Command, Vec<Arc<OwnedFd>>), TrustError> {
        let program = self.part(PartKind::Program, name)?;
        let refused = |why: &str| Err(failed(name)(why));
        if let Some((interpreter, argument)) = program.form.interpreter.split_first() {
            let part = self.part(PartKind::Program, interpreter)?;
            if !part.form.interpreter.is_empty() {
                return refused("the interpreter is itself a script");
            }
            let (mut command, mut keep) = self.start(interpreter, interpreter.as_ref())?;
            command.args(argument).arg(program.path());
            keep.push(program.copy);
            return Ok((command, keep));
        }
        // A loader would run whatever its arguments name.
        if program.form.name.is_some() {
            return refused("a loader or a library is no program");
        }
        let path = program.path();
        let mut keep = vec![program.copy];
        let Some(loader) = program.form.loader else {
            if !program.form.needed.is_empty() {
                return refused("it needs libraries, but names no loader");
            }
            let mut command = Command::new(path);
            command.arg0(shown);
            return Ok((command, keep));
        };
        let loader = self.part(PartKind::Loader, &loader)?;
        let mut command = Command::new(loader.path());
        // The cache would lead `dlopen` to whatever the cache names.
        command.arg("--argv0").arg(shown).arg("--inhibit-cache");
        keep.push(loader.copy);
        // In the loader's order: what the program needs, then what these need. Libraries may need
        // the loader itself, which is there already.
        let mut known: BTreeSet<String> = loader.form.name.into_iter().collect();
        let mut queue = VecDeque::from(program.form.needed);
        let mut paths = Vec::new();
        while let Some(name) = queue.pop_front() {
            if known.insert(name.clone()) {
                let library = self.part(PartKind::Library, &name)?;
                paths.push(library.path());
                keep.push(library.copy);
                queue.extend(library.form.needed);
            }
        }
        if !paths.is_empty() {
            command.arg("--preload").arg(paths.join(":"));
        }
        command.arg(path);
        Ok((command, keep))
    }
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
        let anchor = anchor.map(|path| Anchor::read(path).map_err(unusable(path)));
        let anchor = anchor.transpose()?;
        let folder = std::path::absolute(manifest).map_err(unusable(manifest))?;
        let folder = folder.parent().unwrap_or(Path::new("/")).to_owned();
        let mut platform = Self {
            folder,
            manifest: Vec::new(),
            mode: anchor.as_ref().map(|anchor| anchor.mode),
            checked: None,
            warning: None,
        };
        let mut source = manifest.to_owned();
        if let Some(anchor) = &anchor {
            let name = manifest.file_name().unwrap_or_default().to_string_lossy();
            match Checked::open(&platform.folder, &name, anchor) {
                Ok((checked, copy)) => {
                    platform.checked = Some(checked);
                    source = copy.path().into();
                }
                Err(error) if anchor.mode == Mode::Strict => return Err(error),
                Err(error) => platform.warning = Some(error),
            }
        }
        let bytes = File::open(source).and_then(|file| sealed::read(file, MAX_TEXT_BYTES));
        platform.manifest = bytes.map_err(unusable(manifest))?;
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
        let mut trusted = TrustedCommand {
            command: Command::new(&path),
            keep: Vec::new(),
            warning: self.warning.as_ref().map(ToString::to_string),
            mode: self.mode,
        };
        if let Some(checked) = &self.checked {
            match checked.start(&name.to_string_lossy(), path.as_os_str()) {
                Ok((command, keep)) => {
                    trusted.command = command;
                    trusted.keep = keep;
                }
                Err(error) if self.mode == Some(Mode::Strict) => return Err(error),
                Err(error) => trusted.warning = Some(error.to_string()),
            }
        }
        if self.mode.is_some() {
            trusted.command.env_clear();
        }
        Ok(trusted)
    }
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
    /// Sets a variable of the environment.
    ///
    /// # Errors
    /// In strict mode, if the variable would make the loader, the C library or an interpreter read
    /// files that were not checked. Monitor mode sets it, and returns the warning in
    /// [`Self::warning`].
    pub fn set(&mut self, name: &str, value: &OsStr) -> Result<(), TrustError> {
        if self.mode.is_some() && is_forbidden(name) {
            let error = failed(name)("the variable names files that are not checked");
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
