//! Passes each image's linker script to the linker.

/// Images in the program flash, with their linker scripts.
const IN_SLOTS: [(&str, &str); 4] = [
    ("bank-loader", "bank.x"),
    ("slot-controller", "slot-a.x"),
    ("slot-controller-b", "slot-b.x"),
    ("slot-frames", "slot-a.x"),
];

fn main() {
    // Asked for at run time: two clones may share a target folder.
    let folder = std::env::var("CARGO_MANIFEST_DIR").unwrap_or_default();
    let bins = std::fs::read_dir(format!("{folder}/src/bin"))
        .into_iter()
        .flatten();
    for bin in bins.flatten() {
        let name = bin.file_name().to_string_lossy().replace(".rs", "");
        let slot = IN_SLOTS.iter().find(|(image, _)| *image == name);
        let script = slot.map_or("../virt/link.x", |(_, script)| script);
        println!("cargo:rustc-link-arg-bin={name}=-L{folder}");
        println!("cargo:rustc-link-arg-bin={name}=-T{folder}/{script}");
    }
    // FreeRTOS's message buffer in C, which only the image `bench` links.
    if let Ok(archive) = std::env::var("DEP_TANDEM_FREERTOS_MESSAGE_BUFFER") {
        println!("cargo:rustc-link-arg-bin=bench={archive}");
    }
    for file in [
        "../virt/link.x",
        "link-slot.x",
        "slot-a.x",
        "slot-b.x",
        "bank.x",
        "../virt/start.S",
        "src/registers.S",
        "src/slot.S",
        "src/bin",
    ] {
        println!("cargo:rerun-if-changed={file}");
    }
}
