//! The program of every process: it does what its arguments say, one after the other.

use std::fs;
use std::io::{self, Read as _, Write as _};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use signal_hook::consts::SIGTERM;
use tandem_board_host::process_report;

/// Does the steps. A step that fails writes `error` and ends the process with status 9.
pub(crate) fn run(steps: &[String]) -> ExitCode {
    // What follows are arguments for the step `argument`.
    for step in steps.iter().take_while(|step| *step != "--") {
        let (verb, object) = step.split_once(':').unwrap_or((step, ""));
        if let Err(error) = act(verb, object) {
            let text = format!("{steps:?}: {step}: {error}\n");
            append("error", &text).unwrap();
            return ExitCode::from(9);
        }
    }
    ExitCode::SUCCESS
}

fn act(verb: &str, object: &str) -> io::Result<()> {
    let has = |file: &str| Path::new(file).exists();
    let number = || object.parse::<u64>().map_err(io::Error::other);
    match verb {
        "ready" => process_report::ready(),
        "alive" => process_report::alive(),
        "checkpoint" => process_report::checkpoint(number()? as u32),
        "say" => process_report::say(object),
        // As many as asked for, one each 100 ms.
        "beat" => (0..number()?).try_for_each(|_| {
            std::thread::sleep(Duration::from_millis(100));
            process_report::alive()
        }),
        "sleep" => {
            std::thread::sleep(Duration::from_millis(number()?));
            Ok(())
        }
        "append" => append(object, &format!("{}\n", std::process::id())),
        "log" => append("log", &format!("{object}\n")),
        "exists" => expect(has(object)),
        "absent" => expect(!has(object)),
        "wait" => {
            while !has(object) {
                std::thread::sleep(Duration::from_millis(5));
            }
            Ok(())
        }
        "lines" => {
            let (file, count) = object.split_once('=').unwrap_or((object, ""));
            let lines = fs::read_to_string(file)?.lines().count();
            expect(lines.to_string() == count)
        }
        "crash-times" => {
            let lines = fs::read_to_string("crashes")
                .unwrap_or_default()
                .lines()
                .count();
            append("crashes", "crash\n")?;
            if (lines as u64) < number()? {
                std::process::exit(1);
            }
            Ok(())
        }
        "exit" => std::process::exit(number()? as i32),
        "abort" => std::process::abort(),
        "pause" => loop {
            std::thread::park();
        },
        "term" => await_term(),
        "catch-term" => catch_term(object),
        "to" => process_report::switch_target(object),
        "not-to" => expect(process_report::switch_target(object).is_err()),
        "descriptors" => expect(open_descriptors()? == ["0", "1", "2"]),
        "argument" => {
            let mut arguments = std::env::args().skip_while(|it| it != "--").skip(1);
            expect(arguments.next().as_deref() == Some(object) && arguments.next().is_none())
        }
        "program" => {
            let program = std::env::args().next().unwrap_or_default();
            expect(Path::new(&program).file_name() == std::env::current_exe()?.file_name())
        }
        "variable" => {
            let (name, value) = object.split_once('=').unwrap_or((object, ""));
            expect(std::env::var(name).as_deref() == Ok(value))
        }
        "no-variable" => expect(std::env::var_os(object).is_none()),
        "copy" => {
            let (from, to) = object.split_once('=').unwrap_or((object, ""));
            fs::copy(from, to).map(|_| ())
        }
        "print" => {
            println!("{object}");
            eprintln!("{object}");
            Ok(())
        }
        "child-says" => {
            let mut child = Command::new(std::env::current_exe()?);
            let said = child.args(["actor", &format!("say:{object}")]).status()?;
            expect(said.success())
        }
        "allocate" => {
            let bytes = vec![1_u8; (number()? << 20) as usize];
            expect(std::hint::black_box(bytes).last() == Some(&1))
        }
        "share" => share(number()?),
        "join-group-of-parent" => join_group_of_parent(),
        "steal-control" => steal_control(object),
        "leave-child" => leave_child(object),
        other => Err(io::Error::other(format!("unknown step {other}"))),
    }
}

fn expect(is: bool) -> io::Result<()> {
    if is {
        Ok(())
    } else {
        Err(io::Error::other("not so"))
    }
}

pub(crate) fn append(file: &str, text: &str) -> io::Result<()> {
    let mut options = fs::OpenOptions::new();
    options
        .append(true)
        .create(true)
        .open(file)?
        .write_all(text.as_bytes())
}

/// Waits for SIGTERM, and goes on.
fn await_term() -> io::Result<()> {
    let asked = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGTERM, Arc::clone(&asked))?;
    process_report::ready()?;
    while !asked.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

/// Notes SIGTERM in a file, and does not end by it.
fn catch_term(file: &str) -> io::Result<()> {
    let asked = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(SIGTERM, Arc::clone(&asked))?;
    process_report::ready()?;
    loop {
        std::thread::sleep(Duration::from_millis(5));
        if asked.swap(false, Ordering::Relaxed) {
            append(file, &format!("{}\n", std::process::id()))?;
        }
    }
}

/// Returns the numbers of the open descriptors, but for the one that reads them.
fn open_descriptors() -> io::Result<Vec<String>> {
    let mut found = vec![];
    for entry in fs::read_dir("/proc/self/fd")? {
        let entry = entry?;
        let target = fs::read_link(entry.path())?;
        if !target.to_string_lossy().ends_with("/fd") {
            found.push(entry.file_name().to_string_lossy().into_owned());
        }
    }
    found.sort();
    Ok(found)
}

/// Fills memory that is no process's own.
fn share(megabytes: u64) -> io::Result<()> {
    let memory = rustix::fs::memfd_create("shared", rustix::fs::MemfdFlags::CLOEXEC)?;
    let mut memory = fs::File::from(memory);
    (0..megabytes).try_for_each(|_| memory.write_all(&[1; 1 << 20]))
}

/// Joins the process group of the launcher.
fn join_group_of_parent() -> io::Result<()> {
    let parent = rustix::process::getppid();
    let group = rustix::process::getpgid(parent)?;
    Ok(rustix::process::setpgid(None, Some(group))?)
}

/// Asks for a run target by the socket of the process whose id is in this file.
fn steal_control(file: &str) -> io::Result<()> {
    let pid = fs::read_to_string(file)?;
    let environment = fs::read(format!("/proc/{}/environ", pid.trim()))?;
    let environment = String::from_utf8_lossy(&environment).into_owned();
    let name = environment
        .split('\0')
        .find_map(|it| it.strip_prefix("TANDEM_CONTROL_SOCKET=@"));
    let name = name.ok_or(io::ErrorKind::NotFound)?;
    let mut stream = UnixStream::connect_addr(&SocketAddr::from_abstract_name(name)?)?;
    stream.write_all(b"target off\n")?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    expect(answer.starts_with("only state management"))
}

/// Starts a process in a session of its own that ignores SIGTERM, and does not wait for it.
fn leave_child(file: &str) -> io::Result<()> {
    let mut child = Command::new("setsid");
    child
        .arg(std::env::current_exe()?)
        .args(["actor", &format!("append:{file}")]);
    child.args(["catch-term:child-termed"]).spawn()?;
    while !Path::new(file).exists() {
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}
