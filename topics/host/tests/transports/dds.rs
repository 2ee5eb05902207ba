//! Topics over DDS: two participants on the loopback interface.

use crate::lmu::frame;
use crate::topic::{Checked, Transport};
use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::Duration;
use tandem_board_udp::UdpPlace;
use tandem_topics::{CanFrame, Durability, Endpoint, Qos, READERS, Reliability, TopicType};
use tandem_topics_host::node::Node;
use tandem_topics_host::typed::{TypedReader, TypedWriter};

/// The longest wait of a turn.
const TURN: Duration = Duration::from_millis(1);
const DEPTH: u8 = 3;

/// A topic in a domain of its own. `KEEPS`: late subscribers get the values that are kept.
pub(crate) struct Dds<const KEEPS: bool> {
    place: UdpPlace,
    ends: &'static [Endpoint; 1],
}

impl<const KEEPS: bool> Transport for Dds<KEEPS> {
    type Value = CanFrame;
    type Publisher = TypedWriter<Box<Node<1, 0>>, CanFrame, 1, 0>;
    type Subscriber = TypedReader<Box<Node<0, 1>>, CanFrame, 0, 1>;
    const DEPTH: u32 = DEPTH as u32;
    const LATE: u32 = if KEEPS { DEPTH as u32 } else { 0 };
    const SUBSCRIBERS: usize = READERS;
    const IS_INSTANT: bool = false;

    fn start() -> Self {
        static TOPICS: AtomicU16 = AtomicU16::new(0);
        // A domain is shared only with a test program that runs at the same time. The name of the
        // topic keeps the two apart; a participant borrows it for ever.
        let number = TOPICS.fetch_add(1, Ordering::Relaxed);
        let process = std::process::id();
        let topic = format!("transports-{process}-{number}").leak();
        let durability = match KEEPS {
            true => Durability::TransientLocal,
            false => Durability::Volatile,
        };
        let qos = Qos {
            reliability: Reliability::Reliable,
            durability,
            depth: DEPTH,
        };
        Self {
            place: UdpPlace::new(
                30 + (process as u16).wrapping_add(number) % 200,
                Ipv4Addr::LOCALHOST,
            )
            .unwrap(),
            ends: Box::leak(Box::new([Endpoint {
                topic,
                type_name: CanFrame::TYPE_NAME,
                qos,
            }])),
        }
    }

    fn value(number: u32) -> CanFrame {
        frame(number)
    }

    fn publisher(&self, _: u32) -> Self::Publisher {
        let node = Node::open(self.place, self.ends, &[]).unwrap();
        TypedWriter::new(Box::new(node), 0)
    }

    fn subscriber(&self) -> Self::Subscriber {
        let node = Node::open(self.place, &[], self.ends).unwrap();
        TypedReader::new(Box::new(node), 0)
    }

    fn fill(place: &mut CanFrame, value: CanFrame) -> *const u8 {
        *place = value;
        std::ptr::from_ref(place).cast()
    }

    fn read(view: &CanFrame) -> (CanFrame, *const u8) {
        (*view, std::ptr::from_ref(view).cast())
    }

    fn turn_publisher(publisher: &mut Self::Publisher, subscribers: usize) -> bool {
        publisher.node.turn(TURN).unwrap();
        publisher.node.participant.readers_of(0) == subscribers
    }

    fn turn_subscriber(subscriber: &mut Self::Subscriber, publishers: usize) -> bool {
        subscriber.node.turn(TURN).unwrap();
        subscriber.node.participant.writers_of(0).count() == publishers
    }
}

impl Checked for Dds<false> {
    fn publish_garbage(publisher: &mut Self::Publisher) {
        publisher.node.write(0, &[0, 1, 0, 0, 9, 9]).unwrap();
    }
}
