//! The arguments of `tandem flash` and `tandem bootloader`.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use clap::Args;
use tandem::args::parse_system;
use tandem_board::SystemId;
use tandem_boot_host::udp_bus::{GROUP, PORT, UdpBus};
use tandem_page::json::JsonOption;

const FLASH_EXAMPLES: &str = "\
Examples:
  tandem flash app.srec --key key.der --release 7      sign it and send it
  tandem flash app.srec --key key.der --release 7 --sign-only app.signed.srec
  tandem flash app.signed.srec --to B --resume         continue an interrupted transfer
  tandem flash app.srec --key key.der --release 8 --from app7.srec    what differs alone
  tandem flash --info --to A                           what system A holds
  tandem bootloader --flash a.flash --public key.pub.der --requested
                                                       a bootloader to send it to

The file holds the data of one slot, after its first 256 bytes. For the protocol, the addresses and
the meaning of refusals see docs/boot.md.";

/// Arguments of `tandem flash`.
#[derive(Debug, Args)]
#[command(after_help = FLASH_EXAMPLES)]
pub(crate) struct FlashArgs {
    /// S-records of objcopy or srec_cat, or a signed file
    #[arg(required_unless_present = "info")]
    pub(crate) file: Option<PathBuf>,

    /// Print what a system holds instead: versions, slots, log. Also of a driving vehicle
    #[arg(long, conflicts_with = "file", requires = "to")]
    pub(crate) info: bool,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub(crate) json: JsonOption,

    /// Sign the file with this private key (Ed25519, DER)
    #[arg(long, value_name = "FILE")]
    pub(crate) key: Option<PathBuf>,

    /// The key's number in the bootloader
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    pub(crate) key_number: u8,

    /// Number of the release; a bootloader refuses numbers below that of an approved release
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    pub(crate) release: u32,

    /// Start every core at the entry of the file, not core 0 alone
    #[arg(long)]
    pub(crate) every_core: bool,

    /// A start rolls the release back until the other system, too, has found that it works
    #[arg(long)]
    pub(crate) paired: bool,

    /// The application needs at least this release of the bootloader
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    pub(crate) needs_bootloader: u32,

    /// The application needs at least this release of the configuration
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    pub(crate) needs_configuration: u32,

    /// Once it is approved, applications with a lower number than this never boot again, if the
    /// board has a monotonic counter
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    pub(crate) security_counter: u8,

    /// Send only the difference to this file, the application that the controller runs: S-records,
    /// signed or not
    #[arg(long, value_name = "FILE")]
    pub(crate) from: Option<PathBuf>,

    /// Write the signed file instead of sending it
    #[arg(long, value_name = "FILE")]
    pub(crate) sign_only: Option<PathBuf>,

    /// The system to send it to [default: the one that listens]
    #[arg(long, value_name = "SYSTEM", value_parser = parse_system)]
    pub(crate) to: Option<SystemId>,

    /// Prove with this private key (Ed25519, DER) that this tester may program; needs --to
    #[arg(long, value_name = "FILE", requires = "to")]
    pub(crate) tester_key: Option<PathBuf>,

    /// The number of that key in the bootloader
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) tester_key_number: u8,

    /// Records to send without waiting for an answer; 0 waits after each record
    #[arg(long, value_name = "RECORDS", default_value_t = 16)]
    pub(crate) window: u8,

    /// Continue an interrupted transfer
    #[arg(long)]
    pub(crate) resume: bool,

    /// How long to wait for a bootloader, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    pub(crate) wait: u32,

    /// The bus
    #[command(flatten)]
    pub(crate) bus: BusArgs,
}

/// Arguments of `tandem bootloader`.
#[derive(Debug, Args)]
pub(crate) struct BootloaderArgs {
    /// The program flash of the system; created if missing
    #[arg(long, value_name = "FILE")]
    pub(crate) flash: PathBuf,

    /// A public key that it trusts (Ed25519, DER); the first one has number 0
    #[arg(long, value_name = "FILE")]
    pub(crate) public: Vec<PathBuf>,

    /// A tester's public key (Ed25519, DER); the first one has number 0. With any, only these
    /// testers may program
    #[arg(long, value_name = "FILE")]
    pub(crate) tester_public: Vec<PathBuf>,

    /// Which system
    #[arg(long, value_name = "SYSTEM", default_value = "A", value_parser = parse_system)]
    pub(crate) system: SystemId,

    /// Start as if the application had requested a download: wait 10 s for a host, not 20 ms
    #[arg(long)]
    pub(crate) requested: bool,

    /// Accept and start unsigned images, and log each of them
    #[arg(long)]
    pub(crate) monitor: bool,

    #[command(flatten)]
    #[allow(missing_docs)]
    pub(crate) json: JsonOption,

    /// Approve the image on trial, as the application does, and exit
    #[arg(long, conflicts_with = "json")]
    pub(crate) approve: bool,

    /// The bus
    #[command(flatten)]
    pub(crate) bus: BusArgs,
}

/// The CAN bus over UDP multicast.
#[derive(Debug, Args)]
pub(crate) struct BusArgs {
    /// Multicast group of the CAN bus, as in python-can's udp_multicast
    #[arg(long, default_value_t = GROUP)]
    pub(crate) group: Ipv4Addr,

    /// Port of the multicast group
    #[arg(long, default_value_t = PORT)]
    pub(crate) port: u16,
}

impl BusArgs {
    /// Joins the bus.
    pub(crate) fn join(&self) -> anyhow::Result<UdpBus> {
        Ok(UdpBus::join(self.group, self.port)?)
    }
}
