//! Quartic and quintic polynomials between boundary states: the shapes of least jerk.
//!
//! M. Werling, J. Ziegler, S. Kammel, S. Thrun, "Optimal Trajectory Generation for Dynamic Street
//! Scenarios in a Frenét Frame", ICRA 2010: quintics where the end position is given, quartics
//! where only the end velocity is.

/// A value and its first three derivatives.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Jet {
    pub(crate) value: f32,
    pub(crate) first: f32,
    pub(crate) second: f32,
    pub(crate) third: f32,
}

impl Jet {
    /// Returns the state `t` later, if the first derivative stays constant.
    #[inline]
    fn straight_on(&self, t: f32) -> Self {
        Self {
            value: self.value + self.first * t,
            first: self.first,
            second: 0.0,
            third: 0.0,
        }
    }
}

/// The quintic `c[0] + c[1] t + … + c[5] t⁵` up to `end`, then linear with the first derivative
/// there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quintic {
    c: [f32; 6],
    end: f32,
}

impl Quintic {
    /// From the start's value and derivatives to the end's, over `end` > 0.
    pub(crate) fn new(start: &Jet, goal: &Jet, end: f32) -> Self {
        let t = end;
        let (c0, c1, c2) = (start.value, start.first, 0.5 * start.second);
        let value = goal.value - (c0 + t * (c1 + t * c2));
        let first = (goal.first - (c1 + 2.0 * c2 * t)) * t;
        let second = (goal.second - 2.0 * c2) * t * t;
        let cube = t * t * t;
        let c3 = (10.0 * value - 4.0 * first + 0.5 * second) / cube;
        let c4 = (-15.0 * value + 7.0 * first - second) / (cube * t);
        let c5 = (6.0 * value - 3.0 * first + 0.5 * second) / (cube * t * t);
        Self {
            c: [c0, c1, c2, c3, c4, c5],
            end,
        }
    }

    /// Value and derivatives at `t` ≥ 0.
    #[inline]
    pub(crate) fn at(&self, t: f32) -> Jet {
        if t > self.end {
            return self.inside(self.end).straight_on(t - self.end);
        }
        self.inside(t)
    }

    fn inside(&self, t: f32) -> Jet {
        let [c0, c1, c2, c3, c4, c5] = self.c;
        Jet {
            value: c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
            first: c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))),
            second: 2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5)),
            third: 6.0 * c3 + t * (24.0 * c4 + t * 60.0 * c5),
        }
    }
}

/// A quartic up to `end`, then linear with the first derivative of `last`, its state at `end`. Its
/// coefficients are stored because it is evaluated at many times.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quartic {
    /// Coefficients of value and derivatives, the lowest first.
    value: [f32; 5],
    first: [f32; 4],
    second: [f32; 3],
    third: [f32; 2],
    end: f32,
    last: Jet,
}

impl Quartic {
    /// From the start to a first derivative, with second derivative zero, over `end` > 0.
    pub(crate) fn new(start: &Jet, first: f32, end: f32) -> Self {
        let t = end;
        let (c1, c2) = (start.first, 0.5 * start.second);
        let first = first - (c1 + 2.0 * c2 * t);
        let second = -2.0 * c2;
        let c3 = (first - second * t / 3.0) / (t * t);
        let c4 = (second * t - 2.0 * first) / (4.0 * t * t * t);
        let mut quartic = Self {
            value: [start.value, c1, c2, c3, c4],
            first: [c1, 2.0 * c2, 3.0 * c3, 4.0 * c4],
            second: [2.0 * c2, 6.0 * c3, 12.0 * c4],
            third: [6.0 * c3, 24.0 * c4],
            end,
            last: Jet::default(),
        };
        quartic.last = quartic.inside(end);
        quartic
    }

    /// Returns the end of the quartic; then the line is straight.
    pub(crate) const fn end(&self) -> f32 {
        self.end
    }

    /// Returns the coefficients of the second and third derivative, the lowest first.
    pub(crate) const fn derivatives(&self) -> ([f32; 3], [f32; 2]) {
        (self.second, self.third)
    }

    /// Value and derivatives at `t` ≥ 0.
    #[inline]
    pub(crate) fn at(&self, t: f32) -> Jet {
        if t > self.end {
            return self.last.straight_on(t - self.end);
        }
        self.inside(t)
    }

    #[inline]
    fn inside(&self, t: f32) -> Jet {
        let ([v0, v1, v2, v3, v4], [f0, f1, f2, f3]) = (self.value, self.first);
        let ([s0, s1, s2], [t0, t1]) = (self.second, self.third);
        Jet {
            value: v0 + t * (v1 + t * (v2 + t * (v3 + t * v4))),
            first: f0 + t * (f1 + t * (f2 + t * f3)),
            second: s0 + t * (s1 + t * s2),
            third: t0 + t * t1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f32, b: f32) -> bool {
        (a - b).abs() < 1e-3
    }

    #[test]
    fn quintic_meets_both_ends() {
        let start = Jet {
            value: 1.0,
            first: 0.2,
            second: -0.1,
            third: 0.0,
        };
        let goal = Jet {
            value: -2.0,
            first: 0.1,
            second: 0.05,
            third: 0.0,
        };
        let shape = Quintic::new(&start, &goal, 4.0);
        let (from, to) = (shape.at(0.0), shape.at(4.0));
        assert!(near(from.value, 1.0) && near(from.first, 0.2) && near(from.second, -0.1));
        assert!(near(to.value, -2.0) && near(to.first, 0.1) && near(to.second, 0.05));
        assert!(near(shape.at(6.0).value, -1.8));
    }

    #[test]
    fn quartic_meets_both_ends() {
        let start = Jet {
            value: 3.0,
            first: 20.0,
            second: -1.0,
            third: 0.0,
        };
        let shape = Quartic::new(&start, 12.0, 5.0);
        let (from, to) = (shape.at(0.0), shape.at(5.0));
        assert!(near(from.value, 3.0) && near(from.first, 20.0) && near(from.second, -1.0));
        assert!(near(to.first, 12.0) && near(to.second, 0.0));
        let step = shape.at(2.001).first - shape.at(1.999).first;
        assert!((step / 0.002 - shape.at(2.0).second).abs() < 0.02);
    }
}
