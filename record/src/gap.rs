//! Times without control, each compared with the bound of its cause; the stalls that excuse a part
//! of a time without control; and the times in which both systems transmitted.

use tandem_board::{CoreId, Duration, ResetCause, SupplyEvent, SystemId};
use tandem_bus::Control;
use tandem_bus::RoleCode;
use tandem_cores::trace::Event;
use tandem_redundancy::{Evidence, Phase};
use tandem_vehicle::Ruling;
use tandem_vehicle::mastership::Mastership;

use crate::required_limits::Limits;
use crate::run_log::{ControlFrame, CoreEvent, Stall, Stood};
use crate::takeover::report_of;
use crate::{RunLog, Takeover, ms_between};

/// A system that sends no control frame for longer than this counts as silent, ns: one and a half
/// control periods.
const SILENT_NS: u64 = 15_000_000;
/// A longer stall of a standby may have delayed a poll by more than its jitter (3 ms), because the
/// observed length of a stall is up to 2 ms too short, ns.
const HELD_UP_NS: u64 = 1_000_000;
/// A system whose last status frame is older than this is not standby, ns: two and a half status
/// periods, as in `roles`.
const STATUS_NS: u64 = 250_000_000;
/// A refused frame belongs to a takeover that was at most this long ago, ns. After this time no
/// frame from before the takeover can still arrive.
const AFTER_TAKEOVER_NS: u64 = 1_000_000_000;
/// If nothing delays a control frame, it arrives within this time after it was made, ms: one
/// control period.
const USUAL_WAY_MS: f64 = 10.0;
/// A running predecessor hears the new master within this time, ms: a control period and 1 ms.
pub const HAND_OVER_MS: f64 = 11.0;

/// How long the vehicle may be without control, ms, for each evidence of a takeover that ends it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// The old master fell silent: any evidence except the two below. This bound also applies to a
    /// gap without a takeover, because a master that is late for longer must be replaced.
    pub silent_ms: f64,
    /// The power level of the old master fell.
    pub power_ms: f64,
    /// The old master was running, but its frames did not reach the vehicle.
    pub mute_ms: f64,
    /// The limits of the profile from which the bounds follow. In the hold-down a standby waits for
    /// the vehicle's echo, so every takeover in the hold-down has the bound of a mute master.
    pub limits: Limits,
}

/// No bounds.
impl Default for Bounds {
    fn default() -> Self {
        Self {
            silent_ms: f64::INFINITY,
            power_ms: f64::INFINITY,
            mute_ms: f64::INFINITY,
            limits: Limits::RT,
        }
    }
}

impl Bounds {
    /// Returns the bounds as the vehicle sees them. `on_bus` is the delay of a frame on the bus.
    /// `timers` is the extra lateness of the timers. Only the limit for power does not include it.
    #[must_use]
    pub fn new(limits: Limits, on_bus: Duration, timers: Duration) -> Self {
        let ms = |bound: Duration| (bound + on_bus).as_ms_f64();
        Self {
            silent_ms: ms(limits.silent()),
            power_ms: ms(limits.power() + timers),
            mute_ms: ms(limits.mute()),
            limits,
        }
    }

    /// Returns all bounds, so that the caller can add the delay of a board.
    pub const fn all_mut(&mut self) -> [&mut f64; 3] {
        [&mut self.silent_ms, &mut self.power_ms, &mut self.mute_ms]
    }

    /// Returns the bound of this takeover.
    #[must_use]
    pub fn of_takeover(&self, log: &RunLog, takeover: &Takeover) -> f64 {
        let bound_ms = match takeover.cause {
            Some(Evidence::PeerOff)
                if !self.was_silent(log, takeover) && !core_died(log, takeover) =>
            {
                self.power_ms
            }
            Some(Evidence::MasterMute) => self.mute_ms,
            _ => self.silent_ms,
        };
        if is_held(log, takeover) {
            bound_ms.max(self.mute_ms)
        } else {
            bound_ms
        }
    }

    /// Tests whether the heartbeats were already silent when the power level fell. If they were,
    /// they cannot confirm the fall, so the level must be low for the third witness's limit.
    fn was_silent(&self, log: &RunLog, takeover: &Takeover) -> bool {
        let before_ns = self.limits.silent_before().as_ns();
        let report = report_of(log, takeover.to, takeover.at_ns);
        report.is_some_and(|report| {
            matches!(report, Event::TookOver { since_heartbeat_us, .. }
                if u64::from(since_heartbeat_us) * 1_000 >= before_ns)
        })
    }
}

/// Tests whether core 0 of the old master died in the gap, while its supply had power. The level
/// falls only after the supply has detected the death. The standby may detect the silence of the
/// heartbeats earlier, so the bound of silence applies.
fn core_died(log: &RunLog, takeover: &Takeover) -> bool {
    let gap_ns = takeover.from_ns..takeover.at_ns;
    log.supplies.iter().any(|(at_ns, system, event)| {
        *system == takeover.from
            && gap_ns.contains(at_ns)
            && matches!(event, SupplyEvent::CoreDied { core: died, .. } if *died == CoreId::CONTROL)
    })
}

/// Tests whether the new master was in its hold-down at the old master's last accepted frame.
fn is_held(log: &RunLog, takeover: &Takeover) -> bool {
    let (mut changes, mut changed_ns, mut until_ns) = (0, 0, 0);
    let of_core_0 = |event: &&CoreEvent| {
        event.system == takeover.to
            && event.core == CoreId::CONTROL
            && event.at_ns <= takeover.from_ns
    };
    for CoreEvent { at_ns, event, .. } in log.events.iter().filter(of_core_0) {
        match event {
            Event::Started { cause, .. } => {
                let cause = ResetCause::from_code((*cause).into());
                let was_reset = cause.is_some_and(|cause| cause != ResetCause::PowerOn);
                (changes, changed_ns) = (u32::from(was_reset), *at_ns);
            }
            Event::Phase { from, to, .. } => {
                if from.changes_driver(*to) {
                    let ago = Duration::from_ns(at_ns.saturating_sub(changed_ns));
                    changes = if ago < Limits::HEALTHY_AFTER {
                        changes + 1
                    } else {
                        1
                    };
                    changed_ns = *at_ns;
                }
                if *to == Phase::Standby {
                    until_ns = at_ns + Limits::hold_down(changes).as_ns();
                }
            }
            _ => {}
        }
    }
    takeover.from_ns < until_ns
}

/// The end of a gap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum EndedBy {
    /// The system that drove before, in the same or a later term.
    SameSystem,
    /// The other system, which took over on this evidence.
    Takeover(Option<Evidence>),
    /// The end of the run: no system drove again.
    Nothing,
}

/// A time without an accepted control frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Gap {
    /// Time of the last accepted frame before it, ns.
    pub from_ns: u64,
    /// Time of the first accepted frame after it, or of the end of the run, ns.
    pub to_ns: u64,
    /// What ended the gap.
    pub ended_by: EndedBy,
    /// The longest permitted gap, ms.
    pub bound_ms: f64,
    /// How much of the gap is excused by stalls, ms; 0 if the gap is within its bound.
    pub stalled_ms: f64,
    /// The stalls that excuse this part of the gap.
    pub stalls: Vec<Stall>,
}

impl Gap {
    /// Returns the length of the gap.
    #[must_use]
    pub fn ms(&self) -> f64 {
        ms_between(self.from_ns, self.to_ns)
    }

    /// Returns the length of the gap without the part that stalls excuse.
    #[must_use]
    pub fn net_ms(&self) -> f64 {
        self.ms() - self.stalled_ms
    }

    /// Tests whether it would have kept its bound without the stalls.
    #[must_use]
    pub fn is_explained(&self) -> bool {
        self.net_ms() <= self.bound_ms
    }
}

/// Returns the gaps beyond their bounds, in order. `takeovers` are those of the same log.
#[must_use]
pub fn gaps(log: &RunLog, takeovers: &[Takeover], bounds: &Bounds, stalls: &[Stall]) -> Vec<Gap> {
    let mut all = periods(log, takeovers, bounds, stalls, [0, u64::MAX]);
    all.retain(|gap| gap.ms() > gap.bound_ms);
    all
}

/// Returns all gaps that overlap this span, ns, in order: those between two accepted frames, and
/// that from the last frame to the end of the run. Stalls excuse only gaps beyond their bound.
#[must_use]
pub fn periods(
    log: &RunLog,
    takeovers: &[Takeover],
    bounds: &Bounds,
    stalls: &[Stall],
    [after_ns, before_ns]: [u64; 2],
) -> Vec<Gap> {
    let accepted: Vec<&ControlFrame> = log.accepted().collect();
    let between = accepted.windows(2).map(|pair| {
        let of_pair = |takeover: &&Takeover| takeover.at_ns == pair[1].at_ns;
        let (ended_by, bound_ms) = match takeovers.iter().find(of_pair) {
            Some(takeover) => (
                EndedBy::Takeover(takeover.cause),
                bounds.of_takeover(log, takeover),
            ),
            None => (EndedBy::SameSystem, bounds.silent_ms),
        };
        (pair[0], pair[1].at_ns, ended_by, bound_ms)
    });
    let last = accepted.last().zip(log.until_ns());
    let open = last.map(|(last, end_ns)| (*last, end_ns, EndedBy::Nothing, bounds.silent_ms));
    between
        .chain(open)
        .filter(|(from, to_ns, ..)| *to_ns > after_ns && from.at_ns < before_ns)
        .map(|(from, to_ns, ended_by, bound_ms)| {
            let from_ns = from.at_ns;
            let responsible = Responsible {
                driver: from.system,
                successor: (matches!(ended_by, EndedBy::Takeover(_))
                    || stands_by(log, from.system.peer(), from_ns))
                .then_some(from.system.peer()),
                until_ns: from_ns.saturating_add((bound_ms * 1e6) as u64),
                waits: bounds.limits.longest(),
            };
            let (stalled_ns, stalls) = if ms_between(from_ns, to_ns) > bound_ms {
                responsible.excused(log, stalls, [from_ns, to_ns])
            } else {
                (0, vec![])
            };
            Gap {
                from_ns,
                to_ns,
                ended_by,
                bound_ms,
                stalled_ms: stalled_ns as f64 * 1e-6,
                stalls,
            }
        })
        .collect()
}

/// Tests whether the system was standby at that time, according to its last status frame.
fn stands_by(log: &RunLog, system: SystemId, at_ns: u64) -> bool {
    let mut of_system = log.status.iter().rev().filter(|it| it.system == system);
    let last = of_system.find(|status| status.at_ns <= at_ns);
    last.is_some_and(|last| last.role == RoleCode::Standby && at_ns - last.at_ns < STATUS_NS)
}

/// The systems that must drive in a gap.
struct Responsible {
    /// The master. It is responsible until `until_ns`; without a successor, until the gap ends.
    driver: SystemId,
    /// The standby. It must have replaced the master by `until_ns`, even if the master was held up.
    successor: Option<SystemId>,
    until_ns: u64,
    /// The longest time that a correct standby waits before it takes over.
    waits: Duration,
}

impl Responsible {
    /// Returns how much of this gap is excused by stalls, ns, and these stalls. A stall counts if
    /// it is on the bus or on the CPU of a system that must drive. Overlapping stalls count once.
    ///
    /// A standby that was held up restarts its limits once, because its own stall is not evidence
    /// against the master. So the time that the standby had already waited is excused too, but at
    /// most the longest time that a correct standby waits.
    fn excused(
        &self,
        log: &RunLog,
        stalls: &[Stall],
        [from_ns, to_ns]: [u64; 2],
    ) -> (u64, Vec<Stall>) {
        let (mut counted, mut spans, mut begun_anew) = (vec![], vec![], false);
        let mut stalls = stalls.to_vec();
        stalls.sort_unstable_by_key(|stall| stall.to_ns);
        for stall in stalls {
            let cpu = |system| Some(stall.of) == log.control_cpu(system).map(Stood::Cpu);
            let of_successor = self.successor.is_some_and(cpu);
            let until_ns = match stall.of {
                Stood::Bus => to_ns,
                Stood::Cpu(_) if of_successor || self.successor.is_none() && cpu(self.driver) => {
                    to_ns
                }
                Stood::Cpu(_) if cpu(self.driver) => to_ns.min(self.until_ns),
                Stood::Cpu(_) => continue,
            };
            let mut span = [stall.from_ns.max(from_ns), stall.to_ns.min(until_ns)];
            if span[0] >= span[1] {
                continue;
            }
            let is_long = stall.to_ns - stall.from_ns > HELD_UP_NS && stall.to_ns < to_ns;
            if of_successor && is_long && !begun_anew {
                begun_anew = true;
                span[0] = from_ns.max(span[0].saturating_sub(self.waits.as_ns()));
            }
            spans.push(span);
            counted.push(stall);
        }
        (union_ns(spans), counted)
    }
}

/// Returns the total length that these spans cover; overlaps count once.
fn union_ns(mut spans: Vec<[u64; 2]>) -> u64 {
    spans.sort_unstable();
    let (mut covered_ns, mut until_ns) = (0, 0);
    for [from, to] in spans {
        covered_ns += to.saturating_sub(from.max(until_ns));
        until_ns = until_ns.max(to);
    }
    covered_ns
}

/// Returns the time in which both systems transmitted control frames as master, ms, whether the
/// vehicle obeyed or refused them. Such a time begins when the second system sends its first frame.
/// It ends when one system sends its next frame after the last frame of the other system.
#[must_use]
pub fn both_transmitted_ms(log: &RunLog) -> f64 {
    let claims =
        |frame: &&ControlFrame| !matches!(frame.ruling, Ruling::NotMaster | Ruling::Invalid);
    let mut sent: Vec<(u64, SystemId)> = log
        .control
        .iter()
        .filter(claims)
        .map(|frame| (frame.sent_ns, frame.system))
        .collect();
    sent.sort_unstable();
    // Frames without a silence between them belong to one mastership.
    let (mut both, mut row) = (Mastership::default(), 0);
    let mut last: [Option<(u64, u32)>; 2] = [None; 2];
    for (at_ns, system) in sent {
        let continues = |(last_ns, _): &(u64, u32)| at_ns - last_ns <= SILENT_NS;
        let of = last[system.index()].filter(continues).map_or_else(
            || {
                row += 1;
                row
            },
            |(_, row)| row,
        );
        last[system.index()] = Some((at_ns, of));
        both.accept(at_ns, system.index() as u8, of);
    }
    both.two_masters_ns() as f64 * 1e-6
}

/// Returns for how long both systems may have transmitted, ms. A master that resigns, or whose
/// frames are lost, sends until it hears the new master. A held-up master may send one more frame.
#[must_use]
pub fn hand_over_ms(takeovers: &[Takeover]) -> f64 {
    hand_overs(takeovers) as f64 * HAND_OVER_MS
}

/// Returns how many takeovers replaced a master that was still running.
#[must_use]
pub fn hand_overs(takeovers: &[Takeover]) -> usize {
    let sends = [Some(Evidence::MasterResigns), Some(Evidence::MasterMute)];
    let lived = |of: &&Takeover| of.held_up || sends.contains(&of.cause);
    takeovers.iter().filter(lived).count()
}

/// Counts the control frames that arrived within a second after a takeover and were refused as too
/// old or as based on data that was too old. Frames whose delay a stall explains do not count.
#[must_use]
pub fn stale_frames(log: &RunLog, takeovers: &[Takeover], stalls: &[Stall]) -> usize {
    let follows = |frame: &&ControlFrame| {
        let mut after = takeovers.iter().map(|of| frame.at_ns.checked_sub(of.at_ns));
        after.any(|after| after.is_some_and(|after| after < AFTER_TAKEOVER_NS))
    };
    let stale = log
        .control
        .iter()
        .filter(|frame| frame.ruling == Ruling::Stale)
        .filter(|frame| !was_held_up(log, frame, stalls));
    stale.filter(follows).count()
}

/// Tests whether stalls of the bus and of the sender's CPU explain the delay of this frame.
fn was_held_up(log: &RunLog, frame: &ControlFrame, stalls: &[Stall]) -> bool {
    let max_delay_ms = f64::from(Control::MAX_DELAY_MS);
    let cpu = log.control_cpu(frame.system).map(Stood::Cpu);
    let reaching = stalls
        .iter()
        .filter(|stall| stall.of == Stood::Bus || Some(stall.of) == cpu)
        .filter(|stall| {
            stall.from_ns < frame.at_ns && ms_between(stall.to_ns, frame.at_ns) < max_delay_ms
        })
        .map(|stall| [stall.from_ns, stall.to_ns.min(frame.at_ns)]);
    let stalled_ms = union_ns(reaching.collect()) as f64 * 1e-6;
    let under_way_ms = ms_between(frame.sent_ns, frame.at_ns) - stalled_ms;
    stalled_ms + USUAL_WAY_MS > max_delay_ms && under_way_ms < USUAL_WAY_MS
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::log::{Header, Sample};
    use crate::run_log::StatusFrame;
    use crate::takeovers;
    use tandem_bus::ModeCode;

    const A: SystemId = SystemId::A;
    const B: SystemId = SystemId::B;
    const BOUNDS: Bounds = Bounds {
        silent_ms: 20.0,
        power_ms: 16.0,
        mute_ms: 19.0,
        limits: Limits::RT,
    };
    /// The CPUs of core 0 of A and of B: each core has its own.
    const OF_A: Stood = Stood::Cpu(0);
    const OF_B: Stood = Stood::Cpu(3);

    fn frame(at_ms: u64, system: SystemId, ruling: Ruling) -> ControlFrame {
        ControlFrame {
            at_ns: at_ms * 1_000_000,
            sent_ns: at_ms * 1_000_000,
            system,
            term: 2 + system.index() as u32,
            mode: ModeCode::L3,
            asks: false,
            age_ns: None,
            ruling,
        }
    }

    /// Returns a log of accepted frames, given as (time in ms, system).
    fn log(frames: &[(u64, SystemId)], end_ms: u64) -> RunLog {
        let accepted = |(at_ms, system): &(u64, SystemId)| frame(*at_ms, *system, Ruling::Accepted);
        RunLog {
            header: Header {
                cpus: (0..6).collect(),
                ..Header::default()
            },
            control: frames.iter().map(accepted).collect(),
            start_ns: Some(0),
            end_ns: Some(end_ms * 1_000_000),
            ..RunLog::default()
        }
    }

    fn stall(of: Stood, from_ms: u64, to_ms: u64) -> Stall {
        let (from_ns, to_ns) = (from_ms * 1_000_000, to_ms * 1_000_000);
        Stall { of, from_ns, to_ns }
    }

    fn found(log: &RunLog, stalls: &[Stall]) -> Vec<Gap> {
        gaps(log, &takeovers(log), &BOUNDS, stalls)
    }

    /// T-RED-8: each gap is compared with the bound of its cause. If the level falls when the
    /// heartbeats are already silent, the bound of silence applies.
    #[test]
    fn a_gap_is_judged_by_the_bound_of_the_sign_that_ended_it() {
        for (cause, since_heartbeat_us, died, to_ms, is_beyond) in [
            (Evidence::PeerOff, 11_000, None, 26, false),
            (Evidence::PeerOff, 11_000, None, 27, true),
            // The supply noticed the death of core 0 late.
            (Evidence::PeerOff, 11_000, Some(CoreId::CONTROL), 30, false),
            (Evidence::PeerOff, 11_000, Some(CoreId::CONTROL), 31, true),
            (Evidence::PeerOff, 11_000, Some(CoreId::PLANNING), 27, true),
            (Evidence::PeerOff, 24_000, None, 27, true),
            (Evidence::PeerOff, 129_000, None, 30, false),
            (Evidence::PeerOff, 129_000, None, 31, true),
            (Evidence::MasterMute, 0, None, 29, false),
            (Evidence::MasterMute, 0, None, 30, true),
            (Evidence::PeerSilent, 9_000, None, 30, false),
            (Evidence::PeerSilent, 9_000, None, 31, true),
        ] {
            let mut log = log(&[(0, A), (10, A), (to_ms, B)], to_ms);
            log.events = vec![CoreEvent {
                at_ns: to_ms * 1_000_000,
                system: B,
                core: CoreId::CONTROL,
                event: Event::TookOver {
                    cause,
                    since_heartbeat_us,
                    since_control_us: 0,
                    term: 3,
                },
            }];
            let died = died.map(|core| SupplyEvent::CoreDied { core, signal: 9 });
            log.supplies
                .extend(died.map(|event| (20_000_000, A, event)));
            let what = format!("{cause:?} {since_heartbeat_us} {to_ms} {died:?}");
            assert_eq!(!found(&log, &[]).is_empty(), is_beyond, "{what}");
        }
        let same = log(&[(0, A), (21, A)], 21);
        assert_eq!(found(&same, &[])[0].ended_by, EndedBy::SameSystem);
    }

    /// A system that was just relieved waits for the vehicle's echo, even if the lines show a
    /// failure. Only a change of the driver begins a hold-down, and the second in a row doubles it.
    #[test]
    fn in_the_hold_down_a_takeover_has_the_bound_of_a_mute_master() {
        use Phase::{DegradedMaster, Master, Standby, Starting, Thawed};
        let first = [(Starting, Standby)];
        let relieved = [(Starting, Master), (DegradedMaster, Standby)];
        let thawed = [(Thawed, Standby)];
        let third = [(Master, Standby), (Standby, DegradedMaster), relieved[1]];
        let (on, reset) = (ResetCause::PowerOn, ResetCause::Trap);
        for (cause, phases, standby_for_ms, gap_ms, is_beyond) in [
            (on, &first[..], 60, 16, false),
            (on, &first, 60, 17, true),
            (reset, &first, 99, 19, false),
            (reset, &first, 101, 17, true),
            (reset, &relieved, 199, 19, false),
            (on, &relieved, 60, 19, false),
            (on, &relieved, 60, 20, true),
            (on, &relieved, 99, 19, false),
            (on, &relieved, 101, 17, true),
            (on, &thawed, 99, 19, false),
            (on, &third, 399, 19, false),
            (on, &third, 401, 17, true),
        ] {
            let to_ms = 1_010 + gap_ms;
            let mut log = log(&[(1_000, A), (1_010, A), (to_ms, B)], to_ms);
            let event = |at_ms: u64, event| CoreEvent {
                at_ns: at_ms * 1_000_000,
                system: B,
                core: CoreId::CONTROL,
                event,
            };
            let phase = |(from, to): &(Phase, Phase)| {
                event(
                    1_010 - standby_for_ms,
                    Event::Phase {
                        from: *from,
                        to: *to,
                        on: Evidence::HigherTerm,
                    },
                )
            };
            let (generation, cause) = (1, cause as u8);
            log.events = vec![event(1, Event::Started { generation, cause })];
            log.events.extend(phases.iter().map(phase));
            let took_over = Event::TookOver {
                cause: Evidence::PeerOff,
                since_heartbeat_us: 0,
                since_control_us: 0,
                term: 3,
            };
            log.events.push(event(to_ms, took_over));
            let what = format!("{cause} {phases:?} {standby_for_ms} {gap_ms}");
            assert_eq!(!found(&log, &[]).is_empty(), is_beyond, "{what}");
        }
    }

    #[test]
    fn a_run_in_which_no_system_drives_any_more_has_a_gap_to_its_end() {
        let gap = &found(&log(&[(0, A), (10, A)], 4_010), &[])[0];
        assert_eq!((gap.ms(), gap.ended_by), (4_000.0, EndedBy::Nothing));
        assert!(!gap.is_explained());
        // A person ended the run early. The last recorded state of the world is then the end.
        let mut early = log(&[(0, A), (10, A)], 4_010);
        early.end_ns = None;
        early.samples = vec![Sample {
            at_ns: 2_010_000_000,
            ..Sample::default()
        }];
        assert_eq!(found(&early, &[])[0].ms(), 2_000.0);
    }

    /// Returns whether these stalls excuse the gap from 10 ms until `by` drives at `to_ms`. B is
    /// standby.
    fn excused(by: SystemId, to_ms: u64, stalls: &[Stall]) -> bool {
        let mut log = log(&[(0, A), (10, A), (to_ms, by)], to_ms);
        log.status = vec![StatusFrame {
            at_ns: 0,
            system: B,
            role: RoleCode::Standby,
            mode: ModeCode::L3,
            ability: tandem_bus::AbilityCode::All,
        }];
        let found = found(&log, stalls);
        assert_eq!(found.len(), 1);
        found[0].is_explained()
    }

    #[test]
    fn a_gap_is_explained_by_a_stall_that_makes_up_for_all_beyond_the_bound() {
        // No system is standby: A alone must drive.
        let log = log(&[(0, A), (50, A)], 50);
        let explained = |stalls: &[Stall]| found(&log, stalls)[0].is_explained();
        assert!(!explained(&[]));
        assert!(!explained(&[stall(OF_A, 5, 34)]), "1 ms too short");
        assert!(explained(&[stall(OF_A, 5, 35)]));
        assert!(!explained(&[stall(OF_A, 60, 90)]), "at another time");
        assert!(!explained(&[stall(OF_A, 0, 20), stall(Stood::Bus, 0, 20)]));
        assert!(explained(&[stall(OF_A, 0, 20), stall(Stood::Bus, 10, 30)]));
    }

    #[test]
    fn a_stall_of_a_cpu_on_which_no_core_0_runs_explains_nothing() {
        for cpu in [1, 2, 4, 5, 6] {
            assert!(!excused(B, 51, &[stall(Stood::Cpu(cpu), 10, 51)]), "{cpu}");
            assert!(!excused(A, 51, &[stall(Stood::Cpu(cpu), 10, 51)]), "{cpu}");
        }
        // If the cores are not pinned, their CPUs are unknown.
        let mut log = log(&[(0, A), (50, A)], 50);
        log.header.cpus.clear();
        assert!(!found(&log, &[stall(OF_A, 5, 45)])[0].is_explained());
    }

    /// B must replace A within the bound, even if A or its CPU stalls for longer.
    #[test]
    fn a_stall_of_the_old_master_counts_until_it_must_have_been_replaced() {
        assert!(
            excused(B, 36, &[stall(OF_A, 12, 18)]),
            "its last heartbeat was late"
        );
        assert!(!excused(B, 60, &[stall(OF_A, 12, 60)]));
        assert!(!excused(B, 60, &[stall(OF_A, 31, 60)]));
        assert!(
            !excused(A, 60, &[stall(OF_A, 12, 60)]),
            "B did not take over"
        );
        assert!(excused(A, 60, &[stall(OF_A, 12, 60), stall(OF_B, 20, 50)]));
    }

    #[test]
    fn a_short_stall_beside_a_long_gap_does_not_explain_it() {
        let short = |from_ms: u64| Stall {
            of: OF_B,
            from_ns: from_ms * 1_000_000,
            to_ns: from_ms * 1_000_000 + 1_100_000,
        };
        for (to_ms, from_ms) in [(70, 30), (70, 68), (10_010, 20), (10_010, 10_008)] {
            assert!(!excused(B, to_ms, &[short(from_ms)]), "{to_ms} {from_ms}");
        }
    }

    #[test]
    fn one_stall_does_not_explain_two_gaps() {
        let log = log(&[(0, A), (40, A), (80, A)], 80);
        let found = found(&log, &[stall(OF_A, 25, 55)]);
        let counted: Vec<f64> = found.iter().map(|gap| gap.stalled_ms).collect();
        assert_eq!(counted, [15.0, 15.0], "30 ms together");
        assert!(found.iter().all(|gap| !gap.is_explained()));
    }

    /// A standby that was held up restarts its limits once. The gap may be longer by the stall
    /// and by the time that the standby had already waited: at most the wait before a takeover.
    #[test]
    fn a_stall_of_the_standby_costs_its_length_and_what_was_waited() {
        for (to_ms, stalls, is_explained) in [
            (41, &[stall(OF_B, 19, 22)][..], true),
            (43, &[stall(OF_B, 19, 22)], false),
            (41, &[stall(OF_B, 21, 22)], false),
            (41, &[stall(OF_B, 5, 8)], false),
            (41, &[stall(Stood::Bus, 19, 22)], false),
            (71, &[stall(OF_B, 49, 52)], false),
            // The second stall lengthens the gap only by its own length.
            (44, &[stall(OF_B, 19, 22), stall(OF_B, 30, 33)], true),
            (47, &[stall(OF_B, 19, 22), stall(OF_B, 38, 41)], false),
        ] {
            assert_eq!(
                excused(B, to_ms, stalls),
                is_explained,
                "{to_ms} {stalls:?}"
            );
        }
    }

    #[test]
    fn a_stall_of_the_bus_process_counts_for_its_length() {
        assert!(excused(B, 51, &[stall(Stood::Bus, 20, 41)]));
        assert!(!excused(B, 52, &[stall(Stood::Bus, 20, 41)]));
        assert!(excused(A, 51, &[stall(Stood::Bus, 20, 41)]));
    }

    /// T-CHIP-7, T-RED-9: the time counts even if the vehicle fences off the frames of one system.
    #[test]
    fn both_systems_transmitting_is_counted_though_the_vehicle_refuses_one() {
        let both = |frames: &[ControlFrame]| {
            both_transmitted_ms(&RunLog {
                control: frames.to_vec(),
                ..RunLog::default()
            })
        };
        let row = |system, ruling, from: u64, to: u64| {
            (from..to)
                .step_by(10)
                .map(move |at| frame(at, system, ruling))
        };
        let (accepted, fenced) = (Ruling::Accepted, Ruling::Fenced);
        let master: Vec<_> = row(A, accepted, 0, 1_000).collect();
        assert_eq!(both(&master), 0.0);
        // A standby that transmits for a while, and a standby that sends one frame.
        let chatters = [master.clone(), row(B, fenced, 205, 300).collect()].concat();
        assert_eq!(both(&chatters), 95.0);
        let one = [master.clone(), vec![frame(503, B, fenced)]].concat();
        assert_eq!(both(&one), 7.0);
        // A master that resumes long after it was deposed did not transmit all the time.
        let thawed = [
            row(A, accepted, 0, 100).collect(),
            row(B, accepted, 113, 800).collect(),
            vec![frame(504, A, fenced)],
        ];
        assert_eq!(both(&thawed.concat()), 9.0);
        // Two clean takeovers, and a standby whose frames claim no mastership.
        let clean = [
            row(A, accepted, 0, 100).collect(),
            row(B, accepted, 113, 300).collect::<Vec<_>>(),
            row(A, accepted, 313, 500).collect(),
        ];
        assert_eq!(both(&clean.concat()), 0.0);
        let said = [master, row(B, Ruling::NotMaster, 5, 500).collect()].concat();
        assert_eq!(both(&said), 0.0);
    }

    #[test]
    fn a_takeover_from_a_master_that_lives_permits_a_hand_over() {
        let takeover = |cause, held_up| Takeover {
            from: A,
            to: B,
            from_ns: 0,
            at_ns: 18_000_000,
            cause: Some(cause),
            detected_ms: None,
            gap_ms: 18.0,
            is_false: false,
            held_up,
        };
        for (cause, held_up, lived) in [
            (Evidence::PeerOff, false, 0),
            (Evidence::PeerSilent, false, 0),
            (Evidence::PeerSilent, true, 1),
            (Evidence::MasterResigns, false, 1),
            (Evidence::MasterMute, false, 1),
        ] {
            assert_eq!(hand_overs(&[takeover(cause, held_up)]), lived, "{cause:?}");
        }
    }

    #[test]
    fn stale_frames_count_after_a_takeover() {
        let mut log = log(&[(0, A), (10, A), (23, B)], 3_000);
        for at_ms in [5, 30, 900, 2_000] {
            log.control.push(frame(at_ms, B, Ruling::Stale));
        }
        assert_eq!(stale_frames(&log, &takeovers(&log), &[]), 2);
    }

    /// A frame that was made before a stall and arrives after it does not count as stale.
    #[test]
    fn a_stale_frame_is_explained_by_a_stall_of_its_delay() {
        let mut log = log(&[(0, A), (10, A), (23, B)], 3_000);
        log.control.push(frame(900, B, Ruling::Stale));
        let cpu = |from_ms, to_ms| stall(OF_B, from_ms, to_ms);
        let count = |log: &RunLog, stalls: &[Stall]| stale_frames(log, &takeovers(log), stalls);
        for (stalls, stale) in [
            (&[cpu(838, 899)][..], 0),
            (&[cpu(838, 950)], 0),
            (&[cpu(860, 880), stall(Stood::Bus, 870, 895)], 0),
            (&[cpu(869, 899)], 1),
            (&[stall(OF_A, 838, 899)], 1),
            (&[cpu(790, 859)], 1),
            (&[cpu(901, 990)], 1),
        ] {
            assert_eq!(count(&log, stalls), stale, "{stalls:?}");
        }
        // The frame was on the bus for longer than the stall.
        log.control.last_mut().unwrap().sent_ns -= 80_000_000;
        assert_eq!(count(&log, &[cpu(838, 899)]), 1);
    }
}
