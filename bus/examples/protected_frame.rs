//! A frame with end-to-end protection, and what its receiver says to a damaged, a repeated and a
//! right one. `cargo run -p tandem-bus --example protected_frame`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use tandem_bus::{Control, FrameReceiver, FrameTransmitter, Message};

fn main() {
    let control = Control {
        term: 2,
        steering_angle: 0.01,
        ..Control::default()
    };
    let message = Message::Control { system: 0, control };
    let mut transmitter = FrameTransmitter::new();
    let mut receiver = FrameReceiver::new();
    let frame = transmitter.encode(&message);
    let id = u32::from(frame.id);

    let mut damaged = frame.data().to_vec();
    damaged[8] ^= 1;
    println!("damaged:  {:?}", receiver.receive(id, &damaged));
    println!("right:    {:?}", receiver.receive(id, frame.data()));
    println!("repeated: {:?}", receiver.receive(id, frame.data()));
    let next = transmitter.encode(&message);
    println!("next:     {:?}", receiver.receive(id, next.data()));
}
