//! The example with a core in C: built by its own compiler, run beside the cores in Rust, measured.

use super::{QEMU, TARGET, build_dir, cargo_build_package, finish, machine, port, released};
use crate::{output, read, succeed, write};
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

const GCC: &str = "riscv64-unknown-elf-gcc";
const SIZE: &str = "riscv64-unknown-elf-size";
/// The flags of a user's build: strict, small, no C library, unused functions dropped.
const FLAGS: [&str; 13] = [
    "-march=rv32imac_zicsr",
    "-mabi=ilp32",
    "-std=c99",
    "-Wall",
    "-Wextra",
    "-Werror",
    "-pedantic",
    "-Os",
    "-ffreestanding",
    "-ffunction-sections",
    "-fdata-sections",
    "-nostdlib",
    "-Wl,--gc-sections",
];

pub(super) fn run(root: &Path) -> Result<()> {
    let library = library(root)?;
    let in_c = build_dir(root).join("c-core.elf");
    let sources = port(root).join("c-example/c");
    let mut link = gcc(root);
    link.arg("-T").arg(sources.join("link.ld"));
    for source in ["start.S", "board.c", "main.c"] {
        link.arg(sources.join(source));
    }
    succeed(link.arg(&library).arg("-o").arg(&in_c))?;
    cargo_build_package(root, &["--release", "-p", "tandem-c-example"])?;
    let virt = ["virt", "-smp", "3", "-bios", "none"];
    let mut command = machine(QEMU, &virt, &released(root, "c-example"), 0, (0, &[]));
    // Hart 2 starts in the image of the example.
    let hart_2 = format!("loader,file={},cpu-num=2", in_c.display());
    command.args(["-device", &hart_2]);
    let log = finish(&mut command)?;
    print!("{log}");
    ensure!(
        log.lines().count() >= STEPS,
        "the example ended before its last step"
    );
    sizes(root, &library, &in_c)
}

/// Lines of the log: one for each step of the example.
const STEPS: usize = 6;

/// Builds the static library, as small as possible.
fn library(root: &Path) -> Result<PathBuf> {
    let mut build = crate::cargo(root, &["rustc", "--quiet", "-p", "tandem-capi", "--lib"]);
    build
        .args(["--crate-type", "staticlib", "--profile", "c-library"])
        .args(["--target", TARGET])
        .env("CARGO_TARGET_DIR", build_dir(root));
    crate::run(build)?;
    Ok(build_dir(root)
        .join(TARGET)
        .join("c-library/libtandem_capi.a"))
}

fn gcc(root: &Path) -> Command {
    let mut command = Command::new(GCC);
    command.args(FLAGS).arg("-I").arg(root.join("capi/include"));
    command
}

/// Returns the functions that the header declares.
fn functions(root: &Path) -> Result<Vec<String>> {
    let header = read(root.join("capi/include/tandem.h"))?;
    // A declaration is a line that begins with its type: a status or a number.
    let declared = header.lines().filter_map(|line| {
        let types = ["tandem_status_t ", "uint32_t ", "size_t "];
        let rest = types.iter().find_map(|of| line.strip_prefix(of))?;
        Some(rest.split_once('(')?.0.to_owned())
    });
    Ok(declared.collect())
}

/// Prints the sizes of the library in a C image: the whole library, the functions of `shm`, and the
/// functions that the example calls.
fn sizes(root: &Path, library: &Path, example: &Path) -> Result<()> {
    let all = functions(root)?;
    let redundancy = ["redundancy", "config", "state", "store"];
    let of_shm = |name: &&String| !redundancy.iter().any(|part| name.contains(part));
    let shm: Vec<&String> = all.iter().filter(of_shm).collect();
    ensure!(
        shm.len() < all.len() && shm.len() > 30,
        "the header is read wrong"
    );
    println!("{:<44} {:>7}", "bytes", "text");
    let shown = |what: &str, text: u32| println!("{what:<44} {text:>7}");
    let count = |functions: usize| format!("{functions} functions");
    let messages = ["layout_init", "map_", "incarnation_", "mailbox", "fifo"];
    let of_messages = |name: &&String| messages.iter().any(|part| name.contains(part));
    let few: Vec<&String> = all.iter().filter(of_messages).collect();
    let text = linked(root, library, &few)?;
    shown(
        &format!("map, mailbox, FIFO for C, {}", count(few.len())),
        text,
    );
    let text = linked(root, library, &shm)?;
    shown(&format!("shm for C, {}", count(shm.len())), text);
    let text = linked(root, library, &all.iter().collect::<Vec<_>>())?;
    shown(&format!("shm and redundancy, {}", count(all.len())), text);
    shown("the example's image in C", text_of(example)?);
    Ok(())
}

/// Returns the size of the text of an image that has only these functions and their callees.
fn linked(root: &Path, library: &Path, functions: &[&String]) -> Result<u32> {
    let source = build_dir(root).join("size.c");
    let image = build_dir(root).join("size.elf");
    let on_panic = "void tandem_on_panic(void);\nvoid tandem_on_panic(void) { for (;;) { } }\n";
    write(&source, on_panic)?;
    let mut link = gcc(root);
    link.arg("-Wl,-e,tandem_on_panic");
    for function in functions {
        link.arg(format!("-Wl,-u,{function}"));
    }
    link.arg(&source).arg(library).arg("-o").arg(&image);
    output(&mut link).with_context(|| {
        format!("{GCC}: apt-get install --no-install-recommends gcc-riscv64-unknown-elf")
    })?;
    text_of(&image)
}

fn text_of(image: &Path) -> Result<u32> {
    let table = output(Command::new(SIZE).arg("-A").arg(image))?;
    let line = table.lines().find(|line| line.starts_with(".text"));
    let bytes = line.and_then(|line| line.split_whitespace().nth(1));
    bytes
        .and_then(|bytes| bytes.parse().ok())
        .with_context(|| format!("{}: no .text", image.display()))
}
