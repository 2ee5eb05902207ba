//! Compiles the FreeRTOS kernel with our configuration and the port of the target.

use std::env;
use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Sources of the kernel that every target needs.
const KERNEL: [&str; 4] = ["tasks.c", "queue.c", "list.c", "timers.c"];
/// Sizes of the kernel's objects in words; `kernel/shim.c` checks them against the C types.
const SIZES: [(&str, usize); 3] = [("TASK_WORDS", 32), ("QUEUE_WORDS", 24), ("TIMER_WORDS", 12)];

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=kernel");
    let kernel = PathBuf::from(env::var("DEP_FREERTOS_KERNEL").map_err(
        |_| "DEP_FREERTOS_KERNEL is not set: freertos-next does not say where its sources are",
    )?);
    write_sizes()?;
    let os = env::var("CARGO_CFG_TARGET_OS")?;
    let arch = env::var("CARGO_CFG_TARGET_ARCH")?;
    let mut build = cc::Build::new();
    build.include("kernel").include(kernel.join("include"));
    // The kernel is not our code: its warnings are not reported.
    build.warnings(false).opt_level(2).debug(true);
    match (os.as_str(), arch.as_str()) {
        ("linux", "x86_64" | "aarch64") => host(&mut build),
        ("none", "riscv32") => riscv32(&mut build, &kernel)?,
        _ => {
            let targets = "Linux on x86_64 or aarch64, riscv32 without an operating system";
            return Err(format!("no port for {os} on {arch}, only for {targets}").into());
        }
    }
    for (name, words) in SIZES {
        build.define(&format!("TANDEM_{name}"), words.to_string().as_str());
    }
    for source in KERNEL {
        build.file(kernel.join(source));
    }
    build.file("kernel/shim.c");
    // Links the whole archive: the trap handlers in shim.c replace weak ones.
    build.link_lib_modifier("+whole-archive");
    build.try_compile("tandem_freertos")?;
    // For the test that builds the kernel for FreeRTOS's standard demo tasks.
    println!(
        "cargo::rustc-env=TANDEM_FREERTOS_KERNEL={}",
        kernel.display()
    );
    // A benchmark that builds the kernel with another port reads this variable.
    println!("cargo::metadata=KERNEL={}", kernel.display());
    Ok(())
}

fn write_sizes() -> Result<(), Box<dyn Error>> {
    let mut text = String::new();
    for (name, words) in SIZES {
        text += &format!("pub(crate) const {name}: usize = {words};\n");
    }
    let out = PathBuf::from(env::var("OUT_DIR")?).join("sizes.rs");
    Ok(fs::write(out, text)?)
}

fn host(build: &mut cc::Build) {
    build.include("kernel/host");
}

fn riscv32(build: &mut cc::Build, kernel: &Path) -> Result<(), Box<dyn Error>> {
    let port = kernel.join("portable/GCC/RISC-V");
    let chip = port.join("chip_specific_extensions/RISCV_MTIME_CLINT_no_extensions");
    let (compiler, flags) = riscv_compiler()?;
    build.compiler(compiler).no_default_flags(true);
    for flag in flags {
        build.flag(flag);
    }
    for flag in [
        // Without its default flags, the `cc` crate omits the optimisation level too.
        "-O2",
        "-g",
        "-mcmodel=medany",
        "-ffreestanding",
        "-ffunction-sections",
        "-fdata-sections",
        "-fno-common",
    ] {
        build.flag(flag);
    }
    // Headers for a C library that may be missing: the kernel needs four of its functions.
    build
        .include("kernel/riscv32/libc")
        .include("kernel/riscv32");
    build.include(&port).include(chip);
    message_buffer(build.clone(), kernel)?;
    build.file(port.join("port.c")).file(port.join("portASM.S"));
    Ok(())
}

/// Compiles FreeRTOS's message buffer between cores. Only the benchmark of the firmware links it,
/// for comparison. No task waits at either end: the benchmark rings the doorbell itself.
fn message_buffer(mut build: cc::Build, kernel: &Path) -> Result<(), Box<dyn Error>> {
    build.file(kernel.join("stream_buffer.c"));
    build.define("configUSE_STREAM_BUFFERS", "1");
    build.define("sbSEND_COMPLETED(x)", "");
    build.define("sbRECEIVE_COMPLETED(x)", "");
    build.cargo_metadata(false);
    build.try_compile("tandem_message_buffer")?;
    let archive = PathBuf::from(env::var("OUT_DIR")?).join("libtandem_message_buffer.a");
    println!("cargo::metadata=MESSAGE_BUFFER={}", archive.display());
    Ok(())
}

/// Returns the C compiler for riscv32 and the flags that name its target.
fn riscv_compiler() -> Result<(String, Vec<&'static str>), Box<dyn Error>> {
    println!("cargo::rerun-if-env-changed=TANDEM_RISCV_CC");
    let machine = ["-march=rv32imac_zicsr", "-mabi=ilp32"];
    if let Ok(chosen) = env::var("TANDEM_RISCV_CC") {
        return Ok((chosen, machine.to_vec()));
    }
    let candidates: [(&str, &[&'static str]); 3] = [
        ("riscv64-unknown-elf-gcc", &[]),
        ("riscv32-unknown-elf-gcc", &[]),
        ("clang", &["--target=riscv32-unknown-elf"]),
    ];
    for (name, flags) in candidates {
        let flags = [flags, &machine].concat();
        let mut command = Command::new(name);
        command
            .args(&flags)
            .args(["-x", "c", "-c", "-", "-o", "/dev/null"]);
        command
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null());
        if command.status().is_ok_and(|status| status.success()) {
            return Ok((name.to_string(), flags));
        }
    }
    Err(
        "no C compiler for riscv32: the FreeRTOS kernel needs riscv64-unknown-elf-gcc \
         (apt-get install gcc-riscv64-unknown-elf) or clang; \
         TANDEM_RISCV_CC names another one"
            .into(),
    )
}
