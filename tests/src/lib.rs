//! Whole-process tests of the `tandem` command live in `tests/`.
