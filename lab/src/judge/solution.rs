//! A drive as a CommonRoad solution, XML 2020a, for the tools that check and rank solutions.
//!
//! The vehicle model is `ST2`, the single-track model with the parameters of a BMW 320i: the plant
//! integrates this model, so all its states are at hand. The cost function is `JB1`; another one is
//! chosen by editing `benchmark_id`.

use maud::html;
use tandem_vehicle::commonroad::PlanningProblem;
use tandem_vehicle::plant::PlantState;

const MODEL: &str = "ST2";
const COST: &str = "JB1";
/// Half a tick of the world, s: times closer than this are the same time.
const SAME_TIME_S: f64 = 0.5e-3;
/// The largest heading in a file, rad.
const YAW_MAX: f64 = std::f64::consts::TAU;

/// The states of the ego at the steps of its file.
#[derive(Debug)]
pub(super) struct Track {
    step_s: f64,
    states: Vec<PlantState>,
}

impl Track {
    pub(super) fn new(step_s: f64) -> Self {
        let states = vec![];
        Self { step_s, states }
    }

    /// Takes the state at this scenario time, s, if a step is due. Call it in each tick.
    pub(super) fn see(&mut self, time_s: f64, state: &PlantState) {
        while self.states.len() as f64 * self.step_s <= time_s + SAME_TIME_S {
            self.states.push(*state);
        }
    }

    /// Returns the text of the solution: the states up to the first step at or after `until_s`.
    ///
    /// # Errors
    /// Says why the file cannot have a solution.
    pub(super) fn solution(
        &self,
        benchmark: &str,
        problem: &PlanningProblem,
        until_s: f64,
    ) -> Result<String, String> {
        let Some(id) = problem.id else {
            return Err("no solution: the planning problem has no id".to_owned());
        };
        let is_id = |it: char| it.is_ascii_alphanumeric() || "_-".contains(it);
        if benchmark.is_empty() || !benchmark.chars().all(is_id) {
            return Err("no solution: the file has no benchmark id".to_owned());
        }
        let last = ((until_s - SAME_TIME_S) / self.step_s).ceil().max(1.0);
        let Some(first) = self.states.first() else {
            return Err("no solution: nothing was driven".to_owned());
        };
        let turn = problem.yaw - first.yaw;
        let states = self.states.iter().take(last as usize + 1).enumerate();
        let benchmark = format!("{MODEL}:{COST}:{benchmark}:{}", problem.version);
        let tree = html! {
            CommonRoadSolution benchmark_id=(benchmark) {
                stTrajectory planningProblem=(id) {
                    @for (step, state) in states {
                        stState {
                            x { (state.x) }
                            y { (state.y) }
                            steeringAngle { (state.steering_angle) }
                            velocity { (state.speed) }
                            orientation { ((state.yaw + turn) % YAW_MAX) }
                            yawRate { (state.yaw_rate) }
                            slipAngle { (state.slip_angle) }
                            time { (problem.first_step + step as i64) }
                        }
                    }
                }
            }
        };
        let declaration = "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n";
        Ok(format!("{declaration}{}\n", tree.into_string()))
    }
}
