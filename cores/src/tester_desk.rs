//! The way of a tester's frames from core 0 to the desk on core 2, and of its wishes back.
//!
//! Core 0 has no time to check a signature, and core 2 has no CAN. If one of them dies or restarts,
//! frames are lost; a tester repeats them.

use crate::layout::{ControllerMap, DeskWords, FROM_DESK, TO_DESK};
use tandem_board::tester_desk::{CONNECT, EXTENSION, RELEASES, TO_HOST, TO_LOADER};
use tandem_board::{CanFrame, DeskAction, Instant, ResetRequest, SystemId, TesterDesk};
use tandem_shm::fifo::{Consumer, Producer};

/// What the first word says.
const FOR_LOADER: u32 = 0;
const FOR_HOST: u32 = 1;
const RELEASE: u32 = 2;
const LEAVE: u32 = 3;
const CONFIRM_START: u32 = 4;

/// Returns whether a frame is for the desk: a request that names a system, or a release frame. The
/// records of a download to the other system are not.
pub(crate) fn concerns(frame: &CanFrame) -> bool {
    match (frame.id(), frame.data()) {
        (TO_LOADER, &[a, b, c, d, _, _, _, _]) => {
            a == EXTENSION || u32::from_le_bytes([a, b, c, d]) == CONNECT
        }
        (RELEASES, _) => true,
        _ => false,
    }
}

fn words_of(frame: &CanFrame) -> Option<DeskWords> {
    let &[a, b, c, d, e, f, g, h] = frame.data() else {
        return None;
    };
    let code = match frame.id() {
        TO_LOADER => FOR_LOADER,
        TO_HOST => FOR_HOST,
        RELEASES => RELEASE,
        _ => return None,
    };
    let halves = [[a, b, c, d], [e, f, g, h]].map(u32::from_le_bytes);
    Some([code, halves[0], halves[1]])
}

fn frame_of([code, low, high]: DeskWords) -> Option<CanFrame> {
    let id = match code {
        FOR_LOADER => TO_LOADER,
        FOR_HOST => TO_HOST,
        RELEASE => RELEASES,
        _ => return None,
    };
    let data = u64::from(low) | u64::from(high) << 32;
    CanFrame::new(id, false, &data.to_le_bytes()).ok()
}

/// Core 0's end.
pub(crate) struct DeskPort<'b> {
    to_desk: Producer<'b, DeskWords, 16>,
    from_desk: Consumer<'b, DeskWords, 8>,
}

impl<'b> DeskPort<'b> {
    pub(crate) fn attach(map: &ControllerMap<'b>) -> Option<Self> {
        Some(Self {
            to_desk: TO_DESK.producer(&map.map, map.incarnation).ok()?,
            from_desk: FROM_DESK.consumer(&map.map, map.incarnation).ok()?,
        })
    }

    /// Passes a frame on. Returns whether it fitted.
    pub(crate) fn pass(&mut self, frame: &CanFrame) -> bool {
        words_of(frame).is_some_and(|words| self.to_desk.send(&words).is_ok())
    }

    /// Returns the next wish. Words that are none are skipped.
    pub(crate) fn wish(&mut self) -> Option<DeskAction> {
        let words = self.from_desk.receive().ok().flatten()?;
        match words {
            [LEAVE, code, _] => {
                let request = ResetRequest::from_code(code)?;
                let may = matches!(request, ResetRequest::Software | ResetRequest::Download);
                may.then_some(DeskAction::Leave(request))
            }
            [CONFIRM_START, ..] => Some(DeskAction::ConfirmStart),
            // A desk does not ask other systems.
            words => frame_of(words)
                .filter(|frame| frame.id() != TO_LOADER)
                .map(DeskAction::Send),
        }
    }
}

/// Core 2's end.
pub(crate) struct DeskSeat<'b> {
    to_desk: Consumer<'b, DeskWords, 16>,
    from_desk: Producer<'b, DeskWords, 8>,
}

impl<'b> DeskSeat<'b> {
    pub(crate) fn attach(map: &ControllerMap<'b>) -> Option<Self> {
        Some(Self {
            to_desk: TO_DESK.consumer(&map.map, map.incarnation).ok()?,
            from_desk: FROM_DESK.producer(&map.map, map.incarnation).ok()?,
        })
    }

    /// Passes the next frame to the desk, and lets it do what is due. Returns whether a frame was
    /// there: more may wait. In a flood of frames a plan waits for one of them at most.
    pub(crate) fn poll(
        &mut self,
        desk: &mut impl TesterDesk,
        now: Instant,
        has_role: bool,
    ) -> bool {
        let received = self.to_desk.receive();
        let is_idle = matches!(received, Ok(None));
        if let Ok(Some(words)) = received {
            let wish = frame_of(words).and_then(|frame| desk.hear(now, &frame));
            self.wish(wish);
        }
        let wish = desk.poll(now, has_role);
        self.wish(wish);
        !is_idle
    }

    /// Tells core 0. If core 0 does not listen, the tester asks again.
    fn wish(&mut self, wish: Option<DeskAction>) {
        let words = match wish {
            Some(DeskAction::Send(frame)) => words_of(&frame),
            Some(DeskAction::Leave(request)) => Some([LEAVE, request.code(), 0]),
            Some(DeskAction::ConfirmStart) => Some([CONFIRM_START, 0, 0]),
            None => None,
        };
        if let Some(words) = words {
            let _unheard = self.from_desk.send(&words);
        }
    }
}

/// The desk of an application without a bootloader of its own, as in the thesis: each host that
/// names this system may have it leave for a download.
#[derive(Clone, Copy, Debug)]
pub struct Unguarded(pub SystemId);

impl TesterDesk for Unguarded {
    fn hear(&mut self, _now: Instant, frame: &CanFrame) -> Option<DeskAction> {
        let &[a, b, c, d, system, _, 0, 0] = frame.data() else {
            return None;
        };
        // A request that names no system is for a system that has just started.
        let names = usize::from(system) == self.0.index() + 1;
        let connects = frame.id() == TO_LOADER && u32::from_le_bytes([a, b, c, d]) == CONNECT;
        (names && connects).then_some(DeskAction::Leave(ResetRequest::Download))
    }

    fn poll(&mut self, _now: Instant, _has_role: bool) -> Option<DeskAction> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::CanId;

    /// T-BOOT-1: records of a download to the other system stay away from core 2, and what crosses
    /// the LMU arrives as it was sent. Words that are no frame are none.
    #[test]
    fn only_frames_for_the_desk_cross() {
        let frame = |id, data: &[u8]| CanFrame::new(id, false, data).ok();
        let connect = [0x2D, 0x57, 0x3E, 0x08, 1, 0, 0, 0];
        let question = [b'W', 5, 0x20, 0, 2, 0, 0, 0];
        let told = [b'W', 0x86, 2, 1, 9, 0, 0, 0x80];
        for (id, data) in [
            (TO_LOADER, &connect[..]),
            (TO_LOADER, &question),
            (RELEASES, &told),
        ] {
            let sent = frame(id, data);
            assert!(sent.is_some_and(|frame| concerns(&frame)));
            assert_eq!(sent.and_then(|frame| frame_of(words_of(&frame)?)), sent);
        }
        for (id, data) in [
            (TO_LOADER, &b"S1130000"[..]),
            (TO_LOADER, &connect[..7]),
            (TO_HOST, &question),
            (CanId::Standard(0x126), &connect),
        ] {
            assert!(frame(id, data).is_some_and(|frame| !concerns(&frame)));
        }
        for words in [[3, 0, 0], [4, 0, 0], [u32::MAX, 1, 2]] {
            assert_eq!(frame_of(words), None);
        }
    }
}
