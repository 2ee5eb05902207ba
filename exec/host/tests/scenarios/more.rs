//! Further scenarios.

pub(crate) const ALL: &[(&str, fn())] = &[];
