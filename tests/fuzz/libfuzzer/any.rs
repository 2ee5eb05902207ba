//! Runs the target named by TANDEM_FUZZ_TARGET.
#![no_main]

use std::sync::LazyLock;

use tandem_fuzz::Target;

static TARGET: LazyLock<&Target> = LazyLock::new(|| {
    let name = std::env::var("TANDEM_FUZZ_TARGET").unwrap_or_default();
    tandem_fuzz::target(&name).expect("TANDEM_FUZZ_TARGET names a target")
});

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    (TARGET.body)(data);
});
