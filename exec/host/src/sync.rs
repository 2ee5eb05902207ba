//! Clients and the sync master over shared memory (E-3).
