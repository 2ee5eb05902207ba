//! Play.
use std::net::Ipv4Addr;
use std::time::{Duration, Instant as Clock};
use tandem_board::Instant;
use tandem_topics::*;
use tandem_topics_host::udp::Udp;

const Q: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
const V: Qos = Qos {
    durability: Durability::Volatile,
    ..Q
};
static OUT: [Endpoint; 1] = [Endpoint {
    topic: "vehicle_can",
    type_name: "tandem::CanFrame",
    qos: Q,
}];
static IN: [Endpoint; 1] = [Endpoint {
    topic: "power",
    type_name: "tandem::Power",
    qos: V,
}];

fn main() {
    let n: u32 = std::env::args()
        .nth(1)
        .and_then(|a| a.parse().ok())
        .unwrap_or(200);
    let mut udp = Udp::open(0, Ipv4Addr::LOCALHOST).unwrap();
    let start = Clock::now();
    let now = || Instant::from_ns(start.elapsed().as_nanos() as u64);
    let mut prefix = [1; 12];
    prefix[4..8].copy_from_slice(&std::process::id().to_le_bytes());
    let mut p = Participant::<1, 1, 3, 80>::new(GuidPrefix(prefix), udp.at(), &OUT, &IN);
    let mut sent = 0u32;
    let mut next = Duration::from_secs(2);
    while start.elapsed() < Duration::from_secs(3) + Duration::from_millis(10) * n {
        let due = p.poll(now(), &mut udp);
        if start.elapsed() >= next && sent < n {
            next += Duration::from_millis(10);
            sent += 1;
            let mut b = [0u8; 76];
            b[1] = 1;
            b[4..8].copy_from_slice(&sent.to_le_bytes());
            b[10] = 64;
            p.write(0, &b[..75], sent, &mut udp).unwrap();
        }
        let wait = due.since(now()).as_us().min(1000);
        let _ = udp.wait(Duration::from_micros(wait));
        let mut buf = Vec::new();
        while let Some(d) = udp.receive() {
            buf.push(d.to_vec());
        }
        for d in buf {
            p.hear(now(), &d, &mut udp);
        }
        while let Some(s) = p.take(0) {
            println!("got {:?}", s.payload());
        }
    }
    println!(
        "{:?} {:?} {:?} readers {}",
        p.counts(),
        p.writer_counts(0),
        p.reader_counts(0),
        p.readers_of(0)
    );
    p.leave(&mut udp);
}
