//! A DDS domain for each test.

use std::net::{Ipv4Addr, UdpSocket};

use tandem_board_udp::UdpPlace;

/// A place that no other test has, on this machine and at this time.
pub(crate) struct OwnPlace {
    pub(crate) place: UdpPlace,
    _lock: UdpSocket,
}

/// Takes a free domain. A port that no participant uses is its lock.
pub(crate) fn own_place() -> OwnPlace {
    let interface = Ipv4Addr::LOCALHOST;
    // The ports of these domains are below those that a kernel gives away.
    let domains = (20..100_u16).cycle().skip(std::process::id() as usize % 80);
    let mut taken = domains.take(80).filter_map(|domain| {
        let lock = UdpSocket::bind((interface, 7_400 + 250 * domain + 249)).ok()?;
        let place = UdpPlace::new(domain, interface).ok()?;
        Some(OwnPlace { place, _lock: lock })
    });
    taken.next().unwrap()
}
