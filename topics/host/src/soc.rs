//! The SoC's process: takes the bus frames of both systems, and sends the four topics of commands.

use std::io;
use std::time::Duration;

use tandem_board::Instant;
use tandem_board_udp::UdpPlace;
use tandem_bus::{FrameReceiver, Message};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, SocTopic};
use tandem_topics::{CanFrame, CdrError, Endpoint, TopicType};

use crate::approach::{Approach, Orders};
use crate::gateway::{Gateway, Passed, content};
use crate::node::Node;
use tandem_qos_profiles::{LookupError, Profiles};

/// Protects samples of the four topics end to end, and says when each is due: at first, at once.
#[derive(Clone, Copy, Debug, Default)]
pub struct Commander {
    counters: [u8; 4],
    next: [Option<Instant>; 4],
}

impl Commander {
    /// Returns the payload of a topic if it is due at `now`: then its counter rises, so it must be
    /// written. Its period begins again at `now`, as at most one sample is due after a stall.
    ///
    /// # Errors
    /// [`CdrError`]: an order is out of the range of its type.
    pub fn due(
        &mut self,
        now: Instant,
        topic: SocTopic,
        orders: &Orders,
    ) -> Result<Option<Vec<u8>>, CdrError> {
        let place = topic as usize;
        if self.next[place].is_some_and(|next| now < next) {
            return Ok(None);
        }
        let counter = self.counters[place];
        macro_rules! protected {
            ($sample:expr) => {{
                let mut sample = $sample;
                sample.protect(counter)?;
                sample.encode()?.to_vec()
            }};
        }
        let payload = match topic {
            SocTopic::Power => protected!(orders.power),
            SocTopic::Lateral => protected!(orders.lateral),
            SocTopic::Longitudinal => protected!(orders.longitudinal),
            SocTopic::ParkingBrake => protected!(orders.brake),
        };
        self.counters[place] = counter.wrapping_add(1);
        let period = tandem_board::Duration::from_ms(topic.period_ms().into());
        // On the grid, as long as it keeps up with the time.
        let grid = self.next[place].map_or(now, |next| next + period);
        self.next[place] = Some(if grid > now { grid } else { now + period });
        Ok(Some(payload))
    }
}

/// Returns these endpoints with the quality of service that a profile has for them. A participant
/// borrows its endpoints for ever, so this is for the start of a process: it never frees them.
///
/// # Errors
/// [`LookupError`]: there is no such profile, or it does not fit together for a topic.
pub fn endpoints<const N: usize>(
    of: &[Endpoint; N],
    qos: impl Fn(&str) -> Result<tandem_topics::Qos, LookupError>,
) -> Result<&'static [Endpoint; N], LookupError> {
    let mut own = *of;
    for endpoint in &mut own {
        endpoint.qos = qos(endpoint.topic)?;
    }
    Ok(Box::leak(Box::new(own)))
}

/// The parking application on its participant.
#[derive(Debug)]
pub struct Soc {
    node: Node<4, 1>,
    gateway: Gateway,
    receiver: FrameReceiver,
    commander: Commander,
    approach: Approach,
}

impl Soc {
    /// Opens the SoC's participant, with the quality of service of a profile.
    ///
    /// # Errors
    /// The profile does not exist (as an error of input), or as [`Node::open`].
    pub fn open(
        place: UdpPlace,
        (profiles, profile): (&Profiles, &str),
        approach: Approach,
    ) -> io::Result<Self> {
        let wrong = |error| io::Error::new(io::ErrorKind::InvalidInput, error);
        let outputs = endpoints(&INPUTS, |topic| profiles.writer(profile, topic)).map_err(wrong)?;
        let inputs = endpoints(&OUTPUTS, |topic| profiles.reader(profile, topic)).map_err(wrong)?;
        Ok(Self {
            node: Node::open(place, outputs, inputs)?,
            gateway: Gateway::default(),
            receiver: FrameReceiver::new(),
            commander: Commander::default(),
            approach,
        })
    }

    /// Does what is due at this time of an emulated machine: as [`turn`](Self::turn), until no
    /// datagram is left. To be called every millisecond of that time.
    ///
    /// # Errors
    /// As [`Node::turn`].
    pub fn turn_at(&mut self, now: Instant) -> io::Result<()> {
        self.node.tell_time(now);
        while self.turn(Duration::ZERO)? {}
        Ok(())
    }

    /// Does what is due, and waits for at most this time. Returns whether a datagram has arrived.
    /// To be called at least every 5 ms.
    ///
    /// # Errors
    /// As [`Node::turn`].
    pub fn turn(&mut self, most: Duration) -> io::Result<bool> {
        let has_heard = self.node.turn(most)?;
        let now = self.node.now();
        while let Some(sample) = self.node.take(0) {
            let Ok(frame) = CanFrame::decode(sample.payload()) else {
                continue;
            };
            let passed = self.gateway.hear(now, sample.writer, &frame);
            if let (Some(Passed::InOrder), Some(message)) = (passed, self.message(&frame)) {
                self.approach.on_message(now, &message);
            }
        }
        let orders = self.approach.orders(now);
        for topic in SocTopic::ALL {
            if let Ok(Some(payload)) = self.commander.due(now, topic, &orders) {
                // A writer that has used all its numbers is silent, and the controller stops.
                let _ended = self.node.write(topic as usize, &payload);
            }
        }
        Ok(has_heard)
    }

    /// Returns the message of a frame of the DBC, checked end to end.
    fn message(&mut self, frame: &CanFrame) -> Option<Message> {
        self.receiver.receive(frame.id, content(frame)).ok()
    }

    /// Returns the time on the participant's clock.
    pub fn now(&self) -> Instant {
        self.node.now()
    }

    /// Returns the parking application.
    pub const fn approach(&self) -> &Approach {
        &self.approach
    }

    /// Returns what it has heard.
    pub const fn gateway(&self) -> &Gateway {
        &self.gateway
    }
}
