//! The command lines of a run's processes: hidden arguments of this program.

use std::ffi::OsString;
use std::path::PathBuf;

use tandem_board::{CoreId, Generation, Identity, SystemId};
use tandem_board_udp::UdpPlace;

use crate::name::RunName;
use crate::realtime::{self, Claim, Grant};

/// The CPUs to which the six cores are pinned.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Pinning {
    /// Core i, counted over both systems (A0 is 0, B2 is 5), runs on CPU i modulo the CPU count.
    #[default]
    Auto,
    /// The kernel chooses the CPUs.
    Off,
    /// Core i runs on the CPU whose index is entry i of this list, modulo the length of the list.
    /// The index counts only the CPUs that the process may use.
    Cpus(Vec<usize>),
}

/// How the processes of a run are scheduled.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Schedule {
    /// Whether processes claim real-time priority and locked memory (the kernel may refuse).
    pub realtime: bool,
    /// The CPUs.
    pub pinning: Pinning,
}

impl Default for Schedule {
    fn default() -> Self {
        Self {
            realtime: true,
            pinning: Pinning::Auto,
        }
    }
}

impl Schedule {
    /// Returns what the kernel grants to a separate thread that makes the same claims as a core of
    /// a run with this schedule. A run prints the result at its start.
    ///
    /// This starts a thread, so call it after [`isolation::enter`](crate::isolation::enter).
    #[must_use]
    pub fn probe(&self) -> Grant {
        let priority = self.realtime.then_some(CONTROL_PRIORITY);
        let cpu = (self.pinning != Pinning::Off).then_some(0);
        realtime::probe(Claim {
            priority,
            cpu,
            lock_memory: self.realtime,
        })
    }
}

/// Priorities under SCHED_FIFO. The supply has the highest because it must always run. Next is the
/// vehicle, because its physics must keep time. Core 0 is above cores 1 and 2 because it controls.
const SUPPLY_PRIORITY: u8 = 80;
const VEHICLE_PRIORITY: u8 = 70;
const CONTROL_PRIORITY: u8 = 60;
const COMPUTE_PRIORITY: u8 = 40;

/// Arguments of all processes of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Common {
    /// The run.
    pub run: RunName,
    /// The scheduling of the processes.
    pub schedule: Schedule,
    /// The network of both systems; `None`: they are not connected to one.
    pub network: Option<UdpPlace>,
    /// The program's own arguments, after `--`.
    pub extra: Vec<OsString>,
}

/// Arguments of a supply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SupplyArgs {
    /// The common arguments.
    pub common: Common,
    /// Its system.
    pub system: SystemId,
    /// The file of the system's data flash.
    pub flash: PathBuf,
}

/// Arguments of a core.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CoreArgs {
    /// The common arguments.
    pub common: Common,
    /// The core and its incarnation.
    pub identity: Identity,
    /// The file of the system's data flash.
    pub flash: PathBuf,
    /// The application that a slot names; `None` in the first program of a core.
    pub application: Option<String>,
}

/// Arguments of the vehicle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct VehicleArgs {
    /// The common arguments.
    pub common: Common,
}

/// The arguments of any process of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ProcessArgs {
    /// A supply.
    Supply(SupplyArgs),
    /// A core.
    Core(CoreArgs),
    /// The vehicle.
    Vehicle(VehicleArgs),
}

/// The command line was not made by this program.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("hidden argument {0}: missing or not understood (it is made by this program itself)")]
pub struct InvalidArgs(&'static str);

/// Prefix of the first argument of an application; see [`jump`](crate::jump). The path of
/// its slot follows.
pub(crate) const APPLICATION: &str = "__application ";
const SUPPLY: &str = "__supply";
const CORE: &str = "__core";
const VEHICLE: &str = "__vehicle";

impl SupplyArgs {
    /// Returns the arguments of one of this supply's cores.
    #[must_use]
    pub fn core(&self, core: CoreId, generation: Generation) -> CoreArgs {
        CoreArgs {
            common: self.common.clone(),
            identity: Identity {
                system: self.system,
                core,
                generation,
            },
            flash: self.flash.clone(),
            application: None,
        }
    }

    /// Claims real-time scheduling for this process.
    #[must_use]
    pub fn claim(&self) -> Grant {
        self.common.claim(SUPPLY_PRIORITY, None)
    }
}

impl CoreArgs {
    /// Claims the core's CPU and real-time scheduling for this process.
    #[must_use]
    pub fn claim(&self) -> Grant {
        let of = self.identity;
        let index = of.address().index();
        let cpu = match &self.common.schedule.pinning {
            Pinning::Auto => Some(index),
            Pinning::Off => None,
            Pinning::Cpus(cpus) => index.checked_rem(cpus.len()).map(|at| cpus[at]),
        };
        let control = of.core == CoreId::CONTROL;
        self.common.claim(
            if control {
                CONTROL_PRIORITY
            } else {
                COMPUTE_PRIORITY
            },
            cpu,
        )
    }
}

impl VehicleArgs {
    /// Claims real-time scheduling for this process.
    #[must_use]
    pub fn claim(&self) -> Grant {
        self.common.claim(VEHICLE_PRIORITY, None)
    }
}

impl Common {
    fn claim(&self, priority: u8, cpu: Option<usize>) -> Grant {
        let realtime = self.schedule.realtime;
        let priority = realtime.then_some(priority);
        realtime::claim(Claim {
            priority,
            cpu,
            lock_memory: realtime,
        })
    }

    fn write(&self, argv: &mut Vec<OsString>) {
        let pinning = match &self.schedule.pinning {
            Pinning::Auto => "auto".to_owned(),
            Pinning::Off => "off".to_owned(),
            Pinning::Cpus(cpus) => cpus
                .iter()
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(","),
        };
        let realtime = if self.schedule.realtime { "on" } else { "off" };
        push(argv, "--run", self.run.as_str());
        push(argv, "--realtime", realtime);
        push(argv, "--pin", pinning);
        if let Some(network) = self.network {
            push(argv, "--network", network.to_string());
        }
    }
}

impl ProcessArgs {
    /// Returns the common arguments.
    #[must_use]
    pub const fn common(&self) -> &Common {
        match self {
            Self::Supply(args) => &args.common,
            Self::Core(args) => &args.common,
            Self::Vehicle(args) => &args.common,
        }
    }

    /// Returns the arguments that follow the program's name.
    #[must_use]
    pub fn to_argv(&self) -> Vec<OsString> {
        let mut argv = vec![];
        match self {
            Self::Supply(args) => {
                argv.push(SUPPLY.into());
                args.common.write(&mut argv);
                push(&mut argv, "--system", args.system.to_string());
                push(&mut argv, "--flash", &args.flash);
            }
            Self::Core(args) => {
                argv.push(CORE.into());
                args.common.write(&mut argv);
                push(&mut argv, "--system", args.identity.system.to_string());
                push(&mut argv, "--core", args.identity.core.to_string());
                push(
                    &mut argv,
                    "--generation",
                    args.identity.generation.0.to_string(),
                );
                push(&mut argv, "--flash", &args.flash);
            }
            Self::Vehicle(args) => {
                argv.push(VEHICLE.into());
                args.common.write(&mut argv);
            }
        }
        argv.push("--".into());
        argv.extend(self.common().extra.iter().cloned());
        argv
    }

    /// Parses the arguments that follow the program's name; `None` if they are not those of a
    /// process of a run.
    ///
    /// # Errors
    /// [`InvalidArgs`] if they begin like those of a process and the rest is invalid.
    pub fn parse(argv: impl IntoIterator<Item = OsString>) -> Option<Result<Self, InvalidArgs>> {
        let mut argv = argv.into_iter();
        let mut kind = argv.next()?.into_string().ok()?;
        let application = kind.strip_prefix(APPLICATION).map(str::to_owned);
        if application.is_some() {
            argv.next()?;
            kind = argv.next()?.into_string().ok()?;
        }
        if ![SUPPLY, CORE, VEHICLE].contains(&kind.as_str()) {
            return None;
        }
        let mut parsed = Self::parse_kind(&kind, argv);
        if let Ok(Self::Core(core)) = &mut parsed {
            core.application = application;
        }
        Some(parsed)
    }

    fn parse_kind(kind: &str, argv: impl Iterator<Item = OsString>) -> Result<Self, InvalidArgs> {
        let options = Options::collect(argv)?;
        let common = Common {
            run: options.parse("--run")?,
            schedule: Schedule {
                realtime: options.text("--realtime")? == "on",
                pinning: options.pinning()?,
            },
            network: options.network()?,
            extra: options.extra.clone(),
        };
        Ok(match kind {
            SUPPLY => Self::Supply(SupplyArgs {
                common,
                system: options.system()?,
                flash: options.value("--flash")?.into(),
            }),
            CORE => {
                let core = CoreId::new(options.parse("--core")?).ok_or(InvalidArgs("--core"))?;
                let generation = Generation(options.parse("--generation")?);
                Self::Core(CoreArgs {
                    common,
                    identity: Identity {
                        system: options.system()?,
                        core,
                        generation,
                    },
                    flash: options.value("--flash")?.into(),
                    application: None,
                })
            }
            _ => Self::Vehicle(VehicleArgs { common }),
        })
    }
}

fn push(argv: &mut Vec<OsString>, name: &str, value: impl Into<OsString>) {
    argv.push(name.into());
    argv.push(value.into());
}

struct Options {
    pairs: Vec<(OsString, OsString)>,
    extra: Vec<OsString>,
}

impl Options {
    fn collect(mut argv: impl Iterator<Item = OsString>) -> Result<Self, InvalidArgs> {
        let mut pairs = vec![];
        while let Some(name) = argv.next().filter(|name| name != "--") {
            pairs.push((name, argv.next().ok_or(InvalidArgs("value"))?));
        }
        Ok(Self {
            pairs,
            extra: argv.collect(),
        })
    }

    fn value(&self, name: &'static str) -> Result<&OsString, InvalidArgs> {
        let found = self.pairs.iter().find(|(known, _)| known == name);
        found.map(|(_, value)| value).ok_or(InvalidArgs(name))
    }

    fn text(&self, name: &'static str) -> Result<&str, InvalidArgs> {
        self.value(name)?.to_str().ok_or(InvalidArgs(name))
    }

    fn parse<T: std::str::FromStr>(&self, name: &'static str) -> Result<T, InvalidArgs> {
        self.text(name)?.parse().map_err(|_| InvalidArgs(name))
    }

    fn system(&self) -> Result<SystemId, InvalidArgs> {
        match self.text("--system")? {
            "A" => Ok(SystemId::A),
            "B" => Ok(SystemId::B),
            _ => Err(InvalidArgs("--system")),
        }
    }

    fn network(&self) -> Result<Option<UdpPlace>, InvalidArgs> {
        if self.value("--network").is_err() {
            return Ok(None);
        }
        self.parse("--network").map(Some)
    }

    fn pinning(&self) -> Result<Pinning, InvalidArgs> {
        match self.text("--pin")? {
            "auto" => Ok(Pinning::Auto),
            "off" => Ok(Pinning::Off),
            list => list
                .split(',')
                .map(|cpu| cpu.parse().map_err(|_| InvalidArgs("--pin")))
                .collect::<Result<_, _>>()
                .map(Pinning::Cpus),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn common(pinning: Pinning) -> Common {
        Common {
            run: "tandem-1-a".parse().unwrap(),
            schedule: Schedule {
                realtime: false,
                pinning,
            },
            network: None,
            extra: vec!["--scenario".into(), "cut in".into(), "--".into()],
        }
    }

    #[test]
    fn arguments_come_back_as_they_were() {
        let network = "3@127.0.0.1".parse().ok();
        let supply = SupplyArgs {
            common: Common {
                network,
                ..common(Pinning::Cpus(vec![1, 0]))
            },
            system: SystemId::B,
            flash: "/tmp/a b/--flash".into(),
        };
        let core = supply.core(CoreId::PLANNING, Generation(7));
        let vehicle = VehicleArgs {
            common: common(Pinning::Off),
        };
        for args in [
            ProcessArgs::Supply(supply),
            ProcessArgs::Core(core),
            ProcessArgs::Vehicle(vehicle),
        ] {
            assert_eq!(ProcessArgs::parse(args.to_argv()), Some(Ok(args)));
        }
    }

    /// T-BOOT-7: parses the arguments that the kernel passes when it starts the script of a slot.
    #[test]
    fn an_application_gets_its_name_and_the_arguments_of_its_core() {
        let args = CoreArgs {
            common: common(Pinning::Off),
            identity: Identity {
                system: SystemId::A,
                core: CoreId::CONTROL,
                generation: Generation(2),
            },
            flash: "/tmp/a.dflash".into(),
            application: Some("three-frames".to_owned()),
        };
        let mut argv = vec![
            "__application three-frames".into(),
            "/proc/self/fd/9".into(),
        ];
        argv.extend(ProcessArgs::Core(args.clone()).to_argv());
        assert_eq!(ProcessArgs::parse(argv), Some(Ok(ProcessArgs::Core(args))));
    }

    #[test]
    fn other_commands_are_not_ours() {
        assert_eq!(ProcessArgs::parse(vec![]), None);
        assert_eq!(ProcessArgs::parse(vec!["run".into(), "--run".into()]), None);
    }

    #[test]
    fn what_was_tampered_with_is_refused() {
        let args = ProcessArgs::Vehicle(VehicleArgs {
            common: common(Pinning::Auto),
        });
        let mut argv = args.to_argv();
        argv[2] = "../../etc".into();
        assert_eq!(ProcessArgs::parse(argv), Some(Err(InvalidArgs("--run"))));
        let mut argv = args.to_argv();
        argv.splice(1..1, ["--network".into(), "231@127.0.0.1".into()]);
        let refused = Some(Err(InvalidArgs("--network")));
        assert_eq!(ProcessArgs::parse(argv), refused);
        assert_eq!(
            ProcessArgs::parse(vec![CORE.into()]),
            Some(Err(InvalidArgs("--run")))
        );
    }
}
