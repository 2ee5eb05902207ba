//! The Ethernet port: order, recipients, times, a full buffer, a cut cable.

use crate::barrier::{SETTLE, sleep, sleep_until, wait_for_peer};
use crate::case::{CaseFailure, check, equal, fail};
use tandem_board::{
    Board, Channel, CoreAddress, Datagram, FaultSource, HardwareFault, Instant, Network,
    NetworkAddress, Recipient, SystemId,
};

/// Room for the longest datagram of any board.
const BYTES: usize = 1_472;
/// Every datagram begins with these bytes, then its system, its channel and its number. Strangers
/// may send others.
const MARK: [u8; 2] = [0x7A, 0x4D];
const HEAD: usize = 8;
/// The number of the datagram by which the systems meet.
const HELLO: u32 = u32::MAX;

/// Returns byte `index` of datagram `number`.
const fn content(number: u32, index: usize) -> u8 {
    (number.wrapping_mul(0x9E37_79B1) >> 24) as u8 ^ index as u8
}

/// Returns the length of datagram `number`, from the shortest to the longest, in mixed order.
fn length<N: Network>(number: u32) -> usize {
    let most = N::MAX_BYTES.min(BYTES);
    HEAD + (number as usize).wrapping_mul(577) % (most - HEAD + 1)
}

fn datagram(from: SystemId, channel: Channel, number: u32) -> [u8; BYTES] {
    let mut bytes = core::array::from_fn(|index| content(number, index));
    bytes[..2].copy_from_slice(&MARK);
    bytes[2] = from.index() as u8;
    bytes[3] = channel.index() as u8;
    bytes[4..HEAD].copy_from_slice(&number.to_le_bytes());
    bytes
}

/// Sends datagram `number` as soon as the port takes it.
#[track_caller]
fn send<B: Board>(
    board: &B,
    channel: Channel,
    to: Recipient,
    number: u32,
) -> Result<(), CaseFailure> {
    let bytes = datagram(board.identity().system, channel, number);
    let bytes = &bytes[..length::<B::Network>(number)];
    sleep_until(board, "a port that is full sends", || {
        board.network().try_send(channel, to, bytes).is_ok()
    })
}

/// Returns the next datagram of the suite and its number, if it has arrived.
#[track_caller]
fn fetch<B: Board>(board: &B, channel: Channel) -> Result<Option<(u32, Datagram)>, CaseFailure> {
    let mut bytes = [0; BYTES];
    while let Some(received) = board.network().try_receive(channel, &mut bytes) {
        let peer = board.identity().system.peer();
        let number = u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]);
        let expected = datagram(peer, channel, number);
        if received.len < HEAD || bytes[..2] != MARK {
            continue;
        }
        equal(bytes[2], expected[2], "no system hears itself")?;
        equal(bytes[3], expected[3], "a channel carries its own datagrams")?;
        let len = length::<B::Network>(number);
        equal(
            received.len as u64,
            len as u64,
            "a datagram keeps its length",
        )?;
        check(bytes[..len] == expected[..len], "a datagram comes whole")?;
        return Ok(Some((number, received)));
    }
    Ok(None)
}

/// Waits for the next datagram that is no greeting, or that is one.
#[track_caller]
fn receive<B: Board>(
    board: &B,
    channel: Channel,
    is_greeting: bool,
) -> Result<(u32, Datagram), CaseFailure> {
    let mut found = Ok(None);
    sleep_until(board, "a datagram comes", || {
        found = fetch(board, channel);
        !matches!(&found, Ok(next) if next.is_none_or(|it| (it.0 == HELLO) != is_greeting))
    })?;
    found?.map_or_else(|| fail("a datagram comes"), Ok)
}

/// Greets everyone, and returns the address of the other system. Both systems call it together.
#[track_caller]
fn meet<B: Board>(board: &B, channel: Channel) -> Result<NetworkAddress, CaseFailure> {
    let own = board.network().address(channel);
    check(own.is_some(), "the port is connected")?;
    send(board, channel, Recipient::Everyone, HELLO)?;
    let (_, received) = receive(board, channel, true)?;
    check(Some(received.from) != own, "each station has an address")?;
    Ok(received.from)
}

/// D-1, S-2: both systems send on all channels; what comes is in order, and whole.
pub(super) fn order<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    const ROUNDS: u32 = 30;
    const BURST: u32 = 4;
    wait_for_peer(board, 1)?;
    let mut peers = [NetworkAddress::default(); Channel::ALL.len()];
    for (channel, peer) in Channel::ALL.into_iter().zip(&mut peers) {
        *peer = meet(board, channel)?;
    }
    for round in 0..ROUNDS {
        let numbers = round * BURST..(round + 1) * BURST;
        for number in numbers.clone() {
            for (channel, peer) in Channel::ALL.into_iter().zip(peers) {
                send(board, channel, Recipient::One(peer), number)?;
            }
        }
        for channel in Channel::ALL {
            for number in numbers.clone() {
                let (seen, received) = receive(board, channel, false)?;
                equal(seen, number, "datagrams come in order, and all of them")?;
                let from = peers[channel.index()];
                check(received.from == from, "a datagram tells its sender")?;
            }
        }
        // The buffers are small: the next round begins when this one was received.
        wait_for_peer(board, round + 2)?;
    }
    Ok(())
}

/// Sends to everyone, and to itself, and must hear nothing of that.
pub(super) fn caller<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    meet(board, Channel::Topics)?;
    let own = board.network().address(Channel::Topics).unwrap_or_default();
    send(board, Channel::Topics, Recipient::One(own), 1)?;
    send(board, Channel::Topics, Recipient::Everyone, 2)?;
    sleep(board, SETTLE)?;
    for channel in Channel::ALL {
        while let Some((number, _)) = fetch(board, channel)? {
            equal(number, HELLO, "only the greeting comes, perhaps twice")?;
        }
    }
    wait_for_peer(board, 2)
}

/// Hears what the other system sends to everyone, on its channel.
pub(super) fn audience<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    meet(board, Channel::Topics)?;
    let (number, _) = receive(board, Channel::Topics, false)?;
    equal(
        number,
        2_u32,
        "what is sent to everyone comes, and no other",
    )?;
    sleep(board, SETTLE)?;
    let other = fetch(board, Channel::Time)?;
    check(other.is_none(), "the other channel hears nothing")?;
    wait_for_peer(board, 2)
}

pub(super) fn long_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    let peer = Recipient::One(meet(board, Channel::Topics)?);
    for number in [1, 2] {
        send(board, Channel::Topics, peer, number)?;
    }
    wait_for_peer(board, 2)
}

/// Receives the first datagram into a buffer that is too short.
pub(super) fn short_receiver<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    meet(board, Channel::Topics)?;
    let mut short = [0; HEAD];
    let mut len = 0;
    let expected = datagram(SystemId::A, Channel::Topics, 1);
    sleep_until(board, "a datagram comes", || {
        let received = board.network().try_receive(Channel::Topics, &mut short);
        len = received.map_or(0, |it| it.len);
        short == expected[..HEAD]
    })?;
    equal(len as u64, HEAD as u64, "a short buffer is filled")?;
    let head = |number| datagram(SystemId::A, Channel::Topics, number);
    let mut bytes = [0; BYTES];
    sleep_until(board, "the next datagram comes", || {
        let received = board.network().try_receive(Channel::Topics, &mut bytes);
        received.is_some() && bytes[..HEAD] != head(HELLO)[..HEAD]
    })?;
    let is_second = bytes[..HEAD] == head(2)[..HEAD];
    check(is_second, "what does not fit is cut off")?;
    wait_for_peer(board, 2)
}

/// How many datagrams are sent without a pause: more than a buffer holds.
const FLOOD: u32 = 256;

/// Sends without a pause, then tells which datagrams were refused.
pub(super) fn flood<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    let peer = Recipient::One(meet(board, Channel::Topics)?);
    let mut refused = [0_u8; BYTES];
    for number in 0..FLOOD {
        let bytes = datagram(SystemId::A, Channel::Topics, number);
        let bytes = &bytes[..length::<B::Network>(number)];
        let sent = board.network().try_send(Channel::Topics, peer, bytes);
        refused[number as usize] = u8::from(sent.is_err());
    }
    // The other system has emptied its receiver after step 3.
    wait_for_peer(board, 2)?;
    wait_for_peer(board, 3)?;
    sleep_until(board, "a port that was full sends", || {
        let sent = board.network().try_send(Channel::Topics, peer, &refused);
        sent.is_ok()
    })?;
    wait_for_peer(board, 4)
}

pub(super) fn flooded<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_peer(board, 1)?;
    meet(board, Channel::Topics)?;
    wait_for_peer(board, 2)?;
    let mut came = [false; FLOOD as usize];
    let mut last = None;
    sleep(board, SETTLE)?;
    while let Some((number, _)) = fetch(board, Channel::Topics)? {
        if number != HELLO {
            check(
                last < Some(number),
                "what a full port had taken is in order",
            )?;
            last = Some(number);
            came[number as usize % came.len()] = true;
        }
    }
    check(
        last.is_some(),
        "a port that is full sends what it has taken",
    )?;
    wait_for_peer(board, 3)?;
    let mut refused = [0; BYTES];
    sleep_until(board, "a port that was full sends", || {
        let received = board.network().try_receive(Channel::Topics, &mut refused);
        received.is_some_and(|it| it.len == BYTES && refused[0] <= 1)
    })?;
    let both = came
        .iter()
        .zip(refused)
        .position(|(came, refused)| *came && refused == 1);
    check(both.is_none(), "what a full port refused does not come")?;
    wait_for_peer(board, 4)
}

/// S-2: each datagram has a time of sending and one of receiving, within the calls.
pub(super) fn times<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    const CHANNEL: Channel = Channel::Time;
    let network = board.network();
    check(network.sent_at(CHANNEL).is_none(), "nothing was sent yet")?;
    wait_for_peer(board, 1)?;
    let peer = Recipient::One(meet(board, CHANNEL)?);
    let (mut left, mut came) = (Instant::ORIGIN, Instant::ORIGIN);
    for number in 0..30 {
        let before = board.now();
        wait_for_peer(board, number + 2)?;
        let begin = board.now();
        send(board, CHANNEL, peer, number)?;
        let mut sent_at = None;
        sleep_until(board, "an accepted datagram leaves", || {
            sent_at = network.sent_at(CHANNEL);
            sent_at.is_some()
        })?;
        let sent_at = sent_at.unwrap_or_default();
        check(sent_at >= begin.max(left), "it leaves after the call")?;
        check(sent_at <= board.now(), "it has left when it says so")?;
        let (_, received) = receive(board, CHANNEL, false)?;
        check(
            received.at >= before.max(came),
            "it comes after it was sent",
        )?;
        check(received.at <= board.now(), "it comes before it is read")?;
        (left, came) = (sent_at, received.at);
    }
    wait_for_peer(board, 32)
}

/// The cable of system A is cut for a time: both directions lose silently, until it is mended.
pub(super) fn cut<B: FaultSource>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let set_cut = |is_cut| {
        if place.system == SystemId::A {
            board.set_fault(SystemId::A, HardwareFault::Network, is_cut);
        }
        sleep(board, SETTLE)
    };
    wait_for_peer(board, 1)?;
    let peer = Recipient::One(meet(board, Channel::Topics)?);
    wait_for_peer(board, 2)?;
    set_cut(true)?;
    wait_for_peer(board, 3)?;
    let address = board.network().address(Channel::Topics);
    check(address.is_some(), "a port with a cut cable is connected")?;
    send(board, Channel::Topics, peer, 1)?;
    send(board, Channel::Topics, Recipient::Everyone, 2)?;
    sleep(board, SETTLE)?;
    while let Some((number, _)) = fetch(board, Channel::Topics)? {
        equal(number, HELLO, "a cut cable loses what is sent")?;
    }
    wait_for_peer(board, 4)?;
    set_cut(false)?;
    wait_for_peer(board, 5)?;
    send(board, Channel::Topics, peer, 3)?;
    let (number, _) = receive(board, Channel::Topics, false)?;
    equal(
        number,
        3_u32,
        "a mended cable carries what is sent from then on",
    )?;
    wait_for_peer(board, 6)
}
