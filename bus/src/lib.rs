//! CAN frames of the vehicle: the DBC's signals and their end-to-end protection (no_std).
#![no_std]
