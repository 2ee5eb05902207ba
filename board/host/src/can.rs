//! The CAN controller of a core: a transmit ring to the bus and a cursor in the ring from the bus.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};

use tandem_board::{Can, CanErrors, CanFrame, Identity, Instant, Received, TransmitFull};
use tandem_peripherals::codec::{BusFrame, FRAME_WORDS, Reach, Sender};
use tandem_shm::{FitError, bare, broadcast, fifo};

use crate::backplane::{Backplane, RINGS, TRANSMIT_WORDS, Transmit};
use crate::clock;
use crate::doorbell::Ringers;

/// The CAN controller of one core. The bus itself is part of the vehicle's process, and each frame
/// wakes that process. Without that process the core receives nothing and its transmit ring fills.
#[derive(Debug)]
pub struct HostCan {
    backplane: Backplane,
    of: Identity,
    ringers: Arc<Ringers>,
    transmit: Mutex<fifo::Producer<'static, [u32; TRANSMIT_WORDS]>>,
    receive: Mutex<broadcast::Receiver<'static, [u32; FRAME_WORDS]>>,
    overruns: AtomicU32,
}

impl HostCan {
    pub(crate) fn attach(
        backplane: Backplane,
        of: Identity,
        ringers: Arc<Ringers>,
    ) -> Result<Self, FitError> {
        let transmit = RINGS.transmit[of.address().index()];
        backplane.set_wakes_on_receive(of.system, of.core, false);
        // Now no frame of the last incarnation is the newest one.
        backplane.begin_stamp(of.system, of.core);
        Ok(Self {
            backplane,
            of,
            ringers,
            transmit: Mutex::new(bare::fifo_producer(
                backplane.ring(transmit),
                transmit.shape,
            )?),
            receive: Mutex::new(bare::broadcast_receiver(
                backplane.ring(RINGS.receive),
                RINGS.receive.shape,
            )?),
            overruns: AtomicU32::new(0),
        })
    }

    fn is_for_this_core(&self, frame: &BusFrame) -> bool {
        frame.reach.has(self.of.address())
    }
}

impl HostCan {
    fn send(&self, frame: &CanFrame, mark: u32) -> Result<(), TransmitFull> {
        let frame = BusFrame {
            received: Received {
                frame: *frame,
                at: clock::now(),
            },
            sender: Sender::Core(self.of.address()),
            reach: Reach::NONE,
        };
        let mut transmit = self.transmit.lock().unwrap_or_else(PoisonError::into_inner);
        let discards = self.backplane.discards(self.of.system, self.of.core);
        let words = Transmit {
            frame,
            discards,
            mark,
        };
        transmit
            .send(&words.encode())
            .map_err(|fifo::Full| TransmitFull)?;
        self.ringers.ring_bus();
        Ok(())
    }
}

impl Can for HostCan {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send(frame, 0)
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        let mark = self.backplane.begin_stamp(self.of.system, self.of.core);
        self.send(frame, mark)
    }

    fn stamp(&self) -> Option<Instant> {
        self.backplane.can_stamp(self.of.system, self.of.core)
    }

    fn discard_unsent(&self) {
        let _transmit = self.transmit.lock().unwrap_or_else(PoisonError::into_inner);
        self.backplane.count_discard(self.of.system, self.of.core);
    }

    fn try_receive(&self) -> Option<Received> {
        let mut receive = self.receive.lock().unwrap_or_else(PoisonError::into_inner);
        // The bus may send while this core reads, so one call reads at most one frame per slot.
        for _ in 0..RINGS.receive.shape.slots() {
            match receive.receive() {
                Ok(None) => return None,
                Ok(Some((_, words))) => match BusFrame::decode(&words) {
                    Some(frame) if self.is_for_this_core(&frame) => return Some(frame.received),
                    _ => {}
                },
                Err(lost) => {
                    self.overruns.fetch_add(lost.count, Relaxed);
                }
            }
        }
        None
    }

    fn wake_on_receive(&self, on: bool) {
        self.backplane
            .set_wakes_on_receive(self.of.system, self.of.core, on);
    }

    fn overruns(&self) -> u32 {
        self.overruns.load(Relaxed)
    }

    fn errors(&self) -> CanErrors {
        self.backplane.can_errors(self.of.system, self.of.core)
    }
}
