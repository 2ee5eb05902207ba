//! For whom a lanelet is, by its type and its users.

use super::{Element, Reader, elements};

/// The type of a lanelet on which persons cross other lanes.
const CROSSWALK: &str = "crosswalk";
/// Types of lanelets that cars must not drive on, and the users whose lanelets they may use.
const NOT_FOR_CARS: [&str; 7] = [
    "sidewalk",
    CROSSWALK,
    "bicycleLane",
    "busLane",
    "shoulder",
    "border",
    "restricted",
];
const FOR_CARS: [&str; 2] = ["vehicle", "car"];

impl Reader<'_, '_> {
    /// Returns whether an element of this name in `node` has one of these texts.
    fn names_one(&self, node: Element<'_, '_>, name: &str, texts: &[&str]) -> bool {
        elements(node, name).any(|it| texts.contains(&self.text(it)))
    }

    /// Returns whether persons cross other lanes on this lanelet.
    pub(super) fn is_crosswalk(&self, node: Element<'_, '_>) -> bool {
        self.names_one(node, "laneletType", &[CROSSWALK])
    }

    /// Returns whether a lanelet is not for cars in its direction.
    pub(super) fn is_refused(&self, node: Element<'_, '_>) -> bool {
        let named = |name, texts: &[&str]| self.names_one(node, name, texts);
        let users = ["userOneWay", "userBidirectional"];
        let is_told = users
            .iter()
            .any(|name| elements(node, name).next().is_some());
        let for_cars = users.iter().any(|name| named(name, &FOR_CARS));
        named("laneletType", &NOT_FOR_CARS) || is_told && !for_cars
    }
}
