//! The deterministic client: what the next activation is for (E-1).
