//! What a manifest must hold beyond its syntax: names that exist once, no circle, sensible limits.

use std::collections::{BTreeMap, BTreeSet};

use tandem_board::Duration;
use toml::Spanned;

use super::{
    AliveLimits, DeadlineLimits, Manifest, ManifestError, ProcessPlan, ReadyBy, SchedulingPolicy,
};

/// The longest name: it becomes the name of a folder and a variable of the environment.
const LONGEST_NAME: usize = 64;

/// Checks the values, and resolves all names to indices.
pub(super) fn resolve(manifest: &mut Manifest, text: &str) -> Result<(), ManifestError> {
    let refused = |offset: usize, what: String| {
        let before = text.bytes().take(offset);
        ManifestError::Value(1 + before.filter(|byte| *byte == b'\n').count(), what)
    };
    let wrong = |name: &Spanned<String>, what: &str| {
        refused(name.span().start, format!("{:?}: {what}", name.get_ref()))
    };
    let version = &manifest.version;
    if *version.get_ref() != 1 {
        let what = format!("version = {}: expected 1", version.get_ref());
        return Err(refused(version.span().start, what));
    }
    let indices = |names: &mut dyn Iterator<Item = &Spanned<String>>| {
        let mut found = BTreeMap::new();
        for (at, name) in names.enumerate() {
            if !is_name(name.get_ref()) {
                let what = "expected 1 to 64 letters, digits, '-', '_' or '.'";
                return Err(wrong(name, what));
            }
            if found.insert(name.get_ref().clone(), at).is_some() {
                return Err(wrong(name, "this name is used twice"));
            }
        }
        Ok(found)
    };
    let processes = indices(&mut manifest.processes.iter().map(|it| &it.name))?;
    let targets = indices(&mut manifest.targets.iter().map(|it| &it.name))?;
    let index_of = |name: &Spanned<String>| {
        processes.get(name.get_ref()).copied().ok_or_else(|| {
            let known: Vec<_> = processes.keys().map(String::as_str).collect();
            let known = known.join(", ");
            wrong(name, &format!("no such process; there are: {known}"))
        })
    };
    for plan in &mut manifest.processes {
        plan.dependencies = plan.after.iter().map(index_of).collect::<Result<_, _>>()?;
        if let Some(what) = contradiction(plan) {
            return Err(wrong(&plan.name, what));
        }
    }
    for (at, plan) in manifest.processes.iter().enumerate() {
        if with_dependencies(manifest, &plan.dependencies).contains(&at) {
            return Err(wrong(&plan.name, "it waits for itself, by `after`"));
        }
    }
    for at in 0..manifest.targets.len() {
        let wanted = manifest.targets[at].processes.iter().map(index_of);
        let wanted: Vec<_> = wanted.collect::<Result<_, _>>()?;
        manifest.targets[at].members = with_dependencies(manifest, &wanted).into_iter().collect();
    }
    let mut used = core::iter::once(&manifest.initial).chain(&manifest.fallback);
    match used.find(|name| !targets.contains_key(name.get_ref())) {
        Some(name) => Err(wrong(name, "no such run target")),
        None => Ok(()),
    }
}

fn is_name(name: &str) -> bool {
    let is_fine = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    let length = (1..=LONGEST_NAME).contains(&name.len());
    length && name.bytes().all(is_fine) && !name.starts_with('.')
}

/// Returns what contradicts itself in the plan of a process.
fn contradiction(plan: &ProcessPlan) -> Option<&'static str> {
    let priority = plan.priority.as_ref().map(|it| *it.get_ref());
    let is_realtime = plan.policy != SchedulingPolicy::Other;
    let is_no_cycle = |it: AliveLimits| it.every == Duration::ZERO || it.least > it.most;
    let is_no_span = |it: &DeadlineLimits| it.least > it.most || it.from == it.to;
    Some(if priority.is_some() != is_realtime {
        "`priority` goes with policy = \"fifo\" or \"round-robin\", and needs one"
    } else if priority.is_some_and(|it| !(1..=99).contains(&it)) {
        "`priority` must be 1 to 99"
    } else if plan.cpus.as_ref().is_some_and(Vec::is_empty) {
        "`cpus` is empty: name at least one, or leave it out"
    } else if plan.program.as_os_str().is_empty() {
        "`program` is empty"
    } else if plan.alive.is_some_and(is_no_cycle) {
        "`alive` needs `every` above 0, and `least` not above `most`"
    } else if plan.deadlines.iter().any(is_no_span) {
        "`deadlines` need `least` not above `most`, and two checkpoints"
    } else if plan.state_management && plan.ready == ReadyBy::Exit {
        "state management cannot be ready by its exit"
    } else {
        return None;
    })
}

/// Returns these processes and all that they depend on.
fn with_dependencies(manifest: &Manifest, wanted: &[usize]) -> BTreeSet<usize> {
    let (mut all, mut next) = (BTreeSet::new(), wanted.to_vec());
    while let Some(at) = next.pop() {
        if all.insert(at) {
            next.extend(&manifest.processes[at].dependencies);
        }
    }
    all
}
