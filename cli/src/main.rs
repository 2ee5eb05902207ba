//! The tandem command.
#![forbid(unsafe_code)]

#[allow(dead_code)]
mod mastership;
#[allow(dead_code)]
mod metrics;
#[allow(dead_code)]
mod percentiles;
#[allow(dead_code)]
mod report;
#[allow(dead_code)]
mod roles;
#[allow(dead_code)]
mod runlog;
#[cfg(test)]
#[allow(dead_code)]
mod synthetic;

fn main() {}
