//! The measured steering angle says whether the vehicle follows the command that was sent, or the
//! one that its echo names. T-RED-9

/// Share of the way to the command that the wheels turn in a period of 10 ms: a lag of 50 ms. A
/// dead time of one period precedes it.
const STEP: f32 = 0.181;
/// Standard deviation of the measured angle and of the prediction, rad: the sensor's noise is 3e-4,
/// and a wheel that turns at 0.1 rad/s is predicted with an error of up to 5e-4.
const DEVIATION: f32 = 6e-4;
/// Predictions that are less apart tell nothing, rad.
const APART: f32 = 5e-4;
/// Likelihood ratio that decides, as a logarithm: one wrong decision in 400.
const DECIDES: f32 = 6.0;
/// Largest offset of the angle's sensor that is learned, rad.
const OFFSET: f32 = 1e-3;
/// The measured angle follows a command if it differs from its prediction by no more, rad.
const FOLLOWS: f32 = 4e-3;

/// What the measured angle follows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Follows {
    /// Not known yet, or both are nearly the same.
    Unknown,
    /// The command that was sent: the echo is wrong.
    Sent,
    /// The command in the echo.
    Echo,
}

/// Predicts the wheel angle from the sent and from the echoed commands.
#[derive(Clone, Debug, Default)]
pub(super) struct Wheel {
    /// The newest commands: the sent one, and the difference of the echoed one to it.
    command: [f32; 2],
    /// The commands one period ago.
    delayed: [f32; 2],
    /// The predicted angle, and the difference of the prediction by the echo.
    angle: f32,
    apart: f32,
    offset: f32,
    /// Logarithm of the likelihood ratio: positive if the angle follows the echo.
    evidence: f32,
    measured: Option<f32>,
}

impl Wheel {
    /// Takes an echo and the command that was sent in the same frame, rad. Of another system's
    /// frames only the echo is known.
    pub(super) fn on_echo(&mut self, sent: f32, echoed: f32) {
        self.command = [sent, echoed - sent];
    }

    /// Takes the measured angle, rad: every 10 ms.
    pub(super) fn on_measured(&mut self, measured: f32) {
        if self.measured.replace(measured).is_none() {
            self.angle = measured;
        }
        self.angle += STEP * (self.delayed[0] - self.angle);
        self.apart += STEP * (self.delayed[1] - self.apart);
        self.delayed = self.command;
        let error = measured - self.angle - self.offset;
        if self.apart.abs() >= APART {
            let ratio = self.apart * (error - 0.5 * self.apart) / (DEVIATION * DEVIATION);
            self.evidence = (self.evidence + ratio).clamp(-2.0 * DECIDES, 2.0 * DECIDES);
        } else if self.command[1].abs() < APART {
            self.evidence = 0.0;
            self.offset = (self.offset + 0.02 * error).clamp(-OFFSET, OFFSET);
        }
    }

    /// Returns what the measured angle follows.
    pub(super) fn follows(&self) -> Follows {
        if self.evidence >= DECIDES {
            Follows::Echo
        } else if self.evidence <= -DECIDES {
            Follows::Sent
        } else {
            Follows::Unknown
        }
    }

    /// Returns the measured angle, rad, if it does not follow the commands of the other system in
    /// the echoes.
    pub(super) fn contradicts_echo(&self) -> Option<f32> {
        let error = |measured: f32| (measured - self.angle - self.apart - self.offset).abs();
        self.measured.filter(|measured| error(*measured) > FOLLOWS)
    }
}
