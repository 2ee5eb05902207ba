//! The file of a run: a sequence of entries, in the order in which the vehicle's process sees them.
//!
//! An entry is its length (4 bytes), its kind (1 byte) and its content. Numbers are little-endian.
//! Trace records and frames are binary, because there are thousands per second. The vehicle's own
//! records are JSON. A recording whose writer was killed can be read up to its last whole entry.

use std::fs;
use std::io::{self, Write};
use std::path::Path;

use anyhow::Context as _;
use tandem_board::{CanFrame, CanId, CoreId, Instant, SupplyEvent, SystemId, Traced};
use tandem_bus::candump;
use tandem_vehicle::{LoggedFrame, Ruling};

use crate::log::VehicleRecord;

/// The longest entry that a reader accepts, bytes.
const LONGEST: u32 = 1 << 24;
/// Name of the bus in the CAN log.
const INTERFACE: &str = "can0";
const RULINGS: [Ruling; 7] = [
    Ruling::Accepted,
    Ruling::Fenced,
    Ruling::NotMaster,
    Ruling::Invalid,
    Ruling::Stale,
    Ruling::Implausible,
    Ruling::Unexplained,
];

/// Returns the line of a frame in a CAN log, without a line feed. `epoch_us` is the time of day at
/// which the run's clock was 0.
#[must_use]
pub fn candump_line(logged: &LoggedFrame, epoch_us: u64) -> String {
    let frame = &logged.frame;
    let record = candump::CandumpFrame {
        at_us: epoch_us + logged.at.as_ns() / 1_000,
        interface: INTERFACE,
        id: match frame.id() {
            CanId::Standard(id) => candump::Id::Standard(id),
            CanId::Extended(id) => candump::Id::Extended(id),
        },
        is_fd: frame.is_fd(),
        data: frame.data(),
    };
    record.to_string()
}

/// One entry of a recording.
#[derive(Clone, Debug)]
pub enum Entry {
    /// A record of a core's trace.
    Trace(Traced),
    /// An event of a supply.
    Supply(Instant, SystemId, SupplyEvent),
    /// A frame on the bus.
    Frame(LoggedFrame),
    /// A record of the vehicle itself.
    Vehicle(Box<VehicleRecord>),
}

const TRACE: u8 = 1;
const SUPPLY: u8 = 2;
const FRAME: u8 = 3;
const VEHICLE: u8 = 4;
/// Size of an [`Entry::Trace`] in the file, bytes.
pub const TRACE_BYTES: u64 = 4 + 1 + RECORD as u64;

impl From<VehicleRecord> for Entry {
    fn from(record: VehicleRecord) -> Self {
        Self::Vehicle(Box::new(record))
    }
}

impl Entry {
    /// Appends the entry.
    ///
    /// # Errors
    /// Returns the errors of the writer.
    pub fn write(&self, into: &mut impl Write) -> io::Result<()> {
        let (kind, content) = match self {
            Self::Trace(traced) => return write_entry(into, TRACE, &trace_bytes(traced)),
            Self::Supply(at, system, event) => (SUPPLY, {
                let mut bytes = vec![system.index() as u8];
                bytes.extend(at.as_ns().to_le_bytes());
                bytes.extend(event.encode().iter().flat_map(|word| word.to_le_bytes()));
                bytes
            }),
            Self::Frame(frame) => (FRAME, frame_bytes(frame)),
            Self::Vehicle(record) => (VEHICLE, serde_json::to_vec(record)?),
        };
        write_entry(into, kind, &content)
    }

    #[inline] // into an optimised crate: this one is not, and a run has thousands a second
    fn read(kind: u8, content: &[u8]) -> Option<Self> {
        let mut bytes = Bytes(content);
        Some(match kind {
            TRACE => Self::Trace(bytes.traced()?),
            SUPPLY => {
                let [system] = bytes.take()?;
                let system = SystemId::from_index(system.into())?;
                let at = bytes.instant()?;
                Self::Supply(at, system, SupplyEvent::decode(bytes.record()?)?)
            }
            FRAME => Self::Frame(bytes.frame()?),
            VEHICLE => read_vehicle(content)?,
            _ => return None,
        })
    }
}

/// Its JSON is compiled here, once: there are few of them.
#[inline(never)]
fn read_vehicle(content: &[u8]) -> Option<Entry> {
    let record = serde_json::from_slice::<VehicleRecord>(content).ok()?;
    Some(record.into())
}

fn write_entry(into: &mut impl Write, kind: u8, content: &[u8]) -> io::Result<()> {
    into.write_all(&(1 + content.len() as u32).to_le_bytes())?;
    into.write_all(&[kind])?;
    into.write_all(content)
}

/// Bytes of a trace record in the file: source, time, and four words.
const RECORD: usize = 1 + 8 + 16;

#[inline] // as `Entry::read`
fn trace_bytes(traced: &Traced) -> [u8; RECORD] {
    let source = traced.system.index() * CoreId::COUNT + traced.core.index();
    let mut bytes = [0; RECORD];
    bytes[0] = source as u8;
    bytes[1..9].copy_from_slice(&traced.at.as_ns().to_le_bytes());
    for (place, word) in bytes[9..].chunks_exact_mut(4).zip(traced.record) {
        place.copy_from_slice(&word.to_le_bytes());
    }
    bytes
}

const EXTENDED: u8 = 1;
const FD: u8 = 2;

#[inline] // as `Entry::read`
fn frame_bytes(of: &LoggedFrame) -> Vec<u8> {
    let (id, extended) = match of.frame.id() {
        CanId::Standard(id) => (u32::from(id), 0),
        CanId::Extended(id) => (id, EXTENDED),
    };
    let fd = if of.frame.is_fd() { FD } else { 0 };
    let mut bytes = vec![extended | fd, ruling_code(of.ruling)];
    bytes.extend(of.at.as_ns().to_le_bytes());
    bytes.extend(of.sent.as_ns().to_le_bytes());
    bytes.extend(id.to_le_bytes());
    bytes.extend(of.frame.data());
    bytes
}

/// The unread part of an entry's content.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    #[inline] // as `Entry::read`
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*taken)
    }

    #[inline] // as `Entry::read`
    fn instant(&mut self) -> Option<Instant> {
        Some(Instant::from_ns(u64::from_le_bytes(self.take()?)))
    }

    #[inline] // as `Entry::read`
    fn record(&mut self) -> Option<[u32; 4]> {
        let mut record = [0; 4];
        for word in &mut record {
            *word = u32::from_le_bytes(self.take()?);
        }
        Some(record)
    }

    #[inline] // as `Entry::read`
    fn traced(&mut self) -> Option<Traced> {
        let [source] = self.take()?;
        Some(Traced {
            system: SystemId::from_index(usize::from(source) / CoreId::COUNT)?,
            core: CoreId::new(source % CoreId::COUNT as u8)?,
            at: self.instant()?,
            record: self.record()?,
        })
    }

    fn frame(mut self) -> Option<LoggedFrame> {
        let [flags, ruling] = self.take()?;
        let (at, sent) = (self.instant()?, self.instant()?);
        let id = u32::from_le_bytes(self.take()?);
        let id = if flags & EXTENDED != 0 {
            CanId::Extended(id)
        } else {
            CanId::Standard(u16::try_from(id).ok()?)
        };
        let ruling = match ruling {
            0 => None,
            place => Some(*RULINGS.get(usize::from(place) - 1)?),
        };
        Some(LoggedFrame {
            at,
            sent,
            frame: CanFrame::new(id, flags & FD != 0, self.0).ok()?,
            ruling,
        })
    }
}

/// Reads a recording and passes each entry to `into`.
///
/// # Errors
/// If the file cannot be read or contains an invalid entry, or if `into` fails.
pub fn read(path: &Path, mut into: impl FnMut(Entry) -> anyhow::Result<()>) -> anyhow::Result<()> {
    let bytes = fs::read(path)
        .with_context(|| format!("the vehicle left no recording at {}", path.display()))?;
    let mut rest = &bytes[..];
    // A writer that is killed may leave a partial entry. The recording ends before this entry.
    while let Some((length, content)) = rest.split_first_chunk() {
        let at = bytes.len() - rest.len();
        let foreign = || format!("{}: no entry at byte {at}", path.display());
        let length = u32::from_le_bytes(*length);
        anyhow::ensure!((1..=LONGEST).contains(&length), foreign());
        let Some((entry, after)) = content.split_at_checked(length as usize) else {
            break;
        };
        into(Entry::read(entry[0], &entry[1..]).with_context(foreign)?)?;
        rest = after;
    }
    Ok(())
}

/// Returns the length of the whole entries at the beginning of `bytes` that fit into `most` bytes.
/// The first entry counts even if it does not fit. Returns `None` if there is no whole entry.
#[inline] // as `Entry::read`
#[must_use]
pub fn whole_entries(bytes: &[u8], most: usize) -> Option<usize> {
    let mut end = 0;
    while let Some(length) = bytes[end..].first_chunk::<4>() {
        let next = end + 4 + u32::from_le_bytes(*length) as usize;
        if next > bytes.len() || (end > 0 && next > most) {
            break;
        }
        end = next;
    }
    (end > 0).then_some(end)
}

/// Returns the record of a core's trace if this is its whole entry.
#[inline] // as `Entry::read`
#[must_use]
pub fn traced(entry: &[u8]) -> Option<Traced> {
    let (kind, content) = entry.get(4..)?.split_first()?;
    (*kind == TRACE).then(|| Bytes(content).traced())?
}

/// Passes each entry of these bytes to `into`.
///
/// # Errors
/// If the bytes are not whole valid entries.
pub fn parse(mut bytes: &[u8], mut into: impl FnMut(Entry)) -> anyhow::Result<()> {
    while !bytes.is_empty() {
        let end = whole_entries(bytes, 0).context("a part of an entry")?;
        let (entry, rest) = bytes.split_at(end);
        let (kind, content) = entry[4..]
            .split_first()
            .context("an entry without a kind")?;
        into(Entry::read(*kind, content).context("no entry")?);
        bytes = rest;
    }
    Ok(())
}

/// Returns the number of this ruling in a recording. Numbers begin at 1; 0 means no ruling.
#[must_use]
pub fn ruling_code(ruling: Option<Ruling>) -> u8 {
    let judged = |ruling| RULINGS.iter().position(|known| *known == ruling);
    ruling.and_then(judged).map_or(0, |place| place as u8 + 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RunLog;
    use tandem_bus::{Control, FrameTransmitter, Message, ModeCode, RoleCode};

    fn entries() -> Vec<Entry> {
        let mut transmitter = FrameTransmitter::new();
        let control = Control {
            role: RoleCode::Master,
            mode: ModeCode::L3,
            term: 3,
            ..Control::default()
        };
        let encoded = transmitter.encode(&Message::Control { system: 1, control });
        let frame = CanFrame::new(CanId::Standard(encoded.id), true, encoded.data()).unwrap();
        let at = Instant::from_ns(0x1_2345_6789_ABCD);
        let mut entries = vec![
            Entry::from(VehicleRecord::Start { at_ns: 7 }),
            Entry::Frame(LoggedFrame {
                at,
                sent: Instant::from_ns(5),
                frame,
                ruling: Some(Ruling::Fenced),
            }),
            Entry::Supply(at, SystemId::B, SupplyEvent::Suspended),
        ];
        for system in SystemId::ALL {
            entries.extend(CoreId::ALL.map(|core| {
                Entry::Trace(Traced {
                    at,
                    system,
                    core,
                    record: [1, 2, 3, u32::MAX],
                })
            }));
        }
        entries
    }

    fn written(entries: &[Entry]) -> Vec<u8> {
        let mut bytes = vec![];
        entries
            .iter()
            .for_each(|entry| entry.write(&mut bytes).unwrap());
        bytes
    }

    fn read_back(bytes: &[u8]) -> anyhow::Result<Vec<Entry>> {
        let mut file = tempfile::NamedTempFile::new()?;
        file.write_all(bytes)?;
        let mut found = vec![];
        read(file.path(), |entry| {
            found.push(entry);
            Ok(())
        })?;
        Ok(found)
    }

    #[test]
    fn every_entry_survives_the_file() {
        let bytes = written(&entries());
        let found = read_back(&bytes).unwrap();
        assert_eq!(found.len(), entries().len());
        assert_eq!(written(&found), bytes);
        let mut log = RunLog::default();
        found.into_iter().for_each(|entry| log.push(entry));
        assert_eq!((log.start_ns, log.trace.len()), (Some(7), 6));
        let control = log.control[0];
        assert_eq!((control.system, control.term), (SystemId::B, 3));
        assert_eq!((control.sent_ns, control.ruling), (5, Ruling::Fenced));
        let one = written(&[Entry::Trace(log.trace[0])]);
        assert_eq!(one.len() as u64, TRACE_BYTES);
    }

    /// A killed writer may cut the file after any byte. Whole entries are read without an error.
    #[test]
    fn a_recording_that_was_cut_is_read_up_to_its_last_whole_entry() {
        let bytes = written(&entries());
        let mut most = 0;
        for end in 0..bytes.len() {
            let found = read_back(&bytes[..end]).unwrap().len();
            assert!(found >= most && found < entries().len());
            most = found;
        }
        assert_eq!(most, entries().len() - 1);
    }

    /// Reading a recording in pieces of whole entries gives the same content.
    #[test]
    fn a_recording_is_read_in_pieces_of_whole_entries() {
        let bytes = written(&entries());
        for most in [0, 40, 100, usize::MAX] {
            let (mut left, mut found) = (&bytes[..], vec![]);
            while let Some(end) = whole_entries(left, most) {
                parse(&left[..end], |entry| found.push(entry)).unwrap();
                left = &left[end..];
            }
            assert!(left.is_empty());
            assert_eq!(written(&found), bytes, "{most}");
        }
        assert_eq!(whole_entries(&bytes[..5], 100), None);
        assert!(parse(&bytes[..5], |_| {}).is_err());
        assert!(parse(&[1, 0, 0, 0, 99], |_| {}).is_err());
    }

    #[test]
    fn foreign_bytes_are_an_error_that_names_their_place() {
        let mut bytes = written(&entries()[..1]);
        let at = bytes.len();
        bytes.extend([2, 0, 0, 0, 99, 0]);
        let error = format!("{:#}", read_back(&bytes).unwrap_err());
        assert!(error.contains(&format!("byte {at}")), "{error}");
        assert!(read_back(&[0xFF; 64]).is_err());
    }
}
