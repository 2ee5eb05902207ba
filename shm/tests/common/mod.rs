//! Functions that the loom models share.

use loom::sync::Arc;
use tandem_shm::sync::AtomicU32;

/// Returns this number of zeroed words, new in each execution.
pub(crate) fn zeroed(words: usize) -> Arc<Vec<AtomicU32>> {
    Arc::new((0..words).map(|_| AtomicU32::new(0)).collect())
}

/// Runs the model over all executions with at most this number of pre-emptions.
pub(crate) fn model(preemptions: usize, f: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(preemptions);
    builder.max_branches = 20_000;
    builder.check(f);
}
