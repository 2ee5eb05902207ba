//! Plane geometry: vectors, poses, oriented rectangles. Metres and radians, x east, y north.

use std::f64::consts::{PI, TAU};
use std::ops::{Add, Mul, Neg, Sub};

/// A point or a direction in the plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Vec2 {
    /// m
    pub x: f64,
    /// m
    pub y: f64,
}

impl Vec2 {
    /// The vector (x, y).
    #[must_use]
    pub const fn new(x: f64, y: f64) -> Self {
        Self { x, y }
    }

    /// The unit vector with this angle to the x axis.
    #[must_use]
    pub fn from_angle(angle: f64) -> Self {
        let (sin, cos) = angle.sin_cos();
        Self { x: cos, y: sin }
    }

    /// Returns the scalar product.
    #[must_use]
    pub fn dot(self, other: Self) -> f64 {
        self.x * other.x + self.y * other.y
    }

    /// The z component of the cross product: positive if `other` lies to the left of `self`.
    #[must_use]
    pub fn cross(self, other: Self) -> f64 {
        self.x * other.y - self.y * other.x
    }

    /// Returns the length.
    #[must_use]
    pub fn norm(self) -> f64 {
        self.x.hypot(self.y)
    }

    /// Returns the angle to the x axis, -π ..= π.
    #[must_use]
    pub fn angle(self) -> f64 {
        self.y.atan2(self.x)
    }

    /// Returns this vector, turned left by 90 degrees.
    #[must_use]
    pub const fn left(self) -> Self {
        Self {
            x: -self.y,
            y: self.x,
        }
    }

    /// Returns the point at fraction `t` of the line to `other`.
    #[must_use]
    pub fn lerp(self, other: Self, t: f64) -> Self {
        self + (other - self) * t
    }
}

impl Add for Vec2 {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self {
            x: self.x + other.x,
            y: self.y + other.y,
        }
    }
}

impl Sub for Vec2 {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self {
            x: self.x - other.x,
            y: self.y - other.y,
        }
    }
}

impl Mul<f64> for Vec2 {
    type Output = Self;
    fn mul(self, factor: f64) -> Self {
        Self {
            x: self.x * factor,
            y: self.y * factor,
        }
    }
}

impl Neg for Vec2 {
    type Output = Self;
    fn neg(self) -> Self {
        Self {
            x: -self.x,
            y: -self.y,
        }
    }
}

/// Returns the same angle in -π ..= π.
#[must_use]
pub fn wrap_angle(angle: f64) -> f64 {
    if (-PI..=PI).contains(&angle) {
        angle
    } else {
        (angle + PI).rem_euclid(TAU) - PI
    }
}

/// Returns the angle at fraction `t` between `a` and `b`, in the shorter direction.
#[must_use]
pub fn lerp_angle(a: f64, b: f64, t: f64) -> f64 {
    wrap_angle(a + wrap_angle(b - a) * t)
}

/// Place and heading.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// Centre, m.
    pub position: Vec2,
    /// Heading, rad, counter-clockwise from the x axis.
    pub yaw: f64,
}

impl Pose {
    /// Returns this pose as a frame, prepared for many points.
    #[must_use]
    pub fn frame(self) -> LocalFrame {
        LocalFrame {
            position: self.position,
            forward: Vec2::from_angle(self.yaw),
        }
    }

    /// Converts the point `local` in this pose's frame (x forward, y left) to world coordinates.
    #[must_use]
    pub fn to_world(self, local: Vec2) -> Vec2 {
        self.position + self.rotate(local)
    }

    /// Converts a point in the world to this pose's frame.
    #[must_use]
    pub fn to_local(self, world: Vec2) -> Vec2 {
        self.unrotate(world - self.position)
    }

    /// Converts the direction `local` in this pose's frame to world coordinates.
    #[must_use]
    pub fn rotate(self, local: Vec2) -> Vec2 {
        let forward = Vec2::from_angle(self.yaw);
        forward * local.x + forward.left() * local.y
    }

    /// Converts a direction in the world to this pose's frame.
    #[must_use]
    pub fn unrotate(self, world: Vec2) -> Vec2 {
        let forward = Vec2::from_angle(self.yaw);
        Vec2::new(forward.dot(world), forward.cross(world))
    }
}

/// A pose with the sine and the cosine of its heading, to transform many points.
#[derive(Clone, Copy, Debug)]
pub struct LocalFrame {
    position: Vec2,
    forward: Vec2,
}

impl LocalFrame {
    /// The same frame, moved to another place.
    pub(crate) const fn moved(self, position: Vec2) -> Self {
        Self { position, ..self }
    }

    /// Returns the unit vector with this frame's heading.
    pub(crate) const fn forward(&self) -> Vec2 {
        self.forward
    }

    /// Converts a point in the world to this frame; bit-identical to [`Pose::to_local`].
    #[must_use]
    pub fn to_local(&self, world: Vec2) -> Vec2 {
        let apart = world - self.position;
        Vec2::new(self.forward.dot(apart), self.forward.cross(apart))
    }
}

/// An oriented rectangle: the area of the road that a vehicle covers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Footprint {
    /// Centre and heading.
    pub pose: Pose,
    /// Along the heading, m.
    pub length: f64,
    /// Across the heading, m.
    pub width: f64,
}

impl Footprint {
    /// Returns the four corners: front left, front right, rear right, rear left.
    #[must_use]
    pub fn corners(&self) -> [Vec2; 4] {
        self.corners_along(Vec2::from_angle(self.pose.yaw))
    }

    /// [`Footprint::corners`], with the unit vector of its heading.
    pub(crate) fn corners_along(&self, along: Vec2) -> [Vec2; 4] {
        let forward = along * (self.length / 2.0);
        let left = along.left() * (self.width / 2.0);
        let centre = self.pose.position;
        [
            centre + forward + left,
            centre + forward - left,
            centre - forward - left,
            centre - forward + left,
        ]
    }

    /// Returns whether the two rectangles overlap; touching is not overlapping.
    ///
    /// Separating axis theorem: two convex shapes are apart exactly if their projections on one of
    /// the edge normals are (Gottschalk, Lin, Manocha, "OBBTree", SIGGRAPH 1996).
    #[must_use]
    pub fn overlaps(&self, other: &Self) -> bool {
        let apart = other.pose.position - self.pose.position;
        // At least the sum of both diagonals: a diagonal is never longer than two sides.
        let reach = self.length + self.width + other.length + other.width;
        if apart.dot(apart) * 4.0 > reach * reach {
            return false;
        }
        let [a, b] = [self, other].map(|it| Vec2::from_angle(it.pose.yaw));
        self.overlaps_along(a, other, b)
    }

    /// [`Footprint::overlaps`], with the unit vectors of their headings.
    pub(crate) fn overlaps_along(&self, a: Vec2, other: &Self, b: Vec2) -> bool {
        let apart = other.pose.position - self.pose.position;
        [a, a.left(), b, b.left()].iter().all(|axis| {
            let reach = |shape: &Self, forward: Vec2| {
                forward.dot(*axis).abs() * shape.length + forward.cross(*axis).abs() * shape.width
            };
            apart.dot(*axis).abs() * 2.0 < reach(self, a) + reach(other, b)
        })
    }

    /// The same rectangle, larger by `length` and `width` in total.
    #[must_use]
    pub fn grown(self, length: f64, width: f64) -> Self {
        Self {
            length: self.length + length,
            width: self.width + width,
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectangle(x: f64, y: f64, yaw: f64) -> Footprint {
        Footprint {
            pose: Pose {
                position: Vec2::new(x, y),
                yaw,
            },
            length: 4.0,
            width: 2.0,
        }
    }

    #[test]
    fn rectangles_overlap_exactly_when_no_axis_separates_them() {
        let a = rectangle(0.0, 0.0, 0.0);
        assert!(a.overlaps(&a));
        assert!(a.overlaps(&rectangle(3.99, 1.99, 0.0)));
        assert!(!a.overlaps(&rectangle(4.01, 0.0, 0.0)));
        assert!(!a.overlaps(&rectangle(0.0, 2.01, 0.0)));
        // Turned by 90 degrees it reaches 1 m along x and 2 m along y.
        assert!(a.overlaps(&rectangle(2.99, 0.0, PI / 2.0)));
        assert!(!a.overlaps(&rectangle(3.01, 0.0, PI / 2.0)));
        // Corner to corner at 45 degrees: the bounding boxes overlap, the rectangles do not.
        let reach = (2.0 + 1.0) / 2.0_f64.sqrt();
        assert!(!a.overlaps(&rectangle(
            2.0 + reach / 2.0,
            1.0 + reach / 2.0 + 0.9,
            PI / 4.0
        )));
    }

    /// Each of the four axes is the only one that separates some pair: a corner points to the front
    /// or to the flank of the other rectangle.
    #[test]
    fn no_axis_can_be_left_out() {
        let a = rectangle(0.0, 0.0, 0.0);
        // Its extent along x and along y when it is turned by 45 degrees.
        let reach = (2.0 + 1.0) / 2.0_f64.sqrt();
        for (to_side, overlaps) in [(-0.05, true), (0.05, false)] {
            for b in [
                rectangle(2.0 + reach + to_side, 0.0, PI / 4.0),
                rectangle(0.0, 1.0 + reach + to_side, PI / 4.0),
            ] {
                assert_eq!(a.overlaps(&b), overlaps, "{b:?}");
                assert_eq!(b.overlaps(&a), overlaps, "{b:?}");
            }
        }
    }

    #[test]
    fn a_pose_maps_there_and_back() {
        let pose = Pose {
            position: Vec2::new(3.0, -2.0),
            yaw: 2.5,
        };
        let point = Vec2::new(7.0, 11.0);
        assert!((pose.to_world(pose.to_local(point)) - point).norm() < 1e-12);
        assert_eq!(pose.frame().to_local(point), pose.to_local(point));
        assert!(
            (pose.to_world(Vec2::new(1.0, 0.0)) - pose.position - Vec2::from_angle(2.5)).norm()
                < 1e-12
        );
    }

    #[test]
    fn angles_wrap_the_short_way() {
        assert!(
            (wrap_angle(3.0 * PI) - PI).abs() < 1e-9 || (wrap_angle(3.0 * PI) + PI).abs() < 1e-9
        );
        assert!((lerp_angle(3.0, -3.0, 0.5).abs() - PI).abs() < 1e-9);
        assert_eq!(wrap_angle(0.5), 0.5);
    }
}
