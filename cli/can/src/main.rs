//! `tandem-can`: connects the bus of a run with a SocketCAN interface. `tandem run --can INTERFACE`
//! starts it.
#![forbid(unsafe_code)]

mod interface;

use std::io::{self, Read as _, stdin};
use std::process::{ExitCode, exit};

use anyhow::Context as _;
use clap::Parser;
use socketcan::{CanFdSocket, Socket as _};
use tandem::beside::Ready;
use tandem_board_host::socket::is_trusted;
use tandem_boot_host::{BusPipe, BusPipeListener};

/// Connects the bus of a run with a SocketCAN interface
#[derive(Debug, Parser)]
#[command(version)]
struct Cli {
    /// The interface: vcan0
    interface: String,

    /// The name under which it waits for the vehicle of the run
    name: String,
}

fn main() -> ExitCode {
    let args = Cli::parse();
    match connect(&args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("--can {}: {error:#}", args.interface);
            ExitCode::FAILURE
        }
    }
}

/// Opens both ends, tells `tandem run` so, and passes frames on until the vehicle ends.
fn connect(args: &Cli) -> anyhow::Result<()> {
    let opened = open(args);
    let answer = match &opened {
        Ok(_) => Ready::At(None),
        Err(error) => Ready::Refused(format!("--can {}: {error:#}", args.interface)),
    };
    answer.say()?;
    let Ok((socket, listener)) = opened else {
        return Ok(());
    };
    std::thread::spawn(end_without_run);
    let mut vehicle = listener.accept().context("the vehicle")?;
    while !is_trusted(&vehicle) {
        vehicle = listener.accept().context("the vehicle")?;
    }
    drop(listener);
    pass(&socket, &vehicle)
}

fn open(args: &Cli) -> anyhow::Result<(CanFdSocket, BusPipeListener)> {
    interface::check(&args.interface)?;
    let socket = CanFdSocket::open(&args.interface).context("opening it")?;
    let listener = BusPipeListener::bind(&args.name).context("the connection to the vehicle")?;
    Ok((socket, listener))
}

/// Ends this program when `tandem run` has ended. Without this it would wait for a vehicle that is
/// never started.
fn end_without_run() {
    let _closed = stdin().read(&mut [0]);
    exit(0);
}

/// Passes frames on in both directions until the vehicle ends.
fn pass(socket: &CanFdSocket, vehicle: &BusPipe) -> anyhow::Result<()> {
    std::thread::scope(|scope| {
        scope.spawn(|| from_interface(socket, vehicle));
        while let Ok(Some(frame)) = vehicle.receive() {
            // A frame that the interface does not take is lost, as for a listener that is not
            // there.
            let _lost = interface::to_socket(&frame).map(|it| socket.write_frame(&it));
        }
        exit(0)
    })
}

/// Passes frames on from the interface. If it is gone, the run continues without it.
fn from_interface(socket: &CanFdSocket, vehicle: &BusPipe) {
    loop {
        match socket.read_frame() {
            // The vehicle takes no more frames than its bus carries. The others wait in this
            // connection, and then on the interface, where the oldest are lost.
            Ok(frame) => {
                let _ended = interface::of_socket(&frame).map(|it| vehicle.send(&it));
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => {
                eprintln!("warning: the CAN interface has failed: {error}");
                exit(1);
            }
        }
    }
}
