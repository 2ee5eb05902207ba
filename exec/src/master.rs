//! The sync master: one answer to the requests of all redundant clients (E-3).
