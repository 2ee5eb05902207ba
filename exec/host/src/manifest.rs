//! The manifest: which processes there are, and how they run.
