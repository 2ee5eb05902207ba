//! The bus of a run, open to other programs: they hear each frame, and what they send is on the
//! bus. They are on a bus of UDP multicast, as python-can's `udp_multicast` is, or on a SocketCAN
//! interface, to which the program `tandem-can` connects.

use std::net::Ipv4Addr;

use anyhow::{Context as _, ensure};
use serde::{Deserialize, Serialize};
use tandem_board::CanFrame;
use tandem_board_host::socket::is_trusted;
use tandem_boot_host::{BusPipe, UdpBus};

/// Frames from outside in a millisecond: a bus of 500 kbit/s has room for no more. The others wait.
pub(crate) const FRAMES_PER_MS: usize = 3;

/// Where the other programs are.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum OpenBusPlace {
    /// On a bus of UDP multicast.
    Udp {
        /// The multicast group.
        group: Ipv4Addr,
        /// Its port.
        port: u16,
    },
    /// Behind the bridge that waits under this name.
    Bridge(String),
}

/// The vehicle's end.
pub enum OpenBus {
    /// On a bus of UDP multicast.
    Udp(UdpBus),
    /// Behind a bridge.
    Bridge(BusPipe),
}

impl OpenBus {
    /// Connects to the place.
    ///
    /// # Errors
    /// An error of the operating system, usually because there is no route to the group; or another
    /// user has taken the place of the bridge.
    pub fn join(at: &OpenBusPlace) -> anyhow::Result<Self> {
        match at {
            OpenBusPlace::Udp { group, port } => {
                let bus = UdpBus::join(*group, *port)?;
                bus.set_polled()?;
                Ok(Self::Udp(bus))
            }
            OpenBusPlace::Bridge(name) => {
                let bus = BusPipe::connect(name).context("the bridge to the CAN interface")?;
                ensure!(
                    is_trusted(&bus),
                    "the bridge to the CAN interface is another user's"
                );
                Ok(Self::Bridge(bus))
            }
        }
    }

    /// Tells a frame of the bus to the other programs. A frame that cannot be sent is lost, as for
    /// a listener that is not there.
    pub(crate) fn tell(&self, frame: &CanFrame) {
        let _lost = match self {
            Self::Udp(bus) => bus.send(frame),
            Self::Bridge(bus) => bus.send(frame),
        };
    }

    /// Returns the next frame from outside. Never blocks.
    pub(crate) fn hear(&self) -> Option<CanFrame> {
        match self {
            Self::Udp(bus) => bus.poll().ok().flatten(),
            Self::Bridge(bus) => bus.poll(),
        }
    }
}
