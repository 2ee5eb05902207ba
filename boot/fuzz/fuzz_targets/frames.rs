//! The reassembly of frames.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| tandem_boot_host::fuzz::frames(data));
