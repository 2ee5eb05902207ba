//! SYNC and FUP on CAN: the system that drives tells the sensors the time. S-4

use super::super::Executor;
use super::is_to_gateway;
use tandem_board::{Board, Can, CanFrame, CanId, Duration, Instant, SystemId};
use tandem_bus::TimeSync;
use tandem_timesync::{Arbitrary, CanTimeMaster, Conversion};

/// How often the controller is asked when SYNC was on the bus.
const ASKS_EVERY: Duration = Duration::from_ms(5);

/// The sender of the frames.
pub(super) struct SyncFrames {
    system: SystemId,
    master: CanTimeMaster,
    /// It is not known yet when the last SYNC was on the bus.
    unstamped: bool,
}

impl SyncFrames {
    pub(super) const fn new(system: SystemId, now: Instant) -> Self {
        Self {
            system,
            master: CanTimeMaster::new(system, true, now),
            unstamped: false,
        }
    }

    /// Sends what is due. Returns when it is to be called again.
    pub(super) fn tell<'b, B: Board>(
        &mut self,
        board: &'b B,
        conversion: &Conversion<Arbitrary>,
        executor: &impl Executor<'b, B>,
    ) -> Instant {
        if self.unstamped
            && let Some(at) = board.can().stamp()
        {
            self.unstamped = false;
            let is_to_gateway = is_to_gateway(conversion.status_at(at));
            self.master.on_sent(at, conversion.at(at), is_to_gateway);
        }
        let now = board.now();
        if let Some(frame) = self.master.poll(now, conversion.at(now))
            && let Ok(encoded) = CanFrame::new(self.id(), false, &frame)
        {
            // Only SYNC is stamped. What finds no room is lost: the next one follows.
            let is_sync = frame[0] & 0x08 == 0;
            let sent = executor.shared(|_| match is_sync {
                true => board.can().try_send_stamped(&encoded),
                false => board.can().try_send(&encoded),
            });
            self.unstamped = is_sync && sent.is_ok();
        }
        match self.unstamped {
            true => self.master.due().min(now + ASKS_EVERY),
            false => self.master.due(),
        }
    }

    const fn id(&self) -> CanId {
        CanId::Standard(TimeSync::IDS[self.system.index()])
    }
}
