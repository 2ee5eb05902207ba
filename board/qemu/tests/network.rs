//! Two emulated systems on the Ethernet of this machine. Needs QEMU and the images, so only `cargo
//! xtask firmware test` runs it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::collections::BTreeSet;
use std::net::Ipv4Addr;
use std::path::PathBuf;

use tandem_board::{Channel, HardwareFault, NetworkAddress, Recipient, SystemId, VehiclePort};
use tandem_board_qemu::{EmulatedWorld, MachineOptions, WorldLayout};
use tandem_board_udp::{UdpChannel, UdpPlace};

/// An address of this test alone.
const INTERFACE: Ipv4Addr = Ipv4Addr::new(127, 77, 3, 1);

/// Runs for this many milliseconds of virtual time; returns who has sent what.
fn hear(
    world: &mut EmulatedWorld,
    channel: &UdpChannel,
    ms: u64,
) -> BTreeSet<(NetworkAddress, Vec<u8>)> {
    let mut heard = BTreeSet::new();
    let mut bytes = [0; 2_000];
    for _ in 0..ms {
        world.step().unwrap();
        while let Some(one) = channel.receive(&mut bytes) {
            heard.insert((one.from, bytes[..one.len].to_vec()));
        }
    }
    heard
}

/// D-1: a station outside hears both systems, and a datagram of any length comes back from each,
/// until a cable is cut.
fn a_station_hears_both(layout: WorldLayout) {
    let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    let image = PathBuf::from(images).join("network-echo");
    let mut world = EmulatedWorld::start(&image, layout, MachineOptions::default()).unwrap();
    let domain = if layout == WorldLayout::One { 227 } else { 228 };
    let place = UdpPlace::new(domain, INTERFACE).unwrap();
    world.connect_network(place).unwrap();
    world.step().unwrap();
    world.set_ignition(true);
    for channel in Channel::ALL {
        let station = UdpChannel::open(place, channel).unwrap();
        let greeted: Vec<_> = hear(&mut world, &station, 200).into_iter().collect();
        let greetings: Vec<_> = greeted.iter().map(|(_, bytes)| &bytes[..]).collect();
        assert_eq!(greetings, [[0; 3], [1; 3]], "the first port is that of A");
        for len in [0, 1, 236, 1_472] {
            let sent: Vec<u8> = (0..len).map(|index| index as u8).collect();
            for (at, _) in &greeted {
                station.send(Recipient::One(*at), &sent).unwrap();
            }
            let heard = hear(&mut world, &station, 30);
            let echoes = heard.iter().filter(|(_, bytes)| *bytes == sent);
            assert_eq!(echoes.count(), 2, "an echo of {len} bytes from each");
        }
        world.set_fault(SystemId::A, HardwareFault::Network, true);
        hear(&mut world, &station, 5);
        station.send(Recipient::One(greeted[0].0), &[9]).unwrap();
        let heard: Vec<_> = hear(&mut world, &station, 100).into_iter().collect();
        assert_eq!(heard, greeted[1..], "the cable of A is cut");
        world.set_fault(SystemId::A, HardwareFault::Network, false);
        let heard: Vec<_> = hear(&mut world, &station, 100).into_iter().collect();
        assert_eq!(heard, greeted, "and what was sent before is lost");
    }
    world.end().unwrap();
}

#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_station_hears_both_systems_of_one_machine() {
    a_station_hears_both(WorldLayout::One);
}

#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_station_hears_both_systems_of_two_machines() {
    a_station_hears_both(WorldLayout::Two);
}
