//! The states of a cache line between the two CPUs: which a run met, and which figures belong to
//! the same one.
//!
//! A hypervisor moves its virtual CPUs: between the threads of one physical core, cores that share
//! a cache, and cores that do not. The same line then takes 40, 75 or 250 ns, all lines alike, for
//! milliseconds or for a minute. So a bare line is measured before and after each batch. The times
//! of all these lines have one mode for each state; a batch belongs to one if both its lines do.

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

/// Fewer turns in one state than this say nothing of a further run.
const TURNS: usize = 10;
/// Share of the turns beyond each end of the range.
const BEYOND: f64 = 0.05;

/// Returns the range in which nine in ten turns have the ratio of the case to the floor. `case` and
/// `floor` are the medians by turn; `None` where the turn had another state. `None` if too few
/// turns have both.
///
/// A further run's ratio lies there. The standard error of this run's would be a narrower range,
/// and a wrong one: what makes runs differ lasts longer than a turn, often longer than a run.
pub(crate) fn range(case: &[Option<f64>], floor: &[Option<f64>]) -> Option<[f64; 2]> {
    let turns = case.iter().zip(floor);
    let ratios = turns.filter_map(|(case, floor)| Some((*case)? / (*floor)?));
    let mut ratios: Vec<f64> = ratios.filter(|ratio| ratio.is_finite()).collect();
    ratios.sort_unstable_by(f64::total_cmp);
    let beyond = (BEYOND * ratios.len() as f64) as usize;
    let ends = [ratios.get(beyond)?, ratios.get(ratios.len() - 1 - beyond)?];
    (ratios.len() >= TURNS).then_some(ends.map(|end| *end))
}

#[cfg(test)]
mod tests;
