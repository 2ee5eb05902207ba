//! The folder of a report. It is replaced as a whole, and only if it contains only a report.

use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use serde::Deserialize;
use tempfile::TempDir;

use crate::metrics::SCHEMA;

/// File name of the report's page.
pub const REPORT: &str = "report.html";
/// File name of the figures. The content of this file identifies a folder as a report.
pub const METRICS: &str = "metrics.json";
/// File name of the CAN log.
pub const CANDUMP: &str = "candump.log";
/// File name of the distribution of the control period.
pub const CONTROL_PERIOD: &str = "control-period.hgrm";
/// File name of the distribution of the chain's latency.
pub const CHAIN: &str = "chain.hgrm";
/// File name of the timeline of all cores, for <https://ui.perfetto.dev>.
pub const TRACE: &str = "trace.perfetto-trace";

const FILES: [&str; 6] = [REPORT, METRICS, CANDUMP, CONTROL_PERIOD, CHAIN, TRACE];

/// A folder that a report can replace or create.
#[derive(Debug)]
pub struct ReportFolder {
    /// Path of the folder, with symbolic links resolved.
    path: PathBuf,
    /// Its parent folder.
    parent: PathBuf,
}

impl ReportFolder {
    /// Checks that a report can be written at `path`. Changes nothing.
    ///
    /// # Errors
    /// If a report cannot be written. The message names the obstacle and the remedy.
    pub fn check(path: &Path) -> anyhow::Result<Self> {
        // Replace the target of a symbolic link, so that the link stays.
        let path = match fs::canonicalize(path) {
            Ok(path) => path,
            Err(error) if error.kind() == io::ErrorKind::NotFound => absent(path)?,
            Err(error) => {
                return Err(error).with_context(|| format!("--out {}", path.display()));
            }
        };
        let parent = path.parent().with_context(|| {
            format!(
                "--out {}: the root folder cannot be a report",
                path.display()
            )
        })?;
        if std::env::current_dir().is_ok_and(|current| current.starts_with(&path)) {
            bail!(
                "--out {}: the current folder would be replaced; name another one",
                path.display()
            );
        }
        if path.exists() {
            check_replaceable(&path)?;
        }
        // Try to write: missing permissions or a full disk cannot be detected in another way.
        TempDir::new_in(parent)
            .with_context(|| format!("--out: cannot write in {}", parent.display()))?;
        Ok(Self {
            parent: parent.to_owned(),
            path,
        })
    }

    /// Returns the path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Creates a temporary folder in the same parent. The caller fills it and passes it to `put`.
    ///
    /// # Errors
    /// If the temporary folder cannot be created.
    pub fn stage(&self) -> anyhow::Result<TempDir> {
        tempfile::Builder::new()
            .prefix(".tandem-report-")
            // Request the mode of an ordinary new folder. The umask restricts it.
            .permissions(fs::Permissions::from_mode(0o777))
            .tempdir_in(&self.parent)
            .with_context(|| format!("cannot write in {}", self.parent.display()))
    }

    /// Replaces the old folder by the filled one.
    ///
    /// # Errors
    /// If the old folder is no longer a report, or cannot be replaced.
    pub fn put(&self, stage: TempDir) -> anyhow::Result<()> {
        // Another run may write its report here at the same time. The later report then remains.
        for _ in 0..10 {
            if self.path.exists() {
                check_replaceable(&self.path)?;
                let old = self.stage()?;
                let moved = fs::rename(&self.path, old.path().join("old"));
                if moved
                    .as_ref()
                    .is_err_and(|error| error.kind() != io::ErrorKind::NotFound)
                {
                    return moved.with_context(|| format!("replacing {}", self.path.display()));
                }
            }
            match fs::rename(stage.path(), &self.path) {
                Ok(()) => {
                    // The folder has been moved, so `TempDir` must not delete it.
                    let _ = stage.keep();
                    return Ok(());
                }
                Err(error) if error.kind() == io::ErrorKind::DirectoryNotEmpty => {}
                Err(error) => {
                    return Err(error).with_context(|| format!("writing {}", self.path.display()));
                }
            }
        }
        bail!(
            "{}: other runs keep writing to the same folder",
            self.path.display()
        )
    }
}

/// Returns the full path of a folder that does not exist. Its parent must exist.
fn absent(path: &Path) -> anyhow::Result<PathBuf> {
    if path.symlink_metadata().is_ok() {
        bail!(
            "--out {}: a symbolic link whose target does not exist",
            path.display()
        );
    }
    let name = path
        .file_name()
        .with_context(|| format!("--out {}: not the name of a folder", path.display()))?;
    let parent = match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let parent = fs::canonicalize(parent).with_context(|| {
        let parent = parent.display();
        format!(
            "--out {}: there is no folder {parent}; create it first",
            path.display()
        )
    })?;
    Ok(parent.join(name))
}

/// Checks that an existing folder is empty, or holds a report and nothing else.
fn check_replaceable(path: &Path) -> anyhow::Result<()> {
    let shown = path.display();
    if !path.is_dir() {
        bail!("--out {shown}: it is a file; name a folder");
    }
    let entries = fs::read_dir(path).with_context(|| format!("--out {shown}"))?;
    let mut names = Vec::new();
    for entry in entries {
        names.push(entry.with_context(|| format!("--out {shown}"))?.file_name());
    }
    if names.is_empty() {
        return Ok(());
    }
    if let Some(foreign) = names
        .iter()
        .find(|name| !FILES.iter().any(|known| name == known))
    {
        bail!(
            "--out {shown}: it holds {}, which is not part of a report and would be deleted; \
             name another folder",
            foreign.display()
        );
    }
    #[derive(Deserialize)]
    struct Marker {
        schema: String,
    }
    let marker = fs::read(path.join(METRICS)).ok();
    let marker: Option<Marker> = marker.and_then(|text| serde_json::from_slice(&text).ok());
    if marker.is_none_or(|marker| marker.schema != SCHEMA) {
        bail!(
            "--out {shown}: it is neither empty nor a report of this program; name another folder"
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn put(out: &ReportFolder, content: &str) -> anyhow::Result<()> {
        let stage = out.stage().unwrap();
        fs::write(
            stage.path().join(METRICS),
            format!("{{\"schema\":\"{SCHEMA}\"}}"),
        )
        .unwrap();
        fs::write(stage.path().join(REPORT), content).unwrap();
        out.put(stage)
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_report_replaces_an_empty_folder_and_an_earlier_report() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("out");
        put(&ReportFolder::check(&path).unwrap(), "one").unwrap();
        put(&ReportFolder::check(&path).unwrap(), "two").unwrap();
        assert_eq!(fs::read_to_string(path.join(REPORT)).unwrap(), "two");
        let empty = root.path().join("empty");
        fs::create_dir(&empty).unwrap();
        put(&ReportFolder::check(&empty).unwrap(), "three").unwrap();
        assert_eq!(names(root.path()), ["empty", "out"]);
    }

    #[test]
    fn checking_changes_nothing() {
        let root = tempfile::tempdir().unwrap();
        ReportFolder::check(&root.path().join("out")).unwrap();
        assert!(names(root.path()).is_empty());
    }

    #[test]
    fn what_is_no_report_is_never_replaced() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("file");
        fs::write(&file, "x").unwrap();
        let folder = root.path().join("folder");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("thesis.txt"), "x").unwrap();
        let other = root.path().join("other");
        fs::create_dir(&other).unwrap();
        fs::write(other.join(METRICS), "{\"schema\":\"someone else's\"}").unwrap();
        for path in [
            file,
            folder,
            other,
            root.path().join("a/b"),
            PathBuf::from("/"),
        ] {
            assert!(ReportFolder::check(&path).is_err(), "{}", path.display());
        }
    }

    #[test]
    fn what_came_into_a_report_since_is_never_replaced() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("out");
        let out = ReportFolder::check(&path).unwrap();
        put(&out, "one").unwrap();
        fs::write(path.join("notes.txt"), "mine").unwrap();
        assert!(put(&out, "two").is_err());
        assert_eq!(fs::read_to_string(path.join("notes.txt")).unwrap(), "mine");
        assert_eq!(names(root.path()), ["out"]);
    }

    #[test]
    fn a_symbolic_link_stays() {
        let root = tempfile::tempdir().unwrap();
        let real = root.path().join("real");
        fs::create_dir(&real).unwrap();
        let link = root.path().join("link");
        std::os::unix::fs::symlink(&real, &link).unwrap();
        put(&ReportFolder::check(&link).unwrap(), "one").unwrap();
        assert!(link.is_symlink() && link.join(REPORT).exists());
    }
}
