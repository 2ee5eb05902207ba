//! Collects the recording of a run, and writes it to the folder of a report.

use std::fs::{self, File};
use std::io::{BufWriter, Write as _};
use std::path::Path;

use anyhow::Context as _;
use tandem_processes::files::RunFiles;
use tandem_processes::percentiles::Spans;
use tandem_record::{RunLog, file};

use crate::metrics::{self, Metrics, Surroundings};
use crate::output::{self, ReportFolder};
use crate::report;
use crate::timeline::{self, Timeline};

/// The data of a run, copied from its shared memory before that memory is erased.
pub struct Collected {
    pub(crate) log: RunLog,
    timeline: Timeline,
    stage: tempfile::TempDir,
}

impl Collected {
    pub(crate) fn new(
        out: &ReportFolder,
        files: &RunFiles,
        because: &dyn Fn() -> String,
    ) -> anyhow::Result<Self> {
        let errors = fs::read_to_string(files.errors()).unwrap_or_default();
        let errors = errors.trim();
        if !errors.is_empty() {
            eprintln!("the processes of the run said:\n{errors}");
        }
        let stage = out.stage()?;
        let candump = stage.path().join(output::CANDUMP);
        let mut log = read(&files.recording(), &candump).with_context(because)?;
        // Without an SoC there is none.
        let _ = file::read(&files.soc_time(), |entry| {
            log.push(entry);
            Ok(())
        });
        Ok(Self::staged(log, stage))
    }

    /// Collects a run whose recording is in memory: its log, and its frames as lines of text.
    ///
    /// # Errors
    /// If the folder cannot be written.
    pub fn of(out: &ReportFolder, log: RunLog, candump: &str) -> anyhow::Result<Self> {
        let stage = out.stage()?;
        let path = stage.path().join(output::CANDUMP);
        fs::write(&path, candump).with_context(|| format!("writing {}", path.display()))?;
        Ok(Self::staged(log, stage))
    }

    fn staged(log: RunLog, stage: tempfile::TempDir) -> Self {
        Self {
            timeline: Timeline::new(&log),
            log,
            stage,
        }
    }

    /// Writes the report and the files beside it.
    ///
    /// # Errors
    /// If the folder cannot be written.
    pub fn write(self, out: &ReportFolder, around: &Surroundings) -> anyhow::Result<Metrics> {
        let metrics = metrics::compute(&self.log, &self.timeline, around);
        let json = serde_json::to_string_pretty(&metrics).context("metrics.json")? + "\n";
        let period = Spans::from_ms(metrics::control_periods_ms(&self.log)).to_hgrm();
        let chain = Spans::from_ms(metrics::chain_ms(&self.log)).to_hgrm();
        let trace = timeline::encode(&self.timeline, &self.log);
        let page = report::page(&self.log, &self.timeline, &metrics, trace.begin_ns);
        for (name, content) in [
            (output::REPORT, page.into_bytes()),
            (output::METRICS, json.into_bytes()),
            (output::CONTROL_PERIOD, period.into_bytes()),
            (output::CHAIN, chain.into_bytes()),
            (output::TRACE, trace.bytes),
        ] {
            let path = self.stage.path().join(name);
            fs::write(&path, content).with_context(|| format!("writing {}", path.display()))?;
        }
        out.put(self.stage)?;
        Ok(metrics)
    }
}

/// Reads the recording, and writes its frames to the CAN log.
///
/// # Errors
/// If the recording cannot be read or the log cannot be written.
pub fn read(recording: &Path, candump: &Path) -> anyhow::Result<RunLog> {
    let writing = || format!("writing {}", candump.display());
    let mut lines = BufWriter::new(File::create(candump).with_context(writing)?);
    let mut log = RunLog::default();
    file::read(recording, |entry| {
        if let file::Entry::Frame(frame) = &entry {
            let line = file::candump_line(frame, log.header.epoch_us);
            writeln!(lines, "{line}").with_context(writing)?;
        }
        log.push(entry);
        Ok(())
    })?;
    lines.flush().with_context(writing)?;
    log.sort();
    Ok(log)
}
