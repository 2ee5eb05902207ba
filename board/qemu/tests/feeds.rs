//! The firmware of the controller loses its battery or its hardware fails, in one machine and in
//! two. Needs QEMU and the images, so only `cargo xtask firmware test` runs it.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "all of it is a test"
)]

use std::path::PathBuf;

use tandem_board::{HardwareFault, RoleLamp, SystemId, VehiclePort};
use tandem_board_qemu::{EmulatedWorld, MachineOptions, WorldLayout};

/// Virtual time limit of these tests, ms. Without sensors a system waits two seconds before it
/// begins.
const LIMIT_MS: u64 = 10_000;

/// Runs until `holds` returns true; returns for how many milliseconds it ran.
fn until(world: &mut EmulatedWorld, what: &str, holds: impl Fn(&EmulatedWorld) -> bool) -> u64 {
    for ms in 0..LIMIT_MS {
        if holds(world) {
            return ms;
        }
        world.step().unwrap();
    }
    panic!(
        "{what}: {:?}",
        SystemId::ALL.map(|system| world.role(system))
    );
}

fn power_loss_and_return(layout: WorldLayout) {
    use RoleLamp::{DegradedMaster, Master, Standby, Starting};
    let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    let image = PathBuf::from(images).join("controller");
    let mut world = EmulatedWorld::start(&image, layout, MachineOptions::default()).unwrap();
    world.step().unwrap();
    world.set_ignition(true);
    let [a, b] = SystemId::ALL;
    until(&mut world, "A leads and B stands by", |world| {
        world.role(a) == Master && world.role(b) == Standby
    });
    let under_rtos = world.log().matches("runs its tasks under FreeRTOS").count();
    assert_eq!(under_rtos, if layout == WorldLayout::Two { 2 } else { 0 });
    world.set_feed(a, false);
    let took = until(&mut world, "B drives alone", |world| {
        !world.is_powered(a) && world.role(b) == DegradedMaster
    });
    assert!(took <= 20, "B took {took} ms of virtual time");
    world.set_feed(a, true);
    until(&mut world, "A has power again", |world| world.is_powered(a));
    until(&mut world, "A is in a role again", |world| {
        world.role(a) != Starting
    });
    assert_ne!(world.role(a), Master, "B has the lead");
    assert_eq!(world.role(b), DegradedMaster);
    let log = world.end().unwrap();
    assert!(log.contains("bytes of stack"), "{log}");
}

/// Starts both systems and runs until A has been master for a second.
fn dual() -> EmulatedWorld {
    let images = std::env::var_os("TANDEM_IMAGES").expect("cargo xtask firmware test sets it");
    let image = PathBuf::from(images).join("controller");
    let mut world =
        EmulatedWorld::start(&image, WorldLayout::One, MachineOptions::default()).unwrap();
    let [a, b] = SystemId::ALL;
    world.step().unwrap();
    world.set_ignition(true);
    until(&mut world, "A leads and B stands by", |world| {
        world.role(a) == RoleLamp::Master && world.role(b) == RoleLamp::Standby
    });
    for _ in 0..1_000 {
        world.step().unwrap();
    }
    world
}

/// T-CHIP-6, T-RED-6: if the hardware of the master fails, B drives. A repaired system returns.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_system_whose_hardware_fails_is_replaced() {
    let [a, b] = SystemId::ALL;
    for (fault, within_ms) in [
        (HardwareFault::Undervoltage, 20),
        (HardwareFault::CanTransmit, 30),
    ] {
        let mut world = dual();
        world.set_fault(a, fault, true);
        let took = until(&mut world, "B drives", |world| {
            world.role(b) == RoleLamp::DegradedMaster
        });
        assert!(took <= within_ms, "{fault:?}: {took} ms of virtual time");
        assert_ne!(world.role(a), RoleLamp::Master, "{fault:?}");
        world.set_fault(a, fault, false);
        until(&mut world, "A is in a role again", |world| {
            world.is_powered(a) && world.role(a) != RoleLamp::Starting
        });
        assert_eq!(world.role(b), RoleLamp::DegradedMaster, "{fault:?}");
        world.end().unwrap();
    }
}

/// T-RED-6: a core of the master overwrites the whole LMU. B takes over.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_master_whose_memory_is_overwritten_is_replaced() {
    let [a, b] = SystemId::ALL;
    let mut world = dual();
    world.scribble(a, 1);
    let took = until(&mut world, "B drives", |world| {
        world.role(b) == RoleLamp::DegradedMaster
    });
    assert!(took <= 30, "{took} ms of virtual time");
    assert_ne!(world.role(a), RoleLamp::Master);
    world.end().unwrap();
}

#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_system_that_loses_its_battery_is_replaced_in_one_machine() {
    power_loss_and_return(WorldLayout::One);
}

/// With two machines, core 0 runs its tasks under FreeRTOS.
#[test]
#[ignore = "needs QEMU and the images: cargo xtask firmware test"]
fn a_system_that_loses_its_battery_is_replaced_in_two_machines() {
    power_loss_and_return(WorldLayout::Two);
}
