//! This generator makes `src/types.rs` from `idl/tandem.idl`: an enum for each enum, a struct for
//! each struct. With `TANDEM_WRITE_IDL=1`, which `cargo xtask idl` sets, it writes the file.
//!
//! The macros and functions that the generated code calls are in `src/cdr.rs`. The generator fails
//! on anything in the IDL that it does not know, with its line.
#![allow(clippy::unwrap_used)]

mod grammar;

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::Command;
use std::{env, fs};

use grammar::{Const, Enum, Member, Module, Result, Struct};

const IDL: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/idl/tandem.idl");

#[test]
fn the_code_is_not_stale() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/types.rs");
    let code = generated(&fs::read_to_string(IDL).unwrap());
    let code = code.unwrap_or_else(|error| panic!("{IDL}: {error}"));
    if env::var_os("TANDEM_WRITE_IDL").is_some() {
        return fs::write(&file, code).unwrap();
    }
    assert!(
        fs::read_to_string(&file).unwrap() == code,
        "{} is stale: cargo xtask idl",
        file.display()
    );
}

/// A new type needs only its lines in the IDL.
#[test]
fn one_more_type_needs_only_the_idl() {
    let weather = r#"
        /// Data id of `Weather`.
        const uint16 WEATHER_DATA_ID = 0x9000;
        /// What falls.
        @final enum Fall {
            /// Nothing.
            DRY,
            /// Rain or
            /// drizzle.
            LIGHT_RAIN
        };
        /// The weather.
        @final struct Weather {
            /// CRC.
            uint16 crc;
            /// Counter.
            uint8 counter;
            /// What is falling.
            Fall falling;
            /// Outside the vehicle.
            @range(min=-60.0, max=60.5) @unit("degC") float temperature;
            /// Since the start.
            @unit("us") uint64 since;
        };
    };"#;
    let text = fs::read_to_string(IDL).unwrap();
    let (before, _) = text.rsplit_once("};").unwrap();
    let code = generated(&format!("{before}{weather}")).unwrap();
    for lines in [
        "    /// What falls.\n    Fall[2] {\n        /// Nothing.\n        Dry = 0,\n        \
         /// Rain or\n        /// drizzle.\n        LightRain = 1,\n    }",
        "    /// The weather.\n    Weather[\"tandem::Weather\", 24, 0x9000] {\n",
        "        /// What is falling.\n        falling: Fall,\n",
        "        /// Outside the vehicle. -60.0 ..= 60.5 degC\n        \
         temperature: f32 = -60.0..=60.5,\n",
        "        /// Since the start. 0 ..= 18446744073709551615 us\n        since: u64,\n",
    ] {
        assert!(code.contains(lines), "no {lines:?} in {code}");
    }
}

/// What the generator does not know is an error that names the line.
#[test]
fn an_unknown_element_is_refused_with_its_line() {
    for (text, error) in [
        (
            "interface A {};",
            "line 1: expected `module`, found Word(\"interface\")",
        ),
        (
            "module m {\n/// A.\n@mutable struct A",
            "line 3: expected `final`",
        ),
        (
            "module m {\n/// A.\n@final union A",
            "line 3: expected `struct` or `enum`",
        ),
        ("module m {\n/// A.\nstruct A", "line 3: expected `const`"),
        (
            "module m {\n@final struct A",
            "line 2: expected a comment of three slashes",
        ),
        (
            "module m {\n/// A.\nconst uint16 A = 65536;",
            "line 3: 65536 does not fit",
        ),
        ("module m {\n\n/* A */", "line 3: '/' is not known"),
        (
            "module m {\n",
            "line 1: expected a comment of three slashes, found the end",
        ),
        (
            "module m {};\nmodule n {};",
            "line 2: expected the end of the file",
        ),
    ] {
        let found = generated(text).err();
        assert!(
            found.as_ref().is_some_and(|found| found.starts_with(error)),
            "{text}: {found:?}"
        );
    }
    // The member is on line 5.
    for (member, error) in [
        ("string b;", "line 5: the type string is not known"),
        ("uint8 b[2];", "line 5: uint8 is not known as an array"),
        ("octet b;", "line 5: octet is known as an array only"),
        ("sequence<octet> b;", "line 5: '<' is not known"),
        (
            "@key uint8 b;",
            "line 5: expected one `unit` and one `range`, found @key",
        ),
        (
            "@unit(\"m\") @unit(\"m\") uint8 b;",
            "line 5: expected one `unit`",
        ),
        (
            "@unit(m) uint8 b;",
            "line 5: expected a text, found Word(\"m\")",
        ),
        ("@unit(\"m) uint8 b;", "line 5: a text without end"),
        (
            "@unit(\"m\") float b;",
            "line 5: a float needs @range and @unit",
        ),
        (
            "@range(min=0.0, max=1.0) float b;",
            "line 5: a float needs @range and @unit",
        ),
        (
            "@unit(\"m\") @range(min=0, max=1) float b;",
            "line 5: 0 is no float",
        ),
        (
            "@unit(\"m\") @range(min=0.0, max=1.0e99) float b;",
            "line 5: 1.0e99 is no float",
        ),
        ("@unit(\"m\") boolean b;", "line 5: boolean has no unit"),
        ("@range(min=0, max=1) boolean b;", "line 5: 0 is no boolean"),
        ("@range(min=0, max=256) uint8 b;", "line 5: 256 is no uint8"),
        ("@range(min=-1, max=2) uint8 b;", "line 5: -1 is no uint8"),
        (
            "@range(min=1, max=2) uint8 b;",
            "line 5: 1 ..= 2 does not hold the default, 0",
        ),
        ("uint8 b, c;", "line 5: expected ';', found Mark(',')"),
        ("uint8 b;\n/// C.\nuint8 B;", "line 7: the name B is taken"),
        (
            "uint16 crc;\n/// C.\nuint8 counter;",
            "line 3: A needs the constant A_DATA_ID",
        ),
    ] {
        let text = format!("module m {{\n/// A.\n@final struct A {{\n/// B.\n{member}\n}};\n}};");
        let found = generated(&text).err();
        assert!(
            found.as_ref().is_some_and(|found| found.starts_with(error)),
            "{member}: {found:?}"
        );
    }
}

/// Each protected type has a data id of its own, which the vehicle bus does not use.
#[test]
fn a_data_id_that_is_used_twice_or_not_at_all_is_refused() {
    let id = |name: &str, id: u16| format!("/// I.\nconst uint16 {name}_DATA_ID = {id};\n");
    let protected = |name: &str| {
        format!(
            "/// P.\n@final struct {name} {{\n/// C.\nuint16 crc;\n/// C.\nuint8 counter;\n}};\n"
        )
    };
    let check = |body: &[String]| generated(&format!("module m {{\n{}}};", body.concat()));
    assert!(
        check(&[
            id("P", 0x800),
            id("Q", 0x801),
            protected("P"),
            protected("Q")
        ])
        .is_ok()
    );
    for (body, error) in [
        (
            vec![id("P", 0x800)],
            "line 3: P_DATA_ID is not the id of a struct with a CRC",
        ),
        (
            vec![id("P", 0x0A0), protected("P")],
            "line 3: P_DATA_ID is an id of the vehicle bus",
        ),
        (
            vec![id("P", 9), id("Q", 9), protected("P"), protected("Q")],
            "line 5: Q_DATA_ID is the id of another struct",
        ),
    ] {
        assert_eq!(check(&body).unwrap_err(), error);
    }
}

/// A compiler of IDL that is not ours accepts the file without a warning, and knows the types by
/// the same names. Without `idlc` the test passes and prints that it was skipped.
#[test]
fn idlc_accepts_the_idl() {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("idlc");
    fs::create_dir_all(&folder).unwrap();
    let Ok(output) = Command::new("idlc")
        .arg("-o")
        .arg(&folder)
        .arg(IDL)
        .output()
    else {
        // The test runner does not capture this output, so a skipped test is visible.
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: idlc_accepts_the_idl: no idlc (apt-get install cyclonedds-tools)"
        );
        return;
    };
    let said = [output.stdout, output.stderr].concat();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&said)
    );
    assert_eq!(String::from_utf8_lossy(&said), "");
    let code = fs::read_to_string(folder.join("tandem.c")).unwrap();
    let names = code
        .lines()
        .filter_map(|line| line.trim().strip_prefix(".m_typename = "));
    let names: Vec<&str> = names
        .map(|name| name.trim_matches(&['"', ','][..]))
        .collect();
    let module = grammar::parse(&fs::read_to_string(IDL).unwrap()).unwrap();
    let ours: Vec<String> = module
        .structs
        .iter()
        .map(|one| full_name(&module, one))
        .collect();
    assert_eq!(names, ours);
}

fn generated(text: &str) -> Result<String> {
    let module = grammar::parse(text)?;
    check_names(&module)?;
    check_data_ids(&module)?;
    let (mut enums, mut structs) = (String::new(), String::new());
    for one in &module.enums {
        write_enum(one, &mut enums);
    }
    for one in &module.structs {
        write_struct(&module, one, &mut structs)?;
    }
    Ok(format!(
        "//! Enums and structs of `idl/tandem.idl`. Made by `cargo xtask idl`: not to be edited.\n\
         \n\
         use crate::cdr::{{self, CdrError, Field, TopicType, Walk, enums, structs}};\n\
         use tandem_bus::e2e::{{self, Check, Checker}};\n\
         use tandem_shm::{{Corrupt, Payload}};\n\
         \n\
         enums! {{\n{enums}}}\n\
         \n\
         structs! {{\n{structs}}}\n"
    ))
}

/// Checks that no name is used twice in a scope. IDL does not distinguish `Gear` from `gear`.
fn check_names(module: &Module) -> Result<()> {
    fn check<'a>(names: impl Iterator<Item = (usize, &'a String)>) -> Result<()> {
        let mut taken = Vec::new();
        for (line, name) in names {
            if taken.contains(&name.to_lowercase()) {
                return Err(format!("line {line}: the name {name} is taken"));
            }
            taken.push(name.to_lowercase());
        }
        Ok(())
    }
    let consts = module.consts.iter().map(|one| (one.line, &one.name));
    let enums = module.enums.iter().map(|one| (one.line, &one.name));
    let structs = module.structs.iter().map(|one| (one.line, &one.name));
    let values = module.enums.iter();
    let values = values.flat_map(|one| one.values.iter().map(|value| (one.line, &value.name)));
    check(consts.chain(enums).chain(structs).chain(values))?;
    for one in &module.structs {
        check(one.members.iter().map(|member| (member.line, &member.name)))?;
    }
    Ok(())
}

/// Returns the name of a type as DDS knows it.
fn full_name(module: &Module, one: &Struct) -> String {
    format!("{}::{}", module.name, one.name)
}

/// Returns whether a struct begins with the header of `tandem_bus::e2e`.
fn is_protected(one: &Struct) -> bool {
    let head = one.members.iter().take(2);
    let head: Vec<(&str, &str)> = head.map(|it| (&*it.kind, &*it.name)).collect();
    head == [("uint16", "crc"), ("uint8", "counter")]
}

/// Returns the constant with the data id of a struct.
fn data_id<'a>(module: &'a Module, one: &Struct) -> Option<&'a Const> {
    let name = words(&one.name).join("_").to_uppercase() + "_DATA_ID";
    module.consts.iter().find(|one| one.name == name)
}

fn check_data_ids(module: &Module) -> Result<()> {
    let protected: Vec<&Struct> = module
        .structs
        .iter()
        .filter(|one| is_protected(one))
        .collect();
    for one in &protected {
        let (line, name) = (one.line, &one.name);
        data_id(module, one).ok_or_else(|| {
            let constant = words(name).join("_").to_uppercase();
            format!("line {line}: {name} needs the constant {constant}_DATA_ID")
        })?;
    }
    let ids: Vec<&Const> = protected
        .iter()
        .filter_map(|one| data_id(module, one))
        .collect();
    for (index, Const { line, name, value }) in module.consts.iter().enumerate() {
        let wrong = if !ids.iter().any(|one| one.name == *name) {
            "is not the id of a struct with a CRC"
        } else if tandem_bus::FRAMES.iter().any(|frame| frame.id == *value) {
            "is an id of the vehicle bus"
        } else if module.consts[..index].iter().any(|one| one.value == *value) {
            "is the id of another struct"
        } else {
            continue;
        };
        return Err(format!("line {line}: {name} {wrong}"));
    }
    Ok(())
}

fn write_enum(one: &Enum, out: &mut String) {
    for line in &one.doc {
        writeln!(out, "    /// {line}").unwrap();
    }
    writeln!(out, "    {}[{}] {{", one.name, one.values.len()).unwrap();
    for (raw, value) in one.values.iter().enumerate() {
        for line in &value.doc {
            writeln!(out, "        /// {line}").unwrap();
        }
        let words = words(&value.name).into_iter();
        let name: String = words
            .map(|word| word[..1].to_uppercase() + &word[1..])
            .collect();
        writeln!(out, "        {name} = {raw},").unwrap();
    }
    *out += "    }\n";
}

/// Writes a struct, and returns the length of its body in XCDR1.
fn write_struct(module: &Module, one: &Struct, out: &mut String) -> Result<()> {
    let (mut members, mut len) = (String::new(), 0_usize);
    for member in &one.members {
        let kind = Kind::of(module, member)?;
        len = len.next_multiple_of(kind.bytes) + kind.bytes * member.len.unwrap_or(1);
        let (range, note) = kind.range(member)?;
        let (last, doc) = member
            .doc
            .split_last()
            .ok_or("a member without a comment")?;
        for line in doc {
            writeln!(members, "        /// {line}").unwrap();
        }
        writeln!(members, "        /// {last}{note}").unwrap();
        writeln!(members, "        {}: {}{range},", member.name, kind.rust).unwrap();
    }
    for line in &one.doc {
        writeln!(out, "    /// {line}").unwrap();
    }
    let id = data_id(module, one).map_or(String::new(), |id| format!(", {:#06X}", id.value));
    let full = full_name(module, one);
    writeln!(
        out,
        "    {}[\"{full}\", {len}{id}] {{\n{members}    }}",
        one.name
    )
    .unwrap();
    Ok(())
}

/// What Rust makes of a type of the IDL.
struct Kind {
    rust: String,
    /// Length and alignment in XCDR1, of an element in an array.
    bytes: usize,
    /// The greatest value; `None` if the type is no integer.
    greatest: Option<u64>,
}

impl Kind {
    fn of(module: &Module, member: &Member) -> Result<Self> {
        let Member { line, kind, .. } = member;
        let (rust, bytes, greatest) = match &**kind {
            "uint8" => ("u8", 1, Some(u8::MAX.into())),
            "uint16" => ("u16", 2, Some(u16::MAX.into())),
            "uint32" => ("u32", 4, Some(u32::MAX.into())),
            "uint64" => ("u64", 8, Some(u64::MAX)),
            "boolean" => ("bool", 1, None),
            "float" => ("f32", 4, None),
            "octet" => ("u8", 1, None),
            _ if module.enums.iter().any(|one| one.name == *kind) => (&**kind, 4, None),
            _ => return Err(format!("line {line}: the type {kind} is not known")),
        };
        let rust = match member.len {
            Some(len) if kind == "octet" => format!("[{rust}; {len}]"),
            None if kind != "octet" => rust.to_owned(),
            // An element of another type would have a length before the array in XCDR2.
            Some(_) => return Err(format!("line {line}: {kind} is not known as an array")),
            None => return Err(format!("line {line}: {kind} is known as an array only")),
        };
        Ok(Self {
            rust,
            bytes,
            greatest,
        })
    }

    /// Returns the range of a member as code, and range and unit for its comment.
    fn range(&self, member: &Member) -> Result<(String, String)> {
        let Member { line, kind, .. } = member;
        if kind == "float" && (member.range.is_none() || member.unit.is_none()) {
            return Err(format!("line {line}: a float needs @range and @unit"));
        }
        let unit = member
            .unit
            .as_ref()
            .map_or(String::new(), |unit| format!(" {unit}"));
        let Some((min, max)) = &member.range else {
            return match self.greatest {
                _ if unit.is_empty() => Ok((String::new(), String::new())),
                Some(greatest) => Ok((String::new(), format!(" 0 ..= {greatest}{unit}"))),
                None => Err(format!("line {line}: {kind} has no unit")),
            };
        };
        for limit in [min, max] {
            let is_valid = match self.greatest {
                Some(greatest) => limit.parse::<u64>().is_ok_and(|limit| limit <= greatest),
                None if kind == "float" => {
                    limit.contains('.') && limit.parse().is_ok_and(f32::is_finite)
                }
                None => false,
            };
            if !is_valid {
                return Err(format!("line {line}: {limit} is no {kind}"));
            }
        }
        let holds_default = |min: f64, max: f64| min <= 0.0 && 0.0 <= max;
        let numbers = (min.parse(), max.parse());
        if !matches!(numbers, (Ok(min), Ok(max)) if holds_default(min, max)) {
            return Err(format!(
                "line {line}: {min} ..= {max} does not hold the default, 0"
            ));
        }
        Ok((
            format!(" = {min}..={max}"),
            format!(" {min} ..= {max}{unit}"),
        ))
    }
}

/// Splits `PowerControl` and `POWER_CONTROL` into `power` and `control`.
fn words(name: &str) -> Vec<String> {
    let mut words: Vec<String> = Vec::new();
    let is_shouted = name.chars().all(|c| !c.is_lowercase());
    for part in name.split('_') {
        for (index, c) in part.char_indices() {
            if index == 0 || (c.is_uppercase() && !is_shouted) {
                words.push(String::new());
            }
            if let Some(word) = words.last_mut() {
                word.extend(c.to_lowercase());
            }
        }
    }
    words
}
