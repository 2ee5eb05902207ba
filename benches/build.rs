//! Builds what is in C, and records the commit, the compiler and the flags of this build.
//!
//! In C are FreeRTOS with its own POSIX port, a peer; the library that takes the samples of another
//! peer, ddsperf; and the program that supervisors start.

use std::env;
use std::error::Error;
use std::path::PathBuf;
use std::process::Command;

/// Returns the first line of a command's output; `None` if it fails.
fn said(command: &mut Command) -> Option<String> {
    let output = command.output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    let line = text.lines().next().map(str::to_owned);
    line.filter(|_| output.status.success())
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
    let commit = git("describe --always --dirty --exclude=* --abbrev=12");
    let compiler = said(Command::new(env::var("RUSTC")?).arg("--version"));
    let flags = Some(flags.trim().to_owned());
    for (name, value) in [("COMMIT", commit), ("COMPILER", compiler), ("FLAGS", flags)] {
        let value = value.unwrap_or_else(|| "unknown".to_owned());
        println!("cargo::rustc-env=TANDEM_BENCH_{name}={value}");
    }
    Ok(())
}

fn run(mut command: Command) -> Result<(), Box<dyn Error>> {
    let status = command.status()?;
    if !status.success() {
        return Err(format!("{command:?} ended with {status}").into());
    }
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    note_build()?;
    let ours = PathBuf::from("src/peers/freertos_posix");
    let samples = "src/peers/ddsperf_samples.c";
    let ready = "src/peers/ready.c";
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed={}", ours.display());
    println!("cargo::rerun-if-changed={samples}");
    println!("cargo::rerun-if-changed={ready}");
    // Build the peer from the same kernel sources as tandem-rtos.
    let kernel = PathBuf::from(env::var("DEP_TANDEM_FREERTOS_KERNEL")?);
    let port = kernel.join("portable/ThirdParty/GCC/Posix");
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let program = out.join("freertos-posix");
    let mut compiler = cc::Build::new();
    let compiler = compiler.opt_level(2).warnings(false).try_get_compiler()?;
    let mut command = compiler.to_command();
    command.args(["-w", "-pthread", "-o"]).arg(&program);
    for folder in [&ours, &kernel.join("include"), &port, &port.join("utils")] {
        command.arg("-I").arg(folder);
    }
    command.arg(ours.join("main.c"));
    let of_kernel = ["tasks.c", "queue.c", "list.c", "portable/MemMang/heap_3.c"];
    command.args(of_kernel.map(|source| kernel.join(source)));
    command.args(["port.c", "utils/wait_for_event.c"].map(|source| port.join(source)));
    run(command)?;
    let mut command = compiler.to_command();
    command.args(["-w", "-shared", "-fPIC", "-o"]);
    command.arg(out.join("ddsperf-samples.so")).arg(samples);
    run(command)?;
    let mut command = compiler.to_command();
    command.args(["-w", "-D_GNU_SOURCE", "-o"]);
    command.arg(out.join("ready")).arg(ready);
    run(command)
}
