//! Hostile stations on the network of both systems: what drives does not notice them. D-1, D-3

use tandem_board::{Channel, Duration, Instant, Network, NetworkAddress, Recipient, SystemId};
use tandem_board_sim::{Config, SimStation};
use tandem_cores::driving::parking::SOC_STOP_LIMIT;
use tandem_sim::drive::{Drive, poller};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, controller_prefix};
use tandem_topics::{GuidPrefix, Outlet, Participant};
use tandem_topics_host::approach::Approach;

use crate::topics::{Parked, Soc, WAY_M, is_parked};

const WIRE: Duration = Duration::from_us(100);
const MS: Duration = Duration::from_ms(1);
/// Datagrams in a millisecond: 100,000 a second.
const BURST: usize = 100;
/// The flood begins and ends, ms.
const FLOOD: core::ops::Range<u64> = 3_000..9_000;
const DRIVE_MS: u64 = 12_000;

/// What a participant would send.
#[derive(Default)]
struct Caught(Vec<Vec<u8>>);

impl Outlet for Caught {
    fn send(&mut self, _: Recipient, message: &[u8]) {
        self.0.push(message.to_vec());
    }
}

/// Returns what a participant of this name announces, and asks of its peers.
fn announces(name: GuidPrefix, at: NetworkAddress) -> Vec<Vec<u8>> {
    let mut participant = Participant::<4, 1, 3, 64, 80>::new(name, at, &INPUTS, &OUTPUTS);
    let mut caught = Caught::default();
    participant.poll(Instant::ORIGIN, &mut caught);
    caught.0
}

/// A station that sends without pause.
struct Hostile {
    station: SimStation,
    noise: u64,
}

impl Hostile {
    fn random(&mut self) -> u64 {
        self.noise = self.noise.wrapping_mul(6_364_136_223_846_793_005);
        self.noise = self.noise.wrapping_add(1_442_695_040_888_963_407);
        self.noise >> 24
    }

    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        [(); N].map(|()| self.random() as u8)
    }

    /// Bytes without a meaning; each fourth one begins as a message of RTPS.
    fn nonsense(&mut self) -> Vec<u8> {
        let mut bytes = self.bytes::<52>();
        if self.random().is_multiple_of(4) {
            bytes[..8].copy_from_slice(b"RTPS\x02\x03\x00\x00");
        }
        bytes[..self.random() as usize % 53].to_vec()
    }

    /// The announcement of an unknown participant, or of a system that starts again.
    fn newcomer(&mut self) -> Vec<u8> {
        let name = match self.random() % 4 {
            0 => controller_prefix(self.random() as u8 % 2, self.bytes()),
            _ => GuidPrefix(self.bytes()),
        };
        let at = self.station.address(Channel::Topics).expect("an address");
        announces(name, at).swap_remove(0)
    }

    fn burst(&mut self, datagram: fn(&mut Self) -> Vec<u8>) {
        for _ in 0..BURST {
            let bytes = datagram(self);
            // What the cable does not carry is lost.
            let _lost = self
                .station
                .try_send(Channel::Topics, Recipient::Everyone, &bytes);
        }
    }
}

/// Returns the digest of all frames on the bus and of all events of a drive, while a station sends
/// this.
fn digest(datagram: Option<fn(&mut Hostile) -> Vec<u8>>) -> u64 {
    let config = Config {
        seed: 3,
        network: Some(WIRE),
        ..Config::default()
    };
    let limits = tandem_cores::Config::rt();
    let mut drive = Drive::on_board("cut-in", config, move |board| poller(board, limits));
    let station = drive.pair.join_network();
    let mut hostile = Hostile { station, noise: 1 };
    for ms in 0..DRIVE_MS {
        if let Some(datagram) = datagram.filter(|_| FLOOD.contains(&ms)) {
            hostile.burst(datagram);
        }
        drive.run_for(MS);
    }
    assert_eq!(drive.masters(), [SystemId::A]);
    assert!(drive.seen.borrow().log.accepted().count() > 1_000);
    drive.pair.digest()
}

/// D-1: 100,000 datagrams a second change no frame on the bus, and none is earlier or later.
#[test]
fn a_flood_of_datagrams_changes_no_frame_on_the_bus() {
    let alone = digest(None);
    let floods: [fn(&mut Hostile) -> Vec<u8>; 2] = [Hostile::nonsense, Hostile::newcomer];
    for (index, flood) in floods.into_iter().enumerate() {
        assert_eq!(
            digest(Some(flood)),
            alone,
            "flood {index} changes the drive"
        );
    }
}

/// D-3: a flood begins while the SoC parks. Commands may be lost in the flood: the vehicle stands
/// within the stated time, and parks after it.
#[test]
fn a_flood_of_datagrams_stops_the_vehicle_in_time_at_most() {
    let floods: [fn(&mut Hostile) -> Vec<u8>; 2] = [Hostile::nonsense, Hostile::newcomer];
    for flood in floods {
        let mut parked = Parked::new(12);
        let station = parked.drive.pair.join_network();
        let mut hostile = Hostile { station, noise: 1 };
        parked.run_until(60_000, |it| it.soc.approach.driven() > 3.0);
        let ms = parked.run_until(20_000, |it| {
            hostile.burst(flood);
            it.now().speed == 0.0
        });
        println!("stands after {ms} ms");
        assert!(ms <= SOC_STOP_LIMIT.as_us() / 1_000, "{ms}");
        // It ends: the SoC goes on, if it has not stopped the vehicle for good.
        parked.run_until(60_000, is_parked);
        parked.assert_parked();
    }
}

/// D-3: a second SoC asks for standstill. The standby starts again and hears that one first. It
/// follows the SoC of the master all the same: it parks after a takeover.
#[test]
fn a_standby_that_joins_follows_the_soc_of_the_master() {
    for seed in 20..23 {
        let mut parked = Parked::new(seed);
        let mut other = Soc::join(&mut parked.drive, 6);
        other.approach = Approach::new(0.0);
        for ms in 0..40_000 {
            let pair = &mut parked.drive.pair;
            match ms {
                3_000 => pair.power_off(SystemId::B),
                3_300 => pair.power_on(SystemId::B),
                7_000 => pair.power_off(SystemId::A),
                _ => {}
            }
            // Its commands are due just before those of the first SoC.
            if ms > 1_518 {
                other.turn(parked.drive.pair.now());
            }
            parked.run_until(1, |_| false);
            if is_parked(&parked) {
                break;
            }
        }
        assert_eq!(parked.drive.masters(), SystemId::ALL);
        parked.assert_parked();
        let driven = parked.soc.approach.driven();
        assert!((driven - WAY_M).abs() < 0.3, "{driven}");
    }
}
