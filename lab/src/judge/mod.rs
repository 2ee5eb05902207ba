//! `tandem judge`: drives a folder of scenarios in virtual time, and judges each drive.

mod drive;
mod page;
mod solution;
mod variants;

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context as _, bail};
use drive::{Judgement, Verdict};
use tandem_page::output::{OutputFile, OutputFolder};
use tandem_record::verdict::Rule;
use tandem_vehicle::Scenario;

use crate::args::JudgeArgs;
use crate::work;
use tandem::failure::Failure;

/// Judges all scenarios of the folder.
///
/// # Errors
/// If the folder cannot be read or has no scenario, a result cannot be written, or the ego caused
/// a collision.
pub(crate) fn run(args: &JudgeArgs) -> Result<(), Failure> {
    let folder = args.folder.as_deref();
    if let Some(count) = args.variants {
        let made = variants::variants(count.get(), args.seed);
        return match folder {
            Some(folder) => {
                let place = OutputFolder::check("DIR", folder).map_err(Failure::usage)?;
                let file = |it: variants::Variant| (format!("{}.xml", it.name), it.text);
                Ok(place.fill(&made.into_iter().map(file).collect::<Vec<_>>())?)
            }
            None => judge_variants(args, made),
        };
    }
    let folder = folder.unwrap_or(Path::new(""));
    let files = scenarios(folder).map_err(Failure::Usage)?;
    let places = [
        ("--json", args.json.as_deref()),
        ("--html", args.html.as_deref()),
    ];
    let places = OutputFile::check_all(places);
    let [json_to, html_to] = places.map_err(Failure::usage)?;
    let solutions = args.solutions.as_deref();
    let solutions = solutions.map(|folder| OutputFolder::check("--solutions", folder));
    let solutions_to = solutions.transpose().map_err(Failure::usage)?;
    let judged = all(args, &files)?;
    if !json_to.as_ref().is_some_and(OutputFile::is_stdout) {
        tandem::print(&table(&judged))?;
    }
    if let Some(place) = json_to {
        place.write(&(serde_json::to_string_pretty(&judged)? + "\n"))?;
    }
    if let Some(place) = html_to {
        place.write(&page::page(folder, &judged))?;
    }
    if let Some(place) = solutions_to {
        let solved = judged.iter().filter_map(|it| {
            let text = it.solution.clone()?;
            Some((format!("solution_{}", it.file), text))
        });
        place.fill(&solved.collect::<Vec<_>>())?;
    }
    let caused: Vec<String> = judged
        .iter()
        .filter(|it| it.collision_by_ego)
        .map(|it| format!("{}: a collision that the vehicle caused", it.file))
        .collect();
    if caused.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(caused))
    }
}

/// Judges made scenarios, and prints a table of their classes.
///
/// # Errors
/// If a result cannot be written, or a drive breaks a bound.
fn judge_variants(args: &JudgeArgs, made: Vec<variants::Variant>) -> Result<(), Failure> {
    let [json_to] =
        OutputFile::check_all([("--json", args.json.as_deref())]).map_err(Failure::usage)?;
    let bar = work::bar(made.len() as u64, "{bar:30} {pos}/{len} {msg}")?;
    let judged = work::on_threads(args.jobs, made.into_iter(), |it| {
        bar.set_message(it.name.clone());
        let scenario = Scenario::parse(&it.text, &it.name);
        let judgement = drive::judge_scenario(args, &it.name, scenario);
        bar.inc(1);
        Ok((it.class, judgement))
    });
    bar.finish_and_clear();
    let judged = judged?;
    if !json_to.as_ref().is_some_and(OutputFile::is_stdout) {
        tandem::print(&variants::table(&judged))?;
    }
    if let Some(place) = json_to {
        let judged: Vec<&Judgement> = judged.iter().map(|it| &it.1).collect();
        place.write(&(serde_json::to_string_pretty(&judged)? + "\n"))?;
    }
    let broken = judged.iter().filter_map(|(class, it)| {
        let found = variants::violations(*class, it);
        (!found.is_empty()).then(|| format!("{}: {}", it.file, found.join(", ")))
    });
    let broken: Vec<String> = broken.collect();
    if broken.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(broken))
    }
}

/// Returns the names of the CommonRoad files in the folder, sorted.
fn scenarios(folder: &Path) -> anyhow::Result<Vec<String>> {
    let named = || folder.display().to_string();
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(named)? {
        let name = entry.with_context(named)?.file_name();
        let name = name.into_string();
        files.extend(name.ok().filter(|name| name.ends_with(".xml")));
    }
    if files.is_empty() {
        bail!("{}: there is no scenario, a file *.xml", folder.display());
    }
    files.sort_unstable();
    Ok(files)
}

/// Judges the files on several threads. The results are in the order of `files`.
fn all(args: &JudgeArgs, files: &[String]) -> anyhow::Result<Vec<Judgement>> {
    let bar = work::bar(files.len() as u64, "{bar:30} {pos}/{len} {msg}")?;
    let judged = work::on_threads(args.jobs, files.iter(), |file| {
        bar.set_message(file.clone());
        let judgement = drive::judge(args, file);
        bar.inc(1);
        Ok(judgement)
    });
    bar.finish_and_clear();
    judged
}

/// Returns one line for each file, and the totals.
fn table(judged: &[Judgement]) -> String {
    let longest = judged.iter().map(|it| it.file.len()).max().unwrap_or(0);
    let mut text = format!(
        "{:longest$}  verdict  collision  excursion  goal  brake   jerk  remark\n",
        "file"
    );
    for it in judged {
        let collision = match (it.collision_by_ego, it.collision) {
            (true, _) => "caused",
            (_, true) => "hit",
            _ => "–",
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:longest$}  {:7}  {collision:9}  {:>7.2} m  {:4}  {:>5.1}  {:>5.1}  {}",
            it.file,
            name(it.verdict),
            it.excursion_m,
            goal(it),
            it.brake_max,
            it.jerk_max,
            it.remark(),
        );
    }
    text + &sums(judged) + "\n"
}

fn sums(judged: &[Judgement]) -> String {
    let count = |test: &dyn Fn(&Judgement) -> bool| judged.iter().filter(|it| test(it)).count();
    let of = |verdict| count(&|it| it.verdict == verdict);
    format!(
        "{} files: {} driven, {} stopped, {} refused; {} collisions, {} caused; {} excursions; \
         {} of {} goals reached; outside emergencies {} braked above 4 m/s², {} jerked above \
         10 m/s³",
        judged.len(),
        of(Verdict::Driven),
        of(Verdict::Stopped),
        of(Verdict::Refused),
        count(&|it| it.collision),
        count(&|it| it.collision_by_ego),
        count(&|it| it.excursion_m > 0.0),
        count(&|it| it.goal_reached == Some(true)),
        count(&|it| it.goal_reached.is_some()),
        count(&|it| it.calm_brake_max > 4.0),
        count(&|it| it.calm_jerk_max > 10.0),
    )
}

fn name(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Driven => "driven",
        Verdict::Stopped => "stopped",
        Verdict::Refused => "refused",
    }
}

fn goal(judgement: &Judgement) -> &'static str {
    match judgement.goal_reached {
        Some(true) => "yes",
        Some(false) => "no",
        None => "–",
    }
}

impl Judgement {
    /// Returns the reason, the findings and further remarks, in one line.
    fn remark(&self) -> String {
        let mut remarks = vec![];
        if !self.reason.is_empty() {
            remarks.push(self.reason.clone());
        }
        let mut remark = |said: bool, text: String| {
            if said {
                remarks.push(text);
            }
        };
        remark(!self.goal_missed.is_empty(), self.goal_missed.clone());
        // Omit collisions and excursions, because they have their own columns.
        let own_column = [Rule::Collision, Rule::LeftLane];
        let findings = self.findings.iter();
        for finding in findings.filter(|it| !own_column.contains(&it.rule)) {
            remark(true, finding.to_string());
        }
        remark(self.hit_while_standing, "hit while it stood".to_owned());
        remark(
            self.wrong_way_s > 0.0,
            format!("wrong way for {:.1} s", self.wrong_way_s),
        );
        remark(
            !self.brake_reason.is_empty(),
            format!("braked {:.1} m/s²: {}", self.brake_max, self.brake_reason),
        );
        remark(
            !self.warnings.is_empty(),
            format!("{} warning(s)", self.warnings.len()),
        );
        remarks.join("; ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scenario inside the domain is driven. A scenario that starts beside the road and a broken
    /// file are refused. The JSON has the names that scripts rely on.
    #[test]
    fn a_folder_is_judged() {
        let folder = tempfile::tempdir().unwrap();
        let good = include_str!("../../../vehicle/fixtures/commonroad/sign-2020a.xml");
        let off_road = include_str!("../../../tests/fuzz/corpus/scenario/off-road.xml");
        for (name, text) in [("a.xml", good), ("b.xml", off_road), ("c.xml", "<broken")] {
            std::fs::write(folder.path().join(name), text).unwrap();
        }
        let files = scenarios(folder.path()).unwrap();
        let args = JudgeArgs {
            folder: Some(folder.path().to_owned()),
            variants: None,
            duration: 1.0,
            seed: 1,
            jobs: None,
            json: None,
            html: None,
            solutions: None,
        };
        let judged = files.iter().map(|file| drive::judge(&args, file));
        let judged: Vec<Judgement> = judged.collect();
        let verdicts: Vec<Verdict> = judged.iter().map(|it| it.verdict).collect();
        let refused = Verdict::Refused;
        assert_eq!(verdicts, [Verdict::Driven, refused, refused]);
        assert!(judged[0].distance_m > 5.0, "{}", judged[0].distance_m);
        assert!(
            judged[1].reason.contains("beside the road"),
            "{}",
            judged[1].reason
        );
        assert!(judged[2].reason.contains("c.xml:1"), "{}", judged[2].reason);
        let json = serde_json::to_value(&judged[0]).unwrap();
        for name in [
            "file",
            "verdict",
            "collision",
            "collision_by_ego",
            "excursion_m",
            "goal_reached",
        ] {
            assert!(json.get(name).is_some(), "{name}");
        }
        assert_eq!(json["verdict"], "driven");
        assert!(page::page(folder.path(), &judged).contains("a.xml"));
        assert!(table(&judged).contains("1 driven, 0 stopped, 2 refused"));
    }
}
