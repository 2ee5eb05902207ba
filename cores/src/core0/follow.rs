//! When the control grid moves, so that trajectories do not wait long for the control task.

use tandem_board::Duration;

/// A trajectory waits no longer than this for the control task, once the grid has followed it.
const LONGEST_WAIT: Duration = Duration::from_us(1_500);
/// So many trajectories in a row that waited longer begin a move of the grid. A trajectory that a
/// busy machine holds back waits too, and moving the grid for it leaves the grid just before all
/// others: it then has to move by almost a whole period, and until then commands are old.
const LATE: u8 = 3;
/// By this much it moves: a tick of the kernel, at which all releases lie.
pub(super) const GRID_STEP: Duration = Duration::from_ms(1);

/// Counts the trajectories that waited too long.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Follow {
    waited: u8,
}

impl Follow {
    /// A trajectory has come in, and the control task will take it after `wait`.
    pub(super) fn on_trajectory(&mut self, wait: Duration) {
        if wait <= LONGEST_WAIT {
            self.waited = 0;
        } else {
            self.waited = self.waited.saturating_add(1);
        }
    }

    /// Whether the grid moves earlier by [`GRID_STEP`] now. Once it moves, each further trajectory
    /// that waits too long moves it, until one does not.
    pub(super) fn moves(&mut self) -> bool {
        let moves = self.waited >= LATE;
        if moves {
            self.waited = LATE - 1;
        }
        moves
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_US: u64 = 10_000;

    /// The waits of these trajectories, which arrive this much after the beginning of their round,
    /// µs, and where the grid is at the end. A round has five control periods.
    fn waits(mut grid_us: u64, arrivals_us: [u64; 20]) -> ([u64; 20], u64) {
        let mut follow = Follow::default();
        let waits = arrivals_us.map(|arrival_us| {
            let wait_us = (grid_us + PERIOD_US - arrival_us % PERIOD_US) % PERIOD_US;
            follow.on_trajectory(Duration::from_us(wait_us));
            for _ in 0..5 {
                if follow.moves() {
                    grid_us = (grid_us + PERIOD_US - GRID_STEP.as_us()) % PERIOD_US;
                }
            }
            wait_us
        });
        (waits, grid_us)
    }

    #[test]
    fn the_grid_follows_the_trajectory_by_a_tick_a_round() {
        let (waits, grid_us) = waits(2_700, [3_000; 20]);
        assert_eq!(waits[..3], [9_700; 3], "three begin the move");
        assert_eq!(
            waits[3..12],
            [8_700, 7_700, 6_700, 5_700, 4_700, 3_700, 2_700, 1_700, 700]
        );
        assert_eq!(waits[12..], [700; 8]);
        assert_eq!(grid_us, 3_700);
    }

    /// On a busy machine two trajectories in a row miss their control cycle. Only these are late.
    #[test]
    fn trajectories_that_are_held_back_move_nothing() {
        let mut arrivals_us = [3_000; 20];
        arrivals_us[5..7].fill(4_000);
        let (waits, grid_us) = waits(3_700, arrivals_us);
        let long = waits.iter().filter(|wait_us| **wait_us > 1_500).count();
        assert_eq!((long, grid_us), (2, 3_700), "{waits:?}");
    }
}
