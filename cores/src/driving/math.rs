//! Float functions that give the same bits on every target: libm and plain comparisons, never std.

/// Square root; zero if `x` is negative or not a number.
pub(crate) fn sqrt(x: f32) -> f32 {
    if x > 0.0 { libm::sqrtf(x) } else { 0.0 }
}

/// Sine of an angle in rad.
pub(crate) fn sin(x: f32) -> f32 {
    libm::sinf(x)
}

/// Cosine of an angle in rad.
pub(crate) fn cos(x: f32) -> f32 {
    libm::cosf(x)
}

/// Tangent of an angle in rad.
pub(crate) fn tan(x: f32) -> f32 {
    libm::tanf(x)
}

/// Arc tangent in rad.
pub(crate) fn atan(x: f32) -> f32 {
    libm::atanf(x)
}

/// e to the power of `x`.
pub(crate) fn exp(x: f32) -> f32 {
    libm::expf(x)
}

/// Absolute value.
pub(crate) fn abs(x: f32) -> f32 {
    libm::fabsf(x)
}

/// Returns the greater one; `b` if `a` is not a number.
pub(crate) fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Returns the lesser one; `b` if `a` is not a number.
pub(crate) fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// `x` within `low..=high`; `low` if it is not a number.
pub(crate) fn clamp(x: f32, low: f32, high: f32) -> f32 {
    if x > low { min(x, high) } else { low }
}

/// `x` within `-limit..=limit`.
pub(crate) fn bound(x: f32, limit: f32) -> f32 {
    clamp(x, -limit, limit)
}

/// `a` at 0, `b` at 1, linear between and beyond.
pub(crate) fn lerp(a: f32, b: f32, share: f32) -> f32 {
    a + (b - a) * share
}

/// Returns the same angle in -π..=π. For angles of a few turns.
pub(crate) fn wrap_angle(angle: f32) -> f32 {
    use core::f32::consts::{PI, TAU};
    let mut angle = angle;
    while angle > PI {
        angle -= TAU;
    }
    while angle < -PI {
        angle += TAU;
    }
    angle
}
