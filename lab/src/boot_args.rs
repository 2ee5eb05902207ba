//! The arguments of `tandem flash` and `tandem bootloader`.

use std::net::Ipv4Addr;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use tandem_board::SystemId;

const FLASH_EXAMPLES: &str = "\
Examples:
  tandem flash app.srec --key key.der --release 7      sign it and send it
  tandem flash app.srec --key key.der --release 7 --sign-only app.signed.srec
  tandem flash app.signed.srec --to B --resume         continue what broke off
  tandem bootloader --flash a.flash --public key.pub.der --requested
                                                       something to send it to

The file holds the data of one slot, behind its first 256 bytes. Protocol, addresses and what a
refusal means: docs/boot.md.";

/// Arguments of `tandem flash`.
#[derive(Debug, Args)]
#[command(after_help = FLASH_EXAMPLES)]
pub(crate) struct FlashArgs {
    /// S-records of objcopy or srec_cat, or a signed file
    pub(crate) file: PathBuf,

    /// Sign the file with this private key (Ed25519, DER)
    #[arg(long, value_name = "FILE")]
    pub(crate) key: Option<PathBuf>,

    /// The key's number in the bootloader
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    pub(crate) key_number: u8,

    /// Number of the release; a bootloader refuses lower ones than it has approved
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    pub(crate) release: u32,

    /// Write the signed file instead of sending it
    #[arg(long, value_name = "FILE")]
    pub(crate) sign_only: Option<PathBuf>,

    /// The system to send it to [default: whichever listens]
    #[arg(long, value_enum, ignore_case = true, value_name = "SYSTEM")]
    pub(crate) to: Option<System>,

    /// Records under way without an answer; 0 waits for each
    #[arg(long, value_name = "RECORDS", default_value_t = 16)]
    pub(crate) window: u8,

    /// Continue a transfer that broke off
    #[arg(long)]
    pub(crate) resume: bool,

    /// How long to wait for a bootloader, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 30)]
    pub(crate) wait: u32,

    /// Multicast group of the CAN bus, as python-can's udp_multicast
    #[arg(long, default_value_t = tandem_boot_host::udp_bus::GROUP)]
    pub(crate) group: Ipv4Addr,

    /// Its port
    #[arg(long, default_value_t = tandem_boot_host::udp_bus::PORT)]
    pub(crate) port: u16,
}

/// One of the two systems.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum System {
    /// System A
    #[value(name = "A")]
    A,
    /// System B
    #[value(name = "B")]
    B,
}

impl From<System> for SystemId {
    fn from(system: System) -> Self {
        match system {
            System::A => Self::A,
            System::B => Self::B,
        }
    }
}

/// Arguments of `tandem bootloader`.
#[derive(Debug, Args)]
pub(crate) struct BootloaderArgs {
    /// The program flash of the system; made if it is missing
    #[arg(long, value_name = "FILE")]
    pub(crate) flash: PathBuf,

    /// A public key that it believes (Ed25519, DER); the first one has number 0
    #[arg(long, value_name = "FILE")]
    pub(crate) public: Vec<PathBuf>,

    /// Which system
    #[arg(long, value_enum, ignore_case = true, default_value_t = System::A)]
    pub(crate) system: System,

    /// The application asked for a download: wait 10 s for a host, not 20 ms
    #[arg(long)]
    pub(crate) requested: bool,

    /// Take and start what is not signed, and log it
    #[arg(long)]
    pub(crate) monitor: bool,

    /// Approve what is on trial, as the application does, and end
    #[arg(long)]
    pub(crate) approve: bool,

    /// Multicast group of the CAN bus
    #[arg(long, default_value_t = tandem_boot_host::udp_bus::GROUP)]
    pub(crate) group: Ipv4Addr,

    /// Its port
    #[arg(long, default_value_t = tandem_boot_host::udp_bus::PORT)]
    pub(crate) port: u16,
}
