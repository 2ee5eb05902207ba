//! Writing a run's logs without disturbing the thread that has the data.

use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

use anyhow::{Context as _, anyhow};
use tandem_board::{CanFrame, CanId};
use tandem_bus::candump;

use crate::files::RunFiles;
use crate::live::Live;
use crate::runlog::Record;
use crate::tape::{self, Entry};

/// Name of the bus in the CAN log.
const INTERFACE: &str = "can0";

/// A frame on the bus, with the time of day in µs.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LoggedFrame {
    /// Microseconds since 1970.
    pub(crate) at_us: u64,
    /// The frame.
    pub(crate) frame: CanFrame,
}

/// What is handed over at once.
#[derive(Debug, Default)]
struct Batch {
    frames: Vec<LoggedFrame>,
    records: Vec<Record>,
    tape: Vec<Entry>,
    live: Option<Live>,
}

/// The side of the thread that has the data: it collects, and hands over now and then. Nothing here
/// blocks or makes a system call but [`Recorder::hand_over`], which wakes the writer.
#[derive(Debug)]
pub(crate) struct Recorder {
    batch: Batch,
    /// Entries that the trace's file was given.
    taped: usize,
    to_writer: Sender<Batch>,
    writer: JoinHandle<anyhow::Result<()>>,
}

impl Recorder {
    /// Creates the files and starts the writer.
    ///
    /// # Errors
    /// If a file cannot be created.
    pub(crate) fn create(files: &RunFiles) -> anyhow::Result<Self> {
        let create = |path: PathBuf| {
            File::create(&path).with_context(|| format!("creating {}", path.display()))
        };
        let logs = Logs {
            run: BufWriter::new(create(files.log())?),
            candump: BufWriter::new(create(files.candump())?),
            tape: BufWriter::new(create(files.tape())?),
            live: files.live(),
        };
        let (to_writer, batches) = channel();
        let writer = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || logs.write_all(&batches))
            .context("starting the recorder")?;
        Ok(Self {
            batch: Batch::default(),
            taped: 0,
            to_writer,
            writer,
        })
    }

    /// Takes a frame for the CAN log.
    pub(crate) fn frame(&mut self, at_us: u64, frame: CanFrame) {
        self.batch.frames.push(LoggedFrame { at_us, frame });
    }

    /// Takes a record for the run log.
    pub(crate) fn record(&mut self, record: Record) {
        self.batch.records.push(record);
    }

    /// Takes an entry for the trace. Whether it did: the file has a limit.
    pub(crate) fn trace(&mut self, entry: Entry) -> bool {
        let fits = tape::bytes(self.taped + 1) <= tape::LIMIT_BYTES;
        if fits {
            self.taped += 1;
            self.batch.tape.push(entry);
        }
        fits
    }

    /// Takes how the run stands.
    pub(crate) fn live(&mut self, live: Live) {
        self.batch.live = Some(live);
    }

    /// Hands everything to the writer. If that has failed it is forgotten; [`Recorder::close`]
    /// tells.
    pub(crate) fn hand_over(&mut self) {
        let (frames, records) = (self.batch.frames.len(), self.batch.records.len());
        let tape = self.batch.tape.len();
        // The next batch will be about as large.
        let next = Batch {
            frames: Vec::with_capacity(frames + frames / 4),
            records: Vec::with_capacity(records + records / 4),
            tape: Vec::with_capacity(tape + tape / 4),
            live: None,
        };
        let _ = self
            .to_writer
            .send(std::mem::replace(&mut self.batch, next));
    }

    /// Waits until everything is written.
    ///
    /// # Errors
    /// If something could not be written.
    pub(crate) fn close(mut self) -> anyhow::Result<()> {
        self.hand_over();
        drop(self.to_writer);
        self.writer
            .join()
            .map_err(|_| anyhow!("the recorder has panicked"))?
    }
}

struct Logs {
    run: BufWriter<File>,
    candump: BufWriter<File>,
    tape: BufWriter<File>,
    live: PathBuf,
}

impl Logs {
    fn write_all(mut self, batches: &Receiver<Batch>) -> anyhow::Result<()> {
        for batch in batches {
            self.write(&batch)
                .context("the run's log (is /dev/shm full?)")?;
        }
        self.run
            .flush()
            .and_then(|()| self.candump.flush())
            .and_then(|()| self.tape.flush())
            .context("the run's log")
    }

    fn write(&mut self, batch: &Batch) -> io::Result<()> {
        for logged in &batch.frames {
            let id = match logged.frame.id() {
                CanId::Standard(id) => candump::Id::Standard(id),
                CanId::Extended(id) => candump::Id::Extended(id),
            };
            let flags = logged.frame.is_fd().then_some(candump::BIT_RATE_SWITCH);
            // A `CanFrame` carries no more than a frame can, so a line always exists.
            if let Ok(line) = candump::Record::new(INTERFACE, id, flags, logged.frame.data()) {
                writeln!(self.candump, "{}", line.at_us(logged.at_us))?;
            }
        }
        for record in &batch.records {
            serde_json::to_writer(&mut self.run, record)?;
            self.run.write_all(b"\n")?;
        }
        for entry in &batch.tape {
            entry.write(&mut self.tape)?;
        }
        // Whole lines at every time, for a run that is cut short.
        self.run.flush()?;
        self.candump.flush()?;
        batch
            .live
            .as_ref()
            .map_or(Ok(()), |live| live.write(&self.live))
    }
}
