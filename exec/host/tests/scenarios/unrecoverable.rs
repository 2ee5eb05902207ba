//! The unrecoverable state (E-5): whatever leads to it, pre-clean-up, SIGTERM, SIGKILL and
//! post-clean-up follow, in this order, and nothing is left.

use std::process::Command;

use rustix::process::{Resource, Signal};
use tandem_board_host::spawn::{self, Placement};

use crate::rig::{Rig, is_alive, process, signal, target};

pub(crate) const ALL: &[(&str, fn())] = &[
    ("unreadable_manifest", unreadable_manifest),
    ("no_state_management", no_state_management),
    ("launcher_killed", launcher_killed),
    ("launcher_hangs", launcher_hangs),
    ("launcher_and_process_killed", launcher_and_process_killed),
    ("guardian_killed", guardian_killed),
    ("no_process_left", no_process_left),
    ("no_descriptor_left", no_descriptor_left),
    ("no_fallback", no_fallback),
    ("fallback_fails", fallback_fails),
    ("clean_up_that_hangs", clean_up_that_hangs),
];

/// The first lines of a manifest with a clean-up that writes to the log.
fn head(more: &str) -> String {
    let hook = |what: &str| {
        let program = std::env::current_exe().unwrap();
        let program = program.to_str().unwrap();
        format!("{:?}", [program, "actor", &format!("log:{what}")])
    };
    let (pre, post) = (hook("pre"), hook("post"));
    format!(
        "version = 1\ninitial = \"all\"\n{more}\n[safe-state]\nbefore = {pre}\nafter = {post}\n\
         within = \"1s\"\nwatchdog = \"3s\"\n"
    )
}

/// One process that ends by SIGTERM, one that does not, and one that has left a child.
fn others() -> String {
    let obedient = ["append:pids", "term", "log:termed"];
    let stubborn = ["append:pids", "catch-term:stubborn-termed"];
    let parent = ["append:pids", "leave-child:pids-of-child", "ready", "pause"];
    process("obedient", &obedient, "")
        + &process("stubborn", &stubborn, "")
        + &process("parent", &parent, "")
        + &target("all", &["obedient", "stubborn", "parent", "last"])
}

/// Waits for the end and checks the order, and that nothing is left.
fn check_clean_up(rig: &mut Rig) {
    let status = rig.end();
    assert_eq!(status.code(), Some(1), "{}", rig.story());
    check_order(rig);
}

fn check_order(rig: &Rig) {
    assert_eq!(rig.text("log"), "pre\ntermed\npost\n", "{}", rig.story());
    assert_eq!(rig.pids("stubborn-termed").len(), 1, "{}", rig.story());
    check_nothing_left(rig);
}

fn check_nothing_left(rig: &Rig) {
    let pids = [rig.pids("pids"), rig.pids("pids-of-child")].concat();
    assert!(pids.len() >= 4, "{}", rig.story());
    let left: Vec<_> = pids.into_iter().filter(|pid| is_alive(*pid)).collect();
    assert!(left.is_empty(), "{left:?} are left: {}", rig.story());
}

fn wait_for_all(rig: &Rig) {
    rig.wait_until("all ready", |rig| !rig.events(&["all ready"]).is_empty());
}

/// E-5: a manifest that cannot be read, or that is wrong: the clean-up of the command line runs.
fn unreadable_manifest() {
    let program = std::env::current_exe().unwrap();
    let hook = |what: &str| format!("{} actor log:{what}", program.display());
    let started = process("last", &["append:started", "pause"], "ready = \"running\"");
    let good = [head(""), started, others()];
    let broken = [good.concat().replace("initial", "inital")];
    for manifest in [&broken[..], &[]] {
        let mut rig = Rig::prepare(manifest);
        if manifest.is_empty() {
            std::fs::remove_file(rig.manifest()).unwrap();
        }
        rig.launch(&[&hook("pre"), &hook("post")]);
        assert_eq!(rig.end().code(), Some(2), "{}", rig.story());
        assert_eq!(rig.text("log"), "pre\npost\n", "{}", rig.story());
        assert!(!rig.has("started") && !rig.has("pids"));
        assert!(
            rig.text("errors").contains("manifest.toml"),
            "{}",
            rig.story()
        );
    }
}

/// E-5: state management ends, more often than its manifest permits.
fn no_state_management() {
    let more = "state-management = true\nrestart = { times = 1 }";
    let last = process("last", &["append:pids", "ready", "pause"], more);
    let mut rig = Rig::start(&[head("fallback = \"all\""), last, others()]);
    wait_for_all(&rig);
    signal(
        *rig.pids("pids").iter().find(|pid| is_last(**pid)).unwrap(),
        Signal::KILL,
    );
    rig.wait_until("a restart", |rig| rig.events(&["last: ready"]).len() == 2);
    signal(
        *rig.pids("pids")
            .iter()
            .rev()
            .find(|pid| is_last(**pid))
            .unwrap(),
        Signal::KILL,
    );
    check_clean_up(&mut rig);
    assert!(rig.text("errors").contains("state management is lost"));
}

/// Returns whether this is the process `last`.
fn is_last(pid: i32) -> bool {
    let environment = std::fs::read(format!("/proc/{pid}/environ")).unwrap_or_default();
    environment
        .split(|byte| *byte == 0)
        .any(|it| it == b"TANDEM_EXEC_PROCESS=last")
}

fn running(more: &str) -> Rig {
    let last = process("last", &["append:pids", "ready", "pause"], "");
    let rig = Rig::start(&[head(more), last, others()]);
    wait_for_all(&rig);
    rig
}

/// E-5: the launcher dies.
fn launcher_killed() {
    let mut rig = running("");
    signal(rig.launcher_pid(), Signal::KILL);
    check_clean_up(&mut rig);
}

/// E-5: the launcher hangs, and the watchdog finds it.
fn launcher_hangs() {
    let mut rig = running("");
    signal(rig.launcher_pid(), Signal::STOP);
    check_clean_up(&mut rig);
    assert!(rig.text("errors").contains("silent"), "{}", rig.story());
}

/// E-5: the launcher dies, and at the same time a process whose child has left its session.
fn launcher_and_process_killed() {
    let mut rig = running("");
    let launcher = rig.launcher_pid();
    signal(launcher, Signal::STOP);
    rig.pids("pids")
        .into_iter()
        .for_each(|pid| signal(pid, Signal::KILL));
    signal(launcher, Signal::KILL);
    assert_eq!(rig.end().code(), Some(1));
    assert_eq!(rig.text("log"), "pre\npost\n", "{}", rig.story());
    check_nothing_left(&rig);
}

/// E-5: the watchdog itself dies. The launcher does its work.
fn guardian_killed() {
    let mut rig = running("");
    let launcher = rig.launcher_pid();
    signal(rig.guardian_pid(), Signal::KILL);
    rig.wait_until("the launcher's end", |_| !is_alive(launcher));
    rig.end();
    check_order(&rig);
}

/// E-5: the system gives no further process (EAGAIN of fork).
fn no_process_left() {
    if !rustix::process::geteuid().is_root() {
        eprintln!("needs root, for a user of its own with a limit");
        return;
    }
    let user = 2_000_000_000 + std::process::id();
    // Guardian, launcher, four processes and the child of one; the fifth process is too many.
    starved(
        7,
        Placement {
            uid: Some(user),
            gid: Some(user),
            limits: vec![(Resource::Nproc, 7)],
            ..Placement::default()
        },
    );
}

/// E-5: the system gives no further descriptor (EMFILE).
fn no_descriptor_left() {
    starved(
        40,
        Placement {
            limits: vec![(Resource::Nofile, 24)],
            ..Placement::default()
        },
    );
}

/// Starts so many processes, one after the other, that the system refuses one.
fn starved(count: usize, placement: Placement) {
    let name = |at: usize| format!("number-{at}");
    let mut manifest = vec![head("")];
    for at in 0..count {
        let after = match at {
            0 => "after = [\"obedient\", \"stubborn\", \"parent\"]".to_owned(),
            at => format!("after = [{:?}]", name(at - 1)),
        };
        manifest.push(process(
            &name(at),
            &["append:pids", "ready", "pause"],
            &after,
        ));
    }
    let last = format!("after = [{:?}]", name(count - 1));
    manifest.push(process(
        "last",
        &["append:started-all", "ready", "pause"],
        &last,
    ));
    manifest.push(others());
    let mut rig = Rig::prepare(&manifest);
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.arg("guardian").arg(rig.manifest());
    rig.launch_by_spawn(&mut command, |command| {
        spawn::spawn(command, &placement).map(|(child, refused)| {
            assert!(refused.is_empty());
            child
        })
    });
    check_clean_up(&mut rig);
    assert!(!rig.has("started-all"));
    assert!(
        rig.text("errors").contains("the operating system fails"),
        "{}",
        rig.story()
    );
}

/// E-6: a process fails, and there is no fallback target.
fn no_fallback() {
    let last = process("last", &["append:pids", "ready", "wait:go", "exit:3"], "");
    let mut rig = Rig::start(&[head(""), last, others()]);
    wait_for_all(&rig);
    std::fs::write(rig.path("go"), "").unwrap();
    check_clean_up(&mut rig);
    assert!(
        rig.text("errors").contains("last has failed"),
        "{}",
        rig.story()
    );
}

/// E-6: a process of the fallback target fails, too.
fn fallback_fails() {
    let last = process("last", &["append:pids", "ready", "wait:go", "exit:3"], "");
    let mut rig = Rig::start(&[head("fallback = \"all\""), last, others()]);
    wait_for_all(&rig);
    std::fs::write(rig.path("go"), "").unwrap();
    check_clean_up(&mut rig);
    assert_eq!(
        rig.events(&["last:", "next: fallback"]).len(),
        1,
        "{}",
        rig.story()
    );
    assert_eq!(
        rig.events(&["last:", "next: safe state"]).len(),
        1,
        "{}",
        rig.story()
    );
}

/// E-5: a pre-clean-up that hangs does not keep processes alive.
fn clean_up_that_hangs() {
    let last = process("last", &["append:pids", "ready", "pause"], "");
    let manifest = [head(""), last, others()].concat();
    let mut rig = Rig::start(&[manifest.replace("log:pre", "catch-term:never")]);
    wait_for_all(&rig);
    signal(rig.launcher_pid(), Signal::KILL);
    assert_eq!(rig.end().code(), Some(1));
    assert_eq!(rig.text("log"), "termed\npost\n", "{}", rig.story());
    check_nothing_left(&rig);
    assert!(
        rig.text("errors").contains("pre-clean-up"),
        "{}",
        rig.story()
    );
}
