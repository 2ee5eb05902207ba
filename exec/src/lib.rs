//! Deterministic execution: clients that are activated at the same time and compute the same, the
//! master that activates them, and the comparison of what they computed. Sans-IO.
//!
//! A cycle has four steps:
//!
//! 1. Each client has executed activation `n`. It sends a request ([`message`]): who it is, what it
//!    was activated for, and the digest of its outputs.
//! 2. The [`master`] waits for all clients, or for M of N until a deadline. The
//!    [`lockstep`] compares the outputs. So a client that deviates in activation `n` is found
//!    before an output of `n` counts.
//! 3. The master proposes a response: time and code of activation `n + 1`, and whose outputs count.
//!    The transport decides between masters (see [`master`]).
//! 4. Each [`Client`](client::Client) wakes at that time. All get the same numbers from `random`.
//!
//! The numbers SWS_EM_013xx are those of AUTOSAR R21-11; R23-11 calls this part obsolete.
//!
//! # Example
//!
//! ```
#![doc = include_str!("../examples/lockstep.rs")]
//! ```
#![cfg_attr(not(test), no_std)]
#![forbid(unsafe_code)]

pub mod client;
pub mod lockstep;
pub mod master;
pub mod message;
