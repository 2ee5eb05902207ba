//! Shared by long commands: a progress bar, and work on all CPUs.

use std::num::NonZero;
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use anyhow::{Result, anyhow};
use indicatif::{ProgressBar, ProgressStyle};

/// Shows a progress bar of `count` steps.
pub(crate) fn bar(count: u64, template: &str) -> Result<ProgressBar> {
    let style = ProgressStyle::with_template(template)?;
    let bar = ProgressBar::new(count).with_style(style);
    bar.enable_steady_tick(Duration::from_millis(200));
    Ok(bar)
}

/// Calls `work` on each item, on `jobs` threads: by default one for each CPU. Returns the results
/// in the order of the items.
///
/// # Errors
/// The first error that `work` returned, or an error if `work` panicked.
pub(crate) fn on_threads<T, R: Send>(
    jobs: Option<NonZero<usize>>,
    items: impl Iterator<Item = T> + Send,
    work: impl Fn(T) -> Result<R> + Sync,
) -> Result<Vec<R>> {
    let jobs = jobs.or(thread::available_parallelism().ok());
    let items = Mutex::new(items.enumerate());
    let next = || items.lock().unwrap_or_else(PoisonError::into_inner).next();
    let worker = || -> Result<Vec<_>> {
        let mut done = Vec::new();
        while let Some((index, item)) = next() {
            done.push((index, work(item)?));
        }
        Ok(done)
    };
    let mut done = Vec::new();
    thread::scope(|scope| {
        let workers: Vec<_> = (0..jobs.map_or(1, NonZero::get))
            .map(|_| scope.spawn(worker))
            .collect();
        workers.into_iter().try_for_each(|worker| {
            done.extend(worker.join().map_err(|_| anyhow!("a worker panicked"))??);
            Ok::<_, anyhow::Error>(())
        })
    })?;
    done.sort_unstable_by_key(|(index, _)| *index);
    Ok(done.into_iter().map(|(_, result)| result).collect())
}
