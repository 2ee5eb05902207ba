//! The manifest of an image.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| tandem_boot_host::fuzz::manifest(data));
