//! The worker pool: one function over the elements of a list, in parallel (E-2).
