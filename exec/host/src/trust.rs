//! Trust: what runs is what was checked (E-4).
