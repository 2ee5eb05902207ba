//! What a program needs in order to run: loader and libraries, or an interpreter.

use std::fs::File;
use std::os::unix::fs::FileExt as _;

use object::read::elf::{Dyn as _, FileHeader as _, ProgramHeader as _};
use object::{LittleEndian, ReadCache, StringTable, elf};

use super::Why;

/// The kernel reads this much of a script's first line.
const LINE_BYTES: usize = 256;

/// What an executable file, a library or a script names. The files are 64-bit little-endian ELF.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Form {
    /// Of a script: the path of the interpreter, and the one argument that may follow it.
    pub(super) interpreter: Vec<String>,
    /// The path of the loader; a static program has none.
    pub(super) loader: Option<String>,
    /// The names of the libraries, in the loader's order.
    pub(super) needed: Vec<String>,
    /// The library's own name.
    pub(super) name: Option<String>,
}

impl Form {
    /// Reads the form of a file.
    pub(super) fn of(file: &File) -> Result<Self, Why> {
        let mut start = [0; LINE_BYTES];
        let count = file.read_at(&mut start, 0)?;
        match start[..count].strip_prefix(b"#!") {
            Some(line) => Self::of_script(line),
            None => Self::of_elf(file),
        }
    }

    fn of_script(line: &[u8]) -> Result<Self, Why> {
        let end = line.iter().position(|byte| *byte == b'\n');
        let line = str::from_utf8(&line[..end.ok_or("its first line is too long")?])?;
        let line = line.trim_matches([' ', '\t']);
        let words = line.splitn(2, [' ', '\t']).map(str::trim_start);
        if !line.starts_with('/') {
            return Err("its interpreter has no absolute path".into());
        }
        let interpreter: Vec<String> = words.map(str::to_owned).collect();
        if interpreter[0].ends_with("/env") {
            return Err("`env` would start a program that was not checked".into());
        }
        Ok(Self {
            interpreter,
            ..Self::default()
        })
    }

    fn of_elf(file: &File) -> Result<Self, Why> {
        let data = &ReadCache::new(file);
        let header = elf::FileHeader64::<LittleEndian>::parse(data)?;
        let endian = header.endian()?;
        let segments = header.program_headers(endian, data)?;
        let mut form = Self::default();
        for segment in segments {
            if let Some(path) = segment.interpreter(endian, data)? {
                form.loader = Some(text(path)?);
            }
            let Some(entries) = segment.dynamic(endian, data)? else {
                continue;
            };
            let mut tags = entries.iter().map(|it| it.tag(endian));
            let end = tags.position(|tag| tag == elf::DT_NULL);
            let entries = &entries[..end.ok_or("its dynamic section has no end")?];
            // As the loader does: the last entry counts, and the strings end with their segment.
            let address = entries.iter().rfind(|it| it.tag(endian) == elf::DT_STRTAB);
            let strings = segments.iter().find_map(|it| {
                let offset = address?.val(endian).checked_sub(it.p_vaddr(endian))?;
                let bytes = it.data(endian, data).ok()?.get(offset as usize..);
                bytes.filter(|left| !left.is_empty() && it.p_type(endian) == elf::PT_LOAD)
            });
            let strings = strings.unwrap_or_default();
            let strings = StringTable::new(strings, 0, strings.len() as u64);
            for entry in entries {
                let name = || text(entry.string(endian, strings)?);
                match entry.tag(endian) {
                    elf::DT_NEEDED => form.needed.push(name()?),
                    elf::DT_SONAME => form.name = Some(name()?),
                    // The loader would read these by their paths.
                    elf::DT_AUDIT | elf::DT_DEPAUDIT | elf::DT_FILTER | elf::DT_AUXILIARY => {
                        return Err("it has auditors or filters, which would not be checked".into());
                    }
                    _ => {}
                }
            }
        }
        Ok(form)
    }
}

fn text(bytes: &[u8]) -> Result<String, Why> {
    Ok(str::from_utf8(bytes)?.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    fn form(bytes: &[u8]) -> Result<Form, Why> {
        let mut file = tempfile::tempfile().unwrap();
        file.write_all(bytes).unwrap();
        Form::of(&file)
    }

    /// E-4: a script names its interpreter, whose choice is not left to the search path.
    #[test]
    fn a_script_names_its_interpreter() {
        let script = |text: &[u8]| form(text).unwrap().interpreter;
        assert_eq!(script(b"#!/bin/sh\nexit"), ["/bin/sh"]);
        let spaced = script(b"#! /bin/sh  -e -u \nexit");
        assert_eq!(spaced, ["/bin/sh", "-e -u"]);
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
        let whole = form(&this).unwrap();
        assert!(whole.needed.contains(&"libc.so.6".to_owned()), "{whole:?}");
        assert!(whole.loader.is_some());
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
