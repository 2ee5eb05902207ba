//! The states of a cache line between the two CPUs: which a run met, and which figures belong to
//! the same one.
//!
//! A hypervisor moves its virtual CPUs: between the threads of one physical core, cores that share
//! a cache, and cores that do not. The same line then takes 40, 75 or 250 ns, all lines alike, for
//! milliseconds or for a minute. So a bare line is measured before and after each batch. The times
//! of all these lines have one mode for each state; a batch belongs to a state if both its lines do.

use std::ops::Range;

/// One state, by the time of a bare line.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Mode {
    /// Median time of a line in this state, ps.
    pub(crate) line_ps: f64,
    /// The times that belong to this state, as logarithms of ps.
    range: Range<f64>,
}

/// Width of the kernel, as a logarithm: in one state, lines at other places differ by about 5 %.
const WIDTH: f64 = 0.06;
/// Points of the grid in a width.
const FINE: f64 = 6.0;
/// Two peaks are two states only if the density between them is below this share of the lower one.
const VALLEY: f64 = 0.5;
/// And only if they differ by this many standard deviations: few lines have gaps by chance.
const DEVIATIONS: f64 = 2.5;
/// Fewer lines than this, or than this share, are no state of their own.
const FEWEST: (f64, f64) = (4.0, 0.04);

/// Returns the states that these times of lines show, in ps, the fastest first; none without lines.
///
/// Its peaks are those of the density of the logarithms, by a Gaussian kernel (B. W. Silverman,
/// "Density Estimation for Statistics and Data Analysis", 1986, chapter 2).
pub(crate) fn find(lines_ps: &[f64]) -> Vec<Mode> {
    let mut logs: Vec<f64> = lines_ps.iter().map(|ps| ps.max(1.0).ln()).collect();
    logs.sort_unstable_by(f64::total_cmp);
    let [Some(first), Some(last)] = [logs.first(), logs.last()] else {
        return Vec::new();
    };
    let begin = first - 4.0 * WIDTH;
    let points = ((last - begin + 4.0 * WIDTH) / WIDTH * FINE) as usize;
    let at = |point: usize| begin + point as f64 * WIDTH / FINE;
    let density: Vec<f64> = (0..=points).map(|point| around(&logs, at(point))).collect();
    let bounds = valleys(&density).into_iter().map(at);
    let bounds: Vec<f64> = [f64::NEG_INFINITY].into_iter().chain(bounds).collect();
    let ends = bounds[1..].iter().copied().chain([f64::INFINITY]);
    let ranges = bounds.iter().zip(ends).map(|(begin, end)| *begin..end);
    let modes = ranges.filter_map(|range| {
        let inside = logs.iter().filter(|log| range.contains(log));
        let inside: Vec<f64> = inside.copied().collect();
        let fewest = FEWEST.0.max(FEWEST.1 * logs.len() as f64);
        let line_ps = inside.get(inside.len() / 2)?.exp();
        (inside.len() as f64 >= fewest).then_some(Mode { line_ps, range })
    });
    modes.collect()
}

/// Returns the density of these sorted logarithms at `place`, times a constant.
fn around(logs: &[f64], place: f64) -> f64 {
    let near = |by: f64| logs.partition_point(|log| *log < place + by * WIDTH);
    let near = &logs[near(-5.0)..near(5.0)];
    let kernel = |log: &f64| (-0.5 * ((log - place) / WIDTH).powi(2)).exp();
    near.iter().map(kernel).sum()
}

/// Returns the places of the valleys that are deep enough to part two states.
fn valleys(density: &[f64]) -> Vec<usize> {
    let value = |at: Option<usize>| at.map_or(0.0, |at| density[at]);
    // Peaks, and between each two the lowest place.
    let mut peaks: Vec<usize> = Vec::new();
    let mut lows: Vec<usize> = Vec::new();
    for at in 0..density.len() {
        let (before, here) = (value(at.checked_sub(1)), density[at]);
        let after = value((at + 1 < density.len()).then_some(at + 1));
        if here > before && here >= after {
            if let Some(peak) = peaks.last() {
                let low = (*peak..at).min_by(|a, b| density[*a].total_cmp(&density[*b]));
                lows.extend(low);
            }
            peaks.push(at);
        }
    }
    // The shallowest valley goes first: of its two peaks the lower one goes with it.
    loop {
        let lower = |at: usize| at + usize::from(density[peaks[at]] >= density[peaks[at + 1]]);
        let heights = |at: usize| [density[lows[at]], density[peaks[lower(at)]]];
        let depth = |at: usize| heights(at)[0] / heights(at)[1];
        let parts = |at: usize| {
            let [low, peak] = heights(at);
            // A sum of kernels varies as a count does, less by the square root of 2.
            let deviation = ((low + peak) / std::f64::consts::SQRT_2).sqrt();
            low < VALLEY * peak && peak - low > DEVIATIONS * deviation
        };
        let shallow = (0..lows.len()).filter(|at| !parts(*at));
        let Some(at) = shallow.max_by(|a, b| depth(*a).total_cmp(&depth(*b))) else {
            return lows;
        };
        let gone = lower(at);
        let low = lows.remove(at);
        peaks.remove(gone);
        // Between the peaks on both sides of the one that went, the deeper valley stays.
        let beside = if gone == at {
            at.checked_sub(1)
        } else {
            Some(at)
        };
        if let Some(beside) = beside.and_then(|beside| lows.get_mut(beside)) {
            *beside = if density[low] < density[*beside] {
                low
            } else {
                *beside
            };
        }
    }
}

/// Returns the number of the state of a batch between these two lines; `None` if it changed, or if
/// no state has such lines.
pub(crate) fn of_batch(modes: &[Mode], lines_ps: [f64; 2]) -> Option<usize> {
    let of = |ps: f64| {
        modes
            .iter()
            .position(|mode| mode.range.contains(&ps.max(1.0).ln()))
    };
    let [before, after] = lines_ps.map(of);
    before.filter(|_| before == after)
}

/// Parts of a run that [`next_run`] compares, and how many it needs at least.
const PARTS: (usize, usize) = (8, 4);
/// Student's t for 95 %, by degrees of freedom from `PARTS.1 - 1` on.
const STUDENT: [f64; 5] = [3.182, 2.776, 2.571, 2.447, 2.365];

/// Returns the factor by which the ratio of a further run differs from this one's at most, with
/// 95 %, if that run meets the same state. `case` and `floor` are the medians by turn; `None` where
/// the turn had another state. `None` if too little of the run was in this state.
///
/// The parts of the run stand for further runs (batch means: A. M. Law, "Simulation Modeling and
/// Analysis", section 9.5): what lasts for many turns differs from part to part. The range is one
/// for a prediction: as this run errs, so does the next one.
pub(crate) fn next_run(case: &[Option<f64>], floor: &[Option<f64>]) -> Option<f64> {
    let turns = case.len().min(floor.len());
    let part = |of: &[Option<f64>], number: usize| {
        let turns = turns * number / PARTS.0..turns * (number + 1) / PARTS.0;
        let medians: Vec<f64> = of[turns].iter().copied().flatten().collect();
        tandem_page::format::median(&medians)
    };
    let ratios = (0..PARTS.0).filter_map(|at| Some((part(case, at)? / part(floor, at)?).ln()));
    let logs: Vec<f64> = ratios.filter(|log| log.is_finite()).collect();
    let student = STUDENT.get(logs.len().checked_sub(PARTS.1)?)?;
    let count = logs.len() as f64;
    let mean = logs.iter().sum::<f64>() / count;
    let variance = logs.iter().map(|log| (log - mean).powi(2)).sum::<f64>() / (count - 1.0);
    Some((student * (2.0 * variance / count).sqrt()).exp())
}

#[cfg(test)]
mod tests;
