//! Scene analysis: which lane an object is in, and whether it is about to enter the ego lane.

use crate::driving::math::{abs, cos, sin};
use crate::driving::road::{CentreLine, DEFAULT_LANE_WIDTH_M};
use crate::driving::types::Lanes;

use super::track::Track;

/// A cut-in is foreseen up to this time ahead, s.
const CUT_IN_HORIZON_S: f32 = 2.0;
/// An object that moves across the lane more slowly than this, m/s, is not changing lanes.
const CUT_IN_SPEED: f32 = 0.5;
/// An object must move in for this many cycles in a row to count as a cut-in.
const CUT_IN_CYCLES: u8 = 5;

/// The place of an object on the road.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    pub(crate) lane: i8,
    pub(crate) cuts_in: bool,
}

/// The road around the vehicle, for scene analysis.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RoadView {
    line: CentreLine,
    own: f32,
    left: f32,
    right: f32,
}

impl RoadView {
    /// From the camera's lanes, or else along the curve that the vehicle drives.
    pub(crate) fn new(lanes: Option<&Lanes>, driven_curvature: f32) -> Self {
        match lanes {
            Some(lanes) => Self {
                line: CentreLine::new(lanes),
                own: lanes.width,
                left: lanes.left.unwrap_or(DEFAULT_LANE_WIDTH_M),
                right: lanes.right.unwrap_or(DEFAULT_LANE_WIDTH_M),
            },
            None => Self {
                line: CentreLine::of_curvature(driven_curvature),
                own: DEFAULT_LANE_WIDTH_M,
                left: DEFAULT_LANE_WIDTH_M,
                right: DEFAULT_LANE_WIDTH_M,
            },
        }
    }

    fn lane_of(&self, offset: f32) -> i8 {
        let half = 0.5 * self.own;
        if offset > half + self.left {
            2
        } else if offset > half {
            1
        } else if offset < -half - self.right {
            -2
        } else if offset < -half {
            -1
        } else {
            0
        }
    }

    /// Places a track, and counts in the track for how long it has approached the ego lane.
    pub(crate) fn place(&self, track: &mut Track) -> Place {
        let (foot, offset) = self.line.project(track.x.position(), track.y.position());
        let heading = self.line.heading(foot);
        let across = track.y.velocity() * cos(heading) - track.x.velocity() * sin(heading);
        let lane = self.lane_of(offset);

        // An object moves in if it moves towards the centre, its near side is outside or just over
        // the line, and its centre will be inside the ego lane before the horizon.
        let inwards = if offset > 0.0 { -across } else { across };
        let reach = abs(offset) - inwards * CUT_IN_HORIZON_S;
        let overlaps = abs(offset) - 0.5 * track.width < 0.5 * self.own - 0.2;
        let near = abs(offset) < self.own * 1.6;
        let moves_in = inwards > CUT_IN_SPEED
            && near
            && reach < 0.5 * self.own
            && abs(offset) > 0.25 * self.own;
        track.approaching = if moves_in {
            track.approaching.saturating_add(1)
        } else {
            track.approaching / 2
        };
        let cuts_in =
            moves_in && (track.approaching >= CUT_IN_CYCLES || overlaps && track.approaching > 1);
        Place { lane, cuts_in }
    }
}
