//! Builds the one peer that is a C program: FreeRTOS with its own POSIX port.

use std::env;
use std::error::Error;
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn Error>> {
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
