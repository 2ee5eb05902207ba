//! The LMU: map, lock, sync mailbox, pool, channels (no_std).
#![no_std]
