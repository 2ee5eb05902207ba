//! Tests of the stages of the network, one by one.

use super::*;
use chacha20::ChaCha8Rng;
use chacha20::rand_core::SeedableRng;
use std::vec;
use tandem_board::HardwareFaults;

const A: CoreAddress = CoreAddress::A0;
const B: CoreAddress = CoreAddress::B0;

fn ms(ms: u64) -> Instant {
    Instant::ORIGIN + Duration::from_ms(ms)
}

fn frame(id: u16) -> CanFrame {
    CanFrame::new(CanId::Standard(id), true, &[]).unwrap()
}

/// A network without delays, and its random numbers.
struct Bench {
    network: Network,
    noise: ChaCha8Rng,
}

impl Bench {
    fn new() -> Self {
        Self {
            network: Network::default(),
            noise: ChaCha8Rng::seed_from_u64(1),
        }
    }

    /// Sends a frame at this time; returns the frames that have been on the bus since.
    fn exchange(&mut self, from: CoreAddress, at_ms: u64) -> vec::Vec<Delivery> {
        let Self { network, noise } = self;
        let at = ms(at_ms);
        let sent = Sent::at(at);
        network
            .send_frame(from, &frame(1), sent, at, noise)
            .unwrap();
        self.settle(at_ms)
    }

    fn settle(&mut self, at_ms: u64) -> vec::Vec<Delivery> {
        self.network.settle_bus(ms(at_ms), &mut self.noise);
        core::iter::from_fn(|| self.network.carried()).collect()
    }
}

/// A connection loses frames of its own system only, in one direction, at the configured rate.
#[test]
fn a_faulty_connection_loses_frames_of_its_own_system() {
    let mut bench = Bench::new();
    bench.network.conditions.bus[0].lost_out = 100;
    bench.network.conditions.bus[1].lost_in = 1_000;
    let arrived = (0..10_000).map(|at| bench.exchange(A, at).len()).sum();
    assert!((8_900..9_100usize).contains(&arrived), "{arrived}");
    for at in 10_000..10_100 {
        let [carried] = bench.exchange(B, at)[..] else {
            panic!("the other system loses no frame");
        };
        assert!(carried.reach.has(A), "the other system hears");
        assert!(
            CoreAddress::ALL
                .iter()
                .all(|of| of.system == SystemId::A || !carried.reach.has(*of))
        );
    }
}

#[test]
fn a_cut_system_neither_sends_nor_hears() {
    let mut bench = Bench::new();
    let cuts = &mut bench.network.conditions.cuts;
    cuts.set(Wire::Can, SystemId::A, true);
    assert!(bench.exchange(A, 0).is_empty());
    let [carried] = bench.exchange(B, 0)[..] else {
        panic!("system B is connected");
    };
    let hears = CoreAddress::ALL.map(|of| carried.reach.has(of));
    assert_eq!(hears, [false, false, false, false, true, true]);
}

/// A slow connection delivers each frame at its own time, even if the fault ends before that.
#[test]
fn a_slow_connection_delivers_later() {
    let mut bench = Bench::new();
    bench.network.conditions.bus[0].late = Duration::from_ms(3);
    assert!(bench.exchange(A, 5).is_empty());
    assert_eq!(bench.exchange(B, 6).len(), 1, "the other system");
    assert_eq!(bench.network.next(), ms(8));
    assert!(bench.settle(7).is_empty());
    bench.network.conditions = Conditions::default();
    assert!(bench.settle(7).is_empty() && bench.network.is_disturbed());
    let [due] = bench.settle(8)[..] else {
        panic!("one frame is due");
    };
    assert_eq!((due.sent, due.at), (Sent::at(ms(5)), ms(8)));
    assert!(!bench.network.is_disturbed());
}

/// Two slow connections do not delay each other.
#[test]
fn the_slower_connection_does_not_hold_up_the_faster_one() {
    let mut bench = Bench::new();
    let bus = &mut bench.network.conditions.bus;
    (bus[0].late, bus[1].late) = (Duration::from_ms(9), Duration::from_ms(2));
    assert!(bench.exchange(A, 0).is_empty());
    assert!(bench.exchange(B, 1).is_empty());
    let senders = |bench: &mut Bench, at| {
        let carried = bench.settle(at).into_iter();
        carried.map(|it| it.sender).collect::<vec::Vec<_>>()
    };
    assert_eq!(senders(&mut bench, 3), [Sender::Core(B)]);
    assert_eq!(senders(&mut bench, 9), [Sender::Core(A)]);
}

/// A frame that the bus destroys waits in its controller until the core discards it, the core dies,
/// or the bus accepts it.
#[test]
fn a_frame_that_the_bus_destroys_waits_in_its_controller() {
    let broken = HardwareFaults(HardwareFaults::bit(HardwareFault::CanTransmit));
    let mut bench = Bench::new();
    let mut waits = |end: fn(&mut Network)| {
        bench.network = Network::default();
        bench.network.conditions.hardware[0] = broken;
        assert!(bench.exchange(A, 10).is_empty());
        assert!(!bench.network.is_ready(A, ms(20)));
        end(&mut bench.network);
        bench.network.conditions = Conditions::default();
        bench.settle(20).len()
    };
    assert_eq!(waits(|_| ()), 1);
    assert_eq!(waits(|network| network.discard(A)), 0);
    assert_eq!(waits(|network| network.stop_core(A)), 0);
    assert_eq!(waits(|network| network.restart(A)), 0);
    assert_eq!(waits(|network| network.stop(SystemId::A, ms(11))), 0);
    assert_eq!(waits(|network| network.stop(SystemId::B, ms(11))), 1);
}

/// S-4: the bus tells which frame of a core was on it and when, after any delay; of a discarded one
/// it tells nothing.
#[test]
fn the_bus_tells_when_a_marked_frame_was_on_it() {
    let mut bench = Bench::new();
    bench.network.conditions.bus[0].late = Duration::from_ms(3);
    let send = |bench: &mut Bench, mark| {
        let (at, Bench { network, noise }) = (ms(5), bench);
        let sent = Sent { at, mark };
        network.send_frame(A, &frame(1), sent, at, noise).unwrap();
    };
    for mark in [7, 0, 8] {
        send(&mut bench, mark);
    }
    assert!(bench.settle(7).is_empty());
    let times = |bench: &mut Bench, at| {
        let carried = bench.settle(at).into_iter();
        carried
            .map(|it| (it.sent.mark, it.at))
            .collect::<vec::Vec<_>>()
    };
    assert_eq!(times(&mut bench, 8), [(7, ms(8)), (0, ms(8)), (8, ms(8))]);
    bench.network.conditions.hardware[0] =
        HardwareFaults(HardwareFaults::bit(HardwareFault::CanTransmit));
    send(&mut bench, 9);
    bench.network.discard(A);
    bench.network.conditions = Conditions::default();
    assert_eq!(times(&mut bench, 20), []);
}

/// T-CHIP-5: edges and datagrams arrive after their delays; a stopped system loses its datagram.
#[test]
fn edges_and_datagrams_take_their_time() {
    let mut network = Network::new(WireTimes {
        line: Duration::from_ms(1),
        link: Duration::from_ms(2),
        ..WireTimes::default()
    });
    let edge = Arrival::Edge(SystemId::B, Line::Start, Edge::Rising);
    let datagram = Arrival::Datagram(SystemId::B, vec![1, 2]);
    let [line, link] = [Wire::Line(Line::Start), Wire::Link];
    let send = |network: &mut Network, wire, what: &Arrival| {
        assert_eq!(network.send(wire, SystemId::A, what.clone(), ms(0)), None);
    };
    send(&mut network, link, &datagram);
    send(&mut network, line, &edge);
    assert_eq!(network.next(), ms(1));
    assert_eq!(network.arrived(ms(0)), None);
    assert_eq!(network.arrived(ms(5)), Some(edge.clone()));
    assert_eq!(network.arrived(ms(5)), Some(datagram.clone()));
    send(&mut network, link, &datagram);
    network.stop(SystemId::A, ms(1));
    assert_eq!(network.arrived(ms(5)), None);
    network.conditions.cuts.set(line, SystemId::A, true);
    send(&mut network, line, &edge);
    assert_eq!(network.next(), Instant::NEVER, "the line is cut");
}
