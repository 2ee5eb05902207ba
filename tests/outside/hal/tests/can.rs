//! Frames to and from the drivers of a HAL: one of CAN FD, and one of classic CAN.

use embedded_can::{ExtendedId, Frame, Id, StandardId};
use tandem_board::{CanFrame, CanId, InvalidFrame};
use tandem_bus::{Control, FrameError, FrameReceiver, FrameTransmitter, Message, ReceiveError};

/// A driver's frame of up to `MOST` bytes.
#[derive(Clone, Debug, PartialEq)]
struct Driver<const MOST: usize> {
    id: Id,
    is_remote: bool,
    dlc: usize,
    data: Vec<u8>,
}

impl<const MOST: usize> Frame for Driver<MOST> {
    fn new(id: impl Into<Id>, data: &[u8]) -> Option<Self> {
        let (id, is_remote, dlc, data) = (id.into(), false, data.len(), data.to_vec());
        (dlc <= MOST).then_some(Self {
            id,
            is_remote,
            dlc,
            data,
        })
    }

    fn new_remote(id: impl Into<Id>, dlc: usize) -> Option<Self> {
        let (id, is_remote, data) = (id.into(), true, vec![]);
        Some(Self {
            id,
            is_remote,
            dlc,
            data,
        })
    }

    fn is_extended(&self) -> bool {
        matches!(self.id, Id::Extended(_))
    }

    fn is_remote_frame(&self) -> bool {
        self.is_remote
    }

    fn id(&self) -> Id {
        self.id
    }

    fn dlc(&self) -> usize {
        self.dlc
    }

    fn data(&self) -> &[u8] {
        &self.data
    }
}

type Fd = Driver<64>;
type Classic = Driver<8>;

fn ids() -> [Id; 4] {
    [
        StandardId::ZERO.into(),
        StandardId::MAX.into(),
        ExtendedId::ZERO.into(),
        ExtendedId::MAX.into(),
    ]
}

/// Each id and each length that the bus carries goes to a driver and back; no other length does.
#[test]
fn frames_go_to_a_driver_and_back() {
    let carried = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
    for id in ids() {
        for len in 0..=64 {
            let data: Vec<u8> = (0..len).collect();
            let theirs = <Fd as Frame>::new(id, &data).unwrap();
            let ours = CanFrame::from_hal(&theirs);
            assert_eq!(ours.is_ok(), carried.contains(&len), "{len} bytes");
            let Ok(ours) = ours else { continue };
            assert_eq!((ours.data(), ours.is_fd()), (&data[..], len > 8));
            assert_eq!(Frame::id(&ours), id);
            assert_eq!(ours.is_extended(), theirs.is_extended());
            assert_eq!(ours.to_hal::<Fd>(), Some(theirs));
            assert_eq!(ours.to_hal::<Classic>().is_some(), len <= 8);
            assert_eq!(<CanFrame as Frame>::new(id, &data), Some(ours));
        }
    }
}

/// A standard and an extended id of one number are two ids.
#[test]
fn ids_keep_their_kind() {
    for id in ids() {
        assert_eq!(Id::try_from(CanId::from(id)), Ok(id));
    }
    let standard: Id = StandardId::new(0x123).unwrap().into();
    let extended: Id = ExtendedId::new(0x123).unwrap().into();
    assert_eq!(CanId::from(standard), CanId::Standard(0x123));
    assert_eq!(CanId::from(extended), CanId::Extended(0x123));
    assert_eq!(Id::try_from(CanId::Standard(0x800)), Err(InvalidFrame));
    assert_eq!(
        Id::try_from(CanId::Extended(0x2000_0000)),
        Err(InvalidFrame)
    );
}

/// A remote frame has no data: it is none of ours.
#[test]
fn remote_frames_are_refused() {
    for id in ids() {
        let remote = Fd::new_remote(id, 8).unwrap();
        assert_eq!(CanFrame::from_hal(&remote), Err(InvalidFrame));
        assert_eq!(<CanFrame as Frame>::new_remote(id, 8), None);
    }
}

/// A protected frame goes through a driver of CAN FD, and is checked by its receiver.
#[test]
fn protected_frames_go_through_a_driver() {
    let control = Control {
        term: 2,
        steering_angle: 0.01,
        ..Control::default()
    };
    let message = Message::Control { system: 0, control };
    let encoded = FrameTransmitter::new().encode(&message);
    assert_eq!(encoded.to_hal::<Classic>(), None);
    let mut frame: Fd = encoded.to_hal().unwrap();
    let mut receiver = FrameReceiver::new();
    assert_eq!(receiver.receive_hal(&frame), Ok(message));
    let again = receiver.receive_hal(&frame);
    assert!(
        matches!(again, Err(ReceiveError::Protection(_))),
        "{again:?}"
    );

    // The same number as an extended id, and a remote frame, are other frames.
    let unknown = Err(ReceiveError::Decode(FrameError::UnknownId));
    let remote = Fd::new_remote(frame.id, frame.dlc).unwrap();
    assert_eq!(receiver.receive_hal(&remote), unknown);
    frame.id = ExtendedId::new(encoded.id.into()).unwrap().into();
    assert_eq!(receiver.receive_hal(&frame), unknown);
}
