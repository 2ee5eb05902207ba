//! Interoperation with other implementations of PTP, in networks of their own: linuxptp's `ptp4l`
//! and `statime` as peers, `tshark` as a reader of what we send. What is missing is `SKIPPED`.
//!
//! All ends of a cell have one clock, so the true offset is 0. `TANDEM_PTP_SECONDS` is the time of
//! measuring, 12 s if it is not set. A campaign that a person starts has 120 s, and one cell at a
//! time: `cargo test --release -p tandem-timesync-host --test interop -- --nocapture
//! --test-threads=1`.
#![allow(clippy::unwrap_used)]
#![allow(clippy::print_stdout, reason = "skipped cells and figures are told")]

mod cell;
mod offsets;
mod peers;

use cell::{Bench, Tool, cell};
use offsets::Offsets;
use peers::{Mechanism, capture, our_master, our_slave, ptp4l, statime};
use std::time::Duration;
use tandem_board::Duration as Span;
use tandem_timesync::gptp::TimeOutlet as _;
use tandem_timesync_host::{PtpArrival, TimePort, Transport, now};

/// Lets the second master send between the messages of the first one: right behind them, its cache
/// would be warmer, and its messages faster.
fn half_a_period() {
    std::thread::sleep(Duration::from_millis(62));
}

/// Measures our slave beside ptp4l's, each with a ptp4l of its own as its master, in the same run.
fn follows_ptp4l(bench: &Bench, mechanism: Mechanism) {
    let [mac, _] = bench.link("ours", 0, 1);
    bench.link("theirs", 0, 1);
    let captured = capture(bench, 0, "ours0", &mac);
    ptp4l(bench, 1, mechanism, false, "ours1");
    half_a_period();
    ptp4l(bench, 1, mechanism, false, "theirs1");
    let ours = our_slave(bench, 0, mechanism, "ours0");
    let theirs = ptp4l(bench, 0, mechanism, true, "theirs0");
    bench.wait();
    let [all, ours] = [Offsets::ours, Offsets::some_of_ours].map(|it| it(&ours.read()));
    let theirs = Offsets::ptp4l(&theirs.read());
    bench.figure(&format!(
        "our slave {ours}; ptp4l {theirs}; all of ours {all}"
    ));
    ours.no_worse_than(&theirs);
    captured.check(mechanism.kinds_of_slave());
}

/// Measures ptp4l's slave behind our master, beside the one behind ptp4l.
fn leads_ptp4l(bench: &Bench, mechanism: Mechanism) {
    let [_, mac] = bench.link("ours", 0, 1);
    bench.link("theirs", 0, 1);
    let captured = capture(bench, 1, "ours1", &mac);
    our_master(bench, 1, mechanism, "ours1", &[]);
    half_a_period();
    ptp4l(bench, 1, mechanism, false, "theirs1");
    let ours = ptp4l(bench, 0, mechanism, true, "ours0");
    let theirs = ptp4l(bench, 0, mechanism, true, "theirs0");
    bench.wait();
    let [ours, theirs] = [&ours, &theirs].map(|log| Offsets::ptp4l(&log.read()));
    bench.figure(&format!(
        "ptp4l behind our master {ours}; behind ptp4l {theirs}"
    ));
    ours.no_worse_than(&theirs);
    captured.check(mechanism.kinds_of_master());
}

/// S-2: the document's end-to-end delay.
#[test]
fn follows_ptp4l_end_to_end() {
    cell(
        "follows_ptp4l_end_to_end",
        &[Tool::Ptp4l, Tool::Tshark],
        |bench| {
            follows_ptp4l(bench, Mechanism::EndToEnd);
        },
    );
}

/// S-2: the peer delay in the profile of IEEE 1588.
#[test]
fn follows_ptp4l_peer() {
    cell(
        "follows_ptp4l_peer",
        &[Tool::Ptp4l, Tool::Tshark],
        |bench| {
            follows_ptp4l(bench, Mechanism::Peer);
        },
    );
}

/// S-2: 802.1AS.
#[test]
fn follows_ptp4l_gptp() {
    cell(
        "follows_ptp4l_gptp",
        &[Tool::Ptp4l, Tool::Tshark],
        |bench| {
            follows_ptp4l(bench, Mechanism::Gptp);
        },
    );
}

/// S-2: the document's end-to-end delay.
#[test]
fn leads_ptp4l_end_to_end() {
    cell(
        "leads_ptp4l_end_to_end",
        &[Tool::Ptp4l, Tool::Tshark],
        |bench| {
            leads_ptp4l(bench, Mechanism::EndToEnd);
        },
    );
}

/// S-2: the peer delay in the profile of IEEE 1588.
#[test]
fn leads_ptp4l_peer() {
    cell("leads_ptp4l_peer", &[Tool::Ptp4l, Tool::Tshark], |bench| {
        leads_ptp4l(bench, Mechanism::Peer);
    });
}

/// S-2: 802.1AS.
#[test]
fn leads_ptp4l_gptp() {
    cell("leads_ptp4l_gptp", &[Tool::Ptp4l, Tool::Tshark], |bench| {
        leads_ptp4l(bench, Mechanism::Gptp);
    });
}

/// S-2: messages over UDP.
#[test]
fn follows_ptp4l_over_udp() {
    cell("follows_ptp4l_over_udp", &[Tool::Ptp4l], |bench| {
        bench.link("ours", 0, 1);
        bench.run(0, "ip addr add 10.9.9.1/24 dev ours0");
        bench.run(1, "ip addr add 10.9.9.2/24 dev ours1");
        ptp4l(bench, 1, Mechanism::Udp, false, "ours1");
        let ours = our_slave(bench, 0, Mechanism::Udp, "ours0");
        bench.wait();
        let ours = Offsets::ours(&ours.read());
        bench.figure(&format!("our slave over UDP {ours}"));
    });
}

/// S-2: statime and our slave behind two of our masters, in the same run.
#[test]
fn leads_statime() {
    cell("leads_statime", &[Tool::Statime], |bench| {
        bench.link("ours", 0, 1);
        bench.link("theirs", 0, 1);
        our_master(bench, 1, Mechanism::Gptp, "ours1", &[]);
        half_a_period();
        our_master(bench, 1, Mechanism::Gptp, "theirs1", &[]);
        let ours = our_slave(bench, 0, Mechanism::Gptp, "ours0");
        let theirs = statime(bench, 0, "theirs0");
        bench.wait();
        let [ours, theirs] = [
            Offsets::ours(&ours.read()),
            Offsets::statime(&theirs.read()),
        ];
        bench.figure(&format!("our slave {ours}; statime {theirs}"));
        ours.no_worse_than(&theirs);
    });
}

/// S-2: the ratio of the rates is found, and a leap of the master's time is told.
#[test]
fn a_master_drifts_and_leaps() {
    cell("a_master_drifts_and_leaps", &[], |bench| {
        bench.link("ours", 0, 1);
        let options = ["--rate-ppb", "50000", "--leap-ms", "-40"];
        our_master(bench, 1, Mechanism::EndToEnd, "ours1", &options);
        let log = our_slave(bench, 0, Mechanism::EndToEnd, "ours0");
        bench.wait();
        let said = log.read();
        let rates = offsets::numbers(&said, "\"rate_ppb\":");
        let rate = rates[rates.len() / 2];
        assert!((rate - 50_000).abs() < 20_000, "{rate}");
        let leaps = offsets::numbers(&said, "\"leaps\":");
        assert!(leaps.last().is_some_and(|leaps| *leaps >= 1), "{said}");
        let last = *offsets::numbers(&said, "\"offset_ns\":").last().unwrap();
        assert!((-40_000_000..-20_000_000).contains(&last), "{last}");
        bench.figure(&format!("rate {rate} ppb, {leaps:?} leaps, then {last} ns"));
    });
}

/// S-2: a relay that keeps messages to the slave 1 ms longer than those to the master, and loses
/// each fifth one: the slave's error is half of that, which it cannot know, and says so.
#[test]
fn a_relay_is_asymmetric() {
    cell("a_relay_is_asymmetric", &[], |bench| {
        bench.link("left", 0, 1);
        bench.link("right", 0, 2);
        let mechanism = Mechanism::EndToEnd;
        let ends = ["left0", "right0"]
            .map(|it| TimePort::open(it, mechanism.profile(), Transport::Ethernet).unwrap());
        let seconds = Span::from_ms(1_000).times(bench.seconds as u32 + 5);
        let relay = std::thread::spawn(move || relay(ends, now() + seconds));
        our_master(bench, 1, mechanism, "left1", &[]);
        let log = our_slave(bench, 2, mechanism, "right2");
        bench.wait();
        let said = log.read();
        let (relayed, lost) = relay.join().unwrap();
        let mut offsets = offsets::numbers(&said, "\"offset_ns\":");
        let most = offsets::numbers(&said, "\"error_ns\":")
            .into_iter()
            .max()
            .unwrap();
        assert!(
            lost > 0 && offsets.len() > 10,
            "{lost} of {relayed} lost: {said}"
        );
        offsets.sort_unstable();
        let median = offsets[offsets.len() / 2];
        assert!(median < -300_000 && median > -most, "{median}, {most}");
        bench.figure(&format!(
            "median {median} ns, said to err by {most}; {lost} of {relayed} lost"
        ));
    });
}

/// Carries messages from the left to the right and back. Returns how many, and how many it lost.
fn relay(mut ends: [TimePort; 2], end: tandem_board::Instant) -> (u32, u32) {
    let (mut relayed, mut lost) = (0, 0);
    while now() < end {
        std::thread::sleep(Duration::from_micros(20));
        for from in 0..2 {
            let arrival = ends[from].wait(Span::ZERO).unwrap();
            let Some(PtpArrival::Message(message, _)) = arrival else {
                continue;
            };
            relayed += 1;
            if relayed % 5 == 0 {
                lost += 1;
                continue;
            }
            if from == 0 {
                std::thread::sleep(Duration::from_millis(1));
            }
            ends[1 - from].send(&message, None);
        }
    }
    (relayed, lost)
}

/// S-2: the wrong mechanism and the wrong profile are told.
#[test]
fn it_tells_why() {
    cell("it_tells_why", &[], |bench| {
        bench.link("ours", 0, 1);
        our_master(bench, 1, Mechanism::EndToEnd, "ours1", &[]);
        let peer = our_slave(bench, 0, Mechanism::Peer, "ours0");
        let gptp = our_slave(bench, 0, Mechanism::Gptp, "ours0");
        bench.wait();
        assert!(
            peer.read().contains("{\"why\":\"NoAnswer\""),
            "{}",
            peer.read()
        );
        assert!(
            gptp.read().contains("{\"why\":\"OtherProfile\""),
            "{}",
            gptp.read()
        );
        assert!(!(peer.read() + &gptp.read()).contains("offset_ns"));
    });
}
