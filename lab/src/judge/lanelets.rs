//! Which types of lanelets a vehicle was on: by the file alone, not by the road that is made of it.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use tandem_vehicle::commonroad;
use tandem_vehicle::geometry::Vec2;

/// The type of a lanelet for which the file gives none.
const UNTYPED: &str = "untyped";

/// A lanelet of the file.
#[derive(Debug)]
struct Lanelet {
    types: Vec<String>,
    outline: Vec<Vec2>,
    /// The corners of the box around it.
    low: Vec2,
    high: Vec2,
}

/// All lanelets of a file.
#[derive(Debug, Default)]
pub(super) struct Lanelets(Vec<Lanelet>);

impl Lanelets {
    /// Reads them; none if the file cannot be read.
    pub(super) fn read(path: &Path) -> Self {
        Self::of_text(&std::fs::read_to_string(path).unwrap_or_default())
    }

    /// Those of a file's text; none if it is no scenario.
    pub(super) fn of_text(text: &str) -> Self {
        Self::parse(text).unwrap_or_default()
    }

    fn parse(text: &str) -> Option<Self> {
        let map = commonroad::parse(text, "").ok()?;
        let tree = roxmltree::Document::parse(text).ok()?;
        let mut types: HashMap<i64, Vec<String>> = HashMap::new();
        for node in tree
            .root_element()
            .children()
            .filter(|it| it.has_tag_name("lanelet"))
        {
            let id = node.attribute("id").and_then(|id| id.trim().parse().ok());
            let said = node.children().filter(|it| it.has_tag_name("laneletType"));
            let said = said.filter_map(|it| Some(it.text()?.trim().to_owned()));
            types.entry(id?).or_default().extend(said);
        }
        let lanelets = map.lanelets.into_iter().map(|it| {
            let outline: Vec<Vec2> = { it.left.iter() }
                .chain(it.right.iter().rev())
                .copied()
                .collect();
            let around = |pick: fn(f64, f64) -> f64| {
                let of = |axis: fn(&Vec2) -> f64| outline.iter().map(axis).reduce(pick);
                Vec2::new(of(|p| p.x).unwrap_or(0.0), of(|p| p.y).unwrap_or(0.0))
            };
            let (low, high) = (around(f64::min), around(f64::max));
            let mut types = types.remove(&it.id).unwrap_or_default();
            if types.is_empty() {
                types.push(UNTYPED.to_owned());
            }
            Lanelet {
                types,
                outline,
                low,
                high,
            }
        });
        Some(Self(lanelets.collect()))
    }

    /// Adds the types of all lanelets at this point.
    pub(super) fn add_types(&self, point: Vec2, to: &mut BTreeSet<String>) {
        let here = self.0.iter().filter(|it| it.contains(point));
        to.extend(here.flat_map(|it| it.types.iter().cloned()));
    }
}

impl Lanelet {
    /// Counts the edges that a ray to the east crosses: an odd number means inside.
    fn contains(&self, point: Vec2) -> bool {
        let is_near = (self.low.x..=self.high.x).contains(&point.x)
            && (self.low.y..=self.high.y).contains(&point.y);
        let corners = self.outline.iter();
        let edges = corners
            .clone()
            .zip(corners.skip(1).chain(self.outline.first()));
        let crosses = |(a, b): &(&Vec2, &Vec2)| {
            (a.y > point.y) != (b.y > point.y)
                && point.x < a.x + (b.x - a.x) * (point.y - a.y) / (b.y - a.y)
        };
        is_near && edges.filter(crosses).count() % 2 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A point is in the lanelet that covers it, with all of its types.
    #[test]
    fn a_point_has_the_types_of_its_lanelets() {
        let text = include_str!("../../../vehicle/fixtures/commonroad/areas-2018b.xml");
        let first = "<lanelet id=\"1\">";
        assert!(text.contains(first));
        let typed = "<laneletType>sidewalk</laneletType>";
        let text = text.replacen(first, &format!("{first}{typed}"), 1);
        let lanelets = Lanelets::parse(&text).unwrap();
        let map = commonroad::parse(&text, "").unwrap();
        let middle = |id: i64| {
            let it = map.lanelets.iter().find(|it| it.id == id).unwrap();
            it.left[0]
                .lerp(it.left[1], 0.5)
                .lerp(it.right[0].lerp(it.right[1], 0.5), 0.5)
        };
        let types = |point: Vec2| {
            let mut found = BTreeSet::new();
            lanelets.add_types(point, &mut found);
            found.into_iter().collect::<Vec<_>>()
        };
        assert_eq!(types(middle(1)), ["sidewalk"]);
        assert_eq!(types(middle(3)), [UNTYPED]);
        assert!(types(Vec2::new(-1e6, 0.0)).is_empty());
    }
}
