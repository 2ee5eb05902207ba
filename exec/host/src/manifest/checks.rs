//! What a manifest must hold beyond its syntax: names that exist once, no circle, sensible limits.

use toml::Spanned;

use super::{Manifest, ManifestError, ProcessPlan, ReadyBy, SchedulingPolicy};

/// The longest name: it becomes the name of a folder and a variable of the environment.
const LONGEST_NAME: usize = 64;

/// Checks the values, and resolves all names to indices.
pub(super) fn resolve(manifest: &mut Manifest, text: &str) -> Result<(), ManifestError> {
    let at = |offset: usize, what: String| ManifestError::Value {
        line: 1 + text
            .bytes()
            .take(offset)
            .filter(|byte| *byte == b'\n')
            .count(),
        what,
    };
    if *manifest.version.get_ref() != 1 {
        let what = format!("version = {}: expected 1", manifest.version.get_ref());
        return Err(at(manifest.version.span().start, what));
    }
    let fail = |name: &Spanned<String>, what: &str| {
        Err(at(
            name.span().start,
            format!("{:?}: {what}", name.get_ref()),
        ))
    };
    let processes: Vec<_> = manifest
        .processes
        .iter()
        .map(|it| it.name.clone())
        .collect();
    let targets: Vec<_> = manifest.targets.iter().map(|it| it.name.clone()).collect();
    for names in [&processes, &targets] {
        for (index, name) in names.iter().enumerate() {
            if names[..index]
                .iter()
                .any(|other| other.get_ref() == name.get_ref())
            {
                return fail(name, "this name is used twice");
            }
            if !is_name(name.get_ref()) {
                return fail(name, "expected 1 to 64 letters, digits, '-', '_' or '.'");
            }
        }
    }
    let index_of = |name: &Spanned<String>| {
        let found = processes
            .iter()
            .position(|it| it.get_ref() == name.get_ref());
        let known = || {
            processes
                .iter()
                .map(|it| it.get_ref().as_str())
                .collect::<Vec<_>>()
        };
        found.ok_or_else(|| {
            let known = known().join(", ");
            let what = format!("{:?}: no such process; there are: {known}", name.get_ref());
            at(name.span().start, what)
        })
    };
    for process in &mut manifest.processes {
        process.dependencies = process
            .after
            .iter()
            .map(index_of)
            .collect::<Result<_, _>>()?;
        if let Some(what) = contradiction(process) {
            return fail(&process.name, what);
        }
    }
    if let Some(circle) = find_circle(&manifest.processes) {
        return fail(
            &manifest.processes[circle].name,
            "it waits for itself, by `after`",
        );
    }
    for target in &mut manifest.targets {
        let mut members = target
            .processes
            .iter()
            .map(index_of)
            .collect::<Result<Vec<_>, _>>()?;
        let mut next = 0;
        while let Some(&member) = members.get(next) {
            members.extend(manifest.processes[member].dependencies());
            next += 1;
        }
        members.sort_unstable();
        members.dedup();
        target.members = members;
    }
    for name in [Some(&manifest.initial), manifest.fallback.as_ref()]
        .into_iter()
        .flatten()
    {
        if manifest.target_named(name.get_ref()).is_none() {
            return fail(name, "no such run target");
        }
    }
    Ok(())
}

fn is_name(name: &str) -> bool {
    let is_fine = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
    let length = (1..=LONGEST_NAME).contains(&name.len());
    length && name.bytes().all(is_fine) && !name.starts_with('.')
}

/// Returns what contradicts itself in the plan of a process.
fn contradiction(process: &ProcessPlan) -> Option<&'static str> {
    let has_priority = process.priority.is_some();
    let is_realtime = process.policy != SchedulingPolicy::Other;
    let out_of_range = |it: &Spanned<u8>| !(1..=99).contains(it.get_ref());
    if has_priority != is_realtime {
        return Some("`priority` goes with policy = \"fifo\" or \"round-robin\", and needs one");
    }
    if process.priority.as_ref().is_some_and(out_of_range) {
        return Some("`priority` must be 1 to 99");
    }
    if process.cpus.as_ref().is_some_and(Vec::is_empty) {
        return Some("`cpus` is empty: name at least one, or leave it out");
    }
    if process.program.as_os_str().is_empty() {
        return Some("`program` is empty");
    }
    if process
        .alive
        .is_some_and(|it| it.every.as_ns() == 0 || it.least > it.most)
    {
        return Some("`alive` needs `every` above 0, and `least` not above `most`");
    }
    if process
        .deadlines
        .iter()
        .any(|it| it.least > it.most || it.from == it.to)
    {
        return Some("`deadlines` need `least` not above `most`, and two checkpoints");
    }
    if process.state_management && process.ready == ReadyBy::Exit {
        return Some("state management cannot be ready by its exit");
    }
    None
}

/// Returns a process that waits for itself.
fn find_circle(processes: &[ProcessPlan]) -> Option<usize> {
    let mut settled = vec![false; processes.len()];
    loop {
        let is_free = |at: &usize| {
            let dependencies = processes[*at].dependencies();
            !settled[*at] && dependencies.iter().all(|it| settled[*it])
        };
        match (0..processes.len()).find(is_free) {
            Some(free) => settled[free] = true,
            None => return settled.iter().position(|it| !it),
        }
    }
}
