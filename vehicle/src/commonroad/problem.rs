//! The planning problems of a file, and which of them is driven.

use std::fmt;

use super::{Element, Reader, Result, document, elements};

/// Largest accepted number of planning problems: each is a drive of its own.
const PROBLEMS_MAX: usize = 100;
/// The element.
const PROBLEM: &str = "planningProblem";

/// Which planning problem of a file is driven.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ProblemChoice {
    /// The first one; a warning says so if there are others.
    #[default]
    First,
    /// The one at this place among them, from 1.
    Number(usize),
    /// The first one with this id.
    Id(i64),
}

impl From<Option<i64>> for ProblemChoice {
    /// Chooses the first one if no id is given.
    fn from(id: Option<i64>) -> Self {
        id.map_or(Self::First, Self::Id)
    }
}

/// The planning problem of a file that is driven: what a solution must repeat of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlanningProblem {
    /// Its id; `None` if the file gives none.
    pub id: Option<i64>,
    /// Its place among the planning problems of the file, from 1.
    pub number: usize,
    /// How many planning problems the file has.
    pub count: usize,
    /// `commonRoadVersion` of the file.
    pub version: String,
    /// The ego's heading at the start as the file has it, rad: not wrapped.
    pub yaw: f64,
    /// The step at which the ego starts.
    pub first_step: i64,
    /// Time between two steps, s.
    pub step_s: f64,
}

impl fmt::Display for PlanningProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { number, count, .. } = self;
        match self.id {
            Some(id) => write!(f, "planning problem {id} ({number} of {count})"),
            None => write!(f, "planning problem {number} of {count}, without an id"),
        }
    }
}

/// Returns the id of each planning problem of a file's text, `None` for one without an id; nothing
/// if the text cannot be read.
#[must_use]
pub fn problem_ids(text: &str) -> Vec<Option<i64>> {
    let Ok(document) = document(text, "") else {
        return vec![];
    };
    let problems = elements(document.root_element(), PROBLEM).take(PROBLEMS_MAX);
    let id = |node: Element<'_, '_>| node.attribute("id")?.trim().parse().ok();
    problems.map(id).collect()
}

impl<'a, 'input> Reader<'a, 'input> {
    /// Returns the chosen planning problem, its place among all, from 1, and their number.
    pub(super) fn problem(
        &self,
        root: Element<'a, 'input>,
        choice: ProblemChoice,
    ) -> Result<(Element<'a, 'input>, usize, usize)> {
        self.at_most(root, PROBLEM, PROBLEMS_MAX)?;
        let first = self.child(root, PROBLEM)?;
        let all: Vec<_> = elements(root, PROBLEM).collect();
        let count = all.len();
        let has_id = |node: &&Element<'_, '_>| {
            let id = self.id(**node, "id").ok();
            id.is_some() && ProblemChoice::from(id) == choice
        };
        let found = match choice {
            ProblemChoice::First => Some((0, first)),
            ProblemChoice::Number(number) => {
                let at = number.checked_sub(1);
                at.and_then(|at| Some((at, *all.get(at)?)))
            }
            ProblemChoice::Id(_) => {
                let found = all.iter().enumerate().find(|(_, node)| has_id(node));
                found.map(|(at, node)| (at, *node))
            }
        };
        let Some((at, chosen)) = found else {
            let which = match choice {
                ProblemChoice::Id(id) => format!("has no planning problem with the id {id}"),
                _ => "has fewer planning problems".to_owned(),
            };
            let ids = all.iter().filter_map(|node| node.attribute("id"));
            let advice = format!("choose one of {}", ids.collect::<Vec<_>>().join(", "));
            return Err(self.error(root, &which, &advice));
        };
        if choice == ProblemChoice::First && count > 1 {
            let problem = format!("is driven, the first of {count}");
            self.note(chosen, &problem, "--problem ID chooses another one");
        }
        Ok((chosen, at + 1, count))
    }
}
