//! Tests a run in places that offer less than a developer's machine: a small or full `/dev/shm`, an
//! ordinary user, a container, one CPU. Each trial creates its place itself, so most need root; a
//! trial that lacks the rights is ignored and says so.

use std::ffi::CString;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::os::unix::fs::{PermissionsExt as _, chown};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;

use libtest_mimic::{Failed, Trial};
use rustix::fs::{XattrFlags, setxattr};
use rustix::mount::{MountFlags, MountPropagationFlags, mount, mount_change};
use rustix::process::{Resource, Rlimit, Signal, geteuid, getrlimit, setrlimit};
use rustix::thread::{
    CapabilitySet, CapabilitySets, CpuSet, Gid, Uid, UnshareFlags, capabilities,
    configure_capability_in_ambient_set, sched_setaffinity, set_capabilities,
    set_keep_capabilities, set_no_new_privs, set_thread_gid, set_thread_groups, set_thread_uid,
};
use tandem_board::{CoreId, Generation, SystemId};
use tandem_board_host::process_list::{self, ProcessKind};

use crate::fixture::{self, Case, GRANTED, Script, live, signal};
use crate::launcher;
use crate::residue::{LASTING, Outcome, end_in_order, started, until};

/// The case whose cores must be granted real-time scheduling.
pub(crate) const GRANTED_REALTIME: &str = "with_real_time_granted";

/// Not a separate case: the trials below run it in the places that they create.
pub(crate) const GRANTED_CASE: Case = Case {
    name: GRANTED_REALTIME,
    core: live,
    vehicle: check_granted,
};

const LIMIT: &str = "a_limit_on_priorities_gives_real_time";
/// The highest priority that a process of a run claims.
const PRIORITIES: u64 = 80;
/// The id of a user who owns no file.
const ORDINARY: u32 = 61_234;

fn check_granted(script: &mut Script) {
    for system in SystemId::ALL {
        for core in CoreId::ALL {
            let record = script.await_trace(system, core, GRANTED);
            assert_eq!(record[1], 1, "{system}{core} has real time");
        }
    }
}

pub(crate) fn trials() -> Vec<Trial> {
    type Named = (&'static str, fn() -> Outcome);
    let all: [Named; 13] = [
        ("a_small_dev_shm_refuses_the_run_before_it_starts", small),
        ("a_full_dev_shm_takes_no_supply_and_core_0_comes_back", full),
        ("an_ordinary_user_runs", || as_ordinary_user("own")),
        ("an_ordinary_user_runs_in_a_shared_place", || {
            as_ordinary_user("shared")
        }),
        ("root_in_a_container_without_namespaces_runs", || {
            without(libc::SYS_unshare, false)
        }),
        ("a_user_in_a_container_without_namespaces_runs", || {
            without(libc::SYS_unshare, true)
        }),
        ("root_who_may_not_mount_runs", || {
            without(libc::SYS_mount, false)
        }),
        ("a_user_namespace_without_its_mount_is_not_entered", || {
            without(libc::SYS_mount, true)
        }),
        ("a_user_namespace_without_its_map_is_not_entered", no_map),
        ("an_ambient_capability_gives_real_time", ambient),
        (LIMIT, limit),
        (
            "with_a_file_capability_cores_die_with_their_supply",
            file_capability,
        ),
        ("on_one_cpu_core_0_comes_back", one_cpu),
    ];
    let lacks_root = lacking_right();
    let trials = all.into_iter().map(|(name, trial)| {
        let lacks = lacks_root.clone().or_else(|| match name {
            LIMIT => lacking_limit(),
            _ => None,
        });
        if let Some(lacks) = &lacks {
            eprintln!("SKIPPED {name}: {lacks}");
        }
        Trial::test(name, trial).with_ignored_flag(lacks.is_some())
    });
    trials.collect()
}

/// Returns why this process cannot raise the limit on priorities; `None` if it can.
fn lacking_limit() -> Option<String> {
    let may_raise =
        capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::SYS_RESOURCE));
    let highest = getrlimit(Resource::Rtprio).maximum;
    let suffices = highest.is_none_or(|highest| highest >= PRIORITIES);
    (!may_raise && !suffices).then(|| "the limit on priorities cannot be raised".to_owned())
}

/// Returns why the places of the trials cannot be created here; `None` if they can.
fn lacking_right() -> Option<String> {
    if !geteuid().is_root() {
        return Some("only root can become another user".to_owned());
    }
    let tried = in_own_shm("size=64k", || Ok(())).err();
    tried.map(|error| {
        format!(
            "no mount namespace: {}",
            error.message().unwrap_or_default()
        )
    })
}

/// Runs `work` on a thread with a separate `/dev/shm`, which processes that it starts also use.
fn in_own_shm(options: &str, work: impl FnOnce() -> Outcome + Send) -> Outcome {
    let options = CString::new(options)?;
    let enter = || -> io::Result<()> {
        // SAFETY: the table of file descriptors stays shared.
        unsafe { rustix::thread::unshare_unsafe(UnshareFlags::NEWNS) }?;
        mount_change(
            "/",
            MountPropagationFlags::PRIVATE | MountPropagationFlags::REC,
        )?;
        mount(
            "tmpfs",
            "/dev/shm",
            "tmpfs",
            MountFlags::empty(),
            options.as_c_str(),
        )?;
        Ok(())
    };
    thread::scope(|scope| {
        let worker = scope.spawn(|| {
            enter()?;
            work()
        });
        worker.join().unwrap_or_else(|_| Err("panicked".into()))
    })
}

/// A folder for a run, and a copy of this program, readable by an ordinary user.
struct Ground {
    folder: tempfile::TempDir,
}

impl Ground {
    fn new() -> Result<Self, Failed> {
        let folder = tempfile::tempdir()?;
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755))?;
        let ground = Self { folder };
        fs::create_dir(ground.data())?;
        chown(ground.data(), Some(ORDINARY), Some(ORDINARY))?;
        fs::copy(std::env::current_exe()?, ground.program())?;
        fs::set_permissions(ground.program(), fs::Permissions::from_mode(0o755))?;
        Ok(ground)
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    fn program(&self) -> PathBuf {
        self.folder.path().join("processes")
    }

    fn launcher(&self, case: &str, place: &str) -> Command {
        launcher::launcher(&self.program(), case, &self.data(), place)
    }
}

/// Makes the process that `command` starts run `setup` first.
fn first(command: &mut Command, setup: impl FnMut() -> io::Result<()> + Send + Sync + 'static) {
    // SAFETY: the setups below only make system calls: no allocation, no lock.
    unsafe { command.pre_exec(setup) };
}

/// Makes this process, which must have only one thread, a process of an ordinary user.
fn become_ordinary() -> io::Result<()> {
    set_thread_groups(&[])?;
    set_thread_gid(Gid::from_raw(ORDINARY))?;
    set_thread_uid(Uid::from_raw(ORDINARY))?;
    Ok(())
}

/// Makes the kernel refuse this system call from now on, like the filter of a container.
fn refuse(call: libc::c_long) -> io::Result<()> {
    set_no_new_privs(true)?;
    let statement = |code: u32, jt, jf, k| libc::sock_filter {
        code: code as u16,
        jt,
        jf,
        k,
    };
    let denied = libc::SECCOMP_RET_ERRNO | libc::EPERM as u32;
    let mut filter = [
        // The number of the call is the first word of `seccomp_data`.
        statement(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, 0),
        statement(
            libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K,
            0,
            1,
            call as u32,
        ),
        statement(libc::BPF_RET | libc::BPF_K, 0, 0, denied),
        statement(libc::BPF_RET | libc::BPF_K, 0, 0, libc::SECCOMP_RET_ALLOW),
    ];
    let program = libc::sock_fprog {
        len: filter.len() as u16,
        filter: filter.as_mut_ptr(),
    };
    // SAFETY: the program is valid for the time of the call.
    let done = unsafe {
        libc::prctl(
            libc::PR_SET_SECCOMP,
            libc::SECCOMP_MODE_FILTER,
            &raw const program,
        )
    };
    if done == 0 {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}

/// Starts a run that lasts until it is ended, calls `look`, and ends the run in order.
fn lasts(mut launcher: Command, look: impl FnOnce(u32) -> Outcome) -> Outcome {
    let started = started(launcher.spawn()?, 9)?;
    let looked = look(started.launcher.id());
    end_in_order(started)?;
    looked
}

/// Too little space is an error that names the place, and no file is left there.
fn small() -> Outcome {
    for size in ["size=64k", "size=512k", "size=1m"] {
        in_own_shm(size, || {
            let ground = Ground::new()?;
            let ended = ground.launcher(LASTING.name, "shared").output()?;
            let said = String::from_utf8_lossy(&ended.stderr).into_owned();
            if ended.status.code() != Some(launcher::REFUSED.into()) || !said.contains("/dev/shm") {
                return Err(format!("{size}: {}: {said}", ended.status).into());
            }
            assert_eq!(files("/dev/shm")?, Vec::<PathBuf>::new(), "{size}");
            Ok(())
        })?;
    }
    Ok(())
}

/// T-RED-8: if other files fill `/dev/shm`, the death of core 0 resets its system and has no
/// other effect.
fn full() -> Outcome {
    in_own_shm("size=24m", || {
        let ground = Ground::new()?;
        let started = started(ground.launcher(LASTING.name, "shared").spawn()?, 9)?;
        let filled = fill(Path::new("/dev/shm/others"));
        let supplies = || -> Vec<u32> {
            let all = process_list::of_run(&started.run).into_iter();
            all.filter(|process| process.kind == ProcessKind::Supply)
                .map(|process| process.pid)
                .collect()
        };
        // A core process has its supply's command line until it calls exec: wait for exactly two.
        let before = until("two supplies", || {
            Some(supplies()).filter(|found| found.len() == 2)
        })?;
        let incarnation = |number| {
            let control = ProcessKind::Core(CoreId::CONTROL, Generation(number));
            process_list::of_run(&started.run)
                .into_iter()
                .find(|process| process.kind == control && process.system == Some(SystemId::A))
        };
        let outcome = (|| -> Outcome {
            filled?;
            for number in 1..4 {
                let victim = until("core 0 lives", || incarnation(number))?;
                signal(victim.pid, Signal::KILL);
            }
            until("core 0 comes back", || incarnation(4))?;
            let after = supplies();
            assert!(
                before.iter().all(|supply| after.contains(supply)),
                "{before:?} {after:?}"
            );
            Ok(())
        })();
        end_in_order(started)?;
        fs::remove_file("/dev/shm/others")?;
        assert_eq!(files("/dev/shm")?, Vec::<PathBuf>::new());
        outcome
    })
}

/// Writes until the file system is full.
fn fill(path: &Path) -> io::Result<()> {
    let mut file = File::create(path)?;
    loop {
        match file.write_all(&[0x55; 4096]) {
            Err(error) if error.kind() == io::ErrorKind::StorageFull => return Ok(()),
            written => written?,
        }
    }
}

fn files(folder: &str) -> io::Result<Vec<PathBuf>> {
    fs::read_dir(folder)?
        .map(|entry| Ok(entry?.path()))
        .collect()
}

fn as_ordinary_user(place: &str) -> Outcome {
    let ground = Ground::new()?;
    let mut launcher = ground.launcher(LASTING.name, place);
    first(&mut launcher, become_ordinary);
    lasts(launcher, |_| Ok(()))
}

fn namespace_of(pid: impl std::fmt::Display, kind: &str) -> io::Result<PathBuf> {
    fs::read_link(format!("/proc/{pid}/ns/{kind}"))
}

/// Checks that the run uses the machine's `/dev/shm` and has entered no namespace.
fn is_shared(launcher: u32) -> Outcome {
    for kind in ["user", "mnt"] {
        assert_eq!(
            namespace_of(launcher, kind)?,
            namespace_of("self", kind)?,
            "{kind}"
        );
    }
    Ok(())
}

/// Tests a container whose filter refuses one of the system calls that a namespace needs.
fn without(call: libc::c_long, ordinary: bool) -> Outcome {
    let ground = Ground::new()?;
    let mut launcher = ground.launcher(LASTING.name, "own");
    first(&mut launcher, move || {
        if ordinary {
            become_ordinary()?;
        }
        refuse(call)
    });
    lasts(launcher, is_shared)
}

/// A user namespace is granted, but its map is refused, because a process does not own its files in
/// `/proc` if its user may execute but not read its program.
fn no_map() -> Outcome {
    let ground = Ground::new()?;
    fs::set_permissions(ground.program(), fs::Permissions::from_mode(0o711))?;
    let mut launcher = ground.launcher(LASTING.name, "own");
    first(&mut launcher, become_ordinary);
    lasts(launcher, is_shared)
}

/// An ordinary user whose processes inherit `CAP_SYS_NICE` gets real-time scheduling.
fn ambient() -> Outcome {
    let ground = Ground::new()?;
    let mut launcher = ground.launcher(GRANTED_CASE.name, "own");
    first(&mut launcher, || {
        set_keep_capabilities(true)?;
        become_ordinary()?;
        let nice = CapabilitySet::SYS_NICE;
        let sets = CapabilitySets {
            effective: nice,
            permitted: nice,
            inheritable: nice,
        };
        set_capabilities(None, sets)?;
        configure_capability_in_ambient_set(nice, true)?;
        Ok(())
    });
    fixture::finish(launcher.spawn()?).map_err(Failed::from)
}

/// An ordinary user with a limit on priorities gets real-time scheduling and a private `/dev/shm`.
fn limit() -> Outcome {
    let ground = Ground::new()?;
    let mut launcher = ground.launcher(GRANTED_CASE.name, "own");
    first(&mut launcher, || {
        let limit = Rlimit {
            current: Some(PRIORITIES),
            maximum: Some(PRIORITIES),
        };
        setrlimit(Resource::Rtprio, limit)?;
        become_ordinary()
    });
    fixture::finish(launcher.spawn()?).map_err(Failed::from)
}

/// T-CHIP-6: the kernel unbinds a process from its parent when the process executes a program with
/// a file capability. A core binds itself again.
fn file_capability() -> Outcome {
    let ground = Ground::new()?;
    let nice = CapabilitySet::SYS_NICE.bits() as u32;
    // linux/capability.h, `vfs_cap_data` revision 2, effective.
    let words = [0x0200_0001, nice, 0, 0, 0];
    let bytes: Vec<u8> = words.into_iter().flat_map(u32::to_le_bytes).collect();
    setxattr(
        ground.program(),
        "security.capability",
        &bytes,
        XattrFlags::empty(),
    )?;

    let mut granted = ground.launcher(GRANTED_CASE.name, "own");
    first(&mut granted, become_ordinary);
    fixture::finish(granted.spawn()?)?;

    let mut launcher = ground.launcher(LASTING.name, "own");
    first(&mut launcher, become_ordinary);
    let mut started = started(launcher.spawn()?, 9)?;
    let of_a = || -> Vec<_> {
        let all = process_list::of_run(&started.run).into_iter();
        all.filter(|process| process.system == Some(SystemId::A))
            .collect()
    };
    let supply = of_a()
        .into_iter()
        .find(|process| process.kind == ProcessKind::Supply);
    signal(supply.ok_or("no supply")?.pid, Signal::KILL);
    let dark = until("all of system A is dead", || {
        of_a().is_empty().then_some(())
    });
    let alive = of_a();
    for process in alive {
        signal(process.pid, Signal::KILL);
    }
    signal(started.launcher.id(), Signal::INT);
    until("the launcher ends", || {
        started.launcher.try_wait().ok().flatten()
    })?;
    dark.map_err(Failed::from)
}

/// Tests a run whose nine processes share one CPU.
fn one_cpu() -> Outcome {
    let cases = fixture::all_cases();
    let case = cases
        .into_iter()
        .find(|case| case.name == "death_of_core_0_resets_the_system");
    let ground = Ground::new()?;
    let mut launcher = ground.launcher(case.ok_or("a known case")?.name, "own");
    first(&mut launcher, || {
        let mut one = CpuSet::new();
        one.set(0);
        sched_setaffinity(None, &one)?;
        Ok(())
    });
    fixture::finish(launcher.spawn()?).map_err(Failed::from)
}
