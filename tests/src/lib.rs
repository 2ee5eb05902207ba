//! Code that the tests of the whole product share.
#![forbid(unsafe_code)]
#![allow(clippy::expect_used, reason = "a test may panic")]

pub mod around;
pub mod bent;
