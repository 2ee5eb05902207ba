//! What the tests of the whole have in common.
#![forbid(unsafe_code)]
#![allow(clippy::expect_used, reason = "a test may panic")]

pub mod around;
pub mod bent;
