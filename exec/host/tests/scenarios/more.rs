//! Further scenarios: what a process must not do, and how a platform is switched and ended.

use std::process::Command;

use rustix::process::{Resource, Signal};
use tandem_board_host::spawn::{self, Placement};

use crate::rig::{Rig, driver, is_alive, process, signal, target};

pub(crate) const ALL: &[(&str, fn())] = &[
    ("grandchild_does_not_escape", grandchild_does_not_escape),
    (
        "report_of_a_child_is_not_believed",
        report_of_a_child_is_not_believed,
    ),
    (
        "only_state_management_switches",
        only_state_management_switches,
    ),
    (
        "deadline_and_order_of_checkpoints",
        deadline_and_order_of_checkpoints,
    ),
    (
        "two_launchers_of_one_manifest",
        two_launchers_of_one_manifest,
    ),
    ("end_in_reverse_order", end_in_reverse_order),
    ("second_request_kills", second_request_kills),
    ("state_is_shown", state_is_shown),
    ("what_is_not_granted_is_told", what_is_not_granted_is_told),
    ("output_goes_to_its_file", output_goes_to_its_file),
    ("memory_is_limited", memory_is_limited),
];

fn head() -> String {
    "version = 1\ninitial = \"startup\"\nfallback = \"fallback\"\n".to_owned()
}

fn tail() -> String {
    process("verification", &["append:fallback-ran"], "ready = \"exit\"")
        + &target("startup", &["driver"])
        + &target("fallback", &["driver", "verification"])
        + &target("off", &[])
}

/// What a process has started ends with it, also in a session of its own, and also if it ignores
/// SIGTERM.
fn grandchild_does_not_escape() {
    let steps = ["leave-child:child", "ready", "pause"];
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:with-child", "to:startup", "append:stopped", "wait:go"]),
        process("parent", &steps, ""),
        tail(),
        target("with-child", &["driver", "parent"]),
    ]);
    rig.wait_for("stopped");
    let child = rig.pids("child")[0];
    rig.wait_until("the child's end", |_| !is_alive(child));
    std::fs::write(rig.path("go"), "").unwrap();
    rig.end_well();
}

/// E-6: only the process itself can say that it is ready.
fn report_of_a_child_is_not_believed() {
    let liar = process("liar", &["child-says:READY=1", "append:lied", "pause"], "");
    let mut rig = Rig::start(&[
        head(),
        driver(&["not-to:lie", "exists:lied", "wait:fallback-ran"]),
        liar.replace("ready-within = \"50s\"", "ready-within = \"2s\""),
        tail(),
        target("lie", &["driver", "liar"]),
    ]);
    rig.end_well();
    assert!(rig.events(&["liar: ready"]).is_empty());
}

/// A process that is not state management cannot switch the run target, even if it knows the
/// socket.
fn only_state_management_switches() {
    let steps = [
        "ready",
        "wait:driver-pid",
        "steal-control:driver-pid",
        "append:tried",
        "pause",
    ];
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:both", "append:driver-pid", "wait:tried"]),
        process("thief", &steps, ""),
        tail(),
        target("both", &["driver", "thief"]),
    ]);
    rig.end_well();
}

/// E-6: a checkpoint too late, and one out of order, are failures.
fn deadline_and_order_of_checkpoints() {
    let deadline = "deadlines = [{ from = 1, to = 2, most = \"400ms\" }]";
    let order = "logical = { first = [1], next = [[1, 2], [2, 1]] }";
    let late = ["ready", "checkpoint:1", "pause"];
    let wrong = [
        "ready",
        "checkpoint:1",
        "checkpoint:2",
        "checkpoint:1",
        "checkpoint:1",
        "pause",
    ];
    for (steps, more, words) in [
        (&late[..], deadline, "from checkpoint 1 to 2"),
        (&wrong[..], order, "checkpoint 1 is out of order"),
    ] {
        let mut rig = Rig::start(&[
            head(),
            driver(&["to:checked", "wait:fallback-ran"]),
            process("checked", steps, more),
            tail(),
            target("checked", &["driver", "checked"]),
        ]);
        rig.end_well();
        assert_eq!(rig.events(&[words]).len(), 1, "{}", rig.story());
    }
    // In time and in order, nothing happens.
    let right = [
        "ready",
        "checkpoint:1",
        "checkpoint:2",
        "checkpoint:1",
        "checkpoint:2",
    ];
    let steps = [&right[..], &["append:passed", "pause"]].concat();
    let both = format!("{}\n{order}", deadline.replace("400ms", "50s"));
    let mut rig = Rig::start(&[
        head(),
        driver(&["to:checked", "wait:passed", "sleep:100"]),
        process("checked", &steps, &both),
        tail(),
        target("checked", &["driver", "checked"]),
    ]);
    rig.end_well();
    assert!(!rig.has("fallback-ran"), "{}", rig.story());
}

/// The second launcher of a manifest is refused, and does no harm to the first.
fn two_launchers_of_one_manifest() {
    let mut rig = Rig::start(&[head(), driver(&["append:reached", "wait:go"]), tail()]);
    rig.wait_for("reached");
    let mut second = Command::new(std::env::current_exe().unwrap());
    let second = second.arg("guardian").arg(rig.manifest()).output().unwrap();
    assert_eq!(second.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&second.stderr).contains("runs already"));
    std::fs::write(rig.path("go"), "").unwrap();
    rig.end_well();
    assert_eq!(rig.events(&["driver: started"]).len(), 1);
}

/// SIGTERM ends all, in reverse order of dependency, and is a success.
fn end_in_reverse_order() {
    let a = ["term", "absent:b-ended", "append:a-ended"];
    let b = ["term", "exists:a-ended", "append:b-ended"];
    let mut rig = Rig::start(&[
        "version = 1\ninitial = \"all\"\n".to_owned(),
        process("a", &a, "after = [\"b\"]\nstop-within = \"50s\""),
        process("b", &b, "stop-within = \"50s\""),
        target("all", &["a"]),
    ]);
    rig.wait_until("all ready", |rig| !rig.events(&["all ready"]).is_empty());
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
    assert!(rig.has("b-ended") && !rig.has("error"), "{}", rig.story());
}

/// The second request to end does not wait for a process that is slow.
fn second_request_kills() {
    let slow = process("slow", &["catch-term:termed"], "stop-within = \"10min\"");
    let mut rig = Rig::start(&[
        "version = 1\ninitial = \"all\"\n".to_owned(),
        slow,
        target("all", &["slow"]),
    ]);
    rig.wait_until("all ready", |rig| !rig.events(&["all ready"]).is_empty());
    rig.stop();
    rig.wait_for("termed");
    rig.stop();
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
}

/// `ps` shows state, restarts and status; a target that does not exist is refused by name.
fn state_is_shown() {
    let steps = ["say:STATUS=42 frames", "ready", "pause"];
    let mut rig = Rig::start(&[
        "version = 1\ninitial = \"all\"\n".to_owned(),
        process("shown", &steps, "restart = { times = 1 }"),
        target("all", &["shown"]),
    ]);
    rig.wait_until("all ready", |rig| {
        rig.ask("ps").contains("\"reached\":true")
    });
    let state: serde_json::Value = serde_json::from_str(&rig.ask("ps")).unwrap();
    let shown = &state["processes"][0];
    assert_eq!(
        (&state["target"], &shown["state"]),
        (&"all".into(), &"ready".into())
    );
    assert_eq!(
        (&shown["status"], &shown["restarts"]),
        (&"42 frames".into(), &0.into())
    );
    signal(shown["pid"].as_i64().unwrap() as i32, Signal::KILL);
    rig.wait_until("a restart", |rig| rig.ask("ps").contains("\"restarts\":1"));
    assert_eq!(rig.ask("target x"), "no such run target; there are: all");
    assert_eq!(rig.ask("x"), "expected ps or target NAME");
    rig.stop();
    rig.end();
}

/// A limit above the launcher's own is not granted: the process runs with less, and that is told.
fn what_is_not_granted_is_told() {
    let mut rig = Rig::prepare(&[
        "version = 1\ninitial = \"all\"\n".to_owned(),
        process(
            "greedy",
            &["ready", "pause"],
            "limits = { open-files = 1000 }",
        ),
        process(
            "modest",
            &["ready", "pause"],
            "limits = { open-files = 100 }",
        ),
        target("all", &["greedy", "modest"]),
    ]);
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.arg("guardian").arg(rig.manifest());
    let placement = Placement {
        limits: vec![(Resource::Nofile, 200)],
        ..Placement::default()
    };
    rig.launch_by_spawn(&mut command, |command| {
        Ok(spawn::spawn(command, &placement)?.0)
    });
    rig.wait_until("all ready", |rig| !rig.events(&["all ready"]).is_empty());
    assert_eq!(
        rig.events(&["greedy: not granted", "a limit"]).len(),
        1,
        "{}",
        rig.story()
    );
    assert!(
        rig.events(&["modest: not granted"]).is_empty(),
        "{}",
        rig.story()
    );
    rig.stop();
    rig.end();
}

/// Standard output and standard error of a process go to the file of its manifest.
fn output_goes_to_its_file() {
    let more = "ready = \"exit\"\noutput = \"said\"";
    let mut rig = Rig::start(&[
        "version = 1\ninitial = \"all\"\n".to_owned(),
        process("talks", &["print:hello"], more),
        target("all", &["talks"]),
    ]);
    assert_eq!(rig.end().code(), Some(0), "{}", rig.story());
    assert_eq!(rig.text("said"), "hello\nhello\n");
}

/// E-6: too much memory ends a process: its own, by `setrlimit`; and also what it shares, where the
/// machine grants a group. What is not granted is told.
fn memory_is_limited() {
    for (step, is_shared) in [("allocate:64", false), ("share:64", true)] {
        let mut rig = Rig::start(&[
            head(),
            driver(&["to:hungry", "append:reached", "wait:seen"]),
            process(
                "hungry",
                &["ready", "wait:reached", step, "append:full", "pause"],
                "limits = { memory = 33554432 }",
            ),
            tail(),
            target("hungry", &["driver", "hungry"]),
        ]);
        rig.wait_until("the end of it", |rig| {
            rig.has("fallback-ran") || rig.has("full")
        });
        let is_told = !rig
            .events(&["hungry: not granted", "memory group"])
            .is_empty();
        assert_eq!(
            rig.has("full"),
            is_shared && is_told,
            "{step}: {}",
            rig.story()
        );
        std::fs::write(rig.path("seen"), "").unwrap();
        rig.end_well();
    }
}
