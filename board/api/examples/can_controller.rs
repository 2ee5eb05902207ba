//! A part of a board, here a CAN controller that is a queue, and code that runs on any board.
//! `cargo run -p tandem-board --example can_controller`
#![allow(clippy::print_stdout, reason = "its output is its purpose")]

use std::cell::RefCell;
use std::collections::VecDeque;
use tandem_board::{
    Can, CanErrors, CanFrame, CanId, Instant, InvalidFrame, Received, TransmitFull,
};

/// All that it sends is received here again.
#[derive(Default)]
struct Loopback(RefCell<VecDeque<CanFrame>>);

impl Can for Loopback {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        let mut queue = self.0.borrow_mut();
        if queue.len() == 3 {
            return Err(TransmitFull);
        }
        queue.push_back(*frame);
        Ok(())
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.try_send(frame)
    }

    fn stamp(&self) -> Option<Instant> {
        None
    }

    fn discard_unsent(&self) {}

    fn try_receive(&self) -> Option<Received> {
        let frame = self.0.borrow_mut().pop_front()?;
        let at = Instant::ORIGIN;
        Some(Received { frame, at })
    }

    fn wake_on_receive(&self, _on: bool) {}

    fn overruns(&self) -> u32 {
        0
    }

    fn errors(&self) -> CanErrors {
        CanErrors::default()
    }
}

/// Sends frames until the controller takes no more. Returns how many it took.
fn fill(can: &impl Can) -> Result<u32, InvalidFrame> {
    let frame = CanFrame::new(CanId::Standard(0x123), true, &[7; 12])?;
    let mut taken = 0;
    while can.try_send(&frame).is_ok() {
        taken += 1;
    }
    Ok(taken)
}

fn main() -> Result<(), InvalidFrame> {
    let can = Loopback::default();
    assert_eq!(fill(&can)?, 3);
    while let Some(Received { frame, .. }) = can.try_receive() {
        println!("{:?}: {} bytes", frame.id(), frame.data().len());
    }
    // The bus carries no 13 bytes in one frame.
    assert!(CanFrame::new(CanId::Standard(0x123), true, &[0; 13]).is_err());
    Ok(())
}
