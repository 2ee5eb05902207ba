//! Describes the machine of a measurement, from the data that the machine reports.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs;
use tandem_board_host::realtime::cpus;

/// The dependencies of this build: the lock file that it was built with.
const LOCK: &str = include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.lock"));
/// The peers that are libraries.
const PEERS: [&str; 4] = ["iceoryx2", "io-uring", "rtrb", "triple_buffer"];

/// The machine of a measurement.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Machine {
    /// The name that the processor reports.
    pub(crate) cpu: String,
    /// CPUs that this process may use.
    pub(crate) cpus: usize,
    /// CPUs that the ends were pinned to.
    pub(crate) pinned_to: Vec<usize>,
    pub(crate) kernel: String,
    pub(crate) build: String,
    /// Commit of the sources when this crate was built; `-dirty`: with changes.
    #[serde(default)]
    pub(crate) commit: String,
    /// Compiler.
    #[serde(default)]
    pub(crate) compiler: String,
    /// Optimisation, target, and flags of the compiler.
    #[serde(default)]
    pub(crate) flags: String,
    /// Place of each CPU that an end is pinned to: package, core, and CPUs that share its caches.
    #[serde(default)]
    pub(crate) topology: Vec<String>,
    /// Whether the system runs under a hypervisor: then other guests take time that this system
    /// cannot see.
    pub(crate) hypervisor: bool,
    /// The governor of the first CPU's clock; `None` if this system does not report it.
    pub(crate) governor: Option<String>,
    pub(crate) scheduling: String,
    /// Whether the ends' memory could not be swapped out.
    pub(crate) memory_locked: bool,
    /// The kernel's setting for huge pages in shared memory.
    pub(crate) huge_pages: String,
    pub(crate) versions: BTreeMap<String, String>,
}

impl Machine {
    /// This machine, as the calling process sees it.
    pub(crate) fn this(pinned_to: &[usize]) -> Self {
        let info = read("/proc/cpuinfo");
        let first = pinned_to.first().copied().unwrap_or(0);
        let governor = format!("/sys/devices/system/cpu/cpu{first}/cpufreq/scaling_governor");
        let build = ["release", "debug"][usize::from(cfg!(debug_assertions))];
        Self {
            cpu: field(&info, "model name").unwrap_or("unknown").to_owned(),
            cpus: cpus(),
            pinned_to: pinned_to.to_vec(),
            kernel: read("/proc/sys/kernel/osrelease").trim().to_owned(),
            build: build.to_owned(),
            commit: env!("TANDEM_BENCH_COMMIT").to_owned(),
            compiler: env!("TANDEM_BENCH_COMPILER").to_owned(),
            flags: env!("TANDEM_BENCH_FLAGS").to_owned(),
            topology: pinned_to.iter().map(|cpu| place(*cpu)).collect(),
            hypervisor: field(&info, "flags").is_some_and(|flags| flags.contains(" hypervisor")),
            governor: Some(read(&governor).trim().to_owned()).filter(|name| !name.is_empty()),
            scheduling: scheduling().to_owned(),
            memory_locked: field(&read("/proc/self/status"), "VmLck")
                .is_some_and(|size| !size.starts_with("0 ")),
            huge_pages: chosen(&read("/sys/kernel/mm/transparent_hugepage/shmem_enabled")),
            versions: versions(LOCK),
        }
    }

    /// Processor and kernel.
    pub(crate) fn name(&self) -> String {
        let under = if self.hypervisor {
            " under a hypervisor"
        } else {
            ""
        };
        format!("{}{under}, Linux {}", self.cpu, self.kernel)
    }

    /// Returns the CPUs of the ends.
    pub(crate) fn pinned(&self) -> String {
        let cpus: Vec<String> = self.pinned_to.iter().map(usize::to_string).collect();
        cpus.join(" and ")
    }

    /// Describes the machine in words: one line for each kind of fact.
    pub(crate) fn facts(&self) -> Vec<(&'static str, String)> {
        let versions = self.versions.iter();
        let versions: Vec<String> = versions.map(|(name, v)| format!("{name} {v}")).collect();
        let governor = self.governor.as_deref().unwrap_or("not visible");
        let memory = if self.memory_locked {
            "memory locked"
        } else {
            "memory not locked"
        };
        let build = [&self.compiler[..], &self.flags].join(", ");
        vec![
            ("Machine", self.name()),
            (
                "CPUs",
                format!("{} usable, pinned to {}", self.cpus, self.pinned()),
            ),
            ("Topology", self.topology.join("; ")),
            ("Clock governor", governor.to_owned()),
            ("Scheduling", format!("{}, {memory}", self.scheduling)),
            ("Huge pages for shared memory", self.huge_pages.clone()),
            (
                "Build",
                format!("{} of {}, {build}", self.build, self.commit),
            ),
            ("Versions", versions.join(", ")),
        ]
    }
}

/// Returns the place of a CPU, from the kernel.
fn place(cpu: usize) -> String {
    let of = |file: &str| {
        let text = read(&format!("/sys/devices/system/cpu/cpu{cpu}/{file}"));
        Some(text.trim().to_owned()).filter(|text| !text.is_empty())
    };
    let unknown = || "?".to_owned();
    let caches = (0..8).filter_map(|index| {
        let kind = of(&format!("cache/index{index}/type"))?;
        let level = of(&format!("cache/index{index}/level"))?;
        let shared = of(&format!("cache/index{index}/shared_cpu_list"))?;
        (kind != "Instruction").then(|| format!("L{level} shared by {shared}"))
    });
    format!(
        "CPU {cpu}: package {}, core {}, {}",
        of("topology/physical_package_id").unwrap_or_else(unknown),
        of("topology/core_id").unwrap_or_else(unknown),
        caches.collect::<Vec<_>>().join(", ")
    )
}

/// Returns how long, since this machine started, the hypervisor ran other guests while a CPU of
/// this machine was ready to run, ms, in steps of 10.
pub(crate) fn stolen_ms() -> f64 {
    stolen(&read("/proc/stat"))
}

fn stolen(stat: &str) -> f64 {
    // "cpu", then user, nice, system, idle, iowait, irq, softirq, steal, in hundredths of a second.
    let steal = stat.split_whitespace().nth(8);
    10.0 * steal.and_then(|text| text.parse().ok()).unwrap_or(0.0)
}

fn read(path: &str) -> String {
    fs::read_to_string(path).unwrap_or_default()
}

/// Returns the value of the first `name: value`.
fn field<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    text.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        (key.trim() == name).then_some(value.trim())
    })
}

/// Returns the word in brackets: files under `/sys` mark the present choice with brackets.
fn chosen(text: &str) -> String {
    let word = text.split(['[', ']']).nth(1);
    word.unwrap_or("unknown").to_owned()
}

fn scheduling() -> &'static str {
    // SAFETY: reads the policy of the calling thread and touches no memory.
    match unsafe { libc::sched_getscheduler(0) } & !libc::SCHED_RESET_ON_FORK {
        libc::SCHED_FIFO => "SCHED_FIFO",
        libc::SCHED_RR => "SCHED_RR",
        libc::SCHED_OTHER => "SCHED_OTHER",
        libc::SCHED_BATCH => "SCHED_BATCH",
        _ => "another class",
    }
}

fn versions(lock: &str) -> BTreeMap<String, String> {
    let ours = ("tandem".to_owned(), env!("CARGO_PKG_VERSION").to_owned());
    let of = |name: &str| {
        let package = lock.split_once(&format!("\nname = \"{name}\"\nversion = \""))?;
        let (version, _) = package.1.split_once('"')?;
        Some((name.to_owned(), version.to_owned()))
    };
    let peers = PEERS.iter().filter_map(|name| of(name));
    std::iter::once(ours).chain(peers).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_machine_says_what_it_is() {
        let machine = Machine::this(&[0, 1]);
        assert!(!machine.kernel.is_empty() && machine.cpus > 0);
        assert!(machine.facts().iter().all(|(_, value)| !value.is_empty()));
    }

    #[test]
    fn stolen_time_is_the_eighth_figure() {
        assert_eq!(stolen("cpu  1 2 3 4 5 6 7 89 0 0\ncpu0 1 2 3 4"), 890.0);
        assert_eq!(stolen(""), 0.0);
    }

    #[test]
    fn the_versions_are_those_of_the_lock_file() {
        let lock = "[[package]]\nname = \"rtrb\"\nversion = \"0.4.1\"\nsource = \"x\"\n";
        assert_eq!(versions(lock)["rtrb"], "0.4.1");
        assert_eq!(versions(LOCK).len(), 1 + PEERS.len());
    }

    #[test]
    fn the_chosen_word_stands_in_brackets() {
        assert_eq!(chosen("always [advise] never\n"), "advise");
        assert_eq!(chosen(""), "unknown");
    }
}
