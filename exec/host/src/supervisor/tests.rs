//! The table of the supervisor, row by row, and properties of any history.

use proptest::prelude::*;

use tandem_board::Duration;

use super::*;

const HEAD: &str = "version = 1\ninitial = \"one\"\nfallback = \"two\"\n";

fn process(name: &str, more: &str) -> String {
    format!("[[process]]\nname = {name:?}\nprogram = \"x\"\n{more}\n")
}

fn target(name: &str, processes: &[&str]) -> String {
    format!("[[target]]\nname = {name:?}\nprocesses = {processes:?}\n")
}

/// A supervisor, its time, and what it has done since the last look.
struct Bench {
    supervisor: Supervisor,
    now: Instant,
}

impl Bench {
    fn new(parts: &[String]) -> Self {
        let text = HEAD.to_owned() + &parts.concat();
        let manifest = Manifest::read(text.as_bytes()).unwrap();
        Self {
            supervisor: Supervisor::new(Arc::new(manifest)),
            now: Instant::from_ns(1_000_000),
        }
    }

    /// One process in target one, and nothing in target two.
    fn of_one(more: &str) -> Self {
        Self::new(&[
            process("p", more),
            target("one", &["p"]),
            target("two", &[]),
        ])
    }

    /// Returns the actions without what is told.
    fn on(&mut self, input: Input) -> Vec<Action> {
        let mut actions = self.supervisor.on_input(self.now, input);
        actions.retain(|action| !matches!(action, Action::Tell(_)));
        actions
    }

    fn after(&mut self, ms: u64) -> Vec<Action> {
        self.now += Duration::from_ms(ms);
        self.on(Input::Tick)
    }

    fn report(&mut self, report: ProcessReport) -> Vec<Action> {
        self.on(Input::Report(0, report))
    }

    fn checkpoint(&mut self, number: u32) -> Vec<Action> {
        self.report(ProcessReport::Checkpoint(number, self.now))
    }

    fn state(&self, at: usize) -> &'static str {
        self.supervisor.state_of(at).0
    }
}

const CRASH: ExitKind = ExitKind::Signal(11);
const START: [Action; 1] = [Action::Start(0)];
const TERMINATE: [Action; 1] = [Action::Terminate(0)];
const NOTHING: [Action; 0] = [];

#[test]
fn a_process_is_ready_by_its_report_its_start_or_its_end() {
    let rows = [
        (
            "ready = \"report\"",
            Input::Report(0, ProcessReport::Ready),
            "ready",
        ),
        ("ready = \"running\"", Input::Started(0), "ready"),
        (
            "ready = \"exit\"",
            Input::Ended(0, ExitKind::Code(0)),
            "finished",
        ),
    ];
    for (more, input, expected) in rows.clone() {
        for (_, other, _) in &rows {
            let mut bench = Bench::of_one(more);
            assert_eq!(bench.on(Input::Switch(0)), START);
            assert_eq!(bench.state(0), "starting");
            let is_right = *other == input;
            bench.on(other.clone());
            let reached = bench.supervisor.target() == (Some(0), true);
            assert_eq!(bench.state(0) == expected, is_right, "{more}: {other:?}");
            assert_eq!(reached, is_right, "{more}: {other:?}");
        }
    }
}

#[test]
fn a_dependent_waits_and_a_crash_does_not_touch_it() {
    let mut bench = Bench::new(&[
        process("p", "restart = { times = 1, pause = \"100ms\" }"),
        process("q", "after = [\"p\"]"),
        target("one", &["q"]),
        target("two", &[]),
    ]);
    assert_eq!(bench.on(Input::Switch(0)), START);
    assert_eq!(bench.on(Input::Report(1, ProcessReport::Ready)), NOTHING);
    assert_eq!(bench.report(ProcessReport::Ready), [Action::Start(1)]);
    bench.on(Input::Report(1, ProcessReport::Ready));
    assert_eq!(bench.supervisor.target(), (Some(0), true));
    assert_eq!(bench.on(Input::Ended(0, CRASH)), NOTHING);
    assert_eq!((bench.state(0), bench.state(1)), ("pausing", "ready"));
    assert_eq!(bench.after(99), NOTHING);
    assert_eq!(bench.after(1), START);
    // Both end in reverse order.
    bench.report(ProcessReport::Ready);
    assert_eq!(bench.on(Input::Stop), [Action::Terminate(1)]);
    assert_eq!(bench.on(Input::Ended(1, ExitKind::Signal(15))), TERMINATE);
    let done = [Action::End(Outcome::Done)];
    assert_eq!(bench.on(Input::Ended(0, ExitKind::Signal(15))), done);
    assert_eq!(bench.on(Input::Switch(0)), NOTHING);
}

/// E-6: what is not ready in time gets SIGTERM, then SIGKILL, then its restart.
#[test]
fn late_is_a_failure() {
    let mut bench = Bench::of_one("ready-within = \"10ms\"\nrestart = { times = 1 }");
    bench.on(Input::Switch(0));
    assert_eq!(
        bench.supervisor.next_tick(bench.now),
        Some(bench.now + Duration::from_ms(10))
    );
    assert_eq!(bench.after(9), NOTHING);
    assert_eq!(bench.after(1), TERMINATE);
    // Too late: it is told to end.
    bench.report(ProcessReport::Ready);
    assert_eq!(bench.state(0), "ending");
    assert_eq!(bench.after(999), NOTHING);
    assert_eq!(bench.after(1), [Action::Kill(0)]);
    assert_eq!(bench.after(1_000), NOTHING);
    assert_eq!(bench.on(Input::Ended(0, ExitKind::Signal(9))), START);
    assert_eq!(bench.supervisor.state_of(0), ("starting", 1));
}

/// E-6: restarts, then the fallback target, then the safe state.
#[test]
fn failures_lead_step_by_step_to_the_safe_state() {
    let mut bench = Bench::new(&[
        process("p", "restart = { times = 2 }"),
        target("one", &["p"]),
        target("two", &["p"]),
    ]);
    bench.on(Input::Switch(0));
    for target in [0, 1] {
        for restart in 0..=2 {
            assert_eq!(bench.supervisor.target().0, Some(target));
            assert_eq!(bench.supervisor.state_of(0), ("starting", restart));
            let actions = bench.on(Input::Ended(0, CRASH));
            let is_last = (target, restart) == (1, 2);
            let end = [Action::End(Outcome::SafeState(0))];
            assert_eq!(
                actions,
                if is_last { end } else { START },
                "{target} {restart}"
            );
        }
    }
}

/// A stop may overtake the news that a process could not be started.
#[test]
fn what_was_not_started_needs_no_end() {
    let mut bench = Bench::of_one("");
    bench.on(Input::Switch(0));
    assert_eq!(bench.on(Input::Stop), TERMINATE);
    let end = [Action::End(Outcome::Done)];
    assert_eq!(bench.on(Input::NotStarted(0, "x".to_owned())), end);
}

/// E-5: there is no fallback for state management.
#[test]
fn the_loss_of_state_management_is_unrecoverable() {
    let mut bench = Bench::of_one("state-management = true");
    bench.on(Input::Switch(0));
    let end = [Action::End(Outcome::NoStateManagement(0))];
    assert_eq!(bench.on(Input::NotStarted(0, "x".to_owned())), end);
}

#[test]
fn an_end_with_status_0_is_a_failure_unless_it_is_permitted() {
    for (more, how, expected) in [
        ("", ExitKind::Code(0), "failed"),
        ("may-end = true", ExitKind::Code(0), "finished"),
        ("may-end = true", ExitKind::Code(1), "failed"),
        ("may-end = true", ExitKind::Signal(15), "failed"),
    ] {
        let other = process("q", "");
        let parts = [
            process("p", more),
            other,
            target("one", &["p", "q"]),
            target("two", &["q"]),
        ];
        let mut bench = Bench::new(&parts);
        bench.on(Input::Switch(0));
        bench.report(ProcessReport::Ready);
        bench.on(Input::Ended(0, how));
        // The switch to the fallback forgets the failure.
        let state = if bench.supervisor.target().0 == Some(1) {
            "failed"
        } else {
            bench.state(0)
        };
        assert_eq!(state, expected, "{more} {how:?}");
    }
}

fn supervised(more: &str) -> Bench {
    let mut bench = Bench::of_one(more);
    bench.on(Input::Switch(0));
    bench.report(ProcessReport::Ready);
    bench
}

#[test]
fn alive_supervision_counts_the_reports_of_each_cycle() {
    let limits = "alive = { every = \"100ms\", least = 2, most = 3, tolerated = 1 }";
    // The numbers of reports in the cycles, and the cycle whose end is a failure.
    let rows: [(&[u32], Option<usize>); 5] = [
        (&[2, 3, 2, 3], None),
        (&[2, 1, 2, 4, 2], None),
        (&[2, 1, 1], Some(2)),
        (&[4, 4], Some(1)),
        (&[1, 4], Some(1)),
    ];
    for (cycles, expected) in rows {
        let mut bench = supervised(limits);
        let mut failed = None;
        for (cycle, count) in cycles.iter().enumerate() {
            for _ in 0..*count {
                bench.report(ProcessReport::Alive);
            }
            assert_eq!(bench.after(99), NOTHING);
            if bench.after(1) == TERMINATE {
                failed = Some(cycle);
            }
        }
        assert_eq!(failed, expected, "{cycles:?}");
    }
}

/// Time in which the launcher did not run is no silence of the process.
#[test]
fn a_launcher_that_is_late_does_not_judge() {
    let mut bench = supervised("alive = { every = \"100ms\" }");
    assert_eq!(bench.after(250), NOTHING);
    assert_eq!(bench.after(99), NOTHING);
    assert_eq!(bench.after(1), TERMINATE);
}

#[test]
fn a_process_that_says_it_ends_is_not_supervised() {
    let mut bench = supervised("alive = { every = \"100ms\" }\nmay-end = true");
    bench.report(ProcessReport::Stopping);
    assert_eq!(bench.after(100), NOTHING);
    assert_eq!(
        bench.on(Input::Ended(0, ExitKind::Code(0))),
        [Action::End(Outcome::Done)]
    );
}

#[test]
fn deadline_supervision_measures_between_two_checkpoints() {
    let limits = "deadlines = [{ from = 1, to = 2, least = \"10ms\", most = \"20ms\" }]";
    for (took_ms, fails) in [(9, true), (10, false), (20, false)] {
        let mut bench = supervised(limits);
        assert_eq!(bench.checkpoint(2), NOTHING, "no time runs yet");
        assert_eq!(bench.checkpoint(1), NOTHING);
        assert_eq!(bench.after(took_ms), NOTHING);
        assert_eq!(bench.checkpoint(2) == TERMINATE, fails, "{took_ms}");
    }
    // Without the second checkpoint the time alone tells.
    let mut bench = supervised(limits);
    bench.checkpoint(1);
    assert_eq!(bench.after(20), NOTHING);
    let next = bench.supervisor.next_tick(bench.now).unwrap();
    assert_eq!(next.since(bench.now), Duration::from_ns(1));
    assert_eq!(bench.after(1), TERMINATE);
    // The time of the process counts, not that of the launcher.
    let mut bench = supervised(limits);
    bench.checkpoint(1);
    let then = bench.now + Duration::from_ms(15);
    bench.now += Duration::from_ms(50);
    assert_eq!(bench.report(ProcessReport::Checkpoint(2, then)), NOTHING);
}

#[test]
fn logical_supervision_knows_the_order_of_checkpoints() {
    let order = "logical = { first = [1, 2], next = [[1, 2], [2, 3], [3, 1]] }";
    for (numbers, fails) in [
        (&[1, 2, 3, 1, 2][..], false),
        (&[2, 3], false),
        (&[3], true),
        (&[1, 3], true),
        (&[1, 1], true),
        (&[1, 2, 3, 1, 4], true),
    ] {
        let mut bench = supervised(order);
        let mut failed = vec![];
        for number in numbers {
            failed.push(bench.checkpoint(*number) == TERMINATE);
        }
        assert_eq!(failed.pop(), Some(fails), "{numbers:?}");
        assert!(!failed.contains(&true), "{numbers:?}");
    }
}

#[test]
fn inputs_about_what_does_not_exist_do_nothing() {
    let mut bench = Bench::of_one("");
    bench.on(Input::Switch(0));
    for input in [
        Input::Started(7),
        Input::NotStarted(7, String::new()),
        Input::Report(7, ProcessReport::Ready),
        Input::Ended(7, CRASH),
        Input::Switch(7),
        Input::Tick,
    ] {
        assert_eq!(bench.on(input.clone()), NOTHING, "{input:?}");
        assert_eq!(bench.state(0), "starting");
    }
}

/// What may happen to one of the processes, or to all.
#[derive(Clone, Debug)]
enum Step {
    Ready(usize),
    End(usize, i32),
    Switch(usize),
    Wait(u64),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (0..5_usize).prop_map(Step::Ready),
        3 => (0..5_usize, 0..2).prop_map(|(at, code)| Step::End(at, code)),
        1 => (0..3_usize).prop_map(Step::Switch),
        3 => (0..400_u64).prop_map(Step::Wait),
    ]
}

/// What the world knows: which processes exist, what was done to them.
struct World {
    bench: Bench,
    exists: [bool; 5],
    ready: [bool; 5],
    killed: [bool; 5],
    starts: [u32; 5],
    outcome: Option<Outcome>,
}

impl World {
    fn new() -> Self {
        let parts = [
            process("a", "restart = { times = 1, pause = \"20ms\" }"),
            process(
                "b",
                "after = [\"a\"]\nready-within = \"100ms\"\nstop-within = \"50ms\"",
            ),
            process(
                "c",
                "after = [\"a\", \"b\"]\nrestart = { times = 3 }\nmay-end = true",
            ),
            process("d", "ready = \"exit\"\nafter = [\"a\"]"),
            process(
                "e",
                "ready = \"running\"\nrestart = { times = 2, pause = \"5ms\" }",
            ),
            target("one", &["c", "e"]),
            target("two", &["d", "e"]),
            target("three", &["b"]),
        ];
        Self {
            bench: Bench::new(&parts),
            exists: [false; 5],
            ready: [false; 5],
            killed: [false; 5],
            starts: [0; 5],
            outcome: None,
        }
    }

    /// Gives an input, and checks each action.
    fn on(&mut self, input: Input) {
        assert!(self.outcome.is_none());
        let mut inputs = vec![input];
        while let Some(input) = inputs.pop() {
            for action in self.bench.supervisor.on_input(self.bench.now, input) {
                self.check(&action);
                if let Action::Start(at) = action {
                    inputs.push(Input::Started(at));
                }
            }
        }
    }

    fn check(&mut self, action: &Action) {
        match *action {
            Action::Start(at) => {
                assert!(!self.exists[at], "two of one process");
                let manifest = Arc::clone(&self.bench.supervisor.manifest);
                let plan = &manifest.processes[at];
                let dependencies = &plan.dependencies;
                assert!(
                    dependencies.iter().all(|it| self.ready[*it]),
                    "{at} starts too early"
                );
                self.starts[at] += 1;
                assert!(
                    self.starts[at] <= 1 + plan.restart.times,
                    "too many restarts of {at}"
                );
                self.exists[at] = true;
                self.killed[at] = false;
                self.ready[at] = plan.ready == ReadyBy::Running;
            }
            Action::Terminate(at) => assert!(self.exists[at], "SIGTERM to nothing"),
            Action::Kill(at) => {
                assert!(self.exists[at], "SIGKILL to nothing");
                self.killed[at] = true;
            }
            // Each switch gives each process a new start, and its restarts.
            Action::Tell(LaunchEvent::Switching { .. }) => self.starts = [0; 5],
            Action::Tell(_) => {}
            Action::End(outcome) => self.outcome = Some(outcome),
        }
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Ready(at) if self.exists[at] => {
                let by_report = self.bench.supervisor.manifest.processes[at].ready;
                let is_starting = self.bench.state(at) == "starting";
                if by_report == ReadyBy::Report && is_starting {
                    self.ready[at] = true;
                }
                self.on(Input::Report(at, ProcessReport::Ready));
            }
            Step::End(at, code) if self.exists[at] => {
                self.exists[at] = false;
                self.ready[at] = false;
                let before = self.bench.state(at);
                let plan = &self.bench.supervisor.manifest.processes[at];
                let may = plan.ready == ReadyBy::Exit || before == "ready" && plan.may_end;
                self.ready[at] = may && code == 0 && before != "ending";
                self.on(Input::Ended(at, ExitKind::Code(code)));
            }
            Step::Switch(to) => self.on(Input::Switch(to)),
            Step::Wait(ms) => {
                self.bench.now += Duration::from_ms(ms);
                self.on(Input::Tick);
            }
            _ => {}
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// E-6: whatever happens: no start before all dependencies are ready, no second process beside
    /// the first, never more restarts than permitted; and a stop ends all, also processes that do
    /// not obey.
    #[test]
    fn any_history_is_orderly_and_ends(steps in prop::collection::vec(step(), 0..60)) {
        let mut world = World::new();
        world.on(Input::Switch(0));
        for step in &steps {
            if world.outcome.is_some() {
                break;
            }
            world.step(step);
        }
        if world.outcome.is_none() {
            world.on(Input::Stop);
        }
        // From here on, processes end by SIGKILL only.
        for _ in 0..20 {
            for at in 0..5 {
                if world.killed[at] && world.exists[at] && world.outcome.is_none() {
                    world.step(&Step::End(at, 9));
                }
            }
            if world.outcome.is_some() {
                break;
            }
            let now = world.bench.now;
            world.bench.now = world.bench.supervisor.next_tick(now).expect("something is due");
            world.on(Input::Tick);
        }
        prop_assert!(world.outcome.is_some(), "it does not end");
        if world.outcome == Some(Outcome::Done) {
            prop_assert_eq!(world.exists, [false; 5]);
        }
    }
}
