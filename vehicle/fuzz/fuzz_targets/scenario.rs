//! The reader of scenario files, and the world that follows from them.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    tandem_vehicle::fuzz::scenario(data);
});
