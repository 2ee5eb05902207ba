//! Finds the parts of a platform, and signs their list.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;

use super::list::{List, VERSION};
use super::{Checked, Part, PartEntry, PartKind, TrustError, Why, failed, sealed};

/// Signs a platform: the manifest, its programs, and what these need. Writes the list beside the
/// manifest and returns its parts. `programs` are as the manifest names them, and `key` is the
/// number of the key in the anchor.
///
/// Each program's loader says which libraries the program needs, so the loader runs here.
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
    let real = fs::canonicalize(manifest).map_err(failed(&name))?;
    let folder = real.parent().unwrap_or(Path::new("/"));
    let mut checked = Checked {
        list: List {
            version: VERSION,
            security_counter,
            parts: Vec::new(),
        },
        folder: folder.to_owned(),
        copies: Mutex::default(),
    };
    checked.add(PartKind::Manifest, &name, &name)?;
    for program in programs {
        let program = program.strip_prefix(folder).unwrap_or(program);
        let program = program.to_string_lossy();
        checked.add_program(&program)?;
        checked.start(&program, OsStr::new(""))?;
    }
    let list = checked.list;
    let text = list.signed(key, sign).map_err(failed(&name))?;
    // A reader sees the old list or the new one.
    let fresh = folder.join(format!("{name}.parts.new"));
    let path = folder.join(format!("{name}.parts"));
    let written = fs::write(&fresh, text).and_then(|()| fs::rename(&fresh, path));
    written.map_err(failed(&name))?;
    Ok(list.parts)
}

/// At signing the list grows, and each part of it is checked as it will be at a start.
impl Checked {
    /// Adds a part. A second file of the same name also enters the list, which is refused then.
    fn add(&mut self, kind: PartKind, name: &str, path: &str) -> Result<Part, TrustError> {
        // Without symbolic links, and from the folder if inside of it.
        let path = fs::canonicalize(self.folder.join(path)).map_err(failed(name))?;
        let path = path.strip_prefix(&self.folder).unwrap_or(&path);
        let path = path.to_string_lossy().into_owned();
        let is_it = |it: &PartEntry| (it.kind, &*it.name, &it.path) == (kind, name, &path);
        if !self.list.parts.iter().any(is_it) {
            let file = sealed::open(&self.folder, &path);
            let copy = file.and_then(|file| sealed::copy(&file, name, u64::MAX));
            let (_, length, sha256) = copy.map_err(failed(name))?;
            self.list.parts.push(PartEntry {
                kind,
                name: name.to_owned(),
                path,
                length,
                sha256,
            });
        }
        self.part(kind, name)
    }

    /// Adds a program, its interpreter if it is a script, and what these need.
    fn add_program(&mut self, name: &str) -> Result<(), TrustError> {
        let mut name = name.to_owned();
        let mut form = self.add(PartKind::Program, &name, &name)?.form;
        if !form.interpreter.is_empty() {
            name = form.interpreter.swap_remove(0);
            form = self.add(PartKind::Program, &name, &name)?.form;
        }
        let Some(loader) = form.loader else {
            return Ok(());
        };
        let own = self.add(PartKind::Loader, &loader, &loader)?.form.name;
        let said = libraries(&self.folder.join(loader), &self.folder.join(&name));
        for line in said.map_err(failed(&name))?.lines() {
            // `NAME => PATH (ADDRESS)`. The lines of the kernel and of the loader have no `=>`, but
            // libraries may need the loader by its name: it is there already.
            if let Some((library, rest)) = line.trim().split_once(" => ")
                && let Some((path, _)) = rest.rsplit_once(" (")
                && Some(library) != own.as_deref()
            {
                self.add(PartKind::Library, library, path)?;
            }
        }
        Ok(())
    }
}

/// Asks the loader which libraries a program needs.
fn libraries(loader: &Path, program: &Path) -> Result<String, Why> {
    let mut command = Command::new(loader);
    let said = command.arg("--list").arg(program).env_clear().output()?;
    match said.status.success() {
        true => Ok(String::from_utf8(said.stdout)?),
        false => Err(String::from_utf8_lossy(&said.stderr).trim().into()),
    }
}
