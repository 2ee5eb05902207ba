//! What a program needs in order to run: loader and libraries, or an interpreter.

use std::fs::File;
use std::os::unix::fs::FileExt as _;

/// Linux takes no more than 64 KiB of program headers, which is 1,170.
const MAX_HEADERS: u64 = 1170;
const MAX_NEEDED: usize = 1024;
/// The kernel reads this much of a script's first line.
const LINE_BYTES: usize = 256;
const LOAD: u32 = 1;
const DYNAMIC: u32 = 2;
const INTERPRETER: u32 = 3;

/// The form of an executable file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// An executable or a library.
    Elf(Elf),
    /// A text that an interpreter executes.
    Script {
        /// The path of the interpreter.
        interpreter: String,
        /// The one argument that may follow it.
        argument: Option<String>,
    },
}

/// The parts of a 64-bit little-endian ELF file that the loader reads.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Elf {
    pub(super) machine: u16,
    /// The path of the loader; a static program has none.
    pub(super) loader: Option<String>,
    /// The names of the libraries, in the loader's order.
    pub(super) needed: Vec<String>,
    /// The library's own name.
    pub(super) name: Option<String>,
    /// Folders of libraries, separated by `:`.
    pub(super) folders: Option<String>,
}

impl Form {
    /// Reads the form of a file.
    pub(super) fn of(file: &File) -> Result<Self, String> {
        let mut start = [0; LINE_BYTES];
        let count = file
            .read_at(&mut start, 0)
            .map_err(|error| error.to_string())?;
        let start = &start[..count];
        match start.strip_prefix(b"#!") {
            Some(line) => script(line),
            None => Ok(Self::Elf(Elf::of(file)?)),
        }
    }
}

fn script(line: &[u8]) -> Result<Form, String> {
    let end = line.iter().position(|byte| *byte == b'\n');
    let line = &line[..end.ok_or("its first line is too long")?];
    let line = std::str::from_utf8(line).map_err(|_| "its first line is not text")?;
    let line = line.trim_matches([' ', '\t']);
    let (interpreter, argument) = match line.split_once([' ', '\t']) {
        Some((interpreter, argument)) => (interpreter, Some(argument.trim_start().to_owned())),
        None => (line, None),
    };
    if !interpreter.starts_with('/') {
        return Err("its interpreter has no absolute path".into());
    }
    if interpreter.ends_with("/env") {
        return Err("`env` would start a program that was not checked".into());
    }
    Ok(Form::Script {
        interpreter: interpreter.to_owned(),
        argument,
    })
}

/// One entry of the program header.
struct Segment {
    kind: u32,
    offset: u64,
    address: u64,
    bytes: u64,
}

impl Elf {
    fn of(file: &File) -> Result<Self, String> {
        let header = bytes(file, 0, 64)?;
        if !header.starts_with(b"\x7FELF\x02\x01\x01") {
            return Err("neither a 64-bit little-endian ELF file nor a script".into());
        }
        let (size, count) = (number(&header, 54, 2)?, number(&header, 56, 2)?);
        if size != 56 || count > MAX_HEADERS {
            return Err("its program header has an unknown form".into());
        }
        let table = bytes(file, number(&header, 32, 8)?, size * count)?;
        let segments = table.chunks_exact(56).map(|entry| {
            Ok(Segment {
                kind: number(entry, 0, 4)? as u32,
                offset: number(entry, 8, 8)?,
                address: number(entry, 16, 8)?,
                bytes: number(entry, 32, 8)?,
            })
        });
        let segments: Vec<Segment> = segments.collect::<Result<_, String>>()?;
        let one = |kind| segments.iter().find(|segment| segment.kind == kind);
        let mut elf = Self {
            machine: number(&header, 18, 2)? as u16,
            ..Self::default()
        };
        if let Some(segment) = one(INTERPRETER) {
            elf.loader = Some(text(&bytes(file, segment.offset, segment.bytes)?, 0)?);
        }
        if let Some(segment) = one(DYNAMIC) {
            let entries = bytes(file, segment.offset, segment.bytes)?;
            elf.read_dynamic(file, &segments, &entries)?;
        }
        Ok(elf)
    }

    fn read_dynamic(&mut self, file: &File, all: &[Segment], table: &[u8]) -> Result<(), String> {
        let entries = table.as_chunks::<16>().0.iter();
        let entries = entries.map(|entry| Ok((number(entry, 0, 8)?, number(entry, 8, 8)?)));
        let entries: Vec<(u64, u64)> = entries.collect::<Result<_, String>>()?;
        let end = entries.iter().position(|(tag, _)| *tag == 0);
        let entries = &entries[..end.ok_or("its dynamic section has no end")?];
        let value = |wanted| entries.iter().rev().find(|(tag, _)| *tag == wanted);
        let (Some((_, address)), Some((_, size))) = (value(5), value(10)) else {
            return Ok(());
        };
        let inside = |it: &&Segment| {
            it.kind == LOAD && (it.address..it.address.saturating_add(it.bytes)).contains(address)
        };
        let segment = all.iter().find(inside).ok_or("its strings are nowhere")?;
        let strings = bytes(file, address - segment.address + segment.offset, *size)?;
        for &(tag, offset) in entries {
            let text = || text(&strings, offset);
            match tag {
                1 => self.needed.push(text()?),
                14 => self.name = Some(text()?),
                15 if self.folders.is_none() => self.folders = Some(text()?),
                29 => self.folders = Some(text()?),
                // Auditors and filters: the loader would read these by their paths.
                0x6FFF_FEFB | 0x6FFF_FEFC | 0x7FFF_FFFD | 0x7FFF_FFFF => {
                    return Err("it has auditors or filters, which would not be checked".into());
                }
                _ => {}
            }
        }
        if self.needed.len() > MAX_NEEDED {
            return Err("it needs too many libraries".into());
        }
        Ok(())
    }
}

fn bytes(file: &File, offset: u64, count: u64) -> Result<Vec<u8>, String> {
    let length = file.metadata().map_err(|error| error.to_string())?.len();
    if offset.checked_add(count).is_none_or(|end| end > length) {
        return Err("a header names bytes after the file's end".into());
    }
    let mut bytes = vec![0; count as usize];
    file.read_exact_at(&mut bytes, offset)
        .map_err(|error| error.to_string())?;
    Ok(bytes)
}

fn number(bytes: &[u8], offset: usize, count: usize) -> Result<u64, String> {
    let field = bytes.get(offset..offset + count).ok_or("a short header")?;
    Ok(field
        .iter()
        .rev()
        .fold(0, |sum, byte| sum << 8 | u64::from(*byte)))
}

fn text(bytes: &[u8], offset: u64) -> Result<String, String> {
    let rest = usize::try_from(offset)
        .ok()
        .and_then(|offset| bytes.get(offset..));
    let rest = rest.and_then(|rest| rest.split(|byte| *byte == 0).next());
    let text = rest.and_then(|text| std::str::from_utf8(text).ok());
    Ok(text.ok_or("a name is not text")?.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    fn form(bytes: &[u8]) -> Result<Form, String> {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(bytes).unwrap();
        Form::of(&file)
    }

    /// E-4: a script names its interpreter, whose choice is not left to the search path.
    #[test]
    fn a_script_names_its_interpreter() {
        let script = |interpreter: &str, argument: Option<&str>| Form::Script {
            interpreter: interpreter.into(),
            argument: argument.map(str::to_owned),
        };
        assert_eq!(form(b"#!/bin/sh\nexit"), Ok(script("/bin/sh", None)));
        let spaced = form(b"#! /bin/sh  -e -u \nexit");
        assert_eq!(spaced, Ok(script("/bin/sh", Some("-e -u"))));
        for refused in [
            "#!/bin/sh",
            "#!sh\n",
            "#!/usr/bin/env sh\n",
            "#!/\u{0}\u{fffd}",
            "",
        ] {
            assert!(form(refused.as_bytes()).is_err(), "{refused:?}");
        }
    }

    /// E-4: no changed byte of a header makes the reader fail otherwise than by an error.
    #[test]
    fn damaged_headers_are_refused_or_read() {
        let this = std::fs::read("/proc/self/exe").unwrap();
        let Ok(Form::Elf(elf)) = form(&this[..]) else {
            panic!("this test is no ELF file");
        };
        assert!(elf.needed.contains(&"libc.so.6".to_owned()), "{elf:?}");
        assert!(elf.loader.is_some());
        let short = &this[..4096];
        for at in 0..1024 {
            for value in [0, 1, 0x7F, 0xFF] {
                let mut bytes = short.to_vec();
                bytes[at] = value;
                let _ = form(&bytes);
            }
        }
    }
}
