//! One suite that every board passes.
