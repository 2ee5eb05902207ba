//! Hands each image's linker script to the linker.

/// Images that a bootloader starts from a slot.
const IN_SLOTS: [&str; 2] = ["slot-controller", "slot-frames"];

fn main() {
    let folder = env!("CARGO_MANIFEST_DIR");
    let bins = std::fs::read_dir(format!("{folder}/src/bin"))
        .into_iter()
        .flatten();
    for bin in bins.flatten() {
        let name = bin.file_name().to_string_lossy().replace(".rs", "");
        let script = match IN_SLOTS.contains(&name.as_str()) {
            true => "link-slot.x",
            false => "link.x",
        };
        println!("cargo:rustc-link-arg-bin={name}=-T{folder}/{script}");
    }
    for file in ["link.x", "link-slot.x", "src/start.S", "src/bin"] {
        println!("cargo:rerun-if-changed={file}");
    }
}
