//! Attacks on the trusted platform: each changed byte and each replaced part is refused.

#![expect(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stdout,
    reason = "tests"
)]

mod fixture;
mod lists;
mod matrix;
mod running;
