//! `tandem judge`: drives scenarios in virtual time, and judges each drive.

mod drive;
mod drive_log;
mod lanelets;
mod page;
mod rss;
mod solution;
mod variants;

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail};
use drive::{Judgement, Verdict};
use rss::Collision;
use tandem_page::output::OutputFolder;
use tandem_record::verdict::Rule;
use tandem_vehicle::Scenario;

use crate::args::JudgeArgs;
use crate::work;
use tandem::failure::Failure;
use tandem::output::{REPORT, ReportFolder};

/// Judges all scenarios of the folder, or one file.
///
/// # Errors
/// If the folder cannot be read or has no scenario, a result cannot be written, or the ego caused
/// an avoidable collision or left its lanes.
pub(crate) fn run(args: &JudgeArgs) -> Result<(), Failure> {
    let place = args.folder.as_deref();
    if let Some(count) = args.variants {
        let made = || variants::variants(count, args.seed);
        return match place {
            Some(_) if args.json.is_given() => Err(Failure::Usage(anyhow!(
                "--variants with DIR judges nothing: leave out --json, or DIR"
            ))),
            Some(folder) => {
                let place = OutputFolder::check("DIR", folder).map_err(Failure::usage)?;
                let file = |it: variants::Variant| (format!("{}.xml", it.name), it.text);
                Ok(place.fill(&made().into_iter().map(file).collect::<Vec<_>>())?)
            }
            None => judge_variants(args, made()),
        };
    }
    let (folder, files) = files_at(place.unwrap_or(Path::new(""))).map_err(Failure::Usage)?;
    let args = &JudgeArgs {
        folder: Some(folder.clone()),
        ..args.clone()
    };
    check_choice(args, &folder, &files).map_err(Failure::Usage)?;
    let out = args.out.as_deref().map(ReportFolder::check).transpose();
    let out = out.map_err(Failure::Usage)?;
    let places = args.json.check_with([("--html", args.html.as_deref())]);
    let (json_to, [html_to]) = places.map_err(Failure::usage)?;
    let solutions = args.solutions.as_deref();
    let solutions = solutions.map(|folder| OutputFolder::check("--solutions", folder));
    let solutions_to = solutions.transpose().map_err(Failure::usage)?;
    let judged = all(args, &files, out.as_ref())?;
    tandem::print(&json_to.write(&judged, || table(&judged))?)?;
    if let Some(place) = html_to {
        place.write(&page::page(&folder, &judged))?;
    }
    if let Some(place) = solutions_to {
        let solved = judged.iter().filter_map(|it| {
            let text = it.solution.clone()?;
            Some((it.solution_name(), text))
        });
        place.fill(&solved.collect::<Vec<_>>())?;
    }
    let is_driven = judged.iter().all(|it| it.verdict != Verdict::Refused);
    if let Some(out) = out.filter(|_| is_driven) {
        eprintln!("report: {}", out.path().join(REPORT).display());
    }
    let broken: Vec<String> = judged.iter().filter_map(Judgement::objection).collect();
    if broken.is_empty() {
        Ok(())
    } else {
        Err(Failure::Objections(broken))
    }
}

/// Checks that `--problem` names a planning problem of the only file, and that `--out` is for one
/// drive.
fn check_choice(args: &JudgeArgs, folder: &Path, files: &[String]) -> anyhow::Result<()> {
    let option = match (args.problem, &args.out) {
        (Some(_), _) => "--problem",
        (None, Some(_)) => "--out",
        (None, None) => return Ok(()),
    };
    let [file] = files else {
        let count = files.len();
        bail!("{option} is for one file; there are {count}: name one");
    };
    let ids = Scenario::problem_ids(&folder.join(file));
    let known: Vec<_> = ids.iter().flatten().map(ToString::to_string).collect();
    let known = known.join(", ");
    match args.problem {
        Some(id) if !ids.contains(&Some(id)) => {
            bail!("--problem {id}: {file} has the planning problems {known}")
        }
        None if ids.len() > 1 => bail!(
            "--out is for one drive; {file} has {} planning problems: choose one with --problem: \
             {known}",
            ids.len()
        ),
        _ => Ok(()),
    }
}

/// Returns the folder and the names of the scenarios in it: all, or one if it is a file.
fn files_at(given: &Path) -> anyhow::Result<(PathBuf, Vec<String>)> {
    if !given.is_file() {
        return Ok((given.to_owned(), scenarios(given)?));
    }
    let name = given.file_name().and_then(|name| name.to_str());
    let name = name.with_context(|| format!("{}: no name of a file", given.display()))?;
    let folder = given.parent().unwrap_or_else(|| Path::new("."));
    Ok((folder.to_owned(), vec![name.to_owned()]))
}

/// Judges made scenarios, and prints a table of their classes.
///
/// # Errors
/// If a result cannot be written, or a drive breaks a bound.
fn judge_variants(args: &JudgeArgs, made: Vec<variants::Variant>) -> Result<(), Failure> {
    let json_to = args.json.check().map_err(Failure::usage)?;
    let bar = work::bar(made.len() as u64, "{bar:30} {pos}/{len} {msg}")?;
    let judged = work::on_threads(args.jobs, made.into_iter(), |it| {
        bar.set_message(it.name.clone());
        let scenario = Scenario::parse(&it.text, &it.name);
        let lanelets = lanelets::Lanelets::of_text(&it.text);
        let judgement = drive::judge_scenario(args, &it.name, scenario, &lanelets, None)?;
        bar.inc(1);
        Ok((it.class, judgement))
    });
    bar.finish_and_clear();
    let judged = judged?;
    let judgements: Vec<&Judgement> = judged.iter().map(|it| &it.1).collect();
    tandem::print(&json_to.write(&judgements, || variants::table(&judged))?)?;
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
fn all(
    args: &JudgeArgs,
    files: &[String],
    out: Option<&ReportFolder>,
) -> anyhow::Result<Vec<Judgement>> {
    let bar = work::bar(files.len() as u64, "{bar:30} {pos}/{len} {msg}")?;
    let judged = work::on_threads(args.jobs, files.iter(), |file| {
        bar.set_message(file.clone());
        let judgement = drive::judge(args, file, out)?;
        bar.inc(1);
        Ok(judgement)
    });
    bar.finish_and_clear();
    Ok(judged?.concat())
}

/// Returns one line for each file, and the totals.
fn table(judged: &[Judgement]) -> String {
    let longest = judged.iter().map(|it| it.title().chars().count());
    let longest = longest.max().unwrap_or(0);
    let mut text = format!(
        "{:longest$}  verdict  collision    excursion  goal  brake   jerk  aside   RSS    remark\n\
         {:longest$}                                 m        m/s²   m/s³   m/s²   m\n",
        "file", ""
    );
    for it in judged {
        let collision = match (it.caused(), it.collision_by_ego, it.collision) {
            (true, ..) => "caused",
            (_, true, _) => "unavoidable",
            (.., true) => "hit",
            _ => "–",
        };
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "{:longest$}  {:7}  {collision:11}  {:>9.2}  {:4}  {:>5.1}  {:>5.1}  {:>5.1}  {:>5}  {}",
            it.title(),
            name(it.verdict),
            it.excursion_m,
            goal(it),
            it.brake_max,
            it.jerk_max,
            it.lat_accel_max,
            it.rss
                .margin_m
                .map_or("–".to_owned(), |margin| format!("{margin:.1}")),
            it.remark(),
        );
    }
    text + &sums(judged) + "\n"
}

fn sums(judged: &[Judgement]) -> String {
    let count = |test: &dyn Fn(&Judgement) -> bool| judged.iter().filter(|it| test(it)).count();
    let of = |verdict| count(&|it| it.verdict == verdict);
    let files: BTreeSet<&str> = judged.iter().map(|it| &*it.file).collect();
    let problems = match judged.len() {
        drives if drives == files.len() => String::new(),
        drives => format!(", {drives} planning problems"),
    };
    format!(
        "{} files{}: {} driven, {} stopped, {} refused; {} collisions, {} caused, {} unavoidable by RSS; \
         {} excursions; {} of {} goals reached; outside emergencies {} braked above 4 m/s², {} \
         jerked above 10 m/s³; {} others forced to brake; {} files with defects of the data",
        files.len(),
        problems,
        of(Verdict::Driven),
        of(Verdict::Stopped),
        of(Verdict::Refused),
        count(&|it| it.collision),
        count(&Judgement::caused),
        count(&|it| it.collision_by_ego && !it.caused()),
        count(&|it| it.excursion_m > 0.0),
        count(&|it| it.goal_reached == Some(true)),
        count(&|it| it.goal_reached.is_some()),
        count(&|it| it.calm_brake_max > 4.0),
        count(&|it| it.calm_jerk_max > 10.0),
        judged.iter().map(|it| it.forced_brakes).sum::<u32>(),
        count(&|it| it.warnings.iter().any(|warning| warning.contains(DEFECT))),
    )
}

/// At most this many warnings are told in a line of the table.
const WARNINGS: usize = 3;
/// Types of lanelets that are told: no car belongs there.
const UNUSUAL: [&str; 6] = [
    "sidewalk",
    "bicycleLane",
    "busLane",
    "busStop",
    "shoulder",
    "parking",
];
/// A warning with these words tells a defect of the file's data.
const DEFECT: &str = "a defect of the data";

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
    /// Returns the file, and the planning problem if the file has several.
    fn title(&self) -> String {
        let Self {
            file,
            problem_number,
            problem_count,
            ..
        } = self;
        match (problem_count, self.problem) {
            (..=1, _) => file.clone(),
            (_, Some(id)) => format!("{file} problem {id}"),
            (_, None) => format!("{file} problem {problem_number} of {problem_count}"),
        }
    }

    /// Returns the name of the file of its solution.
    fn solution_name(&self) -> String {
        let stem = self.file.trim_end_matches(".xml");
        match (self.problem_count, self.problem) {
            (2.., Some(id)) => format!("solution_{stem}-{id}.xml"),
            // Without an id there is no solution.
            _ => format!("solution_{}", self.file),
        }
    }

    /// Returns a collision in words, with the defect of the other's data, if it has one.
    fn told(&self, collision: &Collision) -> String {
        let other = format!("obstacle {}:", collision.other);
        let is_its = |warning: &&String| warning.contains(DEFECT) && warning.contains(&other);
        let defect = self.warnings.iter().find(is_its);
        defect.map_or(collision.to_string(), |defect| {
            format!("{collision} ({defect})")
        })
    }

    /// Returns whether the vehicle caused a collision that RSS does not call unavoidable.
    fn caused(&self) -> bool {
        self.collision_by_ego && (self.rss.collisions.is_empty() || self.rss.avoidable() > 0)
    }

    /// Returns why the drive fails the judgement; `None` if it does not.
    fn objection(&self) -> Option<String> {
        let mut why = Vec::new();
        if self.caused() {
            why.push("a collision that the vehicle caused".to_owned());
            why.extend(self.rss.collisions.iter().map(|it| self.told(it)));
        }
        if self.excursion_m > 0.0 {
            why.push(format!("outside its lanes by {:.2} m", self.excursion_m));
        }
        (!why.is_empty()).then(|| format!("{}: {}", self.title(), why.join("; ")))
    }

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
        for collision in &self.rss.collisions {
            remark(true, self.told(collision));
        }
        remark(
            self.forced_brakes > 0,
            format!(
                "{} other(s) braked for the vehicle, up to {:.1} m/s²",
                self.forced_brakes, self.forced_brake_max
            ),
        );
        remark(
            self.invented_m > 0.0,
            format!(
                "{:.0} m past the end of the map, on road that is invented: straight on",
                self.invented_m
            ),
        );
        let types = self
            .lane_types
            .iter()
            .filter(|it| UNUSUAL.contains(&it.as_str()));
        let types: Vec<&str> = types.map(String::as_str).collect();
        remark(
            !types.is_empty(),
            format!("on lanelets of type {}", types.join(", ")),
        );
        for warning in self.warnings.iter().take(WARNINGS) {
            remark(true, warning.clone());
        }
        let more = self.warnings.len().saturating_sub(WARNINGS);
        remark(
            more > 0,
            format!("and {more} more warning(s), all in --json"),
        );
        remarks.join("; ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::OtherTraffic;
    use tandem_page::json::JsonOption;

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
            problem: None,
            duration: 1.0,
            seed: 1,
            jobs: None,
            json: JsonOption::default(),
            html: None,
            solutions: None,
            traffic: OtherTraffic::React,
            out: None,
        };
        let judged = files
            .iter()
            .flat_map(|file| drive::judge(&args, file, None).unwrap());
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

    /// Only a collision that RSS calls avoidable fails the drive; one that it did not see does too.
    #[test]
    fn an_unavoidable_collision_is_told_and_not_caused() {
        let hit = |avoidable| rss::Collision {
            at_s: 0.9,
            other: 7,
            danger_from_s: 0.0,
            gap_m: 7.8,
            safe_gap_m: 40.4,
            avoidable,
            broke: rss::Broke::Nobody,
        };
        for (collisions, told, column) in [
            (vec![], true, "caused"),
            (vec![hit(true), hit(false)], true, "caused"),
            (vec![hit(false)], false, "unavoidable"),
        ] {
            let mut judged = drive::refused("a.xml", String::new());
            (judged.collision, judged.collision_by_ego) = (true, true);
            judged.rss.collisions = collisions;
            assert_eq!(judged.objection().is_some(), told, "{column}");
            let counts = if told {
                "1 caused, 0 unavoidable"
            } else {
                "0 caused, 1 unavoidable"
            };
            let table = table(&[judged]);
            assert!(table.contains(column) && table.contains(counts), "{table}");
        }
    }
}
