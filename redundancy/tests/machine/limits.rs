//! What happens when a time limit ends, but not before.

use super::{Bench, CONFIG, sound};
use tandem_board::{Duration, Instant, ResetCause, SystemId};
use tandem_redundancy::{
    Ability, Action, ClockOwner, Config, Evidence, FailureMode, Input, LinkReport, Loaded, Mode,
    ObeyedTerm, PeerReport, Phase, Redundancy, RedundancyEvent, Role, SystemState, Takeover, Term,
};

/// T-RED-8: a standby polls at the moment when a limit ends, so a takeover does not wait for the
/// next periodic poll.
#[test]
fn a_standby_polls_when_a_limit_ends() {
    let chip = Config::chip();
    let after = |limit: Duration| limit + Duration::from_ns(1);
    for (link, level, expected) in [
        (false, false, after(chip.witness_limit())),
        (true, false, after(chip.link_limit())),
        (true, true, after(chip.level_limit())),
    ] {
        let mut bench = Bench::standby_with(chip);
        let _ = bench.control(16);
        bench.run_with_beats(1);
        let last = bench.now;
        let _ = bench.control(16);
        if link {
            let _ = bench.linked(sound(Role::Master, Term::from_bits(16)));
        }
        bench.snapshot.peer_powered = !level;
        let mut actions = bench.on(Input::Poll(bench.snapshot));
        let mut line_silent = None;
        while bench.machine.phase() == Phase::Standby {
            assert!(actions.deadline() > bench.now);
            bench.now = actions.deadline();
            actions = bench.on(Input::Poll(bench.snapshot));
            if actions
                .events()
                .any(|it| it == RedundancyEvent::LineSilent(1))
            {
                line_silent.get_or_insert(bench.now.since(last));
            }
        }
        assert_eq!(bench.now.since(last), expected, "link {link} level {level}");
        assert_eq!(line_silent, (!level).then_some(after(chip.silent_limit())));
    }
}

/// T-RED-8: while a frame is overdue the vehicle's echo may come at any time, so a standby looks
/// four times in a poll interval; not before, and not for ever.
#[test]
fn a_standby_looks_more_often_while_a_frame_is_overdue() {
    let chip = Config::chip();
    let mut bench = Bench::standby_with(chip);
    let _ = bench.control(16);
    let sent = bench.now;
    let mut widest = [Duration::ZERO; 3];
    while bench.now < sent + chip.control_period.times(3) {
        bench.snapshot.beats = bench.snapshot.beats.map(|count| count + 1);
        let due = bench.on(Input::Poll(bench.snapshot)).deadline();
        let age = bench.now.since(sent);
        let overdue = chip.control_period + chip.poll_interval;
        let part = usize::from(age >= overdue) + usize::from(age >= overdue + chip.control_period);
        widest[part] = widest[part].max(due.since(bench.now));
        bench.now = due;
    }
    let interval = chip.poll_interval;
    assert_eq!(
        widest,
        [interval, Duration::from_ns(interval.as_ns() / 4), interval]
    );
}

/// T-RED-8: a link that falls silent with both lines shows a failed master before its control
/// frames are overdue. A link shows nothing if it fell silent earlier than the lines by more than
/// its limit, because it was cut, or if its limit is not below the third witness's.
#[test]
fn a_link_that_ends_with_the_lines_shows_a_dead_master() {
    let (chip, ms, ns) = (Config::chip(), Duration::from_ms(1), Duration::from_ns(1));
    let with = |report_us| Config {
        report_period: Duration::from_us(report_us),
        ..chip
    };
    let (lines, witness) = (chip.silent_limit(), chip.witness_limit());
    let link = with(2_000).link_limit();
    let nearly = with(5_099).link_limit();
    assert_eq!(with(5_100).link_limit(), witness);
    for (report_us, cut_before, takes) in [
        (2_000, Duration::ZERO, link),
        (2_000, ms, link - ms),
        (2_000, link, lines),
        (2_000, link + ns, witness),
        (5_099, ms, nearly - ms),
        (5_100, ms, witness),
    ] {
        let config = with(report_us);
        let mut bench = Bench::standby_with(config);
        let _ = bench.linked(sound(Role::Master, Term::from_bits(16)));
        let last = bench.now + cut_before;
        while bench.now < last {
            bench.now = last.min(bench.now + config.poll_interval);
            bench.snapshot.beats = bench.snapshot.beats.map(|count| count + 1);
            let _ = bench.on(Input::Poll(bench.snapshot));
        }
        let _ = bench.control(16);
        let mut due = bench.now;
        while bench.machine.phase() == Phase::Standby {
            // Also polls a nanosecond before each limit.
            bench.now = bench.now.max(Instant::from_ns(due.as_ns() - 1));
            let _ = bench.on(Input::Poll(bench.snapshot));
            assert_eq!(bench.machine.phase(), Phase::Standby);
            bench.now = due;
            due = bench.on(Input::Poll(bench.snapshot)).deadline();
        }
        assert_eq!(
            bench.now.since(last),
            takes + ns,
            "cut {cut_before:?} before"
        );
    }
}

/// T-RED-9: a takeover reports its cause, and for how long the master was not heard.
#[test]
fn a_takeover_tells_since_when_the_master_was_silent() {
    let mut bench = Bench::standby();
    let _ = bench.control(16);
    bench.run_with_beats(4);
    let takeover = loop {
        if let Some(takeover) = bench.poll().takeover() {
            break takeover;
        }
    };
    let control = CONFIG.witness_limit() + CONFIG.poll_interval;
    let expected = Takeover {
        cause: Evidence::PeerSilent,
        since_heartbeat: control - Duration::from_ms(4),
        since_control: control,
        term: bench.machine.term(),
    };
    assert_eq!(takeover, expected);
    assert!(takeover.term > Term::from_bits(16));
}

/// T-RED-9: a master gives up its standby when both lines are silent for longer than its limit.
#[test]
fn a_master_gives_up_its_standby_when_the_limit_ends() {
    let config = Config {
        standby_limit: Duration::from_ms(20),
        ..CONFIG
    };
    let mut bench = Bench::master_with(config);
    let last = bench.now;
    while bench.now < last + config.standby_limit {
        let _ = bench.poll();
        assert_eq!(bench.machine.phase(), Phase::Master);
    }
    bench.now += Duration::from_ns(1);
    let _ = bench.on(Input::Poll(bench.snapshot));
    assert_eq!(bench.machine.phase(), Phase::DegradedMaster);
}

/// A report contains the lowest eleven bits of the number of starts; its encoding keeps them.
#[test]
fn a_report_tells_which_start_of_its_sender_it_is() {
    for (starts, expected) in [(0, 1), (0x7FE, 0x7FF), (0x7FF, 0), (0x17FE, 0x7FF)] {
        let state = SystemState {
            total_resets: starts,
            ..SystemState::factory(SystemId::A)
        };
        let mut bench = Bench::new(SystemId::A, state);
        let report = bench.machine.link_report(bench.now);
        assert_eq!(report.start, expected);
        assert_eq!(LinkReport::from_words(&report.to_words()), Some(report));
    }
}

/// Each report has a later time than the one before, even if both are sent at the same moment.
#[test]
fn reports_tell_times_that_rise() {
    let mut bench = Bench::master();
    let mut sent = |after_us| {
        bench.now += Duration::from_us(after_us);
        bench.machine.link_report(bench.now).sent_us
    };
    let first = sent(10);
    assert_eq!([0, 0, 1, 10].map(sent), [1, 2, 3, 11].map(|us| first + us));
}

/// T-RED-6: a master that no longer hears CAN, while the other system does, stops the vehicle until
/// it hears CAN again. The limit doubles with each reset without success, three times at most.
#[test]
fn a_master_stops_the_vehicle_while_its_can_is_open() {
    for (abn_in_a_row, times) in [(0, 1), (1, 2), (2, 4), (3, 8)] {
        let mut bench = Bench::master_from(
            CONFIG,
            SystemState {
                abn_in_a_row,
                ..SystemState::factory(SystemId::A)
            },
        );
        let last_heard = bench.now;
        let mut reported = Vec::new();
        let silent = |it: &RedundancyEvent| matches!(it, RedundancyEvent::CanSilent(_));
        while bench.machine.mode() != Mode::SafeStop {
            let _ = bench.linked(sound(Role::Standby, Term::NONE));
            bench.now += CONFIG.poll_interval;
            bench.snapshot.beats[0] += 1;
            let actions = bench.on(Input::Poll(bench.snapshot));
            reported.extend(actions.events().filter(silent));
        }
        let limit = CONFIG.can_open_limit.times(times);
        assert_eq!(
            bench.now.since(last_heard),
            limit + CONFIG.poll_interval,
            "{abn_in_a_row} resets"
        );
        bench.snapshot.beats[0] += 1;
        reported.extend(bench.poll().events().filter(silent));
        assert_eq!(bench.machine.mode(), Mode::DegradedL2);
        assert_eq!(
            reported,
            [
                RedundancyEvent::CanSilent(true),
                RedundancyEvent::CanSilent(false)
            ]
        );
    }
}

/// T-RED-9: a master that was held up resumes if the vehicle reports that its last frame is too
/// recent for a takeover, or so old that the other system would drive by now.
#[test]
fn the_vehicle_tells_a_master_that_was_held_up_whether_it_is_deposed() {
    let under_way = CONFIG.poll_interval.times(2);
    let recent = (CONFIG.witness_limit() - under_way).as_us() / 1_000;
    let old = (CONFIG.gap_bound() + under_way).as_us() / 1_000;
    for (age_ms, resumes) in [
        (recent - 1, true),
        (recent, false),
        (old, false),
        (old + 1, true),
    ] {
        for dual in [true, false] {
            let mut bench = Bench::master();
            if !dual {
                bench.snapshot.beats[0] += 1;
                for _ in 0..CONFIG.standby_limit.as_us() / 1_000 + 2 {
                    let _ = bench.poll();
                }
                bench.run_with_beats(5);
            }
            let (phase, term) = (bench.machine.phase(), bench.machine.term());
            assert_eq!(phase == Phase::Master, dual);
            assert!(bench.machine.may_transmit(bench.now));
            bench.now += Duration::from_ms(30);
            bench.run_with_beats(1);
            assert_eq!(bench.machine.phase(), Phase::Thawed);
            let actions = bench.obeyed(term, age_ms);
            let expected = if resumes { phase } else { Phase::Thawed };
            assert_eq!(bench.machine.phase(), expected, "{age_ms} ms, {dual}");
            assert_eq!(actions.contains(Action::Transmit), resumes);
        }
    }
}

/// T-RED-9: the other system counts as sound when it has been heard for one second. It counts as
/// the standby after two seconds, if the configuration permits this.
#[test]
fn a_standby_that_is_back_counts_again_after_its_time() {
    for reintegrate in [false, true] {
        let mut bench = Bench::master_with(Config {
            reintegrate,
            ..CONFIG
        });
        while bench.machine.phase() == Phase::Master {
            let _ = bench.poll();
        }
        assert!(bench.machine.state().cpsys_failure);
        let (back, mut sound_after, mut standby_after) = (bench.now, None, None);
        for ms in 0..3_000 {
            if ms % 100 == 0 {
                let _ = bench.on(Input::StatusFrame(sound(Role::Standby, Term::NONE)));
            }
            bench.run_with_beats(1);
            // The first heartbeat is seen one poll later.
            let heard_for = bench.now.since(back + CONFIG.poll_interval);
            if !bench.machine.state().cpsys_failure {
                sound_after.get_or_insert(heard_for);
            }
            if bench.machine.phase() == Phase::Master {
                standby_after.get_or_insert(heard_for);
            }
        }
        assert_eq!(sound_after, Some(CONFIG.recover_after));
        let expected = reintegrate.then_some(CONFIG.recover_after.times(2));
        assert_eq!(standby_after, expected);
    }
}

/// T-RED-2: a standby that has heard no master leads when a handshake shows that the other system
/// starts too, even if a stray edge made it standby. It listens first, and neither the other system
/// nor the vehicle may report a driver. If it has heard a master, that master has failed.
#[test]
fn a_standby_leads_if_the_other_starts_and_no_system_drives() {
    let limit = CONFIG.witness_limit().as_us() / 1_000;
    for (known, beats, after_ms, reports, obeys, expected) in [
        (false, true, 1, false, false, Phase::Standby),
        (false, true, limit, false, false, Phase::Standby),
        (false, true, limit + 1, false, false, Phase::Master),
        (false, false, limit, false, false, Phase::Standby),
        (false, false, limit + 1, false, false, Phase::Master),
        (false, true, limit + 1, true, false, Phase::Standby),
        (false, true, limit + 1, false, true, Phase::Standby),
        (true, true, limit + 1, false, false, Phase::DegradedMaster),
    ] {
        let mut bench = Bench::new(SystemId::B, SystemState::factory(SystemId::B));
        let _ = bench.poll();
        let run = |bench: &mut Bench, ms| {
            for _ in 0..ms {
                bench.snapshot.beats = bench.snapshot.beats.map(|it| it + u32::from(beats));
                let _ = bench.poll();
            }
        };
        bench.snapshot.syncs += 1;
        run(&mut bench, 1);
        if known {
            let _ = bench.control(16);
        }
        run(&mut bench, after_ms - 1);
        let (own, term) = (Term::from_bits(17), Term::from_bits(16));
        if reports {
            let _ = bench.linked(sound(Role::Master, term));
        }
        if obeys {
            let _ = bench.obeyed(own, 0);
        }
        bench.snapshot.handshakes += 1;
        run(&mut bench, 1);
        assert_eq!(
            bench.machine.phase(),
            expected,
            "{known} {beats} {after_ms} {reports} {obeys}"
        );
    }
}

/// T-RED-8: a master that runs but is not heard is mute when the vehicle says so. Without an echo,
/// it is mute if this system hears CAN or the other system says that it does not drive. After an
/// outage of CAN the master has time to be heard again.
#[test]
fn a_mute_master_is_relieved_when_its_limit_ends() {
    let (mute, witness) = (CONFIG.mute_limit(), CONFIG.witness_limit());
    const NEVER: u64 = u64::MAX;
    let outage = Duration::from_ms(30);
    let (reported, listened) = (CONFIG.control_period + CONFIG.poll_interval, witness);
    let no_master = CONFIG.no_master_limit(SystemId::B);
    for (heard, echo, can_from_ms, report, limit) in [
        (true, true, 0, None, Some(witness)),
        (true, true, 30, None, Some(outage + reported)),
        (true, false, 30, None, Some(outage + listened)),
        (true, false, 0, None, Some(mute)),
        (true, false, 0, Some(Role::Master), Some(mute)),
        (true, false, NEVER, Some(Role::Standby), Some(mute)),
        (true, false, NEVER, Some(Role::Master), None),
        (true, false, NEVER, None, None),
        (false, false, 0, None, Some(no_master)),
    ] {
        let mut bench = if heard {
            Bench::standby()
        } else {
            let mut bench = Bench::new(SystemId::B, SystemState::factory(SystemId::B));
            let _ = bench.poll();
            bench.snapshot.syncs += 1;
            let _ = bench.poll();
            bench
        };
        let term = Term::from_bits(16);
        if heard {
            let _ = bench.control(term.bits());
        }
        let since = bench.now;
        let mut took = None;
        for ms in 1..100 {
            bench.now += CONFIG.poll_interval;
            if echo && ms >= can_from_ms {
                let _ = bench.obeyed(term, ms);
            }
            if let Some(role) = report {
                let mode = Mode::L3;
                let can_alive = false;
                let _ = bench.linked(PeerReport {
                    role,
                    mode,
                    term,
                    can_alive,
                    ability: Ability::All,
                });
            }
            bench.snapshot.beats[0] += 1;
            bench.snapshot.can_frames += u32::from(ms >= can_from_ms);
            let _ = bench.on(Input::Poll(bench.snapshot));
            if bench.machine.phase() != Phase::Standby {
                took = Some(bench.now.since(since));
                break;
            }
        }
        let expected = limit.map(|limit| limit + CONFIG.poll_interval);
        assert_eq!(took, expected, "{heard} {echo} {can_from_ms} {report:?}");
    }
}

/// T-RED-9: an echo counts as a control frame only if the standby did not receive that frame: the
/// vehicle accepted it more than the margin after the last frame that the standby received.
#[test]
fn an_echo_replaces_a_control_frame_that_was_missed() {
    let ms = |span: Duration| span.as_us() / 1_000;
    let (margin, witness) = (ms(CONFIG.control_margin), ms(CONFIG.witness_limit()));
    for age in [0, 2] {
        for (told_at, counts_from) in [(age + margin, 0), (age + margin + 1, margin + 1)] {
            let mut bench = Bench::standby();
            let _ = bench.control(16);
            let last = bench.now;
            while bench.machine.phase() == Phase::Standby {
                let _ = bench.poll();
                if ms(bench.now.since(last)) == told_at {
                    let _ = bench.obeyed(Term::from_bits(16), age);
                }
            }
            let took = ms(bench.now.since(last));
            assert_eq!(took, counts_from + witness + 1, "{age} {told_at}");
        }
    }
}

/// T-RED-3: two lines that fall silent while the master drives count as cut. Each cut is reported
/// once.
#[test]
fn cut_lines_are_told_once() {
    let mut bench = Bench::standby();
    let mut reported = Vec::new();
    for cut in [false, true, false, true] {
        let mut times = 0;
        for _ in 0..30 {
            let _ = bench.control(16);
            bench.snapshot.beats[0] += u32::from(!cut);
            let split = |it: &RedundancyEvent| *it == RedundancyEvent::LinesSplit;
            times += bench.poll().events().filter(split).count();
        }
        reported.push(times);
    }
    assert_eq!(reported, [0, 1, 0, 1]);
}

/// T-RED-5: an incarnation counts its wrong command or scene once, even if it finds it repeatedly.
/// A power cycle leaves one attempt. Good operation subtracts one.
#[test]
fn wrong_commands_are_counted_by_incarnation_and_fade() {
    let before = |wrong_in_a_row| SystemState {
        wrong_in_a_row,
        ..SystemState::factory(SystemId::A)
    };
    for (of_before, then) in [(0, 1), (1, 2), (u8::MAX, 2)] {
        let mut bench = Bench::new(SystemId::A, before(of_before));
        for fault in [FailureMode::WrongCommand, FailureMode::WrongScene].repeat(2) {
            let _ = bench.on(Input::OwnFault(fault));
        }
        let counted = bench.machine.state().wrong_in_a_row;
        assert_eq!(counted, then, "{of_before}");
    }
    let mut bench = Bench::master_from(CONFIG, before(1));
    let healthy_ms = CONFIG.healthy_after.as_ns() / 1_000_000;
    bench.run_with_beats(healthy_ms - 1_000);
    assert_eq!(bench.machine.state().wrong_in_a_row, 1);
    bench.run_with_beats(2_000);
    assert_eq!(bench.machine.state().wrong_in_a_row, 0);
}

/// A clock that differs from both others by more than the limit is reported once. If it is the
/// master's own, the master stops the vehicle.
#[test]
fn a_clock_that_differs_is_told_and_the_own_one_is_a_fault() {
    for (peer_ms, vehicle_ms, expected) in [
        (20, 0, None),
        (0, 20, None),
        (40, 15, None),
        (15, 40, None),
        (20, 40, None),
        (40, 20, None),
        (40, 9, Some(ClockOwner::Peer)),
        (9, 40, Some(ClockOwner::Vehicle)),
        (40, 40, Some(ClockOwner::Own)),
        (40, 0, Some(ClockOwner::Peer)),
        (0, 40, Some(ClockOwner::Vehicle)),
    ] {
        let mut bench = Bench::master();
        let mut reported = Vec::new();
        for period in 0..80 {
            bench.run_with_beats(10);
            let jumped = period >= 40;
            let shown = |ms| bench.now + Duration::from_ms(if jumped { ms } else { 0 });
            let (peer, vehicle) = (shown(peer_ms), shown(vehicle_ms));
            let report = LinkReport {
                report: sound(Role::Standby, bench.machine.term()),
                start: 1,
                sent_us: (peer.as_ns() / 1_000) as u32,
            };
            let obeyed = ObeyedTerm {
                term: bench.machine.term(),
                age: Duration::ZERO,
                sent: Some(((vehicle.as_ns() / 1_000_000) as u8, Duration::ZERO)),
            };
            for input in [Input::LinkReport(report), Input::VehicleTerm(obeyed)] {
                reported.extend(bench.on(input).events().filter_map(|event| match event {
                    RedundancyEvent::ClockWrong(clock) => Some(clock),
                    _ => None,
                }));
            }
        }
        assert_eq!(
            reported,
            Vec::from_iter(expected),
            "{peer_ms} {vehicle_ms} ms"
        );
        let stops = bench.machine.mode() == Mode::SafeStop;
        assert_eq!(stops, expected == Some(ClockOwner::Own), "{expected:?}");
    }
}

/// A link that becomes slower is not a witness: a report that is late by more than its limit does
/// not count.
#[test]
fn a_report_that_is_too_late_does_not_count() {
    let mut bench = Bench::master();
    let mut late_ms = 0;
    for report in 0..60 {
        bench.run_with_beats(10);
        if report >= 40 {
            late_ms += 9;
        }
        let before = bench.machine.highest_term();
        let report = sound(Role::Standby, before.above(1, SystemId::B).unwrap());
        let _ = bench.linked_late(report, late_ms);
        let counts = bench.machine.highest_term() > before;
        let limit_ms = CONFIG.report_limit.as_us() / 1_000;
        assert_eq!(counts, late_ms <= limit_ms, "{late_ms} ms late");
    }
}

/// A report counts up to its limit, and not a microsecond longer.
#[test]
fn a_report_counts_up_to_its_limit() {
    // Shorter than the pause after which the comparison of the clocks starts again.
    let report_limit = Duration::from_ms(90);
    for (late, expected) in [
        (report_limit, true),
        (report_limit + Duration::from_us(1), false),
    ] {
        let mut bench = Bench::master_with(Config {
            report_limit,
            ..CONFIG
        });
        let report = |bench: &mut Bench, late: Duration| {
            let before = bench.machine.highest_term();
            let _ = bench.on(Input::LinkReport(LinkReport {
                report: sound(Role::Standby, before.above(1, SystemId::B).unwrap()),
                start: 1,
                sent_us: (bench.now.as_ns() / 1_000 - late.as_us()) as u32,
            }));
            bench.machine.highest_term() > before
        };
        for _ in 0..40 {
            bench.run_with_beats(10);
            assert!(report(&mut bench, Duration::ZERO));
        }
        // The report is sent a millisecond after the last one.
        bench.run_with_beats(1);
        bench.now += late;
        assert_eq!(report(&mut bench, late), expected, "{late:?}");
    }
}

/// A report that was sent before the last one does not count, unless its sender has restarted: then
/// its clock starts again.
#[test]
fn the_clock_of_a_sender_that_has_started_begins_anew() {
    for (start, behind_ms, expected) in [(1, 300, false), (2, 300, true), (2, 900, true)] {
        let mut bench = Bench::master();
        for report in 0..=40 {
            bench.run_with_beats(10);
            let last = report == 40;
            let (start, behind_ms) = if last { (start, behind_ms) } else { (1, 0) };
            let before = bench.machine.highest_term();
            let _ = bench.on(Input::LinkReport(LinkReport {
                report: sound(Role::Standby, before.above(1, SystemId::B).unwrap()),
                start,
                sent_us: (bench.now.as_ns() / 1_000 - behind_ms * 1_000) as u32,
            }));
            let counts = bench.machine.highest_term() > before;
            assert_eq!(counts, !last || expected, "start {start}, {behind_ms} ms");
        }
    }
}

/// T-RED-9: a standby that no longer hears anybody on CAN does not take a handshake for a failed
/// master, but silent lines.
#[test]
fn a_deaf_standby_does_not_act_on_a_handshake() {
    for (deaf, silent, expected) in [
        (true, false, Phase::Standby),
        (false, false, Phase::DegradedMaster),
        (true, true, Phase::DegradedMaster),
    ] {
        let mut bench = Bench::standby();
        let _ = bench.control(16);
        let _ = bench.obeyed(Term::from_bits(16), 0);
        bench.snapshot.handshakes += u32::from(!silent);
        for _ in 0..30 {
            let beats = u32::from(!silent);
            bench.snapshot.beats = bench.snapshot.beats.map(|count| count + beats);
            bench.snapshot.can_frames -= u32::from(deaf);
            let _ = bench.poll();
        }
        assert_eq!(bench.machine.phase(), expected, "{deaf} {silent}");
    }
}

/// T-RED-9: a new standby, which may have a hold-down, listens for the vehicle's echo first;
/// without one it then acts on the lines.
#[test]
fn a_new_standby_listens_for_an_echo_first() {
    let listens = CONFIG.witness_limit() + CONFIG.control_period;
    for (cause, expected) in [
        (ResetCause::PowerOn, CONFIG.level_limit()),
        (ResetCause::Watchdog, listens),
    ] {
        let mut bench = Bench::standby();
        let loaded = Loaded::State(SystemState::factory(SystemId::B));
        bench.machine = Redundancy::new(CONFIG, SystemId::B, cause, loaded, bench.now);
        let _ = bench.poll();
        bench.snapshot.syncs += 1;
        bench.run_with_beats(1);
        let since = bench.now;
        bench.snapshot.peer_powered = false;
        while bench.machine.phase() == Phase::Standby {
            let _ = bench.poll();
        }
        let after = bench.now.since(since);
        let latest = expected + CONFIG.poll_interval.times(3);
        assert!(after >= expected && after <= latest, "{cause:?} {after:?}");
    }
}
