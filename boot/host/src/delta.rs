//! A file that holds only what differs from an application that the controller already has: copy
//! records (S4) for the rest. The bootloader checks the whole as it checks any file. U-5

use crate::{Image, RECORD_DATA, line};
use std::collections::HashMap;

/// Bytes that are looked up in the old image.
const WINDOW: usize = 16;
/// A copy record has four frames, a data record of 16 bytes six: shorter runs are sent as data.
const SHORTEST: usize = 24;
/// Bytes of one copy record. The flash programs them before the answer.
const LONGEST: usize = 4096;
/// Occurrences of the same window that are tried.
const TRIED: usize = 8;

/// Returns the records of an image as a difference to `old`, whose first byte is at the offset
/// `old_at` in the flash.
#[must_use]
pub fn delta(name: &str, image: &Image, old: &[u8], old_at: u32) -> Vec<String> {
    let mut places: HashMap<&[u8], Vec<usize>> = HashMap::new();
    for (at, window) in old.windows(WINDOW).enumerate() {
        let found = places.entry(window).or_default();
        if found.len() < TRIED {
            found.push(at);
        }
    }
    let mut lines = vec![line(0, &[0, 0], name.as_bytes())];
    for (offset, bytes) in image.runs() {
        let mut writer = Writer {
            lines: &mut lines,
            at: image.place() + offset,
            literal: Vec::new(),
        };
        let mut rest = bytes;
        let mut expected = 0;
        while let [first, ..] = rest {
            // The manifest is new, and refused at once if it is wrong.
            let window = rest.get(..WINDOW).filter(|_| offset > 0);
            let known = window.and_then(|window| places.get(window));
            // Code that only moved goes on where the last copy ended.
            let moved = (offset > 0).then_some(expected);
            let candidates = known.into_iter().flatten().copied().chain(moved);
            let copy = candidates
                .map(|from| (common(rest, &old[from.min(old.len())..]), from))
                .max_by_key(|(length, from)| (*length, *from == expected));
            match copy.filter(|(length, _)| *length >= SHORTEST) {
                Some((length, from)) => {
                    writer.copy(old_at + from as u32, length);
                    (rest, expected) = (&rest[length..], from + length);
                }
                None => {
                    writer.literal.push(*first);
                    (rest, expected) = (&rest[1..], expected + 1);
                }
            }
        }
        writer.flush();
    }
    let count = (lines.len() as u32 - 1).to_be_bytes();
    lines.push(line(6, &count[1..], &[]));
    let entry = image.place() + image.manifest.entries[0];
    lines.push(line(7, &entry.to_be_bytes(), &[]));
    lines
}

/// Returns how many bytes at the beginning of both are equal.
fn common(a: &[u8], b: &[u8]) -> usize {
    a.iter().zip(b).take_while(|(a, b)| a == b).count()
}

struct Writer<'l> {
    lines: &'l mut Vec<String>,
    /// Offset in the flash of what is written next, without the literal.
    at: u32,
    literal: Vec<u8>,
}

impl Writer<'_> {
    fn flush(&mut self) {
        for chunk in std::mem::take(&mut self.literal).chunks(RECORD_DATA) {
            self.lines.push(line(3, &self.at.to_be_bytes(), chunk));
            self.at += chunk.len() as u32;
        }
    }

    fn copy(&mut self, from: u32, length: usize) {
        self.flush();
        for done in (0..length).step_by(LONGEST) {
            let part = LONGEST.min(length - done) as u32;
            let data = [
                &(from + done as u32).to_be_bytes()[..],
                &part.to_be_bytes()[2..],
            ];
            self.lines
                .push(line(4, &self.at.to_be_bytes(), &data.concat()));
            self.at += part;
        }
    }
}
