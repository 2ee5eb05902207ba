//! A relay between two domains that loses datagrams: the only path between their participants.
//!
//! Participants find each other by what they announce. The relay hears the announcements of both
//! domains and repeats each one in the other domain. It replaces every address in them with the
//! address of one of its own sockets, and passes on what arrives there. So each peer takes the
//! relay for the other peer, and no peer needs a change.

use socket2::{Domain, Protocol, SockRef, Socket, Type};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::sync::{Arc, Mutex};
use std::thread;

/// Address of discovery. (RTPS 9.6.1.4.1)
const EVERYONE: Ipv4Addr = Ipv4Addr::new(239, 255, 0, 1);
/// The longest datagram of UDP.
const LONGEST: usize = 65_507;
/// Bytes of a locator: kind, port, address.
const LOCATOR: usize = 24;
/// The writer of announcements of participants.
const ANNOUNCER: [u8; 4] = [0, 1, 0, 0xC2];

/// Returns the port where a domain hears announcements. (RTPS 9.6.1.1)
const fn discovery_port(domain: u16) -> u16 {
    7_400 + 250 * domain
}

/// What the relay has seen since it began to lose datagrams.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Relayed {
    pub(crate) all: u32,
    pub(crate) lost: u32,
}

/// A socket that stands for one of a participant.
#[derive(Clone, Copy)]
struct Stand {
    /// The index of the participant's domain.
    side: usize,
    /// Where the participant hears.
    original: u16,
    /// Where the relay hears for it.
    port: u16,
}

struct State {
    /// For each direction: the generator that decides on the next datagram.
    chances: [u64; 2],
    /// How many of 100 datagrams are lost.
    loss_percent: u64,
    relayed: Relayed,
    stands: Vec<Stand>,
}

struct Shared {
    domains: [u16; 2],
    /// All that the relay sends, it sends from here.
    outlet: UdpSocket,
    state: Mutex<State>,
}

/// The relay. Its threads end with the process.
pub(crate) struct Relay(Arc<Shared>);

impl Relay {
    /// Opens a relay between two domains. It loses nothing yet.
    pub(crate) fn between(domains: [u16; 2], seed: u64) -> Self {
        let outlet = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let multicast = SockRef::from(&outlet).set_multicast_if_v4(&Ipv4Addr::LOCALHOST);
        multicast.unwrap();
        let state = State {
            chances: [seed, !seed],
            loss_percent: 0,
            relayed: Relayed::default(),
            stands: Vec::new(),
        };
        let shared = Arc::new(Shared {
            domains,
            outlet,
            state: Mutex::new(state),
        });
        for side in 0..2 {
            let to = SocketAddrV4::new(EVERYONE, discovery_port(domains[1 - side]));
            shared
                .clone()
                .pass_on(announcements(domains[side]), side, to);
        }
        Self(shared)
    }

    /// Loses this share of the datagrams from now on, in both directions.
    pub(crate) fn lose(&self, percent: u64) {
        self.0.state.lock().unwrap().loss_percent = percent;
    }

    /// Returns what it has seen while it lost datagrams.
    pub(crate) fn relayed(&self) -> Relayed {
        self.0.state.lock().unwrap().relayed
    }
}

/// Opens a socket that hears the announcements of a domain.
fn announcements(domain: u16) -> UdpSocket {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).unwrap();
    socket.set_reuse_address(true).unwrap();
    let address = SocketAddrV4::new(EVERYONE, discovery_port(domain));
    socket.bind(&address.into()).unwrap();
    let joined = socket.join_multicast_v4(&EVERYONE, &Ipv4Addr::LOCALHOST);
    joined.unwrap();
    socket.into()
}

impl Shared {
    /// Starts a thread that passes on what arrives at a socket from the domain `side`.
    fn pass_on(self: Arc<Self>, socket: UdpSocket, side: usize, to: SocketAddrV4) {
        let own = self.outlet.local_addr().unwrap();
        thread::spawn(move || {
            let mut bytes = [0; LONGEST];
            while let Ok((len, from)) = socket.recv_from(&mut bytes) {
                // The relay hears its own announcements too.
                if from != own && !self.loses(side) {
                    self.translate(&mut bytes[..len], side);
                    let _lost = self.outlet.send_to(&bytes[..len], SocketAddr::V4(to));
                }
            }
        });
    }

    /// Decides on the next datagram from the domain `side`.
    fn loses(&self, side: usize) -> bool {
        let mut state = self.state.lock().unwrap();
        if state.loss_percent == 0 {
            return false;
        }
        let is_lost = next_chance(&mut state.chances[side]) % 100 < state.loss_percent;
        state.relayed.all += 1;
        state.relayed.lost += u32::from(is_lost);
        is_lost
    }

    /// Replaces all that tells where a participant of the domain `side` is.
    fn translate(self: &Arc<Self>, datagram: &mut [u8], side: usize) {
        let [own, other] = [self.domains[side], self.domains[1 - side]];
        for at in 0..datagram.len().saturating_sub(LOCATOR - 1) {
            let locator = &mut datagram[at..at + LOCATOR];
            // UDP over IPv4, and the twelve bytes before its address.
            if locator[..4] != [1, 0, 0, 0] || locator[6..20] != [0; 14] {
                continue;
            }
            let port = u16::from_le_bytes([locator[4], locator[5]]);
            let port = if locator[20..] == EVERYONE.octets() && port == discovery_port(own) {
                discovery_port(other)
            } else if locator[20..] == Ipv4Addr::LOCALHOST.octets() && port != 0 {
                self.stand_for(side, port)
            } else {
                continue;
            };
            locator[4..6].copy_from_slice(&port.to_le_bytes());
        }
        if datagram.windows(4).any(|four| four == ANNOUNCER) {
            let of = |domain: u16| [0x0F, 0, 4, 0, domain as u8, 0, 0, 0];
            if let Some(at) = datagram.windows(8).position(|eight| eight == of(own)) {
                datagram[at..at + 8].copy_from_slice(&of(other));
            }
        }
    }

    /// Returns the port where the relay hears for a participant of the domain `side`.
    fn stand_for(self: &Arc<Self>, side: usize, original: u16) -> u16 {
        let mut state = self.state.lock().unwrap();
        let mut known = state.stands.iter();
        let is_known = |stand: &&Stand| (stand.side, stand.original) == (side, original);
        if let Some(stand) = known.find(is_known) {
            return stand.port;
        }
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = socket.local_addr().unwrap().port();
        state.stands.push(Stand {
            side,
            original,
            port,
        });
        // The other domain sends to this socket.
        let to = SocketAddrV4::new(Ipv4Addr::LOCALHOST, original);
        self.clone().pass_on(socket, 1 - side, to);
        port
    }
}

/// A generator of chances: splitmix64.
fn next_chance(seed: &mut u64) -> u64 {
    *seed = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mixed = (*seed ^ (*seed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    mixed ^ (mixed >> 31)
}
