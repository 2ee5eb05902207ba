//! Empty: see `[patch.crates-io]` in the manifest of the workspace.
#![no_std]
#![forbid(unsafe_code)]
