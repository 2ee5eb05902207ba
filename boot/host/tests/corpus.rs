//! Replays the corpora of the fuzz targets: every input that a fuzzer found interesting. T-BOOT-4
//!
//! `TANDEM_WRITE_CORPUS=1` writes the inputs that a fuzzer begins with.
#![allow(clippy::unwrap_used)]

mod fixture;

use fixture::{configuration, image};
use std::fs;
use std::path::{Path, PathBuf};
use tandem_boot::{Environment, EnvironmentStore, Region, SIGNED_BYTES, Slot};
use tandem_boot_host::{ProgramFlash, fuzz, records};

type Body = fn(&[u8]);
const TARGETS: [(&str, Body); 4] = [
    ("record", fuzz::record),
    ("frames", fuzz::frames),
    ("manifest", fuzz::manifest),
    ("environment", fuzz::environment),
];

fn corpus(target: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../fuzz/corpus")
        .join(target)
}

#[test]
fn every_input_of_the_corpora_holds() {
    if std::env::var_os("TANDEM_WRITE_CORPUS").is_some() {
        write_seeds();
    }
    for (target, body) in TARGETS {
        let inputs: Vec<_> = fs::read_dir(corpus(target)).unwrap().collect();
        assert!(inputs.len() >= 3, "{target} has {} inputs", inputs.len());
        for input in inputs {
            let path = input.unwrap().path();
            println!("{}", path.display());
            body(&fs::read(path).unwrap());
        }
    }
}

/// Good inputs of each target: a fuzzer finds the bad ones by changing them.
fn seeds() -> Vec<(&'static str, Vec<u8>)> {
    let mut seeds = Vec::new();
    let images = [image(Slot::B, 2, 40), configuration(Slot::A, 1)];
    let lines = records("seed", &[&images[0], &images[1]]);
    for line in lines.iter().step_by(9).chain(&lines[lines.len() - 2..]) {
        seeds.push(("record", line.trim_end().as_bytes().to_vec()));
        let pieces = line.as_bytes().chunks(8);
        let frames = pieces.flat_map(|piece| [&[piece.len() as u8][..], piece].concat());
        seeds.push(("frames", frames.collect()));
    }
    for image in &images {
        seeds.push(("manifest", image.bytes[..SIGNED_BYTES].to_vec()));
    }
    let mut three = images[0].manifest;
    three.parts[1] = three.parts[0];
    three.parts[1].offset += three.parts[0].length;
    three.length *= 2;
    seeds.push(("manifest", three.encode().to_vec()));
    for versions in [[0; 3], [1, 2, 3], [u32::MAX; 3]] {
        let mut flash = ProgramFlash::new();
        let environment = Environment {
            versions,
            ..Environment::default()
        };
        EnvironmentStore::new(environment)
            .settle(&mut flash)
            .unwrap();
        let copies = [0, 1].map(|copy| {
            let at = Region::Environment(copy).range().start;
            flash.firm(at, 96).unwrap()
        });
        seeds.push(("environment", copies.concat()));
    }
    seeds
}

fn write_seeds() {
    for (number, (target, input)) in seeds().into_iter().enumerate() {
        fs::create_dir_all(corpus(target)).unwrap();
        fs::write(corpus(target).join(format!("seed-{number:02}")), input).unwrap();
    }
}
