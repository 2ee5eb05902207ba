//! A CAN controller and a link that alter messages when their core sends or receives them.

use crate::around::Around;
use std::cell::RefCell;
use tandem_board::{
    Board, Can, CanErrors, CanFrame, CanId, CoreId, Instant, Link, LinkFull, Received, TransmitFull,
};
use tandem_board_sim::{Poller, SimBoard};
use tandem_bus::Message;
use tandem_cores::core0::Core0;
use tandem_cores::core1::Core1;
use tandem_cores::{Config, Core};

/// Maps a frame that a core sends to the frames that reach the controller: none, one or more.
pub type OnSend = Box<dyn FnMut(Instant, CanFrame) -> Vec<CanFrame>>;
/// Maps a received frame to the frame that the core reads instead.
pub type OnHear = Box<dyn FnMut(Instant, CanFrame) -> CanFrame>;

/// Maps a datagram that a core sends to the datagrams that reach the link: none, one or more.
pub type OnLink = Box<dyn FnMut(Instant, &[u32]) -> Vec<Vec<u32>>>;

/// A CAN controller around a simulated one, with altered frames.
pub struct BentCan {
    board: SimBoard,
    on_send: RefCell<OnSend>,
    on_hear: RefCell<OnHear>,
}

/// Creates core 0 or core 1 of a system, with functions that alter its sent and received frames.
///
/// # Panics
/// For core 2, which neither sends nor receives frames.
#[must_use]
pub fn bent_core(board: &SimBoard, config: Config, on_send: OnSend, on_hear: OnHear) -> Poller {
    let can = BentCan {
        board: board.clone(),
        on_send: on_send.into(),
        on_hear: on_hear.into(),
    };
    let (link, supply) = (board.link().clone(), board.supply().clone());
    let bent = Around::leaked(board, can, link, supply);
    match board.identity().core {
        CoreId::CONTROL => {
            let mut core = Core0::new(bent, config);
            Box::new(move |_| core.poll())
        }
        CoreId::PERCEPTION => {
            let mut core = Core1::new(bent);
            Box::new(move |_| core.poll())
        }
        other => panic!("{other} has no CAN"),
    }
}

/// A link around a simulated one, with altered datagrams.
pub struct BentLink {
    board: SimBoard,
    on_send: RefCell<OnLink>,
}

/// Creates core 0 of a system, with a function that alters the datagrams that it sends.
#[must_use]
pub fn core_with_link(board: &SimBoard, config: Config, on_send: OnLink) -> Poller {
    let link = BentLink {
        board: board.clone(),
        on_send: on_send.into(),
    };
    let (can, supply) = (board.can().clone(), board.supply().clone());
    let mut core = Core0::new(Around::leaked(board, can, link, supply), config);
    Box::new(move |_| core.poll())
}

impl Link for BentLink {
    const MAX_WORDS: usize = <<SimBoard as Board>::Link as Link>::MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        let datagrams = (self.on_send.borrow_mut())(self.board.now(), words);
        datagrams
            .iter()
            .try_for_each(|words| self.board.link().try_send(words))
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        self.board.link().try_receive(words)
    }
}

/// Returns the frame unchanged.
#[must_use]
pub fn straight(_: Instant, frame: CanFrame) -> CanFrame {
    frame
}

/// Alters the content of a frame of the DBC, and protects it again with its own counter. Returns
/// other frames unchanged.
///
/// # Panics
/// If the altered message cannot be encoded.
#[must_use]
pub fn altered(frame: CanFrame, alter: impl FnOnce(&mut Message)) -> CanFrame {
    let CanId::Standard(id) = frame.id() else {
        return frame;
    };
    let Ok(mut message) = Message::decode(id.into(), frame.data()) else {
        return frame;
    };
    alter(&mut message);
    let encoded = message.encode(frame.data()[2]);
    CanFrame::new(frame.id(), true, encoded.data()).expect("a frame of the DBC")
}

impl Can for BentCan {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        let frames = (self.on_send.borrow_mut())(self.board.now(), *frame);
        frames
            .iter()
            .try_for_each(|frame| self.board.can().try_send(frame))
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        let frames = (self.on_send.borrow_mut())(self.board.now(), *frame);
        frames
            .iter()
            .try_for_each(|frame| self.board.can().try_send_stamped(frame))
    }

    fn stamp(&self) -> Option<Instant> {
        self.board.can().stamp()
    }

    fn discard_unsent(&self) {
        self.board.can().discard_unsent();
    }

    fn try_receive(&self) -> Option<Received> {
        let Received { frame, at } = self.board.can().try_receive()?;
        let frame = (self.on_hear.borrow_mut())(at, frame);
        Some(Received { frame, at })
    }

    fn wake_on_receive(&self, on: bool) {
        self.board.can().wake_on_receive(on);
    }

    fn overruns(&self) -> u32 {
        self.board.can().overruns()
    }

    fn errors(&self) -> CanErrors {
        self.board.can().errors()
    }
}
