//! The CAN controller and the bus.

use super::supply::{is_first_incarnation, software_reset};
use crate::barrier::{
    PATIENCE, SETTLE, sleep, sleep_until, wait_for_all, wait_for_cores, woken_until, word,
};
use crate::case::{CaseFailure, check, equal, fail};
use core::sync::atomic::Ordering;
use tandem_board::{
    Board, Can, CanFrame, CanId, CoreAddress, CoreId, Duration, Instant, Received, Wake,
};

const HERE: &[CoreId] = &[CoreId::CONTROL, CoreId::PERCEPTION];
const PAUSE: Duration = Duration::from_ms(1);

/// Makes a frame that contains a number; its id, kind and length depend on the number.
#[track_caller]
fn numbered(sender: u8, number: u32) -> Result<CanFrame, CaseFailure> {
    let id = match number % 3 {
        0 => CanId::Standard(0x100 + (number % 0x400) as u16),
        _ => CanId::Extended(0x1800_0000 + number % 0x10_0000),
    };
    let mut data = [sender; 16];
    data[..4].copy_from_slice(&number.to_le_bytes());
    let fd = number.is_multiple_of(2);
    let len = if fd { 16 } else { 8 };
    CanFrame::new(id, fd, &data[..len]).or_else(|_| fail("the suite makes valid frames"))
}

/// Returns the sender and the number of a numbered frame.
fn number_of(frame: &CanFrame) -> Option<(u8, u32)> {
    let number = frame.data().first_chunk()?;
    Some((*frame.data().get(4)?, u32::from_le_bytes(*number)))
}

/// Sends as soon as the transmit buffer has room.
#[track_caller]
fn send<B: Board>(board: &B, frame: &CanFrame) -> Result<(), CaseFailure> {
    sleep_until(board, "the transmit buffer empties", || {
        board.can().try_send(frame).is_ok()
    })
}

/// Waits for the next frame.
#[track_caller]
fn receive<B: Board>(board: &B) -> Result<Received, CaseFailure> {
    let mut received = None;
    sleep_until(board, "a frame that was sent comes", || {
        received = board.can().try_receive();
        received.is_some()
    })?;
    received.map_or_else(|| fail("a frame that was sent comes"), Ok)
}

const ORDERED: u32 = 200;

pub(super) fn order_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_all(board, HERE, 1)?;
    for number in 0..ORDERED {
        send(board, &numbered(0xA0, number)?)?;
        if number % 8 == 7 {
            sleep(board, PAUSE)?;
        }
    }
    wait_for_all(board, HERE, 2)
}

/// Every other core of both systems receives the frames in order, each with its time.
pub(super) fn order_receiver<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let begin = board.now();
    wait_for_all(board, HERE, 1)?;
    let mut last_at = begin;
    for number in 0..ORDERED {
        let Received { frame, at } = receive(board)?;
        let expected = numbered(0xA0, number)?;
        let seen = number_of(&frame).map_or(u32::MAX, |(_, number)| number);
        equal(
            seen,
            number,
            "frames of one core come in order, and all of them",
        )?;
        check(frame == expected, "a frame comes as it was sent")?;
        check(at >= last_at, "the times of frames do not go back")?;
        check(
            at <= board.now(),
            "a frame has its time on the receiver's clock",
        )?;
        last_at = at;
    }
    wait_for_all(board, HERE, 2)?;
    check(board.can().try_receive().is_none(), "no frame comes twice")
}

const CHATTER: u32 = 60;

/// Core 0 of both systems sends at the same time.
pub(super) fn chatter<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_all(board, HERE, 1)?;
    for number in 0..CHATTER {
        send(board, &numbered(place.system.index() as u8, number)?)?;
        sleep(board, Duration::from_us(300))?;
    }
    // Wait for both systems, so that no core sends while the listeners compare.
    wait_for_all(board, HERE, 2)?;
    wait_for_all(board, HERE, 3)
}

/// Core 1 of both systems receives the frames of both senders; both must see the same order.
pub(super) fn listener<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_all(board, HERE, 1)?;
    let mut next = [0_u32; 2];
    let mut heard = 0x811C_9DC5_u32;
    for _ in 0..2 * CHATTER {
        let Received { frame, .. } = receive(board)?;
        let Some((sender @ 0..=1, number)) = number_of(&frame) else {
            return fail("only what was sent comes");
        };
        equal(
            number,
            next[usize::from(sender)],
            "frames of each sender come in order",
        )?;
        next[usize::from(sender)] += 1;
        // FNV-1a over the order of senders.
        heard = (heard ^ u32::from(sender)).wrapping_mul(0x0100_0193);
    }
    wait_for_all(board, HERE, 2)?;
    send(board, &numbered(0x40 + place.system.index() as u8, heard)?)?;
    let Received { frame, .. } = receive(board)?;
    let theirs = number_of(&frame).map_or(0, |(_, heard)| heard);
    equal(theirs, heard, "all receivers see one order on the bus")?;
    wait_for_all(board, HERE, 3)
}

pub(super) fn lonely_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for number in 0..5 {
        send(board, &numbered(0xA0, number)?)?;
    }
    wait_for_cores(board, HERE, 2)?;
    sleep(board, PAUSE)?;
    check(
        board.can().try_receive().is_none(),
        "a core does not receive what it sent",
    )
}

/// Receives all frames, which proves to the sender that they were on the bus.
pub(super) fn witness<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for _ in 0..5 {
        receive(board)?;
    }
    wait_for_cores(board, HERE, 2)
}

/// Every payload length of CAN and CAN FD.
const LENGTHS: [usize; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];

/// Returns the frames of the payload cases: each length, FD and classic, with the smallest and the
/// largest ids.
fn payloads() -> impl Iterator<Item = CanFrame> {
    const IDS: [CanId; 4] = [
        CanId::Standard(0),
        CanId::Standard(0x7FF),
        CanId::Extended(0),
        CanId::Extended(0x1FFF_FFFF),
    ];
    let data: [u8; 64] = core::array::from_fn(|index| (index as u8).wrapping_mul(37) ^ 0x80);
    LENGTHS
        .into_iter()
        .enumerate()
        .flat_map(move |(index, len)| {
            [true, false]
                .into_iter()
                .filter_map(move |fd| CanFrame::new(IDS[index % 4], fd, &data[64 - len..]).ok())
        })
}

pub(super) fn payload_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for frame in payloads() {
        send(board, &frame)?;
        sleep(board, PAUSE)?;
    }
    Ok(())
}

pub(super) fn payload_receiver<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for expected in payloads() {
        let Received { frame, .. } = receive(board)?;
        equal(
            frame.data().len() as u64,
            expected.data().len() as u64,
            "lengths stay",
        )?;
        check(frame.data() == expected.data(), "data stay")?;
        check(frame.id() == expected.id(), "ids stay, and their kind")?;
        check(
            frame.is_fd() == expected.is_fd(),
            "CAN FD stays CAN FD, and CAN stays CAN",
        )?;
    }
    Ok(())
}

/// Number of discarded bursts. Each is shorter than a receive FIFO.
const BURSTS: u8 = 10;
const BURST: u32 = 12;

/// Fills the transmit buffer, discards its content, and sends one frame that contains the number of
/// frames before the discard.
pub(super) fn discarding_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for burst in 0..BURSTS {
        let mut sent = 0;
        while sent < BURST && board.can().try_send(&numbered(burst, sent)?).is_ok() {
            sent += 1;
        }
        board.can().discard_unsent();
        send(board, &numbered(0x80 | burst, sent)?)?;
        let heard = || word(board, 0).load(Ordering::Acquire) > u32::from(burst);
        sleep_until(board, "the frame after a discard is sent", heard)?;
    }
    wait_for_cores(board, HERE, 2)
}

/// Receives the first frames of each burst (any number of them), then the frame sent after the
/// discard.
pub(super) fn discard_witness<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for burst in 0..BURSTS {
        let mut heard = 0;
        let sent = loop {
            let (kind, number) = number_of(&receive(board)?.frame).unwrap_or_default();
            if kind == 0x80 | burst {
                break number;
            }
            equal(kind, burst, "what was discarded is not sent later")?;
            equal(number, heard, "a discard leaves no hole in what was sent")?;
            heard += 1;
        };
        check(heard <= sent, "no frame comes twice")?;
        // Release pairs with Acquire in `discarding_sender`.
        word(board, 0).store(u32::from(burst) + 1, Ordering::Release);
    }
    wait_for_cores(board, HERE, 2)?;
    sleep(board, PAUSE)?;
    check(board.can().try_receive().is_none(), "no frame comes twice")
}

const STAMPED: u32 = 20;
/// First byte of the frames that are stamped, and of the frame after each.
const STAMPED_FRAME: u8 = 0xB0;
const NEXT_FRAME: u8 = 0xC0;

/// Sends a frame that the controller stamps as soon as the transmit buffer has room.
#[track_caller]
pub(super) fn send_stamped<B: Board>(board: &B, frame: &CanFrame) -> Result<(), CaseFailure> {
    sleep_until(board, "the transmit buffer empties", || {
        board.can().try_send_stamped(frame).is_ok()
    })
}

/// S-4: the stamp of a frame is when the other core receives it, whatever is sent around it.
pub(super) fn stamping_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    check(board.can().stamp().is_none(), "nothing was stamped yet")?;
    wait_for_cores(board, HERE, 1)?;
    for number in 0..STAMPED {
        let begin = board.now();
        for before in 0..number % 4 {
            send(board, &numbered(0xA0, before)?)?;
        }
        send_stamped(board, &numbered(STAMPED_FRAME, number)?)?;
        sleep(board, PAUSE)?;
        send(board, &numbered(NEXT_FRAME, number)?)?;
        let heard = || word(board, 0).load(Ordering::Acquire) > number;
        sleep_until(board, "the frames come", heard)?;
        let at = [1, 2].map(|index| word(board, index).load(Ordering::Relaxed));
        let at = Instant::from_words(at);
        let stamp = board.can().stamp();
        check(stamp == Some(at), "a frame is stamped when it is received")?;
        check(at >= begin, "a frame is on the bus after it is sent")?;
    }
    wait_for_cores(board, HERE, 2)
}

/// Tells the other core when each stamped frame came, after the next frame has come.
pub(super) fn stamp_witness<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for number in 0..STAMPED {
        loop {
            let Received { frame, at } = receive(board)?;
            match number_of(&frame) {
                Some((STAMPED_FRAME, _)) => {
                    for (index, value) in [1, 2].into_iter().zip(at.to_words()) {
                        word(board, index).store(value, Ordering::Relaxed);
                    }
                }
                Some((NEXT_FRAME, _)) => break,
                _ => {}
            }
        }
        // Release pairs with Acquire in `stamping_sender`.
        word(board, 0).store(number + 1, Ordering::Release);
    }
    wait_for_cores(board, HERE, 2)
}

/// S-4. First incarnation: sends a stamped frame. Second: has no stamp.
pub(super) fn stamps_once<B: Board>(board: &B, place: CoreAddress) -> Result<(), CaseFailure> {
    let none = board.can().stamp().is_none();
    check(none, "this incarnation has stamped nothing")?;
    if is_first_incarnation(board) {
        send_stamped(board, &numbered(STAMPED_FRAME, 0)?)?;
        sleep_until(board, "a frame is stamped", || {
            board.can().stamp().is_some()
        })?;
    }
    software_reset(board, place)
}

const WAKES: u32 = 10;

/// Sends while the receiver sleeps.
pub(super) fn paced_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    for number in 1..=WAKES {
        let ready = || word(board, 0).load(Ordering::Acquire) >= number;
        sleep_until(board, "the receiver goes to sleep", ready)?;
        if number % 2 == 0 {
            sleep(board, Duration::from_ms(3))?;
        }
        send(board, &numbered(0xA0, number)?)?;
    }
    Ok(())
}

pub(super) fn woken_receiver<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    board.can().wake_on_receive(true);
    for number in 1..=WAKES {
        word(board, 0).store(number, Ordering::Release);
        let mut received = None;
        woken_until(board, "a frame wakes a receiver that asked for it", || {
            received = board.can().try_receive();
            received.is_some()
        })?;
        let seen = received.and_then(|Received { frame, .. }| number_of(&frame));
        check(seen == Some((0xA0, number)), "the frame that woke is there")?;
    }
    Ok(())
}

/// Sends until the other core ends the case.
pub(super) fn steady_sender<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    let mut number = 0;
    let limit = board.now() + PATIENCE;
    while word(board, 0).load(Ordering::Acquire) == 0 {
        check(board.now() < limit, "the other core comes to its end")?;
        send(board, &numbered(0xA0, number)?)?;
        number += 1;
        sleep(board, PAUSE)?;
    }
    Ok(())
}

/// Interrupts may be spurious, but not in every wait.
pub(super) fn deaf_sleeper<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    let mut quiet = 0_u32;
    for _ in 0..20 {
        quiet += u32::from(board.wait(board.now() + Duration::from_ms(4)) == Wake::Deadline);
        while board.can().try_receive().is_some() {}
    }
    word(board, 0).store(1, Ordering::Release);
    check(
        quiet > 0,
        "frames do not wake a core that did not ask for it",
    )
}

/// If no frame arrives for this long, no further frame will.
const QUIET: Duration = Duration::from_ms(1_000);
/// More frames than any receive FIFO holds.
const FLOOD: u32 = 6_000;

pub(super) fn flood<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    wait_for_cores(board, HERE, 1)?;
    for number in 0..FLOOD {
        send(board, &numbered(0xA0, number)?)?;
    }
    // Release pairs with Acquire in `late_receiver`.
    word(board, 0).store(1, Ordering::Release);
    wait_for_cores(board, HERE, 2)
}

/// Waits until all frames have been sent; each of them must then be received or counted as lost.
pub(super) fn late_receiver<B: Board>(board: &B, _: CoreAddress) -> Result<(), CaseFailure> {
    let before = board.can().overruns();
    wait_for_cores(board, HERE, 1)?;
    sleep_until(board, "the flood ends", || {
        word(board, 0).load(Ordering::Acquire) == 1
    })?;
    sleep(board, SETTLE)?;
    let mut received = 0;
    let mut last = None;
    let lost = || board.can().overruns().wrapping_sub(before);
    let mut last_at = board.now();
    while received + lost() < FLOOD && board.now().since(last_at) < QUIET {
        let Some(Received { frame, .. }) = board.can().try_receive() else {
            board.wait(board.now() + PAUSE);
            continue;
        };
        let number = number_of(&frame).map(|(_, number)| number);
        check(number > last, "what is not lost comes in order, and once")?;
        last = number;
        last_at = board.now();
        received += 1;
    }
    equal(
        received + lost(),
        FLOOD,
        "every frame is received or counted as lost",
    )?;
    check(
        board.can().try_receive().is_none(),
        "what was counted as lost does not come",
    )?;
    wait_for_cores(board, HERE, 2)
}
