//! Time synchronisation on the host: Ethernet frames of gPTP with the kernel's stamps.
#![forbid(unsafe_code)]
