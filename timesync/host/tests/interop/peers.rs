//! The programs of a cell: ours, ptp4l, statime, tshark.

use crate::cell::{Bench, Log, Tool};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use tandem_timesync::gptp::{DelayMechanism, PtpProfile};

/// How the two ends of a cell talk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mechanism {
    EndToEnd,
    Peer,
    Gptp,
    /// End to end over UDP.
    Udp,
}

impl Mechanism {
    pub(crate) fn profile(self) -> PtpProfile {
        match self {
            Self::EndToEnd | Self::Udp => PtpProfile::END_TO_END,
            Self::Peer => PtpProfile {
                delay: DelayMechanism::Peer,
                ..PtpProfile::END_TO_END
            },
            Self::Gptp => PtpProfile::GPTP,
        }
    }

    const fn options(self) -> &'static str {
        match self {
            Self::EndToEnd => "--end-to-end",
            Self::Peer => "--peer",
            Self::Gptp => "--gptp",
            Self::Udp => "--end-to-end --udp",
        }
    }

    /// Returns the kinds of messages that a slave sends.
    pub(crate) const fn kinds_of_slave(self) -> &'static [u8] {
        match self {
            Self::EndToEnd | Self::Udp => &[0x1],
            // ptp4l asks too.
            Self::Peer | Self::Gptp => &[0x2, 0x3, 0xA],
        }
    }

    /// Returns the kinds of messages that a master sends.
    pub(crate) const fn kinds_of_master(self) -> &'static [u8] {
        match self {
            Self::EndToEnd | Self::Udp => &[0x0, 0x8, 0x9, 0xB],
            Self::Peer | Self::Gptp => &[0x0, 0x3, 0x8, 0xA, 0xB],
        }
    }
}

fn ours(bench: &Bench, network: usize, arguments: &[&str]) -> Log {
    let seconds = bench.seconds.to_string();
    let program = Path::new(env!("CARGO_BIN_EXE_tandem-ptp"));
    bench.spawn(
        network,
        program,
        &[arguments, &["--seconds", &seconds]].concat(),
    )
}

/// Any delay is accepted: on a busy machine one can be longer than in use.
pub(crate) fn our_slave(bench: &Bench, network: usize, it: Mechanism, interface: &str) -> Log {
    let options = [
        "slave",
        interface,
        it.options(),
        "--max-delay-us",
        "1000000",
    ];
    ours(bench, network, &options)
}

pub(crate) fn our_master(
    bench: &Bench,
    network: usize,
    it: Mechanism,
    interface: &str,
    options: &[&str],
) -> Log {
    let arguments = [&["master", interface, it.options()], options].concat();
    ours(bench, network, &arguments)
}

/// Starts ptp4l. It never steers the machine's clock, and tells an offset each second.
pub(crate) fn ptp4l(
    bench: &Bench,
    network: usize,
    it: Mechanism,
    is_slave: bool,
    interface: &str,
) -> Log {
    let socket = bench.file("uds");
    let mut config = format!(
        "[global]\nfree_running 1\ntime_stamping software\nlogSyncInterval -3\nsummary_interval -3\n\
         freq_est_interval 0\nlogAnnounceInterval -1\nannounceReceiptTimeout 2\nuds_address {}\n",
        socket.display()
    );
    config += match it {
        Mechanism::EndToEnd => "network_transport L2\ndelay_mechanism E2E\n",
        Mechanism::Udp => "network_transport UDPv4\ndelay_mechanism E2E\n",
        Mechanism::Peer => "network_transport L2\ndelay_mechanism P2P\n",
        // As in linuxptp's gPTP.cfg, but with a threshold that stamps in software can meet.
        Mechanism::Gptp => {
            "gmCapable 1\npriority1 248\nneighborPropDelayThresh 1000000\nassume_two_step 1\n\
             path_trace_enabled 1\nfollow_up_info 1\ntransportSpecific 1\n\
             ptp_dst_mac 01:80:C2:00:00:0E\nnetwork_transport L2\ndelay_mechanism P2P\n"
        }
    };
    let file = bench.file("ptp4l.cfg");
    std::fs::write(&file, config).unwrap();
    let file = file.display().to_string();
    let mut arguments = vec!["-f", &file, "-m", "-q", "-l", "6", "-i", interface];
    arguments.extend(is_slave.then_some("-s"));
    bench.spawn(network, &Tool::Ptp4l.program(), &arguments)
}

/// Starts statime as a slave of 802.1AS with a clock of its own. It takes part in an election,
/// which it must lose.
pub(crate) fn statime(bench: &Bench, network: usize, interface: &str) -> Log {
    let mut config = String::from("loglevel = \"info\"\nsdo-id = 256\nslave-only = true\n");
    config += "priority1 = 255\nvirtual-system-clock = true\n";
    let port = "network-mode = \"ethernet\"\ndelay-mechanism = \"P2P\"\nhardware-clock = \"none\"";
    writeln!(config, "[[port]]\ninterface = \"{interface}\"\n{port}").unwrap();
    let file = bench.file("statime.toml");
    std::fs::write(&file, config).unwrap();
    bench.spawn(
        network,
        &Tool::Statime.program(),
        &["-c", &file.display().to_string()],
    )
}

/// Frames that tshark records at one of our interfaces.
pub(crate) struct Captured {
    file: PathBuf,
    mac: String,
}

/// Starts to record at an interface with this address.
pub(crate) fn capture(bench: &Bench, network: usize, interface: &str, mac: &str) -> Captured {
    let file = bench.file("frames.pcapng");
    let seconds = format!("duration:{}", bench.seconds);
    let path = file.display().to_string();
    let arguments = ["-q", "-i", interface, "-a", &seconds, "-w", &path];
    bench.spawn(network, &Tool::Tshark.program(), &arguments);
    let mac = mac.to_owned();
    Captured { file, mac }
}

impl Captured {
    /// Asserts that tshark can read all that we have sent, that these kinds of messages are among
    /// it, and no other one.
    pub(crate) fn check(&self, kinds: &[u8]) {
        let fields = [
            "eth.src",
            "ptp.v2.messagetype",
            "_ws.malformed",
            "_ws.expert.message",
        ];
        let mut command = Command::new(Tool::Tshark.program());
        command.arg("-r").arg(&self.file).args(["-T", "fields"]);
        command.args(fields.iter().flat_map(|field| ["-e", field]));
        let output = command.output().unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        let mut found = BTreeSet::new();
        for line in said.lines().filter(|line| line.starts_with(&self.mac)) {
            let [_, kind, malformed, expert] = line.split('\t').collect::<Vec<_>>()[..] else {
                panic!("{line}");
            };
            assert!(malformed.is_empty() && expert.is_empty(), "{line}");
            found.extend(u8::from_str_radix(kind.trim_start_matches("0x"), 16));
        }
        assert_eq!(found, kinds.iter().copied().collect(), "{}", self.mac);
    }
}
