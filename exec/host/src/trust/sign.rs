//! Finds the parts of a platform, and signs their list.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::form::{Elf, Form};
use super::list::{List, hex};
use super::{Part, PartEntry, PartKind, Reason, TrustError, libraries};

/// The loader's own folders, where the configuration names no others.
const FOLDERS: [&str; 4] = ["/lib64", "/usr/lib64", "/lib", "/usr/lib"];
/// The folders of libraries for `ldconfig`.
const CONFIGURATION: &str = "/etc/ld.so.conf.d";

/// Signs a platform: the manifest, its programs, and what these need. Writes the list beside the
/// manifest and returns its parts. `programs` are as the manifest names them, and `key` is the
/// number of the key in the anchor.
///
/// # Errors
/// If a part cannot be read or found, or could not start from checked bytes.
pub fn sign(
    manifest: &Path,
    programs: &[PathBuf],
    security_counter: u32,
    key: u8,
    sign: impl FnOnce(&[u8]) -> [u8; 64],
) -> Result<Vec<PartEntry>, TrustError> {
    let name = manifest.file_name().unwrap_or_default().to_string_lossy();
    let wrong = |error: io::Error| Reason::from(error).of(&*name);
    let folder = fs::canonicalize(manifest).map_err(wrong)?;
    let folder = folder.parent().unwrap_or(Path::new("/"));
    let mut signer = Signer {
        opened: File::open(folder).map_err(wrong)?,
        folder,
        folders: system_folders(),
        parts: BTreeMap::new(),
    };
    signer.add_manifest(&name)?;
    for program in programs {
        let program = program.strip_prefix(folder).unwrap_or(program);
        signer.add_program(&program.to_string_lossy(), true)?;
    }
    let parts: Vec<PartEntry> = signer.parts.into_values().map(|(entry, _)| entry).collect();
    let text = List::new(security_counter, parts.clone()).signed(key, sign);
    let list = format!("{name}.parts");
    let text = text.map_err(|reason| reason.of(&*list))?;
    // A reader sees the old list or the new one.
    let fresh = folder.join(format!("{list}.new"));
    let written = fs::write(&fresh, text).and_then(|()| fs::rename(&fresh, folder.join(&list)));
    written.map_err(|error| Reason::from(error).of(&*list))?;
    Ok(parts)
}

fn system_folders() -> Vec<PathBuf> {
    let files = fs::read_dir(CONFIGURATION).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> = files.map(|file| file.path()).collect();
    files.sort();
    files.insert(0, "/etc/ld.so.conf".into());
    let texts = files
        .iter()
        .filter_map(|file| fs::read_to_string(file).ok());
    let lines: Vec<String> = texts
        .flat_map(|text| text.lines().map(str::to_owned).collect::<Vec<_>>())
        .collect();
    let folders = lines.iter().map(|line| line.trim());
    let folders = folders.filter(|line| line.starts_with('/')).chain(FOLDERS);
    folders.map(PathBuf::from).collect()
}

/// Parts by kind and name. The manifest has no form of a program.
type Found = BTreeMap<(PartKind, String), (PartEntry, Option<Arc<Part>>)>;

/// Finds parts.
struct Signer<'f> {
    folder: &'f Path,
    opened: File,
    folders: Vec<PathBuf>,
    parts: Found,
}

impl Signer<'_> {
    fn add_manifest(&mut self, name: &str) -> Result<(), TrustError> {
        let wrong = |reason: Reason| reason.of(name);
        let sealed = Part::read(&self.opened, name, u64::MAX).map_err(wrong)?;
        let sealed = sealed.ok_or_else(|| wrong(Reason::Length))?;
        let entry = PartEntry {
            kind: PartKind::Manifest,
            name: name.to_owned(),
            path: name.to_owned(),
            length: sealed.length,
            sha256: hex(&sealed.digest),
        };
        self.parts
            .insert((PartKind::Manifest, name.to_owned()), (entry, None));
        Ok(())
    }

    /// Returns the path for the list: without symbolic links, and from the folder if inside of it.
    fn place(&self, path: &Path) -> io::Result<String> {
        let real = fs::canonicalize(self.folder.join(path))?;
        let place = real.strip_prefix(self.folder).unwrap_or(&real);
        let text = place.to_str().map(str::to_owned);
        text.ok_or_else(|| io::Error::other("its path is not UTF-8"))
    }

    fn add(&mut self, kind: PartKind, name: &str, path: &Path) -> Result<Arc<Part>, TrustError> {
        let wrong = |reason: Reason| reason.of(name);
        if let Some((_, Some(part))) = self.parts.get(&(kind, name.to_owned())) {
            return Ok(part.clone());
        }
        let path = self.place(path).map_err(|error| wrong(error.into()))?;
        let sealed = Part::read(&self.opened, &path, u64::MAX).map_err(wrong)?;
        let part = Part::of(sealed.ok_or_else(|| wrong(Reason::Length))?);
        let part = Arc::new(part.map_err(wrong)?);
        let entry = PartEntry {
            kind,
            name: name.to_owned(),
            path,
            length: part.length,
            sha256: hex(&part.digest),
        };
        let parts = &mut self.parts;
        parts.insert((kind, name.to_owned()), (entry, Some(part.clone())));
        Ok(part)
    }

    fn add_program(&mut self, name: &str, may_be_script: bool) -> Result<(), TrustError> {
        let program = self.add(PartKind::Program, name, Path::new(name))?;
        let wrong = |why: &str| Reason::Form(why.to_owned()).of(name);
        let elf = match &program.form {
            Form::Elf(Elf { name: Some(_), .. }) => return Err(Reason::no_program().of(name)),
            Form::Elf(elf) => elf,
            Form::Script { interpreter, .. } if may_be_script => {
                return self.add_program(interpreter, false);
            }
            Form::Script { .. } => return Err(wrong("the interpreter is itself a script")),
        };
        let Some(path) = &elf.loader else {
            return if elf.needed.is_empty() {
                Ok(())
            } else {
                Err(wrong("it needs libraries, but names no loader"))
            };
        };
        let loader = self.add(PartKind::Loader, path, Path::new(path))?;
        let origin = self.origin(PartKind::Program, name);
        let mut origins = BTreeMap::from([(program.digest, origin)]);
        libraries(&program, &loader, |needing, library| {
            let origin = origins.get(&needing.digest).cloned().unwrap_or_default();
            let path = self.find(needing, &origin, library, elf.machine)?;
            let found = self.add(PartKind::Library, library, &path)?;
            origins.insert(found.digest, self.origin(PartKind::Library, library));
            if found
                .elf()
                .map_err(|reason| reason.of(library))?
                .name
                .as_deref()
                != Some(library)
            {
                return Err(Reason::Form("its own name is another".into()).of(library));
            }
            // Two programs may find different files of one name; one list cannot hold both.
            let place = self
                .place(&path)
                .map_err(|error| Reason::from(error).of(library))?;
            match self.parts.get(&(PartKind::Library, library.to_owned())) {
                Some((entry, _)) if entry.path == place => Ok(found),
                _ => Err(Reason::Twice(library.to_owned()).of(library)),
            }
        })?;
        Ok(())
    }

    /// Returns the folder in which a part lies.
    fn origin(&self, kind: PartKind, name: &str) -> PathBuf {
        let entry = self.parts.get(&(kind, name.to_owned()));
        let path = entry.map(|(entry, _)| self.folder.join(&entry.path));
        path.and_then(|path| path.parent().map(Path::to_owned))
            .unwrap_or_default()
    }

    /// Finds a library: first in the folders that the needing part names, then in the system's.
    fn find(
        &self,
        needing: &Part,
        origin: &Path,
        name: &str,
        machine: u16,
    ) -> Result<PathBuf, TrustError> {
        let own = needing.elf().ok().and_then(|elf| elf.folders.as_deref());
        let own = own
            .into_iter()
            .flat_map(|folders| folders.split(':'))
            .map(|folder| {
                let origin = origin.to_string_lossy();
                PathBuf::from(
                    folder
                        .replace("${ORIGIN}", &origin)
                        .replace("$ORIGIN", &origin),
                )
            });
        let fits = |path: &PathBuf| {
            let form = File::open(path).ok().and_then(|file| Form::of(&file).ok());
            matches!(form, Some(Form::Elf(elf)) if elf.machine == machine)
        };
        let found = own
            .chain(self.folders.iter().cloned())
            .map(|folder| folder.join(name))
            .find(fits);
        found.ok_or_else(|| {
            let error = io::Error::other("in no folder of libraries");
            Reason::from(error).of(name)
        })
    }
}
