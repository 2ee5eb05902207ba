//! Software lockstep: compares the outputs of redundant clients (E-3).
