//! Start protocol, heartbeat, roles and faults of a dual system: sans-IO (no_std).
#![no_std]
