//! Checks that `include/tandem.h` is what cbindgen generates; `TANDEM_WRITE_HEADER=1` writes it.
#![allow(clippy::unwrap_used)]

use cbindgen::{Builder, Config};
use std::fs;
use std::path::Path;

/// Converts the name of a type to the style of C: `TandemLock` becomes `tandem_lock_t`.
fn c_name(name: &str) -> String {
    let mut made = String::new();
    for letter in name.chars() {
        if letter.is_uppercase() && !made.is_empty() {
            made.push('_');
        }
        made.extend(letter.to_lowercase());
    }
    made + "_t"
}

fn generated(room: &Path) -> String {
    let mut config = Config::from_file(room.join("cbindgen.toml")).unwrap();
    for entry in fs::read_dir(room.join("src")).unwrap() {
        let text = fs::read_to_string(entry.unwrap().path()).unwrap();
        for line in text.lines() {
            let words: Vec<&str> = line.split(|c: char| !c.is_alphanumeric()).collect();
            if let ["pub", "struct" | "enum" | "type", name, ..] = words[..]
                && name.starts_with("Tandem")
            {
                config.export.rename.insert(name.to_owned(), c_name(name));
            }
        }
    }
    let mut header = Vec::new();
    Builder::new()
        .with_config(config)
        .with_crate(room)
        .generate()
        .unwrap()
        .write(&mut header);
    // cbindgen derives the prefix from the type's name, including `_t`.
    String::from_utf8(header)
        .unwrap()
        .replace("TANDEM_STATUS_T_", "TANDEM_STATUS_")
}

#[test]
fn the_header_is_not_stale() {
    let room = Path::new(env!("CARGO_MANIFEST_DIR"));
    let file = room.join("include/tandem.h");
    let header = generated(room);
    if std::env::var_os("TANDEM_WRITE_HEADER").is_some() {
        fs::write(&file, &header).unwrap();
    }
    let committed = fs::read_to_string(&file).unwrap_or_default();
    assert!(
        committed == header,
        "capi/include/tandem.h is stale: cargo xtask c-header"
    );
}
