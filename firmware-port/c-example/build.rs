//! Passes the linker script of the board to the linker.

fn main() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../virt/link.x");
    println!("cargo:rustc-link-arg-bins=-T{script}");
    println!("cargo:rerun-if-changed={script}");
}
