//! Writes a run's recording without disturbing the thread that produces the data.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

use anyhow::{Context as _, anyhow};
use tandem_board::{CoreAddress, Traced};
use tandem_board_host::isolation;
use tandem_cores::trace::Event;
use tandem_record::Entry;
use tandem_record::file::TRACE_BYTES;

use crate::files::RunFiles;
use crate::live::Live;

/// The recording is in shared memory. When its trace records reach this size, further events of the
/// schedulers are omitted, except one ring of each core in each batch: live views take a core
/// without a record for dead. A run reaches the limit after about six minutes.
const TRACE_LIMIT_BYTES: u64 = 64 << 20;

/// Returns the largest size of the trace records in a recording, bytes: at most half of the free
/// space. The rest of the recording, which a report needs, grows more slowly.
fn trace_limit_bytes(free_bytes: u64) -> u64 {
    TRACE_LIMIT_BYTES.min(free_bytes / 2)
}

/// The entries and the live state that are sent to the writer in one message.
#[derive(Debug, Default)]
struct Batch {
    entries: Vec<Entry>,
    live: Option<Live>,
}

/// Collects entries on the producing thread, and sends them to the writer thread in batches. Only
/// [`Recorder::hand_over`] makes a system call, to wake the writer. Only `close` blocks.
#[derive(Debug)]
pub struct Recorder {
    batch: Batch,
    /// Bytes of trace records in the recording.
    trace_bytes: u64,
    /// The limit of `trace_bytes`. Records that the analysis needs are written even beyond it.
    trace_limit_bytes: u64,
    /// The cores of which this batch holds a record beyond the limit.
    kept: [bool; CoreAddress::ALL.len()],
    to_writer: Sender<Batch>,
    writer: JoinHandle<anyhow::Result<()>>,
}

impl Recorder {
    /// Creates the file and starts the writer.
    ///
    /// # Errors
    /// If the file cannot be created.
    pub fn create(files: &RunFiles) -> anyhow::Result<Self> {
        let path = files.recording();
        let file = File::create(&path).with_context(|| format!("creating {}", path.display()))?;
        let free = isolation::free_bytes(&path).unwrap_or(u64::MAX);
        let live = files.live();
        let (to_writer, batches) = channel();
        let writer = std::thread::Builder::new()
            .name("recorder".to_owned())
            .spawn(move || write_all(BufWriter::new(file), &live, &batches))
            .context("starting the recorder")?;
        Ok(Self {
            batch: Batch::default(),
            trace_bytes: 0,
            trace_limit_bytes: trace_limit_bytes(free),
            kept: Default::default(),
            to_writer,
            writer,
        })
    }

    /// Adds an entry to the batch.
    pub fn record(&mut self, entry: impl Into<Entry>) {
        self.batch.entries.push(entry.into());
    }

    /// Adds a record of a core's trace. Returns `false` if the recording omits this record.
    pub fn trace(&mut self, traced: Traced) -> bool {
        let is_full = self.trace_bytes >= self.trace_limit_bytes;
        let event = Event::decode(traced.record);
        if is_full && event.is_none_or(Event::is_scheduling) {
            let kept = &mut self.kept[CoreAddress::new(traced.system, traced.core).index()];
            // A ring belongs to no span, so it is right without the records around it.
            let is_ring = matches!(event, Some(Event::Ring { .. }));
            if *kept || !is_ring {
                return false;
            }
            *kept = true;
        }
        self.trace_bytes += TRACE_BYTES;
        self.record(Entry::Trace(traced));
        true
    }

    /// Sets the live state of the run.
    pub fn live(&mut self, live: Live) {
        self.batch.live = Some(live);
    }

    /// Sends the batch to the writer thread. If the writer has failed, the entries are dropped,
    /// and [`Recorder::close`] returns the error.
    pub fn hand_over(&mut self) {
        let count = self.batch.entries.len();
        // The next batch will have about the same size.
        let next = Batch {
            entries: Vec::with_capacity(count + count / 4),
            live: None,
        };
        self.kept = Default::default();
        let _ = self
            .to_writer
            .send(std::mem::replace(&mut self.batch, next));
    }

    /// Sends the rest, and waits until the writer has written everything.
    ///
    /// # Errors
    /// If the writer could not write an entry.
    pub fn close(mut self) -> anyhow::Result<()> {
        self.hand_over();
        drop(self.to_writer);
        self.writer
            .join()
            .map_err(|_| anyhow!("the recorder has panicked"))?
    }
}

fn write_all(
    mut recording: BufWriter<File>,
    live: &Path,
    batches: &Receiver<Batch>,
) -> anyhow::Result<()> {
    for batch in batches {
        let written = batch
            .entries
            .iter()
            .try_for_each(|entry| entry.write(&mut recording))
            // Flush whole entries, in case the run is killed.
            .and_then(|()| recording.flush())
            .and_then(|()| batch.live.map_or(Ok(()), |state| state.write(live)));
        written.context("the run's recording (is /dev/shm full?)")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::{CoreId, Instant, SystemId};
    use tandem_cores::task_table::TaskCode;
    use tandem_record::{RunLog, file};

    #[test]
    fn the_trace_leaves_half_of_the_free_space_to_the_rest() {
        assert_eq!(trace_limit_bytes(0), 0);
        assert_eq!(trace_limit_bytes(10 << 20), 5 << 20);
        assert_eq!(trace_limit_bytes(u64::MAX), TRACE_LIMIT_BYTES);
    }

    /// In a long run the recording omits scheduler events, but keeps all that the analysis needs.
    #[test]
    fn a_full_recording_omits_only_the_events_of_schedulers() {
        let folder = tempfile::tempdir().unwrap();
        let files = RunFiles::within(folder.path());
        let mut recorder = Recorder::create(&files).unwrap();
        let traced = |event: Event| Traced {
            at: Instant::ORIGIN,
            system: SystemId::A,
            core: CoreId::CONTROL,
            record: event.encode(),
        };
        let ready = Event::Ready {
            task: TaskCode::CONTROL,
        };
        assert!(recorder.trace(traced(ready)));
        recorder.trace_bytes = recorder.trace_limit_bytes;
        assert!(!recorder.trace(traced(ready)));
        assert!(recorder.trace(traced(Event::LinesSplit)));
        // One ring of each core in each batch says that the core runs.
        let ring = traced(Event::Ring {
            core: CoreId::PLANNING,
        });
        let of_other = Traced {
            core: CoreId::PERCEPTION,
            ..ring
        };
        assert_eq!(
            [ring, ring, of_other].map(|it| recorder.trace(it)),
            [true, false, true]
        );
        recorder.hand_over();
        assert_eq!([ring, ring].map(|it| recorder.trace(it)), [true, false]);
        recorder.close().unwrap();
        let mut log = RunLog::default();
        file::read(&files.recording(), |entry| {
            log.push(entry);
            Ok(())
        })
        .unwrap();
        assert_eq!((log.trace.len(), log.events.len()), (5, 1));
    }
}
