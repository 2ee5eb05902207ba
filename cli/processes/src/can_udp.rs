//! The bus of a run, open to other programs over UDP multicast as python-can's `udp_multicast` is:
//! they hear each frame, and what they send is on the bus.

use std::io;
use std::net::Ipv4Addr;

use serde::{Deserialize, Serialize};
use tandem_board::CanFrame;
use tandem_boot_host::UdpBus;

/// Frames from outside in a millisecond: a bus of 500 kbit/s has room for no more. The others wait.
pub(crate) const FRAMES_PER_MS: usize = 3;

/// The address of the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CanGroup {
    /// The multicast group.
    pub group: Ipv4Addr,
    /// Its port.
    pub port: u16,
}

/// The vehicle's end.
pub struct CanUdp(UdpBus);

impl CanUdp {
    /// Joins the group.
    ///
    /// # Errors
    /// An error of the operating system, usually because there is no route to the group.
    pub fn join(at: CanGroup) -> io::Result<Self> {
        let bus = UdpBus::join(at.group, at.port)?;
        bus.set_polled()?;
        Ok(Self(bus))
    }

    /// Tells a frame of the bus to the other programs. A frame that cannot be sent is lost, as for
    /// a listener that is not there.
    pub(crate) fn tell(&self, frame: &CanFrame) {
        let _lost = self.0.send(frame);
    }

    /// Returns the next frame from outside. Never blocks.
    pub(crate) fn hear(&self) -> Option<CanFrame> {
        self.0.poll().ok().flatten()
    }
}
