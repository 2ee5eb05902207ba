//! The simulated board passes the conformance suite, and the suite finds every defect of a board.
#![allow(clippy::unwrap_used, reason = "all of it is a test")]

mod bent;

use bent::{Bent, Common, Defect};
use std::collections::BTreeSet;
use std::fmt;
use std::sync::{Arc, Mutex};
use tandem_board::{Board, CoreAddress, Duration, Identity, Instant, SystemId};
use tandem_board_conformance::{
    Case, CaseFailure, CaseOutcome, CasePart, Rig, Setting, Summary, case_of, cases, run_all,
    run_role,
};
use tandem_board_sim::{Config, Order, SimPair, SystemEventKind, blocking};

/// Virtual time after which a case is considered hung: longer than a role's time limits.
const HANGS_AFTER: Duration = Duration::from_ms(60_000);

/// Runs each case that `takes` accepts on a separate pair, each role as a blocking core.
struct SimRig<'a> {
    config: Config,
    defect: Option<Defect>,
    takes: &'a dyn Fn(&str) -> bool,
}

/// Why a role failed.
#[derive(Debug, PartialEq)]
enum Fault {
    Failed(CoreAddress, CaseFailure),
    Hung,
    Reset(SystemId),
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed(place, failure) => write!(f, "{place}: {failure}"),
            Self::Hung => f.write_str("a role does not end"),
            Self::Reset(system) => write!(f, "system {system} was reset"),
        }
    }
}

type Results = Arc<Mutex<Vec<Option<Result<(), CaseFailure>>>>>;

fn part_of(identity: Identity, parts: &[CasePart<Bent>]) -> Option<usize> {
    parts
        .iter()
        .position(|part| part.place == identity.address())
}

impl Rig for SimRig<'_> {
    type Board = Bent;
    type Fault = Fault;

    fn takes(&self, case: &Case<Bent>) -> bool {
        (self.takes)(case.name)
    }

    fn play(&mut self, number: usize, case: &Case<Bent>) -> Result<(), Fault> {
        let watchdog = case.setting.watches();
        let suspends = case.setting == Setting::Suspends;
        let config = Config {
            watchdog,
            ..self.config.clone()
        };
        let results: Results = Arc::new(Mutex::new(vec![None; case.parts.len()]));
        let (parts, reported) = (case.parts, Arc::clone(&results));
        let (defect, common) = (self.defect, Arc::new(Common::new(self.defect)));
        let mut pair = SimPair::new(config, move |board| {
            let Some(index) = part_of(board.identity(), parts) else {
                return Box::new(|_| Instant::NEVER);
            };
            let (reported, common) = (Arc::clone(&reported), Arc::clone(&common));
            blocking(board, move |board| {
                let board = Bent::new(board, defect, &common);
                let result = board.play(|board| run_role(number, index, board));
                reported.lock().unwrap()[index] = Some(result);
            })
        });
        SystemId::ALL
            .into_iter()
            .for_each(|system| pair.power_on(system));
        let reset = |pair: &SimPair| {
            let plays = |system| parts.iter().any(|part| part.place.system == system);
            let events = pair.events().into_iter();
            let mut resets = events.filter(|event| matches!(event.kind, SystemEventKind::Reset(_)));
            let reset = resets.find(|event| plays(event.system));
            reset
                .filter(|_| !case.setting.restarts())
                .map(|event| event.system)
        };
        let hung = pair.run_while(Instant::ORIGIN + HANGS_AFTER, |pair| {
            let results = results.lock().unwrap();
            let failed = results.iter().any(|result| matches!(result, Some(Err(_))));
            let awaited = |(part, result): (&CasePart<Bent>, &Option<_>)| {
                result.is_none() && !(suspends && part.place.system == SystemId::A)
            };
            !failed && reset(pair).is_none() && parts.iter().zip(results.iter()).any(awaited)
        });
        for (part, result) in parts.iter().zip(results.lock().unwrap().iter()) {
            if let Some(Err(failure)) = result {
                return Err(Fault::Failed(part.place, *failure));
            }
        }
        match reset(&pair) {
            Some(system) => Err(Fault::Reset(system)),
            None if hung => Err(Fault::Hung),
            None => Ok(()),
        }
    }
}

fn config() -> Config {
    Config {
        look_at_clock: Duration::from_us(20),
        network: Some(Duration::from_us(5)),
        ..Config::default()
    }
}

fn run(config: Config) -> (Summary, Vec<String>) {
    run_some(config, None, &|_| true)
}

/// Runs the cases whose names `takes` accepts.
fn run_some(
    mut config: Config,
    defect: Option<Defect>,
    takes: &dyn Fn(&str) -> bool,
) -> (Summary, Vec<String>) {
    if let Some(defect) = defect {
        defect.configure(&mut config);
    }
    let mut failed = Vec::new();
    let mut rig = SimRig {
        config,
        defect,
        takes,
    };
    let summary = run_all(&mut rig, |case, outcome| {
        if let CaseOutcome::Failed(fault) = outcome {
            failed.push(format!("{}: {fault}", case.name));
        }
    });
    (summary, failed)
}

/// T-BOOT-2, among other contracts: core 0 starts alone and releases the other cores.
#[test]
fn the_simulated_board_passes() {
    let (summary, failed) = run(config());
    assert_eq!(failed, Vec::<String>::new());
    assert!(summary.passed > 30);
    assert_eq!(summary.skipped, 0);
}

#[test]
fn the_simulated_board_passes_in_any_order_of_cores() {
    for seed in 0..5 {
        let (_, failed) = run(Config {
            seed,
            order: Order::Shuffled,
            ..config()
        });
        assert_eq!(failed, Vec::<String>::new(), "seed {seed}");
    }
}

/// Cases that no defect makes fail, because they prove that nothing crashes, or prove a property
/// that every board in safe Rust has.
const CANNOT_FAIL_HERE: [&str; 1] = ["trace-and-lamp"];

/// Each defect makes some case fail, and each case fails for some defect. A case that has failed
/// for one defect runs again only for defects that no other case finds or that this case must find.
#[test]
fn conformance_catches_defects() {
    let mut fallible = BTreeSet::new();
    for defect in Defect::all() {
        let run = |takes: &dyn Fn(&str) -> bool| run_some(config(), Some(defect), takes).1;
        let must_find = match defect {
            Defect::FaultWithoutEffect(fault) => Some(case_of(fault)),
            _ => None,
        };
        let mut failed = run(&|case| !fallible.contains(case) || must_find == Some(case));
        if failed.is_empty() {
            failed = run(&|case| fallible.contains(case));
        }
        assert!(!failed.is_empty(), "the suite does not find {defect:?}");
        if let Some(case) = must_find {
            assert!(failed[0].starts_with(case), "{case} does not find it");
        }
        println!("{defect:?}:\n    {}", failed.join("\n    "));
        fallible.extend(
            failed
                .iter()
                .filter_map(|line| Some(line.split_once(':')?.0.to_string())),
        );
    }
    let infallible: Vec<_> = cases::<Bent>()
        .iter()
        .map(|case| case.name)
        .filter(|name| !fallible.contains(*name))
        .collect();
    assert_eq!(infallible, CANNOT_FAIL_HERE, "cases that never fail");
}

#[test]
fn names_of_cases_are_unique() {
    let names: BTreeSet<_> = cases::<Bent>().iter().map(|case| case.name).collect();
    assert_eq!(names.len(), cases::<Bent>().len());
}
