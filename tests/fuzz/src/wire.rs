//! Fuzz targets for messages of other systems and nodes, and for the flash of a core that died.

use crc::{CRC_32_ISO_HDLC, Crc};
use tandem_board::{CanFrame, CanId, FlashStatus, Instant, SystemId};
use tandem_bus::{FRAMES, FrameError, FrameReceiver, FrameTransmitter, Message, e2e};
use tandem_record::{Entry, RunLog, file, takeovers};
use tandem_redundancy::{FlashOp, Geometry, LinkReport, Loaded, StateStore, SystemState};
use tandem_vehicle::world_loop::LoggedFrame;

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Takes flags, id, time and data of a frame. Its line in candump's format must contain them all.
///
/// # Panics
/// If the line contains other values.
pub(crate) fn candump(bytes: &[u8]) -> bool {
    let Some((head, data)) = bytes.split_first_chunk::<13>() else {
        return false;
    };
    let [flags, id @ .., _, _, _, _, _, _, _, _] = *head;
    let id = u32::from_le_bytes(id);
    let mut time = [0; 8];
    time.copy_from_slice(&head[5..]);
    let at = Instant::from_ns(u64::from_le_bytes(time));
    let id = if flags & 1 == 0 {
        CanId::Standard(id as u16)
    } else {
        CanId::Extended(id)
    };
    let Ok(frame) = CanFrame::new(id, flags & 2 != 0, data) else {
        return false;
    };
    let (sent, ruling) = (at, None);
    let logged = LoggedFrame {
        at,
        sent,
        frame,
        ruling,
    };
    let epoch_us = 1_700_000_000_000_000;
    let line = file::candump_line(&logged, epoch_us);
    let (time, rest) = line.split_once(' ').expect("a time");
    let (_, content) = rest.split_once(' ').expect("an interface");
    let time = time.trim_start_matches('(').trim_end_matches(')');
    let (seconds, micros) = time.split_once('.').expect("a fraction");
    assert_eq!(micros.len(), 6, "{line}");
    let number = |text: &str| text.parse::<u64>().expect("digits");
    assert_eq!(
        number(seconds) * 1_000_000 + number(micros),
        epoch_us + at.as_ns() / 1_000
    );
    let (number, data) = content.split_once('#').expect("an id");
    let read = u32::from_str_radix(number, 16).expect("hexadecimal digits");
    let read = match number.len() {
        3 => CanId::Standard(read as u16),
        8 => CanId::Extended(read),
        _ => panic!("{line}"),
    };
    let (is_fd, data) = match data.strip_prefix('#') {
        Some(fd) => (true, &fd[1..]),
        None => (false, data),
    };
    let (pairs, odd) = data.as_bytes().as_chunks::<2>();
    let pairs = pairs.iter().map(|pair| {
        let text = std::str::from_utf8(pair).expect("ASCII");
        u8::from_str_radix(text, 16).expect("hexadecimal digits")
    });
    let data: Vec<u8> = pairs.collect();
    assert_eq!((read, is_fd, odd), (frame.id(), frame.is_fd(), &b""[..]));
    assert_eq!(data, frame.data(), "{line}");
    true
}

/// Takes a frame's number in the DBC, a counter, and its data. With valid end-to-end protection it
/// is decoded or rejected. A decoded message that is encoded again must decode to the same message.
///
/// # Panics
/// If the second message differs.
pub(crate) fn message(bytes: &[u8]) -> bool {
    let [number, counter, data @ ..] = bytes else {
        return false;
    };
    let id = FRAMES[usize::from(*number) % FRAMES.len()].id;
    let mut data = data.to_vec();
    // Protect random data, as a faulty node does; noise on the wire rarely passes the checksum.
    e2e::protect(id, *counter, &mut data);
    let mut receiver = FrameReceiver::new();
    let Ok(message) = receiver.receive(id.into(), &data) else {
        return false;
    };
    let encoded = FrameTransmitter::new().encode(&message);
    assert_eq!(encoded.id, id);
    let again = Message::decode(id.into(), encoded.data());
    let twice = again.map(|message| FrameTransmitter::new().encode(&message));
    let twice: Result<Vec<u8>, FrameError> = twice.map(|it| it.data().to_vec());
    assert_eq!(twice.as_deref(), Ok(encoded.data()), "{message:?}");
    true
}

/// Takes the words of a datagram. With an odd number of bytes, the last word becomes the checksum.
///
/// # Panics
/// If the words of an accepted report differ from those that its sender would send.
pub(crate) fn link(bytes: &[u8]) -> bool {
    let (words, rest) = bytes.as_chunks::<4>();
    let mut words: Vec<u32> = words.iter().map(|word| u32::from_le_bytes(*word)).collect();
    if !rest.is_empty()
        && let Some((check, content)) = words.split_last_mut()
    {
        let content: Vec<u8> = content.iter().flat_map(|word| word.to_le_bytes()).collect();
        *check = CRC.checksum(&content);
    }
    let Some(report) = LinkReport::from_words(&words) else {
        return false;
    };
    assert_eq!(report.to_words()[..], words[..]);
    true
}

/// Size of a sector, bytes.
const SECTOR: usize = 128;

/// Takes two sectors of the data flash, as a power loss or wear left them. They may or may not hold
/// a state. Then states are written, and each must be found after it was written. If the number of
/// bytes is odd, all records have valid checksums.
///
/// # Panics
/// If the state that was written last is not found.
pub(crate) fn flash(bytes: &[u8]) -> bool {
    let mut flash = [0xFF; 2 * SECTOR];
    for (cell, byte) in flash.iter_mut().zip(bytes) {
        *cell = *byte;
    }
    if bytes.len() % 2 == 1 {
        for record in flash.as_chunks_mut::<{ SystemState::BYTES }>().0 {
            if record.iter().any(|byte| *byte != 0xFF) {
                let (content, check) = record.split_at_mut(SystemState::BYTES - 4);
                check.copy_from_slice(&CRC.checksum(content).to_le_bytes());
            }
        }
    }
    let geometry = Geometry::first_sectors(SECTOR as u32);
    let load = |flash: &[u8]| {
        StateStore::load(geometry, |offset, into| {
            into.copy_from_slice(&flash[offset as usize..][..into.len()]);
            Ok(())
        })
    };
    let (mut store, found) = load(&flash);
    for number in 0..6 {
        let state = SystemState {
            total_resets: 1_000_000 + number,
            ..SystemState::factory(SystemId::B)
        };
        store.request(state);
        while let Some(op) = store.poll(FlashStatus::Idle) {
            let (at, new) = match &op {
                FlashOp::Erase { sector } => (*sector as usize * SECTOR, &[0xFF; SECTOR][..]),
                FlashOp::Program { offset, data } => (*offset as usize, &data[..]),
            };
            if let FlashOp::Program { .. } = op {
                let old = &flash[at..at + new.len()];
                assert!(old.iter().all(|byte| *byte == 0xFF), "not erased");
            }
            flash[at..at + new.len()].copy_from_slice(new);
        }
        assert_eq!(store.durable(), Some(&state));
        assert_eq!(load(&flash).1, Loaded::State(state));
    }
    matches!(found, Loaded::State(_))
}

/// Checks that a recording is rejected, or can be analysed.
///
/// # Panics
/// If a written frame differs from the bytes that were read, or the analysis panics.
pub(crate) fn recording(bytes: &[u8]) -> bool {
    let mut log = RunLog::default();
    let mut rest = bytes;
    while let Some(end) = file::whole_entries(rest, 0) {
        let (bytes, next) = rest.split_at(end);
        rest = next;
        let read = file::parse(bytes, |entry| {
            if let Entry::Frame(frame) = &entry {
                let mut written = Vec::new();
                entry.write(&mut written).expect("memory can be written");
                // The bytes are length and kind, then the flags, of which two are known.
                assert_eq!(written[5], bytes[5] & 3);
                assert_eq!(written[6..], bytes[6..]);
                let _ = file::candump_line(frame, 0);
            }
            log.push(entry);
        });
        if read.is_err() {
            break;
        }
    }
    log.sort();
    let _ = takeovers(&log);
    rest.is_empty()
}
