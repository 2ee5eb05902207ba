//! The board in one process, on a clock that the caller advances.
