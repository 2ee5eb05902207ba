//! The 16 scenarios of S-CORE's lifecycle, by their names.

use std::os::unix::fs::MetadataExt as _;

use crate::rig::{Rig, driver, is_alive, process, target};

pub(crate) const ALL: &[(&str, fn())] = &[
    ("complex_monitoring", complex_monitoring),
    ("crash_ignores_dependents", crash_ignores_dependents),
    ("crash_on_startup", crash_on_startup),
    (
        "fallback_to_same_target_restarts",
        fallback_to_same_target_restarts,
    ),
    (
        "incorrect_config_non_reporting",
        incorrect_config_non_reporting,
    ),
    ("parallel_launch", parallel_launch),
    ("process_complex_rep_failure", process_complex_rep_failure),
    ("process_crash_monitoring", process_crash_monitoring),
    ("process_fd_leak", process_fd_leak),
    ("process_launch_args", process_launch_args),
    ("process_simple_rep_failure", process_simple_rep_failure),
    ("process_wrong_binary_failure", process_wrong_binary_failure),
    ("sandbox_options", sandbox_options),
    ("shutdown_signal", shutdown_signal),
    ("smoke", smoke),
    ("switch_run_target", switch_run_target),
];

/// The first lines of a manifest whose failures lead to the target `fallback`.
fn head() -> String {
    "version = 1\ninitial = \"startup\"\nfallback = \"fallback\"\n".to_owned()
}

/// The process that shows that the fallback target runs, and the targets that all have.
fn tail() -> String {
    process("verification", &["append:fallback-ran"], "ready = \"exit\"")
        + &target("startup", &["driver"])
        + &target("fallback", &["driver", "verification"])
        + &target("off", &[])
}

/// E-6: a process that stops saying that it is alive is ended, and the fallback target runs.
fn complex_monitoring() {
    let steps = ["ready", "beat:15", "append:beaten", "pause"];
    let alive = "alive = { every = \"1s\", least = 1, most = 20 }";
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:monitored", "wait:fallback-ran"]),
        process("beating", &steps, alive),
        tail(),
        target("monitored", &["driver", "beating"]),
    ]);
    rig.end_well();
    assert!(
        rig.has("beaten"),
        "it was ended while it was alive: {}",
        rig.story()
    );
    assert_eq!(rig.events(&["beating: it was alive 0 times"]).len(), 1);
}

/// E-6: the crash of a process does not restart those that depend on it.
fn crash_ignores_dependents() {
    let crashing = [
        "ready",
        "wait:dependent",
        "crash-times:1",
        "append:normal",
        "pause",
    ];
    let dependent = [
        "append:dependent",
        "ready",
        "wait:normal",
        "lines:dependent=1",
        "term",
    ];
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:both", "wait:normal", "sleep:50", "lines:dependent=1"]),
        process("crashing", &crashing, "restart = { times = 1 }"),
        process("dependent", &dependent, "after = [\"crashing\"]"),
        tail(),
        target("both", &["driver", "dependent"]),
    ]);
    rig.end_well();
    assert!(!rig.has("fallback-ran"));
}

/// E-6: a process may crash before it is ready as often as its manifest says, and no more.
fn crash_on_startup() {
    for crashes in [2, 3] {
        let steps = [&format!("crash-times:{crashes}"), "ready", "pause"];
        let mut rig = Rig::start(&[
            head(),
            driver(&["to:crashing", "absent:fallback-ran"]),
            process(
                "crashing",
                &steps,
                &format!("restart = {{ times = {crashes} }}"),
            ),
            tail(),
            target("crashing", &["driver", "crashing"]),
        ]);
        rig.end_well();
        assert_eq!(rig.text("crashes").lines().count(), crashes + 1);
    }
    let mut rig = Rig::start(&[
        head(),
        driver(&["not-to:crashing", "wait:fallback-ran"]),
        process("crashing", &["crash-times:1", "ready", "pause"], ""),
        tail(),
        target("crashing", &["driver", "crashing"]),
    ]);
    rig.end_well();
    assert_eq!(rig.text("crashes").lines().count(), 1);
}

/// E-6: a process that crashed is started afresh if the fallback target holds it, too.
fn fallback_to_same_target_restarts() {
    let steps = [
        "ready",
        "sleep:50",
        "crash-times:1",
        "append:normal",
        "pause",
    ];
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:crashing", "wait:normal"]),
        process("crashing", &steps, ""),
        target("startup", &["driver"]),
        target("crashing", &["driver", "crashing"]),
        target("fallback", &["driver", "crashing"]),
        target("off", &[]),
    ]);
    rig.end_well();
    assert_eq!(rig.events(&["next: fallback"]).len(), 1, "{}", rig.story());
}

/// A process that reports, but should not by its manifest, is not disturbed by that.
fn incorrect_config_non_reporting() {
    let steps = [
        "no-variable:NOTIFY_SOCKET",
        "ready",
        "alive",
        "checkpoint:3",
        "append:reported",
    ];
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:native", "wait:reported"]),
        process("native", &steps, "ready = \"running\"\nmay-end = true"),
        tail(),
        target("native", &["driver", "native"]),
    ]);
    rig.end_well();
    assert!(!rig.has("fallback-ran"));
}

/// Processes that do not depend on each other start at the same time. Each is ready only when all
/// have started: one after the other would never be.
fn parallel_launch() {
    let one = |name: &str| {
        let own = format!("append:started-{name}");
        let steps = [
            &own,
            "wait:started-a",
            "wait:started-b",
            "wait:started-c",
            "ready",
            "pause",
        ];
        process(name, &steps, "")
    };
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:parallel", "to:startup"]),
        one("a"),
        one("b"),
        one("c"),
        tail(),
        target("parallel", &["driver", "a", "b", "c"]),
    ]);
    rig.end_well();
    assert!(!rig.has("fallback-ran"));
}

/// E-6: a process that is not ready in time is ended, and the fallback target runs. Here it says
/// other things in time: status, checkpoints, that it is alive.
fn process_complex_rep_failure() {
    let talk = ["say:STATUS=working", "alive", "checkpoint:1"];
    let supervised = "alive = { every = \"50s\" }\nlogical = { first = [1], next = [] }\n";
    not_ready_in_time(&talk, supervised);
}

/// E-6: a process that is not ready in time is ended, and the fallback target runs.
fn process_simple_rep_failure() {
    not_ready_in_time(&[], "");
}

fn not_ready_in_time(talk: &[&str], supervised: &str) {
    let in_time = [talk, &["sleep:50", "ready", "pause"]].concat();
    let late = [talk, &["append:late", "pause"]].concat();
    let limits = format!("{supervised}ready-within = \"500ms\"");
    let late = process("late", &late, "").replace("ready-within = \"50s\"", &limits);
    let mut rig = Rig::start(&[
        head(),
        driver(&[
            "to:in-time",
            "absent:fallback-ran",
            "not-to:late",
            "wait:fallback-ran",
        ]),
        process("in-time", &in_time, supervised),
        late,
        tail(),
        target("in-time", &["driver", "in-time"]),
        target("late", &["driver", "late"]),
    ]);
    rig.end_well();
    assert_eq!(
        rig.events(&["late: it was not ready within 500 ms"]).len(),
        1
    );
}

/// E-6: the unexpected end of a process at run time leads to the fallback target.
fn process_crash_monitoring() {
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:crashing", "append:reached", "wait:fallback-ran"]),
        process("crashing", &["ready", "wait:reached", "abort"], ""),
        tail(),
        target("crashing", &["driver", "crashing"]),
    ]);
    rig.end_well();
    assert_eq!(rig.events(&["crashing: it ended: signal: 6"]).len(), 1);
}

/// No process inherits a descriptor of the launcher, and a report leaves none open.
fn process_fd_leak() {
    let native = ["descriptors", "append:native-done"];
    let reporting = [
        "descriptors",
        "ready",
        "descriptors",
        "append:reporting-done",
        "pause",
    ];
    let mut rig = Rig::start(&[
        head(),
        driver(&[
            "descriptors",
            "to:all",
            "descriptors",
            "wait:native-done",
            "wait:reporting-done",
        ]),
        process("native", &native, "ready = \"exit\""),
        process("reporting", &reporting, ""),
        tail(),
        target("all", &["driver", "native", "reporting"]),
    ]);
    rig.end_well();
}

/// A process gets the arguments and the environment of its manifest, and no others.
fn process_launch_args() {
    let steps = [
        "program",
        "argument:two words, \"quoted\"",
        "variable:VEHICLE=tandem",
        "no-variable:HOME",
        "append:checked",
        "--",
        "two words, \"quoted\"",
    ];
    let more = "ready = \"exit\"\nenvironment = { VEHICLE = \"tandem\" }";
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:launched", "exists:checked"]),
        process("launched", &steps, more),
        tail(),
        target("launched", &["driver", "launched"]),
    ]);
    rig.end_well();
}

/// E-6: a program that is not there fails its run target.
fn process_wrong_binary_failure() {
    let missing = "[[process]]\nname = \"missing\"\nprogram = \"no/such/program\"\n".to_owned();
    let mut rig = Rig::start(&[
        head(),
        driver(&["not-to:missing", "wait:fallback-ran"]),
        missing,
        tail(),
        target("missing", &["driver", "missing"]),
    ]);
    rig.end_well();
    assert_eq!(
        rig.events(&["missing: it did not start", "No such file"])
            .len(),
        1
    );
}

/// User, groups, folder, CPUs, priority and limits are those of the manifest; what the machine does
/// not grant is told.
fn sandbox_options() {
    let is_root = rustix::process::geteuid().is_root();
    let user = "uid = 1234\ngid = 2345\ngroups = [3456, 4567]\n";
    let more = "ready = \"exit\"\ndirectory = \"inner\"\ncpus = [0]\npolicy = \"fifo\"\n\
        priority = 7\nlimits = { open-files = 32, core = 0, memory = 100000000 }\n";
    let more = if is_root {
        format!("{user}{more}")
    } else {
        more.to_owned()
    };
    let placed = [
        "copy:/proc/self/status=status",
        "copy:/proc/self/limits=limits",
        "copy:/proc/self/stat=stat",
        "append:written",
    ];
    let mut rig = Rig::prepare(&[
        head(),
        driver(&["to:placed"]),
        process("placed", &placed, &more),
        tail(),
        target("placed", &["driver", "placed"]),
    ]);
    let inner = rig.path("inner");
    std::fs::create_dir(&inner).unwrap();
    let all = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    std::fs::set_permissions(&inner, all).unwrap();
    rig.launch(&[]);
    rig.end_well();
    let status = rig.text("inner/status");
    let field = |name: &str| {
        let line = status
            .lines()
            .find_map(|line| line.strip_prefix(name))
            .unwrap_or_default();
        line.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    assert_eq!(field("Cpus_allowed_list:"), "0", "{status}");
    let limits = rig.text("inner/limits");
    let has = |name: &str, value: &str| {
        let mut lines = limits.lines().filter(|line| line.starts_with(name));
        lines.any(|line| line.split_whitespace().filter(|it| *it == value).count() == 2)
    };
    assert!(has("Max open files", "32"), "{limits}");
    assert!(has("Max core file size", "0"), "{limits}");
    assert!(has("Max data size", "100000000"), "{limits}");
    // Fields 40 and 41, the priority and the policy (1: SCHED_FIFO). proc(5)
    let stat = rig.text("inner/stat");
    let fields: Vec<_> = stat
        .rsplit_once(')')
        .unwrap()
        .1
        .split_whitespace()
        .skip(37)
        .collect();
    let is_granted = rig.events(&["placed: not granted", "policy"]).is_empty();
    assert_eq!(
        fields[..2] == ["7", "1"],
        is_granted,
        "{stat}: {}",
        rig.story()
    );
    if is_root {
        assert_eq!(field("Uid:"), "1234 1234 1234 1234");
        assert_eq!(field("Gid:"), "2345 2345 2345 2345");
        assert_eq!(field("Groups:"), "3456 4567");
        let written = std::fs::metadata(rig.path("inner/written")).unwrap();
        assert_eq!((written.uid(), written.gid()), (1234, 2345));
    }
}

/// A process that does not end by SIGTERM is killed after its time.
fn shutdown_signal() {
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:running", "to:startup", "lines:termed=1"]),
        process(
            "stubborn",
            &["catch-term:termed"],
            "stop-within = \"300ms\"",
        ),
        tail(),
        target("running", &["driver", "stubborn"]),
    ]);
    rig.end_well();
    assert!(!is_alive(rig.pids("termed")[0]));
}

/// Start, two switches of the run target, end.
fn smoke() {
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:running", "to:startup"]),
        process("process", &["ready", "pause"], ""),
        tail(),
        target("running", &["driver", "process"]),
    ]);
    rig.end_well();
    assert_eq!(rig.events(&["process: ready"]).len(), 1);
    assert!(!rig.has("fallback-ran"));
}

/// Processes start after what they depend on is ready, and end before it. A process of both targets
/// runs on.
fn switch_run_target() {
    let a = [
        "exists:b-ready",
        "append:a-started",
        "term",
        "absent:b-ended",
        "append:a-ended",
    ];
    let b = [
        "sleep:50",
        "absent:a-started",
        "append:b-ready",
        "term",
        "exists:a-ended",
        "append:b-ended",
    ];
    let d = ["append:d-started", "term", "append:d-ended"];
    let e = ["append:e-started", "term", "append:e-ended"];
    let steps = [
        "to:first",
        "exists:a-started",
        "exists:d-started",
        "absent:e-started",
        "to:second",
        "exists:a-ended",
        "exists:b-ended",
        "exists:e-started",
        "absent:d-ended",
        "lines:d-started=1",
        "to:startup",
        "exists:d-ended",
        "exists:e-ended",
    ];
    let mut rig = Rig::start(&[
        head(),
        driver(&steps),
        process("a", &a, "after = [\"b\"]\nstop-within = \"50s\""),
        process("b", &b, "stop-within = \"50s\""),
        process("d", &d, "stop-within = \"50s\""),
        process("e", &e, "stop-within = \"50s\""),
        tail(),
        target("first", &["driver", "a", "d"]),
        target("second", &["driver", "d", "e"]),
    ]);
    rig.end_well();
}
