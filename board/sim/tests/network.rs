//! The Ethernet of a pair: further stations, jobs, resets, and runs without it.
#![allow(clippy::unwrap_used, reason = "all of it is a test")]

use tandem_board::{
    Board, Channel, CoreId, Duration, HardwareFault, Instant, Network, Recipient, ResetCause,
    SystemId,
};
use tandem_board_sim::{Config, PortFault, SimPair};

const A: SystemId = SystemId::A;
const B: SystemId = SystemId::B;
const CONTROL: CoreId = CoreId::CONTROL;
const TOPICS: Channel = Channel::Topics;

fn config() -> Config {
    Config {
        watchdog: false,
        network: Some(Duration::from_us(5)),
        ..Config::default()
    }
}

/// Returns the first bytes of all that a port has received.
fn heard(port: &impl Network) -> Vec<u8> {
    let mut bytes = [0; 4];
    let next = || port.try_receive(TOPICS, &mut bytes).map(|_| bytes[0]);
    std::iter::from_fn(next).collect()
}

fn pass(pair: &mut SimPair) {
    pair.run_for(Duration::from_ms(1));
}

/// D-1: a computer outside both systems hears both, and is heard until its cable is cut.
#[test]
fn a_further_station_takes_part() {
    let mut pair = SimPair::idle(config());
    let soc = pair.join_network();
    let boards = SystemId::ALL.map(|system| pair.board(system, CONTROL));
    for (byte, board) in (1..).zip(&boards) {
        let sent = board
            .network()
            .try_send(TOPICS, Recipient::Everyone, &[byte]);
        assert_eq!(sent, Ok(()));
    }
    pass(&mut pair);
    assert_eq!(heard(&soc), [1, 2]);
    assert_eq!(heard(boards[0].network()), [2]);
    let to_b = Recipient::One(boards[1].network().address(TOPICS).unwrap());
    soc.try_send(TOPICS, to_b, &[3]).unwrap();
    let sent_at = soc.sent_at(TOPICS);
    assert_eq!(sent_at, Some(pair.now()), "its clock is the virtual time");
    pass(&mut pair);
    assert_eq!(heard(boards[0].network()), []);
    assert_eq!(heard(boards[1].network()), [1, 3]);
    let all_lost = PortFault {
        lost_out: 1_000,
        ..PortFault::default()
    };
    soc.disturb(all_lost);
    soc.try_send(TOPICS, to_b, &[4]).unwrap();
    soc.disturb(PortFault::default());
    pair.disturb_network(B, all_lost);
    let sent = boards[1]
        .network()
        .try_send(TOPICS, Recipient::Everyone, &[5]);
    assert_eq!(sent, Ok(()));
    pass(&mut pair);
    assert_eq!(heard(boards[1].network()), []);
    assert_eq!(heard(&soc), []);
}

/// S-2: what a job sends leaves when the job ends, and tells the time of that.
#[test]
fn a_datagram_leaves_at_the_end_of_its_job() {
    let mut pair = SimPair::idle(config());
    let a = pair.board(A, CONTROL);
    let send = |byte| a.network().try_send(TOPICS, Recipient::Everyone, &[byte]);
    send(1).unwrap();
    assert_eq!(a.network().sent_at(TOPICS), Some(a.now()));
    a.hold(Some(0));
    send(2).unwrap();
    a.hold(None);
    pass(&mut pair);
    assert_eq!(a.network().sent_at(TOPICS), None, "the newest has not left");
    a.let_go(0);
    assert_eq!(a.network().sent_at(TOPICS), Some(a.now()));
    pass(&mut pair);
    assert_eq!(heard(pair.board(B, CONTROL).network()), [1, 2]);
}

#[test]
fn a_system_that_restarts_hears_nothing_from_before() {
    let mut pair = SimPair::idle(config());
    let soc = pair.join_network();
    soc.try_send(TOPICS, Recipient::Everyone, &[1]).unwrap();
    pair.reset(A, ResetCause::Software);
    pair.run_for(Duration::from_ms(100));
    assert_eq!(heard(pair.board(A, CONTROL).network()), []);
    pair.set_fault(A, HardwareFault::Network, true);
    pair.reset(A, ResetCause::Software);
    pair.run_for(Duration::from_ms(100));
    assert_eq!(heard(pair.board(B, CONTROL).network()), [1]);
    soc.try_send(TOPICS, Recipient::Everyone, &[2]).unwrap();
    pass(&mut pair);
    let a = pair.board(A, CONTROL);
    assert_eq!(heard(a.network()), [], "a reset mends no cable");
    assert_eq!(a.network().sent_at(TOPICS), None);
}

#[test]
fn a_port_is_not_connected_without_a_network_or_on_another_core() {
    let without = SimPair::idle(Config::default());
    let with = SimPair::idle(config());
    for board in [without.board(A, CONTROL), with.board(A, CoreId::PERCEPTION)] {
        let network = board.network();
        assert_eq!(network.address(TOPICS), None);
        let sent = network.try_send(TOPICS, Recipient::Everyone, &[1]);
        assert_eq!(sent, Ok(()));
        assert_eq!(network.sent_at(TOPICS), None);
        assert_eq!(network.try_receive(TOPICS, &mut [0; 4]), None);
    }
    assert_eq!(without.now(), Instant::ORIGIN);
}
