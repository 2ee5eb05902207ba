//! The Ethernet between the systems and further stations: one switch, and a cable to each station.

use alloc::collections::VecDeque;
use alloc::vec::Vec;

use rand::Rng;
use tandem_board::{Channel, Duration, Instant, NetworkAddress, NetworkFull, Recipient, SystemId};

use super::model::is_lost;

/// Time of a byte on the cable: 100 Mbit/s.
const BYTE: Duration = Duration::from_ns(80);
/// What a frame has besides the datagram, bytes: preamble, headers, check sequence, pause.
const AROUND_BYTES: usize = 66;
/// The transmit buffer is full while it holds more than this time's worth: 16 of the longest
/// datagrams.
const TRANSMIT_BUFFER: Duration = Duration::from_us(1_968);
/// How many datagrams of a channel wait at a station. Further ones are lost.
const RECEIVE_BUFFER: usize = 64;

/// A station of the network: a system, or another computer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Station(u8);

impl Station {
    /// Returns the station of a system.
    #[must_use]
    pub const fn of(system: SystemId) -> Self {
        Self(system.index() as u8)
    }

    /// Returns where the station hears: 10.0.0.1 for system A, 10.0.0.2 for B, and so on.
    #[must_use]
    pub const fn address(self, channel: Channel) -> NetworkAddress {
        NetworkAddress {
            address: [10, 0, 0, 1 + self.0],
            port: match channel {
                Channel::Topics => 7_410,
                Channel::Time => 319,
            },
        }
    }
}

/// What is wrong with the cable of a station. By default nothing is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PortFault {
    /// How many of a thousand datagrams that the station sends are lost. 1000: all.
    pub lost_out: u16,
    /// How many of a thousand datagrams to the station are lost. 1000: all.
    pub lost_in: u16,
    /// Additional delay of what the station sends.
    pub late_out: Duration,
    /// Additional delay of what it receives.
    pub late_in: Duration,
}

/// A datagram that was received.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Packet {
    /// The sender.
    pub from: NetworkAddress,
    /// When it arrived.
    pub at: Instant,
    /// The content.
    pub bytes: Vec<u8>,
}

/// A station's end of its cable.
#[derive(Clone, Debug, Default)]
struct Port {
    is_cut: bool,
    fault: PortFault,
    /// From this time on it is idle.
    free: Instant,
    /// When the newest datagram of each channel left, or will leave.
    left: [Option<Instant>; Channel::ALL.len()],
    /// Datagrams by their time of arrival, which may be in the future.
    inbox: [VecDeque<Packet>; Channel::ALL.len()],
}

/// The network of a run. A receiver polls it, so it never acts by itself.
#[derive(Clone, Debug)]
pub struct Ethernet {
    /// Time in the cables and the switch.
    delay: Duration,
    /// By the number of the station.
    ports: Vec<Port>,
}

impl Ethernet {
    /// Makes a network of systems A and B. A datagram arrives `delay` after its last bit has left.
    #[must_use]
    pub fn new(delay: Duration) -> Self {
        let ports = SystemId::ALL.map(|_| Port::default()).into();
        Self { delay, ports }
    }

    /// Connects a further station.
    ///
    /// # Panics
    /// If 254 stations are connected.
    pub fn join(&mut self) -> Station {
        assert!(self.ports.len() < 254, "a network has at most 254 stations");
        self.ports.push(Port::default());
        Station(self.ports.len() as u8 - 1)
    }

    fn port(&mut self, of: Station) -> &mut Port {
        &mut self.ports[usize::from(of.0)]
    }

    /// Sends a datagram.
    ///
    /// # Errors
    /// [`NetworkFull`] if the station has sent more than the cable carries.
    pub fn send(
        &mut self,
        (from, channel): (Station, Channel),
        to: Recipient,
        bytes: &[u8],
        now: Instant,
        noise: &mut impl Rng,
    ) -> Result<(), NetworkFull> {
        let port = self.port(from);
        let leaves = port.free.max(now);
        if leaves.since(now) >= TRANSMIT_BUFFER {
            return Err(NetworkFull);
        }
        port.free = leaves + BYTE.times((AROUND_BYTES + bytes.len()) as u32);
        port.left[channel.index()] = Some(leaves);
        let (free, fault) = (port.free, port.fault);
        if port.is_cut || is_lost(fault.lost_out, noise) {
            return Ok(());
        }
        let arrives = free + self.delay + fault.late_out;
        for (station, port) in (0..).map(Station).zip(&mut self.ports) {
            let hears = match to {
                Recipient::Everyone => station != from,
                Recipient::One(at) => station != from && station.address(channel) == at,
            };
            if hears && !port.is_cut && !is_lost(port.fault.lost_in, noise) {
                let at = arrives + port.fault.late_in;
                let inbox = &mut port.inbox[channel.index()];
                let behind = inbox.partition_point(|other| other.at <= at);
                let packet = Packet {
                    from: from.address(channel),
                    at,
                    bytes: bytes.into(),
                };
                if inbox.len() < RECEIVE_BUFFER {
                    inbox.insert(behind, packet);
                }
            }
        }
        Ok(())
    }

    /// Returns when the newest datagram of this channel left the station; `None` if it has not.
    #[must_use]
    pub fn sent_at(&self, (of, channel): (Station, Channel), now: Instant) -> Option<Instant> {
        let left = self.ports[usize::from(of.0)].left[channel.index()];
        left.filter(|left| *left <= now)
    }

    /// Forgets when a datagram of this channel left the station, because a newer one waits for the
    /// end of its job.
    pub fn forget_sent(&mut self, (of, channel): (Station, Channel)) {
        self.port(of).left[channel.index()] = None;
    }

    /// Returns the next datagram that has arrived at a station by `now`.
    pub fn receive(&mut self, (at, channel): (Station, Channel), now: Instant) -> Option<Packet> {
        let inbox = &mut self.port(at).inbox[channel.index()];
        let has_arrived = inbox.front().is_some_and(|packet| packet.at <= now);
        has_arrived.then(|| inbox.pop_front()).flatten()
    }

    /// Cuts or mends the cable of a station. What is on its way to the station is lost.
    pub fn set_cut(&mut self, of: Station, is_cut: bool, now: Instant) {
        let port = self.port(of);
        port.is_cut = is_cut;
        for inbox in &mut port.inbox {
            inbox.retain(|packet| packet.at <= now || !is_cut);
        }
    }

    /// Sets what is wrong with the cable of a station.
    pub fn disturb(&mut self, of: Station, fault: PortFault) {
        self.port(of).fault = fault;
    }

    /// Restarts the port of a station: nothing that was sent or received before is left.
    pub fn restart(&mut self, of: Station) {
        let port = self.port(of);
        let (is_cut, fault) = (port.is_cut, port.fault);
        *port = Port {
            is_cut,
            fault,
            ..Port::default()
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chacha20::ChaCha8Rng;
    use chacha20::rand_core::SeedableRng;

    const A: (Station, Channel) = (Station(0), Channel::Topics);
    const B: (Station, Channel) = (Station(1), Channel::Topics);
    const TO_B: Recipient = Recipient::One(Station(1).address(Channel::Topics));

    struct Bench(Ethernet, ChaCha8Rng);

    impl Bench {
        fn new() -> Self {
            let delay = Duration::from_us(5);
            Self(Ethernet::new(delay), ChaCha8Rng::seed_from_u64(1))
        }

        fn send(&mut self, from: (Station, Channel), to: Recipient, byte: u8, us: u64) {
            let Self(ethernet, noise) = self;
            let sent = ethernet.send(from, to, &[byte; 34], at(us), noise);
            assert_eq!(sent, Ok(()));
        }

        /// Returns the first bytes of all that has arrived.
        fn hears(&mut self, at_port: (Station, Channel), us: u64) -> Vec<u8> {
            let next = || self.0.receive(at_port, at(us));
            core::iter::from_fn(next).map(|it| it.bytes[0]).collect()
        }
    }

    fn at(us: u64) -> Instant {
        Instant::ORIGIN + Duration::from_us(us)
    }

    /// D-1, S-2: a datagram leaves behind those before it, and takes the time of its bits.
    #[test]
    fn a_datagram_has_the_times_of_the_cable() {
        let mut bench = Bench::new();
        bench.send(A, TO_B, 1, 100);
        bench.send(A, TO_B, 2, 100);
        assert_eq!(bench.0.sent_at(A, at(107)), None, "it waits for the first");
        assert_eq!(bench.0.sent_at(A, at(108)), Some(at(108)));
        assert_eq!(bench.hears(B, 112), [], "100 bytes, 8 µs, and 5 µs");
        let first = bench.0.receive(B, at(200)).unwrap();
        assert_eq!((first.at, first.from), (at(113), A.0.address(A.1)));
        assert_eq!(bench.0.receive(B, at(200)).unwrap().at, at(121));
    }

    #[test]
    fn everyone_is_all_others_on_the_channel_and_one_is_one() {
        let mut bench = Bench::new();
        let other = (bench.0.join(), Channel::Topics);
        bench.send(A, Recipient::Everyone, 1, 0);
        bench.send(A, TO_B, 2, 0);
        let own = Recipient::One(A.0.address(A.1));
        bench.send(A, own, 3, 0);
        assert_eq!(bench.hears(A, 999), []);
        assert_eq!(bench.hears(B, 999), [1, 2]);
        assert_eq!(bench.hears(other, 999), [1]);
        assert_eq!(bench.hears((B.0, Channel::Time), 999), []);
    }

    #[test]
    fn a_cut_loses_what_is_on_its_way_and_what_is_sent() {
        for cut in [A.0, B.0] {
            let mut bench = Bench::new();
            bench.send(A, TO_B, 1, 0);
            bench.send(A, TO_B, 2, 50);
            bench.0.set_cut(cut, true, at(51));
            bench.send(A, TO_B, 3, 60);
            bench.0.set_cut(cut, false, at(100));
            bench.send(A, TO_B, 4, 101);
            let arrive: &[u8] = if cut == A.0 { &[1, 2, 4] } else { &[1, 4] };
            assert_eq!(bench.hears(B, 999), arrive);
        }
    }

    #[test]
    fn a_disturbed_cable_loses_and_delays_in_its_direction() {
        let mut bench = Bench::new();
        let fault = PortFault {
            lost_out: 500,
            late_in: Duration::from_us(1_000),
            ..PortFault::default()
        };
        bench.0.disturb(A.0, fault);
        let to_a = Recipient::One(A.0.address(A.1));
        for byte in 0..40 {
            bench.send(A, TO_B, byte, u64::from(byte) * 10);
            bench.send(B, to_a, byte, u64::from(byte) * 10);
        }
        let through = bench.hears(B, 9_999);
        assert!((10..30).contains(&through.len()), "{through:?}");
        assert!(through.is_sorted());
        assert_eq!(bench.hears(A, 1_012), []);
        assert_eq!(bench.hears(A, 9_999).len(), 40);
    }

    #[test]
    fn a_full_port_refuses_and_a_full_receiver_loses() {
        let mut bench = Bench::new();
        let Bench(ethernet, noise) = &mut bench;
        let mut send = |us| ethernet.send(A, TO_B, &[0; 1_472], at(us), noise);
        assert!((0..16).all(|_| send(0).is_ok()));
        assert_eq!(send(0), Err(NetworkFull));
        assert_eq!(send(2_000), Ok(()));
        for us in 1..=100 {
            bench.send(A, TO_B, us as u8, 10_000 * us);
        }
        assert_eq!(bench.hears(B, 9_999_999).len(), RECEIVE_BUFFER);
        bench.send(A, TO_B, 7, 2_000_000);
        bench.0.restart(B.0);
        assert_eq!(bench.hears(B, 9_999_999), []);
    }
}
