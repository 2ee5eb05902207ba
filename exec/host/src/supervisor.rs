//! The supervisor: decides what starts, restarts and stops. It is told the time (E-6).
