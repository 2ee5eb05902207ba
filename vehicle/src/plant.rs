//! The plant: a dynamic single-track vehicle without actuators, integrated by Runge-Kutta.
//!
//! Model "ST" and parameter set 2 (BMW 320i) of Althoff, Koschi, Würsching, "CommonRoad: Vehicle
//! Models", 2020. Step responses are compared to the published Python implementation, see
//! `fixtures/plant/`.

/// Below this speed the kinematic model is used, m/s: the dynamic model divides by the speed.
pub const KINEMATIC_BELOW: f64 = 0.1;

/// m/s²
const GRAVITY: f64 = 9.81;

/// Parameters of the single-track model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameters {
    /// Length of the body, m.
    pub length: f64,
    /// Width of the body, m.
    pub width: f64,
    /// Largest road wheel angle to either side, rad.
    pub steering_max: f64,
    /// Largest rate of the road wheel angle, rad/s.
    pub steering_rate_max: f64,
    /// Largest acceleration and deceleration, m/s².
    pub acceleration_max: f64,
    /// Above this speed the engine's power limits the acceleration, m/s.
    pub switching_speed: f64,
    /// Highest speed, m/s.
    pub speed_max: f64,
    /// Lowest speed (reverse), m/s.
    pub speed_min: f64,
    /// kg
    pub mass: f64,
    /// Centre of gravity to front axle, m.
    pub front_axle: f64,
    /// Centre of gravity to rear axle, m.
    pub rear_axle: f64,
    /// Height of the centre of gravity, m.
    pub height: f64,
    /// Yaw inertia, kg m².
    pub inertia: f64,
    /// Friction coefficient between tyre and road.
    pub friction: f64,
    /// Cornering stiffness coefficient of both axles, 1/rad.
    pub stiffness: f64,
}

/// Parameter set 2: BMW 320i.
pub const BMW_320I: Parameters = Parameters {
    length: 4.508,
    width: 1.61,
    steering_max: 1.066,
    steering_rate_max: 0.4,
    acceleration_max: 11.5,
    switching_speed: 7.319,
    speed_max: 50.8,
    speed_min: -13.9,
    mass: 1_093.295_233_467_404_6,
    front_axle: 1.156_195_706_4,
    rear_axle: 1.422_717_093_6,
    height: 0.613_730_04,
    inertia: 1_791.599_530_012_285_6,
    friction: 1.048_9,
    stiffness: 21.92 / 1.048_9,
};

/// State of the single-track model.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlantState {
    /// Centre of gravity, m.
    pub x: f64,
    /// Centre of gravity, m.
    pub y: f64,
    /// Road wheel angle, rad, left positive.
    pub steering_angle: f64,
    /// Speed of the centre of gravity, m/s.
    pub speed: f64,
    /// Heading of the body, rad.
    pub yaw: f64,
    /// rad/s
    pub yaw_rate: f64,
    /// Side slip angle at the centre of gravity, rad.
    pub slip_angle: f64,
}

/// The inputs of the plant, held for one step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PlantInput {
    /// Rate of the road wheel angle, rad/s.
    pub steering_rate: f64,
    /// Longitudinal acceleration, m/s².
    pub acceleration: f64,
}

impl PlantInput {
    /// Returns the nearest input that the vehicle can follow in this state.
    #[must_use]
    pub fn limited(self, state: &PlantState, p: &Parameters) -> Self {
        let at_stop = |angle: f64| angle >= p.steering_max;
        let (rate, angle) = (self.steering_rate, state.steering_angle);
        let blocked = (at_stop(angle) && rate >= 0.0) || (at_stop(-angle) && rate <= 0.0);
        let steering_rate = if blocked {
            0.0
        } else {
            rate.clamp(-p.steering_rate_max, p.steering_rate_max)
        };

        let (a, v) = (self.acceleration, state.speed);
        let blocked = (v <= p.speed_min && a <= 0.0) || (v >= p.speed_max && a >= 0.0);
        let engine = p.acceleration_max * (p.switching_speed / v.max(p.switching_speed));
        let acceleration = if blocked {
            0.0
        } else {
            a.clamp(-p.acceleration_max, engine)
        };
        Self {
            steering_rate,
            acceleration,
        }
    }
}

/// What the derivatives of one step share.
struct Rates<'a> {
    p: &'a Parameters,
    input: PlantInput,
    /// Whether the input is far from each limit, so that the same input holds in the whole step.
    is_free: bool,
    axles: Axles,
}

/// The load on the axles, and what follows from it, for one input.
struct Axles {
    u: PlantInput,
    wheelbase: f64,
    yaw_gain: f64,
    front: f64,
    /// Stiffness of both axles together, and its moments: damping, between the axles, in front.
    both: f64,
    damping: f64,
    moment: f64,
    front_moment: f64,
}

impl Axles {
    /// The longitudinal acceleration shifts load between the axles.
    fn new(u: PlantInput, p: &Parameters) -> Self {
        let (lf, lr) = (p.front_axle, p.rear_axle);
        let wheelbase = lf + lr;
        let front = p.stiffness * (GRAVITY * lr - u.acceleration * p.height);
        let rear = p.stiffness * (GRAVITY * lf + u.acceleration * p.height);
        Self {
            u,
            wheelbase,
            yaw_gain: p.friction * p.mass / (p.inertia * wheelbase),
            front,
            both: rear + front,
            damping: lf * lf * front + lr * lr * rear,
            moment: lr * rear - lf * front,
            front_moment: lf * front,
        }
    }
}

impl<'a> Rates<'a> {
    fn new(state: &PlantState, input: PlantInput, dt: f64, p: &'a Parameters) -> Self {
        let u = input.limited(state, p);
        // Angle and speed change by less than this.
        let (turn, gain) = (
            2.0 * p.steering_rate_max * dt,
            2.0 * p.acceleration_max * dt,
        );
        let turns = state.steering_angle.abs() + turn < p.steering_max;
        let moves = state.speed + gain < p.speed_max && state.speed - gain > p.speed_min;
        let fastest = (state.speed + gain).max(p.switching_speed);
        let has_power = u.acceleration * fastest < p.acceleration_max * p.switching_speed;
        Self {
            p,
            input,
            is_free: turns && moves && has_power,
            axles: Axles::new(u, p),
        }
    }

    /// Returns the time derivative of the state.
    fn at(&mut self, state: &PlantState) -> PlantState {
        if !self.is_free {
            self.axles = Axles::new(self.input.limited(state, self.p), self.p);
        }
        if state.speed.abs() < KINEMATIC_BELOW {
            kinematic(state, self.axles.u, self.p)
        } else {
            dynamic(state, &self.axles, self.p)
        }
    }
}

/// Derivative with tyre slip.
fn dynamic(state: &PlantState, axles: &Axles, p: &Parameters) -> PlantState {
    let (v, angle) = (state.speed, state.steering_angle);
    let (rate, slip) = (state.yaw_rate, state.slip_angle);
    let slip_gain = p.friction / (v * axles.wheelbase);
    PlantState {
        x: v * (slip + state.yaw).cos(),
        y: v * (slip + state.yaw).sin(),
        steering_angle: axles.u.steering_rate,
        speed: axles.u.acceleration,
        yaw: rate,
        yaw_rate: axles.yaw_gain
            * (-axles.damping / v * rate + axles.moment * slip + axles.front_moment * angle),
        slip_angle: slip_gain * (axles.moment / v * rate - axles.both * slip + axles.front * angle)
            - rate,
    }
}

/// Derivative of rolling without slip, referred to the centre of gravity.
fn kinematic(state: &PlantState, u: PlantInput, p: &Parameters) -> PlantState {
    let wheelbase = p.front_axle + p.rear_axle;
    let share = p.rear_axle / wheelbase;
    let (tan, cos) = (state.steering_angle.tan(), state.steering_angle.cos());
    let v = state.speed;
    let rolling_slip = (tan * share).atan();
    // By the chain rule from `rolling_slip` and from yaw rate = v cos(slip) tan(angle) / wheelbase.
    let slip_rate = share * u.steering_rate / (cos * cos * (1.0 + (tan * share).powi(2)));
    let (slip_sin, slip_cos) = state.slip_angle.sin_cos();
    PlantState {
        x: v * (rolling_slip + state.yaw).cos(),
        y: v * (rolling_slip + state.yaw).sin(),
        steering_angle: u.steering_rate,
        speed: u.acceleration,
        yaw: v * rolling_slip.cos() * tan / wheelbase,
        yaw_rate: (u.acceleration * slip_cos * tan - v * slip_sin * slip_rate * tan
            + v * slip_cos * u.steering_rate / (cos * cos))
            / wheelbase,
        slip_angle: slip_rate,
    }
}

impl PlantState {
    /// Returns `self + rate * dt`, component by component.
    fn advanced(&self, rate: &Self, dt: f64) -> Self {
        Self {
            x: self.x + rate.x * dt,
            y: self.y + rate.y * dt,
            steering_angle: self.steering_angle + rate.steering_angle * dt,
            speed: self.speed + rate.speed * dt,
            yaw: self.yaw + rate.yaw * dt,
            yaw_rate: self.yaw_rate + rate.yaw_rate * dt,
            slip_angle: self.slip_angle + rate.slip_angle * dt,
        }
    }

    /// Sets yaw rate and slip angle to the values of rolling without slip: below
    /// [`KINEMATIC_BELOW`] they follow from the other states, and remaining tyre slip would never
    /// decay.
    pub fn settle_slowly_rolling(&mut self, p: &Parameters) {
        let wheelbase = p.front_axle + p.rear_axle;
        let tan = self.steering_angle.tan();
        self.slip_angle = (tan * p.rear_axle / wheelbase).atan();
        self.yaw_rate = self.speed * self.slip_angle.cos() * tan / wheelbase;
    }

    /// Returns the state `dt` seconds later, for constant input: classic fourth-order Runge-Kutta.
    ///
    /// At 1 ms it is stable down to [`KINEMATIC_BELOW`], where the tyres' time constant is 0.46 ms.
    #[must_use]
    pub fn stepped(&self, input: PlantInput, dt: f64, p: &Parameters) -> Self {
        let mut rates = Rates::new(self, input, dt, p);
        let k1 = rates.at(self);
        let k2 = rates.at(&self.advanced(&k1, dt / 2.0));
        let k3 = rates.at(&self.advanced(&k2, dt / 2.0));
        let k4 = rates.at(&self.advanced(&k3, dt));
        self.advanced(&k1, dt / 6.0)
            .advanced(&k2, dt / 3.0)
            .advanced(&k3, dt / 3.0)
            .advanced(&k4, dt / 6.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the largest difference of any component, for pose and motion.
    fn distance(a: &PlantState, b: &PlantState) -> (f64, f64) {
        let pose = [a.x - b.x, a.y - b.y];
        let motion = [
            a.steering_angle - b.steering_angle,
            a.speed - b.speed,
            a.yaw - b.yaw,
            a.yaw_rate - b.yaw_rate,
            a.slip_angle - b.slip_angle,
        ];
        let largest = |values: &[f64]| values.iter().fold(0.0, |m: f64, v| m.max(v.abs()));
        (largest(&pose), largest(&motion))
    }

    /// The plant agrees with an independent implementation over steering steps, slaloms, braking in
    /// a turn, launching, inputs beyond the limits, and crawling.
    ///
    /// Runge-Kutta of fourth order at 1 ms has a global error below 1e-8 here; 1e-6 leaves room for
    /// the kink of the acceleration limit at the switching speed, where a fixed step is of first
    /// order. Only the slip angle of "crawl" may differ by more (1e-4 rad at 0.1 rad of steering):
    /// the published kinematic branch squares the tangent once more than the chain rule does. This
    /// affects no other value of that case.
    #[test]
    fn step_responses_agree_with_commonroad_vehicle_models() {
        let text = include_str!("../fixtures/plant/step_responses.csv");
        let mut state = PlantState::default();
        let mut cases = 0;
        let rows = text.lines().filter(|line| !line.starts_with('#')).skip(1);
        for row in rows {
            let (case, values) = row.split_once(',').unwrap();
            let v: Vec<f64> = values.split(',').map(|v| v.parse().unwrap()).collect();
            let expected = PlantState {
                x: v[3],
                y: v[4],
                steering_angle: v[5],
                speed: v[6],
                yaw: v[7],
                yaw_rate: v[8],
                slip_angle: v[9],
            };
            if v[0] == 0.0 {
                (state, cases) = (expected, cases + 1);
                continue;
            }
            let input = PlantInput {
                steering_rate: v[1],
                acceleration: v[2],
            };
            for _ in 0..50 {
                state = state.stepped(input, 1e-3, &BMW_320I);
            }
            if case == "crawl" {
                assert!(
                    (state.slip_angle - expected.slip_angle).abs() < 1e-4,
                    "{row}"
                );
                state.slip_angle = expected.slip_angle;
            }
            let (pose, motion) = distance(&state, &expected);
            assert!(pose < 1e-6 && motion < 1e-6, "{pose:e} {motion:e} at {row}");
        }
        assert_eq!(cases, 6);
    }

    /// One derivative by the formulas as they are published, with nothing computed in advance.
    fn plain(state: &PlantState, input: PlantInput, p: &Parameters) -> PlantState {
        let u = input.limited(state, p);
        if state.speed.abs() < KINEMATIC_BELOW {
            return kinematic(state, u, p);
        }
        let (lf, lr, v) = (p.front_axle, p.rear_axle, state.speed);
        let front = p.stiffness * (GRAVITY * lr - u.acceleration * p.height);
        let rear = p.stiffness * (GRAVITY * lf + u.acceleration * p.height);
        let (angle, rate, slip) = (state.steering_angle, state.yaw_rate, state.slip_angle);
        let turning = -(lf * lf * front + lr * lr * rear) / v * rate
            + (lr * rear - lf * front) * slip
            + lf * front * angle;
        let slipping = (rear * lr - front * lf) / v * rate - (rear + front) * slip + front * angle;
        PlantState {
            x: v * (slip + state.yaw).cos(),
            y: v * (slip + state.yaw).sin(),
            steering_angle: u.steering_rate,
            speed: u.acceleration,
            yaw: rate,
            yaw_rate: p.friction * p.mass / (p.inertia * (lf + lr)) * turning,
            slip_angle: p.friction / (v * (lf + lr)) * slipping - rate,
        }
    }

    /// What a step computes in advance changes no bit, also at and beyond each limit.
    #[test]
    fn a_step_is_that_of_the_plain_formulas_to_the_last_bit() {
        let p = &BMW_320I;
        let bits = |it: &PlantState| {
            let PlantState {
                x,
                y,
                steering_angle,
                speed,
                yaw,
                yaw_rate,
                slip_angle,
            } = *it;
            [x, y, steering_angle, speed, yaw, yaw_rate, slip_angle].map(f64::to_bits)
        };
        let speeds = [
            -14.0, -13.9, -13.89, -2.0, -0.1, 0.0, 0.09, 0.100_01, 0.3, 7.31, 7.32,
        ];
        let faster = [12.0, 33.0, 50.78, 50.799, 50.8, 60.0];
        let angles = [-1.1, -1.066, -1.065_9, -0.03, 0.0, 0.2, 1.065_7, 1.066, 1.2];
        let accelerations = [
            -20.0, -11.5, -3.0, 0.0, 1.65, 1.66, 2.55, 7.0, 11.4, 11.5, 12.0,
        ];
        for speed in speeds.into_iter().chain(faster) {
            for steering_angle in angles {
                for acceleration in accelerations {
                    for steering_rate in [-0.5, -0.4, -0.01, 0.0, 0.39, 1.0] {
                        let input = PlantInput {
                            steering_rate,
                            acceleration,
                        };
                        let (yaw, yaw_rate, slip_angle) = (0.7 * speed, 0.1, -0.02);
                        let begin = PlantState {
                            steering_angle,
                            speed,
                            yaw,
                            yaw_rate,
                            slip_angle,
                            ..PlantState::default()
                        };
                        let dt = 1e-3;
                        let k1 = plain(&begin, input, p);
                        let k2 = plain(&begin.advanced(&k1, dt / 2.0), input, p);
                        let k3 = plain(&begin.advanced(&k2, dt / 2.0), input, p);
                        let k4 = plain(&begin.advanced(&k3, dt), input, p);
                        let expected = begin
                            .advanced(&k1, dt / 6.0)
                            .advanced(&k2, dt / 3.0)
                            .advanced(&k3, dt / 3.0)
                            .advanced(&k4, dt / 6.0);
                        let end = begin.stepped(input, dt, p);
                        assert_eq!(bits(&end), bits(&expected), "{begin:?} {input:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn steering_stops_at_its_end() {
        let mut state = PlantState {
            speed: 1.0,
            ..PlantState::default()
        };
        for _ in 0..5_000 {
            state = state.stepped(
                PlantInput {
                    steering_rate: 1.0,
                    acceleration: 0.0,
                },
                1e-3,
                &BMW_320I,
            );
        }
        assert!(
            (state.steering_angle - BMW_320I.steering_max).abs() < 1e-3,
            "{state:?}"
        );
    }
}
