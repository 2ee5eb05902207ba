//! Passes the linker script of the `virt` machines to the linker.

fn main() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../virt/link.x");
    println!("cargo:rustc-link-arg-bins=-T{script}");
    for file in ["../virt/link.x", "../virt/start.S", "src/registers.S"] {
        println!("cargo:rerun-if-changed={file}");
    }
}
