//! Where the messages go: an MCAP file, clients of a WebSocket server, or both.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Read as _, Seek as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use foxglove::{Context, McapWriterHandle, WebSocketServerHandle};

use crate::at;

/// The first bytes of an MCAP file.
const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// The server is for this machine: Foxglove in its browser, or through ssh.
const HOST: &str = "127.0.0.1";

/// The open sinks. Dropping them closes the file.
pub(crate) struct Sinks {
    file: Option<(McapWriterHandle<BufWriter<File>>, PathBuf)>,
    server: Option<WebSocketServerHandle>,
}

impl Sinks {
    /// Creates the file, and starts the server at this port; 0 chooses one. Both get the messages
    /// of the context's channels.
    ///
    /// # Errors
    /// If the port is taken, or the file cannot be written or is no MCAP file. Then nothing is
    /// left behind.
    pub(crate) fn open(
        context: &Arc<Context>,
        path: Option<&Path>,
        port: Option<u16>,
    ) -> anyhow::Result<Self> {
        let start = |port| {
            let server = context.websocket_server().name("tandem").bind(HOST, port);
            let server = server.start_blocking();
            server.with_context(|| format!("--foxglove: port {port} of {HOST}"))
        };
        let server = port.map(start).transpose()?;
        let create = |path: &Path| {
            let file = create(path)?;
            let writer = context.mcap_writer().create(BufWriter::new(file));
            let writer = writer.map_err(|error| at(path, error))?;
            anyhow::Ok((writer, path.to_owned()))
        };
        let file = path.map(create).transpose()?;
        Ok(Self { file, server })
    }

    /// Returns the port of the server.
    pub(crate) fn port(&self) -> Option<u16> {
        self.server.as_ref().map(WebSocketServerHandle::port)
    }

    /// Completes the file with these figures, and disconnects all clients.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(crate) fn close(self, figures: &BTreeMap<String, String>) -> anyhow::Result<()> {
        if let Some((writer, path)) = self.file {
            let written = writer.write_metadata("tandem", figures.clone());
            let written = written.and_then(|()| writer.close());
            written.map_err(|error| at(&path, error))?;
        }
        if let Some(server) = self.server {
            server.stop().wait_blocking();
        }
        Ok(())
    }

    /// Removes the file: there was no run.
    ///
    /// # Errors
    /// If the file cannot be removed.
    pub(crate) fn discard(self) -> anyhow::Result<()> {
        let Some((writer, path)) = self.file else {
            return Ok(());
        };
        drop(writer);
        fs::remove_file(&path).map_err(|error| at(&path, error))
    }
}

/// Creates the file, or empties an MCAP file that exists.
fn create(path: &Path) -> anyhow::Result<File> {
    let mut options = OpenOptions::new();
    let opened = options.read(true).write(true).create(true).truncate(false);
    let mut file = opened.open(path).map_err(|error| at(path, error))?;
    let metadata = file.metadata().map_err(|error| at(path, error))?;
    if !metadata.is_file() {
        return Err(at(path, "it is no regular file"));
    }
    let mut begin = [0; MAGIC.len()];
    if metadata.len() > 0 && (file.read_exact(&mut begin).is_err() || begin != MAGIC) {
        return Err(at(path, "it exists and is no MCAP file; name another one"));
    }
    let emptied = file.set_len(0).and_then(|()| file.rewind());
    emptied.map_err(|error| at(path, error))?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Only a file that this program may have written is replaced.
    #[test]
    fn a_file_that_is_no_mcap_file_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.txt");
        fs::write(&path, "my notes").unwrap();
        let Err(error) = Sinks::open(&Context::new(), Some(&path), None) else {
            panic!("it was replaced")
        };
        assert!(error.to_string().contains("no MCAP file"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), b"my notes");
    }

    #[test]
    fn an_older_recording_is_replaced_and_a_discarded_one_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run.mcap");
        for _ in 0..2 {
            let sinks = Sinks::open(&Context::new(), Some(&path), None).unwrap();
            sinks.close(&BTreeMap::new()).unwrap();
        }
        let bytes = fs::read(&path).unwrap();
        assert!(bytes.starts_with(&MAGIC) && bytes.ends_with(&MAGIC));
        let sinks = Sinks::open(&Context::new(), Some(&path), None).unwrap();
        sinks.discard().unwrap();
        assert!(!path.exists());
    }

    #[test]
    fn a_taken_port_is_refused() {
        let first = Sinks::open(&Context::new(), None, Some(0)).unwrap();
        let port = first.port().unwrap();
        let Err(error) = Sinks::open(&Context::new(), None, Some(port)) else {
            panic!("two servers at one port")
        };
        assert!(
            format!("{error:#}").contains(&port.to_string()),
            "{error:#}"
        );
    }
}
