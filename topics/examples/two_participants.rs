//! A controller publishes a frame of the bus, and another participant gets it. The network is a
//! list here. `cargo run -p tandem-topics --example two_participants`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::error::Error;
use tandem_board::{Duration, Instant, NetworkAddress, Recipient};
use tandem_topics::endpoints::{INPUTS, OUTPUTS};
use tandem_topics::{CanFrame, Controller, Endpoint, GuidPrefix, Outlet, Participant, TopicType};

/// A participant that reads what controllers write, and writes nothing.
type Listener = Participant<0, 1, 3, 0, { CanFrame::PAYLOAD_LEN }>;
static NOTHING: [Endpoint; 0] = [];

/// What a participant has sent.
#[derive(Default)]
struct Sent(Vec<Vec<u8>>);

impl Outlet for Sent {
    fn send(&mut self, _to: Recipient, message: &[u8]) {
        self.0.push(message.to_vec());
    }
}

fn place(host: u8) -> NetworkAddress {
    let (address, port) = ([10, 0, 0, host], 7_410);
    NetworkAddress { address, port }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut controller = Controller::new(GuidPrefix([1; 12]), place(1), &OUTPUTS, &INPUTS);
    let mut listener = Listener::new(GuidPrefix([2; 12]), place(2), &NOTHING, &OUTPUTS);
    let (mut ours, mut theirs) = (Sent::default(), Sent::default());
    let (mut now, mut taken) = (Instant::ORIGIN, None);
    for ms in 0..1_000 {
        now += Duration::from_ms(1);
        controller.poll(now, &mut ours);
        listener.poll(now, &mut theirs);
        if ms == 500 {
            println!("the controller serves {} reader", controller.readers_of(0));
            let frame = CanFrame {
                id: 0x123,
                length: 2,
                ..CanFrame::default()
            };
            let sample = frame.encode()?;
            controller.write(0, sample.as_ref(), &mut ours)?;
        }
        for datagram in core::mem::take(&mut ours.0) {
            listener.hear(now, &datagram, &mut theirs);
        }
        for datagram in core::mem::take(&mut theirs.0) {
            controller.hear(now, &datagram, &mut ours);
        }
        if let Some(sample) = listener.take(0) {
            taken = Some(CanFrame::decode(sample.payload())?);
        }
    }
    let frame = taken.ok_or("no sample arrived")?;
    println!("frame {:#x} with {} bytes", frame.id, frame.length);
    assert_eq!((frame.id, frame.length), (0x123, 2));
    Ok(())
}
