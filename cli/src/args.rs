//! The arguments of the `tandem` command.

mod can_bus;
mod exec;
mod shown;
mod timing;

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::str::FromStr;

use crate::beside::PassedArguments;
use crate::board_kind::{BoardKind, DemoBoard};
use clap::builder::ArgPredicate;
use clap::{Args, Parser, Subcommand, ValueEnum};
use tandem_board::SystemId;
use tandem_board_udp::UdpPlace;
use tandem_boot_host::udp_bus::{GROUP, PORT};
use tandem_page::json::JsonOption;
use tandem_vehicle::sensors::{NoSensorFault, NoSensorTiming};
use tandem_vehicle::{SensorFault, SensorTiming};

pub use can_bus::CanBus;
pub use exec::{ExecArgs, ExecCommand, ExecRunArgs, ExecTargetArgs, ManifestArgs};
pub use shown::{FoxgloveArgs, WebArgs};
pub use timing::{GrandmasterArgs, GrandmasterScale, TimeArgs, TimeBoard};

const EXAMPLES: &str = "\
The three jobs:
  benchmark  tandem bench --quick
             latency between cores, beside the hardware's floor and other libraries
  kill       tandem run                       in one terminal
             kill -9 $(tandem ps --json | jq '.[] | select(.kind == \"supply\"
                                              and .role == \"master\") | .pid')
             the other system continues to drive; the report shows how
  reuse      the crates shm, redundancy, cores and bus are no_std; see README.md

With --json a command prints one JSON document, and nothing else on stdout; with --json=FILE, or
--json FILE if FILE ends in .json or is a path to a new file, it writes the document there beside
its text; docs/json.md.";

const RUN_EXAMPLES: &str = "\
Examples:
  tandem run                                   60 s of the scenario cut-in
  tandem run --scenario hard-braking --duration 30
  tandem run --scenario path/to/USA_US101-3_3_T-1.xml --out us101
  tandem run --soc 12 --duration 20            an ADAS computer parks over DDS (tandem topics)
  tandem run --json --quiet | jq .control_gap_max_ms

With --board qemu the same controller runs bare-metal in emulated machines. Time is the emulator's,
and the report says so. The run prints the emulators' process ids; you can kill those too.

Kill any process of the run while it drives (tandem ps lists them). At the end the run writes a
report into the folder that --out names: report.html, metrics.json, candump.log, two .hgrm files.";

const TOPICS_EXAMPLES: &str = "\
Examples:
  tandem topics                      what there is, who writes and reads it, and what does not fit
  tandem topics echo EgoMotion       a message of the bus, with names and units
  tandem topics echo vehicle/can --for 1s --json | jq .
  tandem topics rate                 how often each frame arrives
  tandem topics age                  how old each frame is
  tandem topics loss                 which frames were lost
  tandem topics soc --park 12        command the parking, as the ADAS computer does

The controller publishes while `tandem run --soc` drives. docs/topics.md shows how to subscribe with
Cyclone DDS. A writer of the controller serves two readers: beside the SoC, one `tandem topics`.";

/// A fail-operational controller: two systems of three cores each, and the vehicle that they drive
#[derive(Debug, Parser)]
#[command(name = "tandem", version, after_help = EXAMPLES, max_term_width = 100)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Drive a scenario with both systems, and write a report
    Run(RunArgs),
    /// List the processes of all runs
    Ps(PsArgs),
    /// Watch a run live, and inject faults by keys
    Top(PassedArguments),
    /// Show a run in Foxglove: as an MCAP file, or live
    Foxglove(PassedArguments),
    /// Show a run live as a web page on this machine, with buttons that inject faults
    Web(PassedArguments),
    /// Publish a run for observers; `tandem run` starts this
    #[command(hide = true)]
    Publish,
    /// Park the vehicle of a run; `tandem run --soc` starts this
    #[command(hide = true)]
    Soc(SocArgs),
    /// Give the time to a run, as the grandmaster that its clocks follow
    Grandmaster(GrandmasterArgs),
    /// Cut a wire of a run while it drives
    Cut(WireArgs),
    /// Restore a wire that was cut
    Mend(WireArgs),
    /// Switch a system of a run off or on while it drives
    Power(PowerArgs),
    /// Inject a hardware fault that no signal to a process can cause
    Fault(FaultArgs),
    /// Show, initialise or clear the data flashes that `tandem run --dflash` keeps
    Dflash(DflashArgs),
    /// List the built-in scenarios
    Scenarios(ScenariosArgs),
    /// Convert the CAN log of a run to a format of Vector's tools: ASC or BLF
    CanLog(PassedArguments),
    /// Drive a folder of scenarios in virtual time and judge each drive
    Judge(PassedArguments),
    /// Measure the latency between cores, beside the hardware's floor and other libraries
    Bench(PassedArguments),
    /// Try faults on the control cores of both systems, in virtual time
    Sim(PassedArguments),
    /// Inject faults into the processes and wires of real runs, and report the gap of each kind
    Chaos(PassedArguments),
    /// Run the thesis's experiments and print its figures beside the measured ones
    Thesis(PassedArguments),
    /// Show FreeRTOS tasks as an oscilloscope would: their periods and their preemption
    RtosDemo(PassedArguments),
    /// Show the topics between the controller and the SoC, or command as the SoC does
    Topics(TopicsArgs),
    /// Run the processes of a manifest: checked, supervised, restarted, ended in order
    Exec(ExecArgs),
    /// Show the vehicle's time: whom each clock follows, its offset, rate and status
    Time(TimeArgs),
    /// Download the smallest application over CAN to an empty controller, start it, and show a
    /// frame of each core
    BootDemo(BootDemoArgs),
    /// Sign an application and download it to a bootloader over CAN
    Flash(PassedArguments),
    /// Run the bootloader of one system on a flash file, and print what it would start
    Bootloader(PassedArguments),
    /// Print the completions of all commands for a shell
    Completions(PassedArguments),
    /// Write the man pages of all commands to a folder
    Man(PassedArguments),
}

/// Arguments of `tandem boot-demo`.
#[derive(Debug, Args)]
pub struct BootDemoArgs {
    /// What the controller runs on
    #[arg(long, value_enum, default_value_t = DemoBoard::Host)]
    pub board: DemoBoard,

    /// Folder of the images for the emulated board
    /// [default: the output folder of `cargo xtask firmware build`]
    #[arg(long, value_name = "FOLDER")]
    pub images: Option<PathBuf>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,
}

/// Arguments of `tandem scenarios`.
#[derive(Debug, Args)]
pub struct ScenariosArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,
}

/// Arguments of `tandem run`.
#[derive(Debug, Args)]
#[command(after_help = RUN_EXAMPLES)]
pub struct RunArgs {
    /// A built-in scenario (see `tandem scenarios`) or a CommonRoad XML file (2018b or 2020a)
    #[arg(
        long,
        value_name = "FILE|NAME",
        default_value = "cut-in",
        default_value_if("soc", ArgPredicate::IsPresent, "parking")
    )]
    pub scenario: String,

    /// Of a file with several planning problems: drive the one with this id [default: the first]
    #[arg(long, value_name = "ID", allow_negative_numbers = true)]
    pub problem: Option<i64>,

    /// What the controller runs on
    #[arg(long, value_enum, default_value_t = BoardKind::Host)]
    pub board: BoardKind,

    /// Keep both systems' program flash, and the signing key, in this folder; creates what is
    /// missing [default: a new flash with a factory image, for this run only]
    #[arg(long, value_name = "FOLDER")]
    pub program_flash: Option<PathBuf>,

    /// Update both systems to this release while they drive: first the standby, then the master,
    /// which hands over; the second update needs --reintegrate
    #[arg(long, value_name = "RELEASE")]
    pub update: Option<u32>,

    /// Open the bus to other programs: on a SocketCAN interface such as vcan0, or as `udp`, the bus
    /// of python-can's udp_multicast, which needs a route for multicast (docs/boot.md). They hear
    /// each frame, and what they send is on the bus
    #[arg(long, value_name = "INTERFACE|udp")]
    pub can: Option<CanBus>,

    /// Multicast group of that bus
    #[arg(long, value_name = "ADDRESS", default_value_t = GROUP, requires = "can")]
    pub can_group: Ipv4Addr,

    /// Port of that bus
    #[arg(long, value_name = "PORT", default_value_t = PORT, requires = "can")]
    pub can_port: u16,

    /// Connect both systems to this DDS domain, 0 to 230; each run needs one of its own
    /// (docs/topics.md) [default: no network; 0 with --soc or --grandmaster]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=230))]
    pub domain: Option<u16>,

    /// Address of the network interface of that domain
    #[arg(long, value_name = "ADDRESS", default_value_t = Ipv4Addr::LOCALHOST)]
    pub interface: Ipv4Addr,

    /// Start an ADAS computer that parks: forward over this way, m, then the parking brake; the
    /// driver asks for it from the start, unless --parks says when
    #[arg(long, value_name = "METRES", num_args = 0..=1, default_missing_value = "12",
          value_parser = parse_way)]
    pub soc: Option<f32>,

    /// Start a grandmaster of time, which both systems and the SoC follow
    #[arg(long, value_enum, value_name = "SCALE", num_args = 0..=1, default_missing_value = "tai")]
    pub grandmaster: Option<GrandmasterScale>,

    /// Start the controller without its bootloader, to measure what the bootloader costs
    #[arg(long, conflicts_with_all = ["program_flash", "update"])]
    pub no_bootloader: bool,

    /// The controller's image for an emulated board
    /// [default: built by `cargo xtask firmware build`]
    #[arg(long, value_name = "FILE")]
    pub firmware: Option<PathBuf>,

    /// How long to drive, in scenario time: 60, 60s, 1.5m
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = parse_duration,
          allow_hyphen_values = true)]
    pub duration: f64,

    /// Time limits: for real time, for a desktop, or chosen by what the machine grants
    #[arg(long, value_enum, default_value_t = Timing::Auto)]
    pub timing: Timing,

    /// Seed of the sensors' noise
    #[arg(long, default_value_t = 1)]
    pub seed: u64,

    /// Folder of the report; an existing folder must be empty or hold an earlier report
    #[arg(long, value_name = "DIR", default_value = "tandem-report")]
    pub out: PathBuf,

    /// Folder that keeps both systems' data flash from run to run [default: new for each run]
    #[arg(long, value_name = "DIR")]
    pub dflash: Option<PathBuf>,

    /// CPUs of the cores, as 0,1 or 0-3; core i runs on the i-th of them, modulo their number
    /// [default: all]
    #[arg(long, value_name = "LIST", value_parser = parse_cpus)]
    pub cpus: Option<CpuList>,

    /// Let a system that has restarted rejoin as standby
    #[arg(long)]
    pub reintegrate: bool,

    /// The driver overrides the function between these scenario times, in seconds: 10-15
    #[arg(long, value_name = "FROM-TO", value_parser = parse_span)]
    pub overrides: Option<(f64, f64)>,

    /// Time after which the driver answers a takeover request: 4s [default: never]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub answers: Option<f64>,

    /// Scenario time from which the driver wants the vehicle parked: 0s or 5s [default: never]
    #[arg(long, value_name = "TIME", value_parser = parse_start)]
    pub parks: Option<f64>,

    /// Make a sensor send nothing, or 400 ms late, between two scenario times in seconds:
    /// camera-front:lost:10-15 or radar-front:late:10-15; may be repeated
    #[arg(long, value_name = "SENSOR:KIND:FROM-TO", value_parser = parse_sensor_fault)]
    pub sensor_fault: Vec<String>,

    /// Set how a sensor's clock differs from the vehicle's, or how late it sends its lists:
    /// radar-front:offset:5ms, all:rate:100ppm, all:drift:0.5ppm/s, camera-front:jump:-50ms@10s,
    /// all:delay:20ms, all:jitter:5ms; may be repeated
    #[arg(long, value_name = "SENSOR:KIND:VALUE", value_parser = parse_sensor_time)]
    pub sensor_time: Vec<String>,

    /// Switch system A on this long after system B: 40ms
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    pub stagger: Option<f64>,

    /// Also record the run for Foxglove, to this MCAP file (docs/foxglove.md)
    #[arg(long, value_name = "FILE")]
    pub mcap: Option<PathBuf>,

    /// Show the run live in Foxglove, at this port of this machine; 0 chooses one
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "8765")]
    pub foxglove: Option<u16>,

    /// Show the run live as a web page on this port of 127.0.0.1, as `tandem web` does; 0 is a free
    /// port
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "0")]
    pub web: Option<u16>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,

    /// Print only errors, and where the run is shown
    #[arg(long, short)]
    pub quiet: bool,
}

impl RunArgs {
    /// Returns where both systems are on a network; `None` without one.
    pub fn network(&self) -> Option<UdpPlace> {
        let has_station = self.soc.is_some() || self.grandmaster.is_some();
        let domain = self.domain.or(has_station.then_some(0))?;
        UdpPlace::new(domain, self.interface).ok()
    }

    /// Returns the scenario time from which the driver wants the vehicle parked, s.
    pub fn parks_from_s(&self) -> Option<f64> {
        self.parks.or(self.soc.map(|_| 0.0))
    }
}

/// Arguments of the process that `tandem run --soc` starts.
#[derive(Debug, Args)]
pub struct SocArgs {
    /// The way to drive, m
    #[arg(long, value_parser = parse_way)]
    pub park: f32,

    /// Domain and address of the network: 3@127.0.0.1
    #[arg(long)]
    pub place: UdpPlace,

    /// The file that it writes
    #[arg(long)]
    pub leaves: PathBuf,

    /// The recording of its time
    #[arg(long)]
    pub times: PathBuf,

    /// Claim real time
    #[arg(long)]
    pub realtime: bool,
}

/// Arguments of `tandem cut` and `tandem mend`.
#[derive(Debug, Args)]
pub struct WireArgs {
    /// The wire
    #[arg(value_enum, value_name = "WIRE")]
    pub wire: WireName,

    /// Only the direction from this system [default: both]
    #[arg(long, value_name = "SYSTEM", value_parser = parse_system)]
    pub from: Option<SystemId>,

    /// The run
    #[command(flatten)]
    pub run: RunChoice,
}

/// Which run a command acts on.
#[derive(Debug, Args)]
pub struct RunChoice {
    /// Which run: its name, or the process id of its `tandem run` [default: the only one]
    #[arg(long = "run", value_name = "RUN")]
    pub name: Option<String>,
}

/// The wires between the systems and to the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum WireName {
    /// The first heartbeat line
    #[value(name = "heartbeat-1")]
    Heartbeat1,
    /// The second heartbeat line
    #[value(name = "heartbeat-2")]
    Heartbeat2,
    /// The start line
    Start,
    /// The line of time synchronisation
    Time,
    /// The power level line, which then reads as high
    Level,
    /// The data link
    Link,
    /// The connection to the CAN bus
    Can,
}

/// Arguments of `tandem power`.
#[derive(Debug, Args)]
pub struct PowerArgs {
    /// On or off
    #[arg(value_enum)]
    pub switch: Switch,

    /// The system
    #[arg(value_name = "SYSTEM", value_parser = parse_system)]
    pub system: SystemId,

    /// The run
    #[command(flatten)]
    pub run: RunChoice,
}

/// Values of the switch argument of `tandem power`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Switch {
    /// Restart a system that was switched off or whose supply was killed
    On,
    /// Cut the power of the system
    Off,
}

/// Arguments of `tandem fault`.
#[derive(Debug, Args)]
pub struct FaultArgs {
    /// The fault
    #[arg(value_enum)]
    pub fault: FaultKind,

    /// The system with the fault
    #[arg(value_name = "SYSTEM", value_parser = parse_system)]
    pub system: SystemId,

    /// End a lasting fault
    #[arg(long)]
    pub mend: bool,

    /// Seed of the random words that `lmu` writes
    #[arg(long, default_value_t = 1)]
    pub seed: u32,

    /// The run
    #[command(flatten)]
    pub run: RunChoice,
}

/// Faults that signals to a process cannot cause.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FaultKind {
    /// A core overwrites the whole shared memory of its system
    Lmu,
    /// Core 0 stops for 100 ms, longer than its watchdog waits
    Hang,
    /// A stray handshake edge on the start line
    Handshake,
    /// A stray sync edge on the start line
    Sync,
    /// The output driver reports an open load, until restored
    OpenLoad,
    /// The output driver reports a short circuit, until restored
    ShortCircuit,
    /// The bus destroys each frame that the system sends, so its CAN controller goes bus-off, until
    /// restored
    BusOff,
    /// The CAN receiver finds an error in each frame, until restored
    CanReceive,
    /// The chip signals an error on the error pin to its supply, until restored
    ErrorPin,
    /// The voltage of a supply rail is too low, until restored
    Undervoltage,
    /// The voltage of a supply rail is too high, until restored; then switch the system off and on
    Overvoltage,
    /// The cable of the Ethernet port is cut, until restored
    NetworkCut,
}

/// Arguments of `tandem dflash`.
#[derive(Debug, Args)]
pub struct DflashArgs {
    /// What to do
    #[command(subcommand)]
    pub command: DflashCommand,

    /// The folder of the data flashes, as for `tandem run --dflash`
    #[arg(long, value_name = "DIR", default_value = ".", global = true)]
    pub folder: PathBuf,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,
}

/// The subcommands of `tandem dflash`.
#[derive(Clone, Copy, Debug, Subcommand)]
pub enum DflashCommand {
    /// Print the state of both systems
    Show,
    /// Write the state of a new controller: one system is master, all counts are zero
    Init {
        /// The system that is master
        #[arg(long, value_name = "SYSTEM", default_value = "A", value_parser = parse_system)]
        master: SystemId,
    },
    /// Erase the data flash of one system or both
    Clear {
        /// The system [default: both]
        #[arg(value_name = "SYSTEM", value_parser = parse_system)]
        system: Option<SystemId>,
    },
}

/// Arguments of `tandem topics`.
#[derive(Debug, Args)]
#[command(after_help = TOPICS_EXAMPLES)]
pub struct TopicsArgs {
    /// What to do [default: list]
    #[command(subcommand)]
    pub command: Option<TopicsCommand>,

    /// Where to listen
    #[command(flatten)]
    pub place: TopicsPlace,
}

/// The subcommands of `tandem topics`.
#[derive(Debug, Subcommand)]
pub enum TopicsCommand {
    /// List topics, their writers and readers, and whose quality of service does not fit
    List,
    /// Print samples as they arrive, until Ctrl-C or for a time
    Echo {
        /// A topic, a message of the bus or its id: soc/power, EgoMotion, 0x110
        name: String,
    },
    /// Print how often each frame of the bus arrives, and the longest time between two
    Rate,
    /// Print the time since the last frame of each id, and which are late
    Age,
    /// Print the frames that neither system has published, by id
    Loss,
    /// Command the vehicle as the ADAS computer does
    Soc {
        /// Drive forward over this way, stop, and park, m
        #[arg(long, value_name = "METRES", value_parser = parse_way)]
        park: f32,
    },
}

/// Where `tandem topics` listens, and how.
#[derive(Clone, Debug, Args)]
pub struct TopicsPlace {
    /// The DDS domain, 0 to 230
    #[arg(long, value_name = "N", default_value_t = 0, global = true,
          value_parser = clap::value_parser!(u16).range(0..=230))]
    pub domain: u16,

    /// Address of the network interface
    #[arg(long, value_name = "ADDRESS", default_value_t = Ipv4Addr::LOCALHOST, global = true)]
    pub interface: Ipv4Addr,

    /// Quality of service: a profile of a DDS-XML file [default: Tandem::Soc, which is built in]
    #[arg(long, value_name = "FILE#LIBRARY::PROFILE", global = true)]
    pub profile: Option<ProfileName>,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,

    /// How long to listen, s: 5, 500ms [default: list 3s, rate, age and loss 5s, others no limit]
    #[arg(long = "for", value_name = "TIME", value_parser = parse_duration, global = true)]
    pub time_s: Option<f64>,
}

/// A profile of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProfileName {
    /// The file.
    pub file: PathBuf,
    /// The full name of the profile.
    pub name: String,
}

impl FromStr for ProfileName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.rsplit_once('#');
        let parts = parts.filter(|(file, name)| !file.is_empty() && name.contains("::"));
        let (file, name) = parts.ok_or("write it as soc.xml#Library::Profile")?;
        Ok(Self {
            file: file.into(),
            name: name.to_owned(),
        })
    }
}

fn parse_way(text: &str) -> Result<f32, String> {
    let most = tandem_topics_host::approach::WAY_MAX;
    let number = text.trim().trim_end_matches('m').trim_end();
    let way = number.parse().ok();
    way.filter(|way| *way > 0.0 && *way <= most)
        .ok_or_else(|| format!("write it as 12 or 12m: more than 0 and at most {most} m"))
}

/// Arguments of `tandem ps`.
#[derive(Debug, Args)]
pub struct PsArgs {
    #[command(flatten)]
    #[allow(missing_docs)]
    pub json: JsonOption,
}

/// Values of `--timing`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Timing {
    /// Real time if the machine grants it, with limits from its stalls, measured for 0.5 s
    Auto,
    /// Real time; fails if the machine does not grant it
    Rt,
    /// No real time
    Desktop,
}

/// A list of at least one CPU number, without duplicates.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CpuList(pub Vec<usize>);

/// The longest run, s. Limits the size of a run's log.
const DURATION_MAX_S: f64 = 3600.0;

/// Reads a time that may be the start of the scenario; returns seconds.
fn parse_start(text: &str) -> Result<f64, String> {
    match text.trim() {
        "0" | "0s" => Ok(0.0),
        later => parse_duration(later),
    }
}

/// Parses a time such as 20, 20s, 500ms or 1.5m. Returns seconds.
///
/// # Errors
/// If the text is not a time, or the time is longer than the longest run.
pub fn parse_duration(text: &str) -> Result<f64, String> {
    let text = text.trim();
    let unit_at = text
        .find(|c: char| c.is_ascii_alphabetic())
        .unwrap_or(text.len());
    let (number, unit) = text.split_at(unit_at);
    let factor = match unit {
        "" | "s" => 1.0,
        "ms" => 1e-3,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => return Err("write it as 60, 60s, 500ms or 1.5m".to_owned()),
    };
    let number: f64 = number
        .trim()
        .parse()
        .map_err(|_| "write it as 60, 60s, 500ms or 1.5m".to_owned())?;
    let seconds = number * factor;
    if !(seconds > 0.0 && seconds <= DURATION_MAX_S) {
        return Err(format!(
            "it must be more than 0 and at most {DURATION_MAX_S} s"
        ));
    }
    Ok(seconds)
}

fn parse_span(text: &str) -> Result<(f64, f64), String> {
    let (from, to) = text.split_once('-').ok_or("write it as 10-15")?;
    let seconds = |text: &str| text.trim_end_matches('s').parse::<f64>().ok();
    match (seconds(from), seconds(to)) {
        (Some(from), Some(to)) if (0.0..to).contains(&from) && to <= DURATION_MAX_S => {
            Ok((from, to))
        }
        _ => Err("write it as 10-15: in seconds, the first before the second".to_owned()),
    }
}

fn parse_sensor_fault(text: &str) -> Result<String, NoSensorFault> {
    text.parse::<SensorFault>().map(|_| text.to_owned())
}

fn parse_sensor_time(text: &str) -> Result<String, NoSensorTiming> {
    text.parse::<SensorTiming>().map(|_| text.to_owned())
}

/// Parses the name of a system, A or B, in either case.
///
/// # Errors
/// If the text is not one of the two names.
pub fn parse_system(text: &str) -> Result<SystemId, String> {
    let named = |system: &SystemId| system.to_string().eq_ignore_ascii_case(text);
    let found = SystemId::ALL.into_iter().find(named);
    found.ok_or_else(|| "it is A or B".to_owned())
}

fn parse_cpus(text: &str) -> Result<CpuList, String> {
    let number = |text: &str| {
        text.trim()
            .parse::<usize>()
            .map_err(|_| "write it as 0,1 or 0-3".to_owned())
    };
    let mut cpus = Vec::new();
    for part in text.split(',') {
        let (first, last) = match part.split_once('-') {
            Some((first, last)) => (number(first)?, number(last)?),
            None => (number(part)?, number(part)?),
        };
        if first > last || last > 4095 {
            return Err(format!("{part} is no range of CPUs"));
        }
        cpus.extend(first..=last);
    }
    let mut once = cpus.clone();
    once.sort_unstable();
    once.dedup();
    if once.len() < cpus.len() {
        return Err("a CPU is named twice".to_owned());
    }
    Ok(CpuList(cpus))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }

    #[test]
    fn spans_are_two_times_in_order() {
        assert_eq!(parse_span("10-15"), Ok((10.0, 15.0)));
        assert_eq!(parse_span("0s-2.5s"), Ok((0.0, 2.5)));
        for text in [
            "", "5", "5-", "6-5", "5-5", "-1-5", "nan-5", "1-inf", "1-1e9",
        ] {
            assert!(parse_span(text).is_err(), "{text}");
        }
    }

    #[test]
    fn durations_are_read_with_and_without_unit() {
        for (text, seconds) in [("60", 60.0), ("60s", 60.0), ("1.5m", 90.0), ("500 ms", 0.5)] {
            assert_eq!(parse_duration(text), Ok(seconds), "{text}");
        }
        for text in [
            "0", "-5", "nan", "NaN", "inf", "", "s", "1x", "2h", "1e400", "0ms",
        ] {
            assert!(parse_duration(text).is_err(), "{text}");
        }
    }

    #[test]
    fn cpus_are_lists_and_ranges() {
        assert_eq!(parse_cpus("0,1"), Ok(CpuList(vec![0, 1])));
        assert_eq!(parse_cpus("2, 0-1"), Ok(CpuList(vec![2, 0, 1])));
        for text in ["", "x", "1-0", "0,0", "0-99999", "-1", "0,"] {
            assert!(parse_cpus(text).is_err(), "{text}");
        }
    }

    #[test]
    fn ways_and_profiles_are_read() {
        assert_eq!(parse_way("12m"), Ok(12.0));
        assert_eq!(parse_way("0.5"), Ok(0.5));
        for text in ["", "0", "-1", "nan", "51", "1e9", "x"] {
            assert!(parse_way(text).is_err(), "{text}");
        }
        let profile = "a#b.xml#L::P".parse::<ProfileName>().unwrap();
        assert_eq!(
            (profile.file.to_str(), &*profile.name),
            (Some("a#b.xml"), "L::P")
        );
        for text in ["", "L::P", "#L::P", "a.xml#P"] {
            assert!(text.parse::<ProfileName>().is_err(), "{text}");
        }
    }
}
