//! Random mutations of valid inputs.

use chacha20::ChaCha8Rng;
use chacha20::rand_core::{Rng as _, SeedableRng as _};

use crate::Target;

/// Replacements for numbers in a text.
const NUMBERS: [&str; 14] = [
    "0",
    "-1",
    "1e-308",
    "1e308",
    "NaN",
    "inf",
    "99999999",
    "-9e7",
    "0.0001",
    "1",
    "2",
    "86400",
    "",
    "9223372036854775807",
];
/// Replacements for bytes: the limits of common ranges.
const BYTES: [u8; 6] = [0, 1, 0x7F, 0x80, 0xFE, 0xFF];
/// Largest number of mutations of one input.
const DAMAGES: usize = 5;

/// Creates inputs from seeds. The same seed always gives the same input.
#[derive(Debug)]
pub struct Mutator {
    bases: Vec<Vec<u8>>,
    is_text: bool,
}

impl Mutator {
    /// Creates a mutator for the inputs of the target's corpus.
    ///
    /// # Errors
    /// If the corpus cannot be read.
    pub fn new(target: &Target) -> std::io::Result<Self> {
        let inputs = target.corpus()?;
        Ok(Self {
            bases: inputs.into_iter().map(|(_, input)| input).collect(),
            is_text: target.is_text,
        })
    }

    /// Returns the input for this seed.
    #[must_use]
    pub fn input(&self, seed: u64) -> Vec<u8> {
        let mut draw = Draw(ChaCha8Rng::seed_from_u64(seed));
        let Some(base) = self.bases.get(draw.below(self.bases.len())) else {
            return Vec::new();
        };
        let damages = 1 + draw.below(DAMAGES);
        if !self.is_text {
            let mut bytes = base.clone();
            (0..damages).for_each(|_| damage_bytes(&mut bytes, &mut draw));
            return bytes;
        }
        let text = String::from_utf8_lossy(base);
        let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
        for _ in 0..damages {
            if !lines.is_empty() {
                damage_lines(&mut lines, &mut draw);
            }
        }
        lines.join("\n").into_bytes()
    }
}

struct Draw(ChaCha8Rng);

impl Draw {
    fn below(&mut self, limit: usize) -> usize {
        (self.0.next_u64() % limit.max(1) as u64) as usize
    }
}

fn damage_bytes(bytes: &mut Vec<u8>, draw: &mut Draw) {
    let (at, other) = (draw.below(bytes.len()), draw.below(bytes.len() + 1));
    let (from, to) = (at.min(other), at.max(other));
    match draw.below(6) {
        0 => bytes.truncate(at),
        1 => bytes.extend_from_within(from..to),
        2 => drop(bytes.drain(from..to)),
        _ if bytes.is_empty() => {}
        3 => bytes[at] ^= 1 << draw.below(8),
        4 => bytes[at] = BYTES[draw.below(BYTES.len())],
        _ => bytes[at] = draw.below(256) as u8,
    }
}

fn damage_lines(lines: &mut Vec<String>, draw: &mut Draw) {
    let (line, other) = (draw.below(lines.len()), draw.below(lines.len()));
    match draw.below(8) {
        0 => drop(lines.remove(line)),
        1 => lines.swap(line, other),
        2 => lines[line] = lines[other].clone(),
        3 => {
            // Repeat a part of the file many times.
            let end = (line + 1 + draw.below(12)).min(lines.len());
            let piece = lines[line..end].to_vec();
            let times = 1 + draw.below(300);
            let repeated = std::iter::repeat_n(piece, times).flatten();
            lines.splice(line..line, repeated);
        }
        4 => {
            let mut bytes = std::mem::take(&mut lines[line]).into_bytes();
            damage_bytes(&mut bytes, draw);
            lines[line] = String::from_utf8_lossy(&bytes).into_owned();
        }
        _ => {
            let text = &lines[line];
            let is_number = |c: char| c.is_ascii_digit() || c == '.';
            let starts: Vec<usize> = text.match_indices(is_number).map(|(at, _)| at).collect();
            if let Some(&start) = starts.get(draw.below(starts.len())) {
                let rest = &text[start..];
                let end = start + rest.find(|c| !is_number(c)).unwrap_or(rest.len());
                let number = NUMBERS[draw.below(NUMBERS.len())];
                lines[line] = format!("{}{number}{}", &text[..start], &text[end..]);
            }
        }
    }
}
