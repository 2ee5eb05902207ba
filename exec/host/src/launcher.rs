//! The launcher: starts, watches and stops processes as the supervisor decides.
