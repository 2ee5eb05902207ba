//! Connections that take time.
#![allow(clippy::unwrap_used, reason = "all of it is a test")]

use tandem_board::{
    Board, Can, CanFrame, CanId, CoreId, Duration, Edge, Instant, Line, Lines, Link, SystemId,
};
use tandem_board_sim::{BitRates, Bits, Config, SimPair, WireTimes};

const RATES: BitRates = BitRates::TANDEM;

fn pair() -> SimPair {
    SimPair::idle(Config {
        watchdog: false,
        wires: WireTimes {
            line: Duration::from_us(3),
            link: Duration::from_us(50),
            bus: Some(RATES),
            wrong_bits: 0,
        },
        ..Config::default()
    })
}

fn frame(id: u16, data: &[u8]) -> CanFrame {
    CanFrame::new(CanId::Standard(id), true, data).unwrap()
}

fn send(pair: &SimPair, from: SystemId, core: CoreId, frame: &CanFrame) {
    pair.board(from, core).can().try_send(frame).unwrap();
}

/// S-3, S-4: an edge and a frame have the exact time of their arrival, on the clock of each system,
/// however late it is read. A power-on forgets the edge.
#[test]
fn what_hardware_stamps_has_the_exact_time() {
    let mut pair = pair();
    pair.set_clock_rate(SystemId::B, 100_000);
    pair.run_for(Duration::from_ms(1_000));
    let [near, far] = SystemId::ALL.map(|of| pair.board(of, CoreId::CONTROL));
    let clocks = || [near.now().as_ns(), far.now().as_ns()];
    let [near_ns, far_ns] = clocks();
    near.lines().send(Line::Time, Edge::Rising);
    let sent = frame(0x100, &[0x55; 16]);
    near.can().try_send_stamped(&sent).unwrap();
    assert_eq!((far.lines().time_edge(), near.can().stamp()), (None, None));
    pair.run_for(Duration::from_ms(1_000));
    // The clock of B is 1 in 10,000 faster: 3 µs are 3,000.3 ns on it.
    let at = far_ns + 3_000;
    let edge = far.lines().time_edge().unwrap();
    assert_eq!(edge.count, 1);
    assert!((at..=at + 1).contains(&edge.at.as_ns()), "{edge:?}");
    let takes = RATES.time(Bits::of(&sent)).as_ns();
    let stamp = Instant::from_ns(near_ns + takes);
    assert_eq!(near.can().stamp(), Some(stamp));
    let heard = far.can().try_receive().unwrap().at.as_ns();
    let at = far_ns + takes + takes / 10_000;
    assert!((at..=at + 1).contains(&heard), "{heard} {at}");
    near.lines().send(Line::Time, Edge::Falling);
    pair.run_for(Duration::from_ms(1));
    assert_eq!(far.lines().time_edge(), Some(edge), "a falling edge");
    pair.power_off(SystemId::B);
    pair.power_on(SystemId::B);
    let far = pair.board(SystemId::B, CoreId::CONTROL);
    assert_eq!(far.lines().time_edge(), None);
}

/// The waiting frame with the lowest identifier is sent next. A frame on the bus is not
/// interrupted, and the frames of one sender keep their order.
#[test]
fn frames_take_the_time_of_their_bits_and_the_lowest_identifier_wins() {
    let mut pair = pair();
    let frames = [(0x300, 64), (0x200, 16), (0x100, 8), (0x080, 0)];
    let frames = frames.map(|(id, length)| frame(id, &vec![0x55; length]));
    send(&pair, SystemId::A, CoreId::CONTROL, &frames[0]);
    pair.run_until(Instant::from_ns(1_000));
    send(&pair, SystemId::A, CoreId::CONTROL, &frames[3]);
    send(&pair, SystemId::A, CoreId::PLANNING, &frames[1]);
    send(&pair, SystemId::B, CoreId::CONTROL, &frames[2]);
    pair.run_for(Duration::from_ms(5));
    let pause = RATES.time(Bits::INTERMISSION);
    let mut at = Instant::ORIGIN;
    for (index, on_bus) in [0, 3, 2, 1].into_iter().zip(pair.take_bus_log()) {
        at += RATES.time(Bits::of(&frames[index]));
        assert_eq!((on_bus.frame, on_bus.at), (frames[index], at));
        at += pause;
    }
    assert!(pair.take_bus_log().is_empty());
}

/// A system that loses power in the middle of a frame destroys it; the other nodes continue after
/// the error frame. An edge that the system has sent still arrives; a datagram does not.
#[test]
fn what_a_system_sends_ends_with_its_power() {
    let mut pair = pair();
    let (lost, next) = (frame(0x100, &[0x55; 64]), frame(0x200, &[0x55; 8]));
    let a = pair.board(SystemId::A, CoreId::CONTROL);
    let b = pair.board(SystemId::B, CoreId::CONTROL);
    a.can().try_send(&lost).unwrap();
    b.can().try_send(&next).unwrap();
    pair.run_until(Instant::from_ns(100_000));
    a.lines().send(Line::Heartbeat1, Edge::Rising);
    a.link().try_send(&[1]).unwrap();
    pair.power_off(SystemId::A);
    assert_eq!(b.lines().received(Line::Heartbeat1, Edge::Rising), 0);
    pair.run_for(Duration::from_ms(1));
    assert_eq!(b.lines().received(Line::Heartbeat1, Edge::Rising), 1);
    assert_eq!(b.link().try_receive(&mut [0; 4]), None);
    let log = pair.take_bus_log();
    let begins =
        Instant::from_ns(100_000) + RATES.time(Bits::ERROR) + RATES.time(Bits::INTERMISSION);
    let [only] = log[..] else { panic!("{log:?}") };
    assert_eq!(only.frame, next);
    assert_eq!(only.at, begins + RATES.time(Bits::of(&next)));
}

/// A frame with wrong bits arrives later, and only once.
#[test]
fn a_frame_with_a_wrong_bit_is_sent_again() {
    let mut pair = SimPair::idle(Config {
        watchdog: false,
        wires: WireTimes {
            bus: Some(RATES),
            // One bit in a thousand: about every third frame of this length is destroyed.
            wrong_bits: 1_000_000,
            ..WireTimes::default()
        },
        ..Config::default()
    });
    let mut late = 0;
    for number in 0..100 {
        let frame = frame(0x100, &[number; 32]);
        let begins = pair.now();
        send(&pair, SystemId::A, CoreId::CONTROL, &frame);
        pair.run_for(Duration::from_ms(10));
        let log = pair.take_bus_log();
        assert_eq!(log.len(), 1, "{number}");
        late += u32::from(log[0].at > begins + RATES.time(Bits::of(&frame)));
    }
    assert!((10..60).contains(&late), "{late}");
}

#[test]
fn different_runs_have_different_digests() {
    let run = |data: &[u8], at_us| {
        let mut pair = pair();
        pair.run_for(Duration::from_us(at_us));
        send(&pair, SystemId::A, CoreId::CONTROL, &frame(0x100, data));
        pair.run_for(Duration::from_ms(1));
        pair.digest()
    };
    assert_eq!(run(&[1, 2], 7), run(&[1, 2], 7));
    assert_ne!(run(&[1, 2], 7), run(&[1, 3], 7));
    assert_ne!(run(&[1, 2], 7), run(&[1, 2], 8));
}

#[test]
fn a_clock_jumps_both_ways() {
    let mut pair = pair();
    pair.run_for(Duration::from_ms(20));
    let now = |pair: &SimPair| SystemId::ALL.map(|of| pair.board(of, CoreId::CONTROL).now());
    let before = now(&pair);
    pair.jump_clock(SystemId::A, 500);
    pair.jump_clock(SystemId::B, -7);
    pair.run_for(Duration::from_ms(1));
    let after = now(&pair);
    assert_eq!(after[0].since(before[0]), Duration::from_ms(501));
    assert_eq!(before[1].since(after[1]), Duration::from_ms(6));
}
