//! Records the frames of a vehicle that the driving functions drive. Tests include this file.

use tandem_board::{CanFrame, CanId, Received};
use tandem_bus::{Control, FrameTransmitter, Message, ModeCode, RoleCode};
use tandem_golden::{Functions, instant, play};
use tandem_peripherals::codec::{BusFrame, Reach, Sender};
use tandem_vehicle::{LocalBus, Scenario, World, WorldConfig};

/// Time for which the functions drive, ms.
pub(crate) const DRIVE_MS: u64 = 3_000;

/// Returns the frames of a vehicle that the functions drive.
pub(crate) fn record(scenario: &str) -> Vec<u32> {
    let mut world = World::new(&Scenario::load(scenario).unwrap(), WorldConfig { seed: 3 });
    let mut functions = Functions::new();
    let mut transmitter = FrameTransmitter::new();
    let mut recording = vec![];
    let mut bus = LocalBus::new(instant(0));
    for ms in 0..DRIVE_MS {
        let at = instant(ms);
        bus.now = at;
        world.run_period(at, &mut bus, &mut |_| {});
        for frame in bus.from_vehicle.drain(..) {
            let CanId::Standard(id) = frame.id() else {
                panic!("a frame of the DBC has a standard id");
            };
            functions.on_frame(at, id, frame.data());
            let on_bus = BusFrame {
                received: Received { frame, at },
                sender: Sender::Vehicle,
                reach: Reach::ALL,
            };
            recording.extend(on_bus.encode());
        }
        if let Some(command) = functions.tick(ms) {
            let control = Control {
                role: RoleCode::Master,
                mode: ModeCode::L3,
                term: 2,
                steering_angle: command.steering_angle,
                acceleration: command.acceleration,
                ..Control::default()
            };
            let frame = transmitter.encode(&Message::Control { system: 0, control });
            let frame = CanFrame::new(CanId::Standard(frame.id), true, frame.data());
            bus.to_vehicle.push(frame.unwrap());
        }
    }
    assert_eq!(
        functions.digest(),
        play(&recording, DRIVE_MS),
        "the golden replay computes what was computed while it was recorded"
    );
    recording
}
