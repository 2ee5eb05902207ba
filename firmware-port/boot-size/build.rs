//! Passes the linker script and an option to the linker.

fn main() {
    let folder = env!("CARGO_MANIFEST_DIR");
    println!("cargo:rustc-link-arg-bins=-T{folder}/link.x");
    // Functions with the same instructions are linked once.
    println!("cargo:rustc-link-arg-bins=--icf=all");
    println!("cargo:rerun-if-changed=link.x");
}
