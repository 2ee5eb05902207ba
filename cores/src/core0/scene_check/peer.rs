//! This system's scene against the scene of the other system, which crosses the link.
//!
//! Both systems hear the same frames, so their scenes are nearly equal. A difference means that
//! all cores of one system hear wrongly. That system's values do not continue those on which both
//! agreed: it finds this itself, and leaves. A value of the other system is compared and nothing
//! else.

use super::ego::EgoCheck;
use super::lanes::{Comparison, OLDEST, apart};
use super::{Difference, carried};
use crate::driving::types::{Ego, Lanes, Scene};
use tandem_board::Instant;

/// A difference counts after this many compared scenes: a system that has just joined does not yet
/// filter like the other one.
const WARM_UP: u8 = 10;
/// The scenes of both systems are this far apart in time at most, s.
const APART_S: f32 = 0.05;

/// What a scene says of the lane and of the vehicle's motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::core0) struct PeerScene {
    /// The time of the scene, on this system's clock.
    pub(in crate::core0) at: Instant,
    /// The ego lane's centre line, as in [`Lanes`](crate::driving::types::Lanes).
    pub(in crate::core0) c: [f32; 4],
    /// The acceleration is not compared.
    pub(in crate::core0) ego: Ego,
}

impl PeerScene {
    /// Returns what a scene with a lane says.
    pub(super) fn of(scene: &Scene) -> Option<Self> {
        Some(Self {
            at: scene.at,
            c: scene.lanes?.c,
            ego: scene.ego,
        })
    }
}

pub(super) struct PeerCheck {
    newest: Option<PeerScene>,
    /// This system's line in the scene before, and its time.
    before: Option<(Instant, [f32; 4])>,
    ego: EgoCheck,
    lanes: Comparison,
    compared: u8,
    /// A difference was reported.
    is_reported: bool,
}

impl PeerCheck {
    pub(super) fn new() -> Self {
        Self {
            newest: None,
            before: None,
            ego: EgoCheck::new(APART_S),
            lanes: Comparison::default(),
            compared: 0,
            is_reported: false,
        }
    }

    /// Returns whether a difference is reported for the first time.
    pub(super) const fn is_new(&mut self) -> bool {
        !core::mem::replace(&mut self.is_reported, true)
    }

    /// Takes the other system's scene.
    pub(super) fn on_peer(&mut self, peer: PeerScene) {
        if self.newest.replace(peer).is_none_or(|it| it.at < peer.at) {
            self.ego.on_ego(peer.at, peer.ego);
        }
    }

    /// Compares a scene. Returns the largest difference as a share of its tolerance, and the
    /// difference once it has lasted.
    pub(super) fn check(&mut self, scene: &Scene) -> (f32, Option<Difference>) {
        let peer = self.newest.filter(|it| scene.at.since(it.at) <= OLDEST);
        let (Some(peer), Some(lanes)) = (peer, &scene.lanes) else {
            *self = Self::new();
            return (0.0, None);
        };
        let line = carried(&peer.c, peer.at, scene.at, &scene.ego);
        // The other system may not have used the newest frame of the camera yet.
        let before = self.before.replace((scene.at, lanes.c));
        let before = before.map(|(at, c)| carried(&c, at, scene.at, &scene.ego));
        let far = |c: &[f32; 4]| apart(c, &line, lanes.view_range);
        let nearest = before.filter(|before| far(before) < far(&lanes.c));
        let compared = Lanes {
            c: nearest.unwrap_or(lanes.c),
            ..*lanes
        };
        let (of_lanes, of_line) = self.lanes.check(scene, &compared, &line);
        let (of_ego, of_motion) = self.ego.check(scene.at, &scene.ego);
        self.compared = self.compared.saturating_add(1);
        if self.compared < WARM_UP {
            return (0.0, None);
        }
        // A wrong motion also bends the line.
        (of_lanes.max(of_ego), of_motion.or(of_line))
    }
}
