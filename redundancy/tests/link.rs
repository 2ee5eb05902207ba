//! Which datagrams of the link are a sign of life.

use tandem_board::{Duration, Instant, ResetCause, SystemId};
use tandem_redundancy::{
    Ability, Config, ControlHeader, Input, LineSnapshot, LinkReport, Loaded, Mode, PeerReport,
    Phase, Redundancy, Role, SystemState, Term,
};

const MASTER: PeerReport = PeerReport {
    role: Role::Master,
    mode: Mode::L3,
    term: Term::from_bits(16),
    can_alive: true,
    ability: Ability::All,
};

/// A standby that polls every millisecond.
struct Standby {
    machine: Redundancy,
    snapshot: LineSnapshot,
    now: Instant,
}

impl Standby {
    /// Returns a standby whose master has driven for 400 ms.
    fn new() -> Self {
        let now = Instant::from_ns(5_000_000_000);
        let loaded = Loaded::State(SystemState::factory(SystemId::B));
        let power_on = ResetCause::PowerOn;
        let mut standby = Self {
            machine: Redundancy::new(Config::rt(), SystemId::B, power_on, loaded, now),
            snapshot: LineSnapshot {
                handshakes: 0,
                syncs: 0,
                beats: [0; 2],
                peer_powered: true,
                can_frames: 0,
            },
            now,
        };
        standby.poll(0);
        standby.snapshot.syncs += 1;
        for _ in 0..40 {
            let frame = ControlHeader {
                system: SystemId::A,
                term: MASTER.term,
                role: MASTER.role,
                mode: MASTER.mode,
            };
            let _ = standby.machine.on(standby.now, Input::ControlFrame(frame));
            standby.report(0);
            (0..10).for_each(|_| standby.poll(1));
        }
        standby
    }

    fn poll(&mut self, beats: u32) {
        self.now += Duration::from_ms(1);
        self.snapshot.beats = self.snapshot.beats.map(|count| count + beats);
        self.snapshot.can_frames += 1;
        let _ = self.machine.on(self.now, Input::Poll(self.snapshot));
    }

    /// Passes on a report that was sent `ago_ms` milliseconds ago.
    fn report(&mut self, ago_ms: u64) {
        let link = LinkReport {
            report: MASTER,
            start: 1,
            sent_us: (self.now.as_ns() / 1_000 - ago_ms * 1_000) as u32,
        };
        let _ = self.machine.on(self.now, Input::LinkReport(link));
    }
}

/// T-CHIP-5, T-RED-9: over a working link, reports show that the master runs, and the standby does
/// not take over. It takes over if the link repeats the last report, delivers an earlier one again,
/// or delivers each report far too late.
#[test]
fn a_link_that_repeats_its_datagrams_is_no_sign_of_life() {
    // Name; age of a report, given the time since the master sent the last one, ms; final phase.
    type Case = (&'static str, fn(u64) -> u64, Phase);
    let cases: [Case; 4] = [
        ("whole", |_| 0, Phase::Standby),
        ("repeats", |since| since, Phase::DegradedMaster),
        ("earlier", |since| since + 50, Phase::DegradedMaster),
        ("late", |_| 150, Phase::DegradedMaster),
    ];
    for (name, ago_ms, expected) in cases {
        let mut standby = Standby::new();
        assert_eq!(standby.machine.phase(), Phase::Standby);
        for since in 11..=26 {
            standby.poll(0);
            if since % 5 == 0 {
                standby.report(ago_ms(since));
            }
        }
        assert_eq!(standby.machine.phase(), expected, "{name}");
    }
}
