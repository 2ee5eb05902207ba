//! Shared by the tests of the whole product.
#![forbid(unsafe_code)]
#![allow(clippy::expect_used, reason = "a test may panic")]

pub mod around;
pub mod bent;
