//! Builds the one peer that is a C program, FreeRTOS with its own POSIX port, and notes commit,
//! compiler and flags, which a result must name.

use std::env;
use std::error::Error;
use std::path::PathBuf;
use std::process::Command;

/// What a command says in its first line; `None` if it fails.
fn said(command: &mut Command) -> Option<String> {
    let output = command
        .output()
        .ok()
        .filter(|output| output.status.success())?;
    let text = String::from_utf8(output.stdout).ok()?;
    text.lines().next().map(str::to_owned)
}

fn note_build() -> Result<(), env::VarError> {
    let git = |args: &str| said(Command::new("git").args(args.split(' ')));
    if let Some(log) = git("rev-parse --git-path logs/HEAD") {
        println!("cargo::rerun-if-changed={log}");
    }
    let flags = env::var("CARGO_ENCODED_RUSTFLAGS").unwrap_or_default();
    let flags = flags.replace('\u{1f}', " ");
    let (level, target) = (env::var("OPT_LEVEL")?, env::var("TARGET")?);
    let flags = format!("opt-level {level}, {target} {flags}");
    for (name, value) in [
        (
            "COMMIT",
            git("describe --always --dirty --exclude=* --abbrev=12"),
        ),
        (
            "COMPILER",
            said(Command::new(env::var("RUSTC")?).arg("--version")),
        ),
        ("FLAGS", Some(flags.trim().to_owned())),
    ] {
        let value = value.unwrap_or_else(|| "unknown".to_owned());
        println!("cargo::rustc-env=TANDEM_BENCH_{name}={value}");
    }
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    note_build()?;
    let ours = PathBuf::from("src/peers/freertos_posix");
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={}", ours.display());
    // Where tandem-rtos has its kernel from: the peer is of the same sources.
    let kernel = PathBuf::from(env::var("DEP_TANDEM_FREERTOS_KERNEL")?);
    let port = kernel.join("portable/ThirdParty/GCC/Posix");
    let program = PathBuf::from(env::var("OUT_DIR")?).join("freertos-posix");
    let compiler = cc::Build::new()
        .opt_level(2)
        .warnings(false)
        .try_get_compiler()?;
    let mut command = compiler.to_command();
    command.arg("-w").arg("-pthread").arg("-o").arg(&program);
    for folder in [&ours, &kernel.join("include"), &port, &port.join("utils")] {
        command.arg("-I").arg(folder);
    }
    command.arg(ours.join("main.c"));
    for source in ["tasks.c", "queue.c", "list.c", "portable/MemMang/heap_3.c"] {
        command.arg(kernel.join(source));
    }
    command
        .arg(port.join("port.c"))
        .arg(port.join("utils/wait_for_event.c"));
    let status = command.status()?;
    if !status.success() {
        return Err(format!("{command:?} ended with {status}").into());
    }
    Ok(())
}
