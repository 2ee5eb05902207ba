//! The unrecoverable state (E-5).

pub(crate) const ALL: &[(&str, fn())] = &[];
