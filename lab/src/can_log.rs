//! `tandem can-log`: converts a log in candump format to ASC or BLF, the formats of Vector's tools.

use std::fs;
use std::path::Path;

use anyhow::{Context as _, anyhow, bail, ensure};
use blf_asc::{ArbitrationId, AscWriter, BlfWriter, DataBytes, Message};
use tandem::failure::Failure;
use tandem::output::CANDUMP;
use tandem_page::output::OutputFile;

use crate::args::CanLogArgs;

/// Flags of a CAN FD frame in the candump format: sent at the higher bit rate, and the sender is
/// error passive.
const BIT_RATE_SWITCH: u32 = 1;
const ERROR_STATE: u32 = 2;
/// The lengths of the data of CAN FD beyond 8 bytes.
const LONG_DATA: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];
/// Time stamps in a log are in µs, with this many digits.
const MICRO_DIGITS: usize = 6;

/// The format to write.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    /// Text.
    Asc,
    /// Binary, compressed.
    Blf,
}

/// Converts the log.
///
/// # Errors
/// [`Failure::Usage`] if the log cannot be read, or the file cannot be written or has another
/// ending. Nothing is written then.
pub(crate) fn run(args: &CanLogArgs) -> Result<(), Failure> {
    let format = format(&args.file).map_err(Failure::Usage)?;
    let frames = read(&args.log).map_err(Failure::Usage)?;
    let place = OutputFile::check("FILE", &args.file).map_err(Failure::usage)?;
    place.write(&encode(format, &frames)?)?;
    Ok(())
}

fn format(file: &Path) -> anyhow::Result<Format> {
    let ending = file.extension().map(|it| it.to_ascii_lowercase());
    match ending.as_ref().and_then(|it| it.to_str()) {
        Some("asc") => Ok(Format::Asc),
        Some("blf") => Ok(Format::Blf),
        _ => bail!(
            "{}: the name of the file to write ends in .asc or .blf",
            file.display()
        ),
    }
}

/// Reads the frames of a log, or of the log in a report's folder.
fn read(log: &Path) -> anyhow::Result<Vec<Message>> {
    let log = if log.is_dir() {
        log.join(CANDUMP)
    } else {
        log.to_owned()
    };
    let shown = log.display();
    let text = fs::read_to_string(&log).with_context(|| shown.to_string())?;
    let (mut buses, mut frames) = (Vec::new(), Vec::new());
    for (index, line) in text.lines().enumerate() {
        if !line.trim().is_empty() {
            let frame = frame(line, &mut buses);
            frames.push(frame.with_context(|| format!("{shown}: line {}", index + 1))?);
        }
    }
    ensure!(!frames.is_empty(), "{shown}: there is no frame in it");
    Ok(frames)
}

/// Reads a line: `(1436509052.249713) vcan0 0A0##1A1B2C3`. Appends its bus to `buses` if it is new.
fn frame<'a>(line: &'a str, buses: &mut Vec<&'a str>) -> anyhow::Result<Message> {
    let mut words = line.split_whitespace();
    let (Some(time), Some(bus), Some(frame)) = (words.next(), words.next(), words.next()) else {
        bail!("it is no line of candump's log format: (TIME) BUS ID#DATA");
    };
    let time = time.strip_prefix('(').and_then(|it| it.strip_suffix(')'));
    let time = time.context("the time is not in parentheses")?;
    let (seconds, micros) = time.split_once('.').unwrap_or(("", ""));
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|it| it.is_ascii_digit());
    let is_time = is_number(seconds) && is_number(micros) && micros.len() == MICRO_DIGITS;
    ensure!(is_time, "{time}: no time in s with six decimals");
    let channel = buses.iter().position(|known| *known == bus);
    let channel = channel.unwrap_or_else(|| {
        buses.push(bus);
        buses.len() - 1
    });
    let (id, content) = frame.split_once('#').context("the frame has no #")?;
    let (number, most) = (u32::from_str_radix(id, 16), [0x7FF, 0x1FFF_FFFF]);
    let is_extended = id.len() == 8;
    let number = number
        .ok()
        .filter(|it| *it <= most[usize::from(is_extended)]);
    let fits = is_extended || id.len() == 3;
    let number = number.filter(|_| fits && !id.starts_with('+'));
    let number = number.ok_or_else(|| anyhow!("{id}: no identifier of a data frame"))?;
    let (flags, digits) = match content.strip_prefix('#') {
        None => (None, content),
        Some(rest) => {
            let flags = rest.chars().next().and_then(|it| it.to_digit(16));
            let flags = flags.context("a CAN FD frame without its flags")?;
            (Some(flags), &rest[1..])
        }
    };
    let data = bytes(digits).ok_or_else(|| anyhow!("{digits}: no data bytes"))?;
    let length = data.len();
    let is_length = length <= 8 || flags.is_some() && LONG_DATA.contains(&length);
    ensure!(is_length, "{length} data bytes: no frame has so many");
    Ok(Message {
        timestamp: time.parse()?,
        arbitration_id: ArbitrationId(number),
        is_extended_id: is_extended,
        is_fd: flags.is_some(),
        bitrate_switch: flags.unwrap_or(0) & BIT_RATE_SWITCH != 0,
        error_state_indicator: flags.unwrap_or(0) & ERROR_STATE != 0,
        dlc: u8::try_from(length)?,
        data: DataBytes(data),
        channel: u16::try_from(channel)?,
        ..Message::default()
    })
}

fn bytes(digits: &str) -> Option<Vec<u8>> {
    let digits: Option<Vec<u32>> = digits.chars().map(|it| it.to_digit(16)).collect();
    let (pairs, rest) = digits.as_ref()?.as_chunks::<2>();
    let byte = |[high, low]: &[u32; 2]| (high << 4 | low) as u8;
    rest.is_empty().then(|| pairs.iter().map(byte).collect())
}

/// Returns the content of the file. The library writes to paths only, so it writes to a temporary
/// file first.
fn encode(format: Format, frames: &[Message]) -> anyhow::Result<Vec<u8>> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("log");
    match format {
        Format::Asc => {
            let mut writer = AscWriter::create(&path)?;
            for frame in frames {
                writer.on_message_received(frame)?;
            }
            writer.finish()?;
        }
        Format::Blf => {
            let mut writer = BlfWriter::create(&path)?;
            for frame in frames {
                writer.on_message_received(frame)?;
            }
            writer.finish()?;
        }
    }
    Ok(fs::read(&path)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_lines_of_candump_are_frames() {
        let mut buses = vec![];
        let held = frame("(0000000012.000345) can1 0CFF0127##3E230", &mut buses).unwrap();
        assert_eq!(
            (held.arbitration_id.0, held.is_extended_id),
            (0x0CFF_0127, true)
        );
        assert!(held.is_fd && held.bitrate_switch && held.error_state_indicator);
        assert_eq!(held.data.as_slice(), [0xE2, 0x30]);
        for line in [
            "",
            "can0 0A0#11",
            "12.000345 can0 0A0#11",
            "(12.345) can0 0A0#11",
            "(-1.000000) can0 0A0#11",
            "(1.000000) can0 0A0",
            "(1.000000) can0 800#11",
            "(1.000000) can0 +A0#11",
            "(1.000000) can0 00A0#11",
            "(1.000000) can0 20000080#0011",
            "(1.000000) can0 0A0#R",
            "(1.000000) can0 0A0#1",
            "(1.000000) can0 0A0#é1",
            "(1.000000) can0 0A0##",
            "(1.000000) can0 0A0##é",
            "(1.000000) can0 0A0#112233445566778899",
            "(1.000000) can0 0A0##1112233445566778899",
        ] {
            assert!(frame(line, &mut buses).is_err(), "{line}");
        }
    }

    #[test]
    fn the_name_of_the_file_says_its_format() {
        assert_eq!(format(Path::new("a.ASC")).unwrap(), Format::Asc);
        assert_eq!(format(Path::new("a.asc.blf")).unwrap(), Format::Blf);
        for name in ["asc", "a.log", ".asc", "a."] {
            assert!(format(Path::new(name)).is_err(), "{name}");
        }
    }
}
