//! FreeRTOS's standard demo tasks, from its own release, on the host port. T-RTOS-1, T-RTOS-2
//!
//! `TANDEM_FREERTOS` names the folder of that release; without it every suite is skipped. Each is
//! linked into a program of its own, with the crate's port and the kernel's sources. The kernel has
//! the crate's configuration, and the options that the demos need beyond it (`FreeRTOSConfig.h`).
//! `runner.rs` runs the suite in virtual time, and calls its own check until 20 s have passed.
#![allow(clippy::unwrap_used, reason = "all of it is a test")]

use std::env;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

include!(concat!(env!("OUT_DIR"), "/sizes.rs"));

const VARIABLE: &str = "TANDEM_FREERTOS";
/// The kernel's sources that the demos need.
const KERNEL: [&str; 6] = [
    "tasks",
    "queue",
    "list",
    "timers",
    "event_groups",
    "stream_buffer",
];

/// A test for each suite: the name of its source, the calls in C by which a board starts and checks
/// it, and further definitions for `suite.c`.
macro_rules! suites {
    ($($name:ident $file:literal, $start:literal, $check:literal $(, $further:literal)*;)*) => {
        mod suite {
            $(
                #[test]
                fn $name() {
                    let further = [concat!("START=", $start), concat!("CHECK=", $check), $($further),*];
                    super::passes($file, &further);
                }
            )*
        }
    };
}

suites! {
    abort_delay "AbortDelay",
        "vCreateAbortDelayTasks()", "xAreAbortDelayTestTasksStillRunning()";
    block_q "BlockQ",
        "vStartBlockingQueueTasks(2)", "xAreBlockingQueuesStillRunning()";
    block_time "blocktim",
        "vCreateBlockTimeTasks()", "xAreBlockTimeTestTasksStillRunning()";
    count_sem "countsem",
        "vStartCountingSemaphoreTasks()", "xAreCountingSemaphoreTasksStillRunning()";
    death "death",
        "vCreateSuicidalTasks(3)", "xIsCreateTaskStillRunning()";
    dynamic "dynamic",
        "vStartDynamicPriorityTasks()", "xAreDynamicPriorityTasksStillRunning()";
    event_groups "EventGroupsDemo",
        "vStartEventGroupTasks()", "xAreEventGroupTasksStillRunning()",
        "TICK=vPeriodicEventGroupsProcessing()";
    flop "flop",
        "vStartMathTasks(0)", "xAreMathsTaskStillRunning()";
    gen_q "GenQTest",
        "vStartGenericQueueTasks(0)", "xAreGenericQueueTasksStillRunning()";
    int_queue "IntQueue",
        "vStartInterruptQueueTasks()", "xAreIntQueueTasksStillRunning()",
        "TICK=suite_raise(1)",
        "FIRST=suite_raise(2);portYIELD_FROM_ISR(xFirstTimerHandler())",
        "SECOND=portYIELD_FROM_ISR(xSecondTimerHandler())";
    int_sem "IntSemTest",
        "vStartInterruptSemaphoreTasks()", "xAreInterruptSemaphoreTasksStillRunning()",
        "TICK=vInterruptSemaphorePeriodicTest()";
    integer "integer",
        "vStartIntegerMathTasks(0)", "xAreIntegerMathsTaskStillRunning()";
    message_buffer "MessageBufferDemo",
        "vStartMessageBufferTasks(configMINIMAL_STACK_SIZE)",
        "xAreMessageBufferTasksStillRunning()";
    message_buffer_amp "MessageBufferAMP",
        "vStartMessageBufferAMPTasks(configMINIMAL_STACK_SIZE)",
        "xAreMessageBufferAMPTasksStillRunning()",
        "SENT=vGenerateCoreBInterrupt";
    poll_q "PollQ",
        "vStartPolledQueueTasks(1)", "xArePollingQueuesStillRunning()";
    queue_overwrite "QueueOverwrite",
        "vStartQueueOverwriteTask(0)", "xIsQueueOverwriteTaskStillRunning()",
        "TICK=vQueueOverwritePeriodicISRDemo()";
    queue_peek "QPeek",
        "vStartQueuePeekTasks()", "xAreQueuePeekTasksStillRunning()";
    queue_set "QueueSet",
        "vStartQueueSetTasks()", "xAreQueueSetTasksStillRunning()",
        "TICK=vQueueSetAccessQueueSetFromISR()";
    queue_set_polling "QueueSetPolling",
        "vStartQueueSetPollingTask()", "xAreQueueSetPollTasksStillRunning()",
        "TICK=vQueueSetPollingInterruptAccess()";
    recursive_mutex "recmutex",
        "vStartRecursiveMutexTasks()", "xAreRecursiveMutexTasksStillRunning()";
    sem_test "semtest",
        "vStartSemaphoreTasks(1)", "xAreSemaphoreTasksStillRunning()";
    sp_flop "sp_flop",
        "vStartMathTasks(0)", "xAreMathsTaskStillRunning()";
    static_allocation "StaticAllocation",
        "vStartStaticallyAllocatedTasks()", "xAreStaticAllocationTasksStillRunning()";
    stream_buffer "StreamBufferDemo",
        "vStartStreamBufferTasks()", "xAreStreamBufferTasksStillRunning()",
        "TICK=vPeriodicStreamBufferProcessing()";
    stream_buffer_interrupt "StreamBufferInterrupt",
        "vStartStreamBufferInterruptDemo()", "xIsInterruptStreamBufferDemoStillRunning()",
        "TICK=vBasicStreamBufferSendFromISR()";
    task_notify "TaskNotify",
        "vStartTaskNotifyTask()", "xAreTaskNotificationTasksStillRunning()",
        "TICK=xNotifyTaskFromISR()";
    task_notify_array "TaskNotifyArray",
        "vStartTaskNotifyArrayTask()", "xAreTaskNotificationArrayTasksStillRunning()",
        "TICK=xNotifyArrayTaskFromISR()";
    timer_demo "TimerDemo",
        "vStartTimerDemoTask(50)", "xAreTimerDemoTasksStillRunning(5000)",
        "TICK=vTimerPeriodicISRTests()";
}

/// Runs this command, which succeeds.
fn run(command: &mut Command) {
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    let status = output.status;
    assert!(status.success(), "{command:?}: {status}: {said}");
}

/// Returns the folder of FreeRTOS's release, or says that this test is skipped.
fn release() -> Option<PathBuf> {
    let folder = env::var_os(VARIABLE);
    if folder.is_none() {
        let test = std::thread::current();
        let name = test.name().unwrap_or("a test");
        // The test runner does not capture this output, so a skipped test is visible.
        let _ = writeln!(std::io::stderr(), "SKIPPED {name}: {VARIABLE} is not set");
    }
    let folder = PathBuf::from(folder?);
    let has_demos = folder.join("FreeRTOS/Demo/Common/Minimal").is_dir();
    assert!(
        folder.is_absolute() && has_demos,
        "{VARIABLE}={folder:?} is not the absolute path of a release of FreeRTOS"
    );
    Some(folder)
}

/// Links `program` with a suite of the release, and with these definitions for `suite.c`.
fn link(program: &str, release: &Path, file: &str, definitions: &[&str]) -> Command {
    let ours = Path::new(env!("CARGO_MANIFEST_DIR"));
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("standard-demos");
    // With this, cargo does not run the crate's build script, which would add the crate's kernel.
    let target = format!("{}-unknown-linux-gnu", env::consts::ARCH);
    let out = env!("OUT_DIR");
    let no_kernel = format!("target.{target}.tandem-freertos.rustc-env.OUT_DIR={out:?}");
    let mut cargo = Command::new(env!("CARGO"));
    cargo
        .current_dir(ours)
        .args(["build", "--locked", "--example", "standard-demos"]);
    run(cargo
        .args(["--config", &no_kernel, "--target-dir"])
        .arg(&folder));

    let demos = release.join("FreeRTOS/Demo/Common");
    let kernel = Path::new(env!("TANDEM_FREERTOS_KERNEL"));
    let [tests, port] = ["tests/standard_demos", "kernel"].map(|it| ours.join(it));
    let headers = [
        &tests,
        &port,
        &port.join("host"),
        &kernel.join("include"),
        &demos.join("include"),
    ];
    let words = [
        ("TASK", TASK_WORDS),
        ("QUEUE", QUEUE_WORDS),
        ("TIMER", TIMER_WORDS),
    ];
    let mut cc = Command::new("cc");
    cc.args(["-O2", "-g", "-w"]);
    cc.args(headers.map(|it| format!("-I{}", it.display())));
    cc.args(words.map(|(name, words)| format!("-DTANDEM_{name}_WORDS={words}")));
    cc.arg(format!("-DHEADER=\"{}.h\"", file.trim_start_matches("sp_")));
    cc.args(definitions.iter().map(|it| format!("-D{it}")));
    cc.arg(demos.join("Minimal").join(file).with_extension("c"));
    cc.args([tests.join("suite.c"), port.join("shim.c")]);
    cc.args(KERNEL.map(|it| kernel.join(it).with_extension("c")));
    cc.arg(folder.join("debug/examples/libstandard_demos.a"));
    run(cc.args(["-lm", "-o"]).arg(folder.join(program)));
    Command::new(folder.join(program))
}

/// Fails if one of the suite's own checks does.
fn passes(file: &str, definitions: &[&str]) {
    if let Some(release) = release() {
        run(&mut link(file, &release, file, definitions));
    }
}

/// The controls: each damage of the kernel makes a suite's own check fail. The damage is code in
/// trace points of the kernel, which are empty otherwise.
#[test]
fn a_broken_kernel_is_found() {
    let Some(release) = release() else { return };
    let fails = |file, definitions: &[&str]| {
        let output = link("broken", &release, file, definitions)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(
            !output.status.success() && said.contains(" of 4 checks passed"),
            "{file}: {said}"
        );
    };
    let no_inheritance = [
        "START=vStartGenericQueueTasks(0)",
        "CHECK=xAreGenericQueueTasksStillRunning()",
        "traceENTER_xTaskPriorityInherit(holder)=return 0",
    ];
    fails("GenQTest", &no_inheritance);
    let lost_wakeups = [
        "START=vStartBlockingQueueTasks(2)",
        "CHECK=xAreBlockingQueuesStillRunning()",
        "traceENTER_xTaskRemoveFromEventList(list)=static int it; if(++it % 100 == 0) return 0",
    ];
    fails("BlockQ", &lost_wakeups);
}
