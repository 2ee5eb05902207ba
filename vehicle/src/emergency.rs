//! Decides whether a situation is an emergency, by the deceleration that it needs.

use crate::geometry::{Footprint, Pose, wrap_angle};
use crate::plant::BMW_320I;
use crate::traffic::Participant;

/// A situation that needs a larger deceleration than this is an emergency, m/s². It is below the
/// 3.5 m/s² that ISO 15622 permits a cruise control.
pub(crate) const EMERGENCY_BRAKING: f64 = 3.0;
/// The distance to an object that must remain, m.
const ROOM_M: f64 = 1.0;
/// Lower limit of the distance in the computation, m.
const LEAST_M: f64 = 0.1;
/// Another road user is in the way if, within this time, s, it is in the ego's path widened on each
/// side by this lateral room, m.
const SOON_S: f64 = 2.0;
const ASIDE_M: f64 = 0.35;

/// The values of the ego that braking depends on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ego {
    pub(crate) pose: Pose,
    /// m/s
    pub(crate) speed: f64,
    /// Curvature of the ego's path, 1/m.
    pub(crate) curvature: f64,
    /// Distance to the end of the lane or of the domain, m; infinite without one.
    pub(crate) end: f64,
}

/// Returns the constant deceleration, m/s², that the ego needs for everything ahead. `leader`:
/// distance to the vehicle ahead in the lane, m (the lane may bend before it), and its speed, m/s.
pub(crate) fn needed<'a>(
    ego: &Ego,
    leader: (f64, f64),
    others: impl IntoIterator<Item = &'a Participant>,
) -> f64 {
    let end = behind(ego.speed, ego.end - BMW_320I.length / 2.0, 0.0, 0.0);
    let leader = behind(ego.speed, leader.0, leader.1, 0.0);
    let others = others.into_iter().map(|other| needed_for(ego, other));
    others.fold(end.max(leader), f64::max)
}

/// Returns this deceleration for one other road user; 0 if it is not in the way.
fn needed_for(ego: &Ego, other: &Participant) -> f64 {
    let Footprint {
        pose,
        length,
        width,
    } = other.footprint;
    let place = ego.pose.to_local(pose.position);
    if place.x <= 0.0 {
        return 0.0;
    }
    let turned = wrap_angle(pose.yaw - ego.pose.yaw - ego.curvature * place.x);
    let (sine, cosine) = turned.sin_cos();
    let half = |along: f64, across: f64| (length * along + width * across).abs() / 2.0;
    let reach = half(sine.abs(), cosine.abs()) + BMW_320I.width / 2.0 + ASIDE_M;
    let now = place.y - ego.curvature * place.x * place.x / 2.0;
    let soon = now + SOON_S * other.speed * sine;
    if now.min(soon) > reach || now.max(soon) < -reach {
        return 0.0;
    }
    let gap = place.x - half(cosine.abs(), sine.abs()) - BMW_320I.length / 2.0;
    behind(ego.speed, gap, other.speed * cosine, other.acceleration)
}

/// Returns the constant deceleration, m/s², that keeps [`ROOM_M`] behind a leader that brakes
/// constantly. Either the leader stops first, or both have equal speed at that distance: A.
/// Kesting, M. Treiber, D. Helbing, Phil. Trans. R. Soc. A 368 (2010), equation 2.
fn behind(speed: f64, gap: f64, leader: f64, acceleration: f64) -> f64 {
    let gap = (gap - ROOM_M).max(LEAST_M);
    let (closing, braking) = (speed - leader, (-acceleration).max(0.0));
    if leader >= 0.0 && leader * closing < 2.0 * gap * braking {
        return speed * speed / (2.0 * gap + leader * leader / braking);
    }
    if closing <= 0.0 {
        return 0.0;
    }
    braking + closing * closing / (2.0 * gap)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Vec2;

    fn other(x: f64, y: f64, yaw: f64, speed: f64, acceleration: f64) -> Participant {
        let position = Vec2::new(x, y);
        Participant {
            footprint: Footprint {
                pose: Pose { position, yaw },
                length: BMW_320I.length,
                width: 1.8,
            },
            speed,
            acceleration,
        }
    }

    const FREE: (f64, f64) = (f64::INFINITY, 0.0);

    /// Each case is a hand calculation: v²/2s, or the leader's braking and the closing speed.
    #[test]
    fn the_deceleration_that_a_situation_needs() {
        let ego = Ego {
            pose: Pose::default(),
            speed: 20.0,
            curvature: 0.0,
            end: f64::INFINITY,
        };
        let at = |gap: f64| gap + ROOM_M + BMW_320I.length;
        let stands = other(at(40.0), 0.0, 0.0, 0.0, 0.0);
        let cases = [
            ("stands 40 m ahead", stands, 5.0),
            ("as fast", other(at(5.0), 0.0, 0.0, 20.0, 0.0), 0.0),
            ("10 m/s slower", other(at(10.0), 0.0, 0.0, 10.0, 0.0), 5.0),
            // The leader stops after 50 m: 400 / (2 * (50 + 10)).
            ("brakes", other(at(10.0), 0.0, 0.0, 20.0, -4.0), 3.333),
            (
                "slower, and brakes",
                other(at(10.0), 0.0, 0.0, 10.0, -1.0),
                6.0,
            ),
            ("drives away", other(at(1.0), 0.0, 0.0, 25.0, 0.0), 0.0),
            (
                "in the next lane",
                other(at(10.0), 3.5, 0.0, 10.0, 0.0),
                0.0,
            ),
            ("behind", other(-at(1.0), 0.0, 0.0, 30.0, 0.0), 0.0),
        ];
        for (name, other, expected) in cases {
            let needed = needed(&ego, FREE, &[other]);
            assert!((needed - expected).abs() < 0.01, "{name}: {needed}");
        }
        // The other vehicle enters from the side within two seconds.
        let comes_in = |yaw: f64| needed(&ego, FREE, &[other(at(10.0), 3.5, yaw, 10.0, 0.0)]);
        assert!(comes_in(-0.2) > 4.0, "{}", comes_in(-0.2));
        assert_eq!(comes_in(0.2), 0.0, "it turns away");
        // The road and the ego bend to the left: an object straight ahead is beside the path.
        let bend = Ego {
            curvature: 0.01,
            ..ego
        };
        assert_eq!(needed(&bend, FREE, &[stands]), 0.0);
        let ends = Ego {
            end: 40.0 + ROOM_M + BMW_320I.length / 2.0,
            ..ego
        };
        assert!((needed(&ends, FREE, &[]) - 5.0).abs() < 0.01);
    }
}
