//! What happens to the messages between the nodes, and what their readers see.

use std::collections::BTreeMap;

use chacha20::ChaCha8Rng;
use rand::RngExt;
use tandem_board::{Duration, Instant, SystemId};
use tandem_timesync::gptp::EventId;
use tandem_timesync::{
    Arbitrary, CanTimeFrame, CanTimeMaster, Conversion, PulseMaster, PulseTransfer, TimeStatus,
};

use crate::nodes::{Clock, Follower, Grandmaster, Out, Sensor, System, Time, global};
use crate::oracle::{Excuse, Violation};
use crate::plan::{
    Incident, Liar, MS, Place, Plan, QUIET_NS, RECOVERS_NS, Spell, US, magnitude, rng,
};

/// How often a system works.
const TURN_NS: u64 = 10 * MS;
/// The first grandmaster's time at the beginning: in 2026.
const BEGIN_NS: u64 = 1_790_000_000_000_000_000;
/// At the end of a sequence the time is at most this far from the truth, ns.
const RECOVERED_NS: u64 = MS;

enum Event {
    Grandmaster(usize),
    Turn(usize),
    /// To a grandmaster (0, 1) or a system (2, 3), with the stamp of its arrival.
    Datagram(usize, Vec<u8>, Instant),
    /// Of the same, when an event message left.
    Sent(usize, EventId, Instant),
    Edge(usize, u64),
    Transfer(usize, PulseTransfer<Arbitrary>),
    /// Of a system, when SYNC was on the bus.
    OnBus(usize, Instant),
    Frame(usize, CanTimeFrame, Instant),
    Read(Place),
    Incident(Incident),
    Restart(usize),
}

/// What happens to a message.
enum Fate {
    Good,
    Lost,
    /// It arrives again after this time.
    Twice(u64),
    /// It is handed over late; the stamp of its arrival is right.
    Late(u64),
    /// It waits in a queue before it arrives.
    Queued(u64),
    Corrupt,
}

pub(crate) struct World<'p> {
    plan: &'p Plan,
    rng: ChaCha8Rng,
    now: u64,
    queue: BTreeMap<(u64, u64), Event>,
    count: u64,
    gms: Vec<Grandmaster>,
    systems: [System; 2],
    sensor: Sensor,
    driving: usize,
    /// The time of a chain without a grandmaster.
    origin: Option<(usize, Clock)>,
    has_begun: bool,
    excuse: Excuse,
    /// When each station was handed its last message that kept the order of its link.
    handed: [u64; 4],
    /// The error that the last sender of SYNC stated then, ns.
    on_bus_ns: u64,
    /// When the last two messages to each receiver were wild: stations, sensor.
    wild: [[Option<u64>; 2]; 5],
    violation: Option<(u64, Place, Violation)>,
}

/// Returns whether a master says that its time is not that of a living origin.
fn is_to_gateway(status: TimeStatus) -> bool {
    status.has(TimeStatus::SYNC_TO_GATEWAY) || !status.is_synchronised()
}

impl<'p> World<'p> {
    pub(crate) fn new(plan: &'p Plan, number: u64) -> Self {
        let mut rng = rng(number, 2);
        let clock = |shown, place: usize| Clock {
            since: 0,
            shown,
            ppb: plan.rates_ppb[place],
        };
        let wrong = magnitude(&mut rng, MS, 1 << 60);
        let origins = [BEGIN_NS, wrong];
        let masters = match plan.liar {
            _ if !plan.has_grandmaster => 0,
            Liar::SecondMaster => 2,
            _ => 1,
        };
        let gms = (0..masters).map(|n| Grandmaster::new(n as u8 + 1, clock(origins[n], n)));
        // Far from zero: a clock may jump back by 10 s.
        let start = |rng: &mut ChaCha8Rng| 100_000 * MS + magnitude(rng, MS, 1 << 50);
        let local = [start(&mut rng), start(&mut rng), start(&mut rng)];
        let mut world = Self {
            plan,
            now: 0,
            queue: BTreeMap::new(),
            count: 0,
            gms: gms.collect(),
            systems: [0, 1].map(|of| System::new(of, clock(local[of], 2 + of), 0)),
            sensor: Sensor::new(clock(local[2], 4)),
            driving: 0,
            origin: None,
            has_begun: false,
            excuse: Excuse::default(),
            handed: [0; 4],
            on_bus_ns: 0,
            wild: [[None; 2]; 5],
            violation: None,
            rng,
        };
        for n in 0..masters {
            world.after(n as u64 * 700 * MS, Event::Grandmaster(n));
        }
        for n in 0..2 {
            world.after(n as u64 * MS, Event::Turn(n));
        }
        for place in [Place::System(0), Place::System(1), Place::Sensor] {
            world.after(0, Event::Read(place));
        }
        for (at, incident) in &plan.incidents {
            world.after(*at, Event::Incident(*incident));
        }
        world
    }

    /// Runs the sequence. Returns the first violation, with its time and place.
    pub(crate) fn run(mut self) -> Option<(u64, Place, Violation)> {
        let end = self.plan.ends + QUIET_NS;
        while let Some(((at, _), event)) = self.queue.pop_first()
            && at <= end
        {
            self.now = at;
            self.on(event);
            if self.violation.is_some() {
                return self.violation;
            }
        }
        None
    }

    fn after(&mut self, span: u64, event: Event) {
        self.count += 1;
        self.queue.insert((self.now + span, self.count), event);
    }

    fn is_quiet(&self) -> bool {
        self.now >= self.plan.ends
    }

    fn draw(&mut self, below: u64) -> u64 {
        self.rng.random_range(0..below.max(1))
    }

    /// What happens to the next message to this receiver.
    fn fate(&mut self, to: usize) -> Fate {
        if self.is_quiet() || self.draw(1_000) >= self.plan.faulty_permille.into() {
            return Fate::Good;
        }
        match self.draw(6) {
            0 | 1 => Fate::Lost,
            2 => Fate::Twice(magnitude(&mut self.rng, US, 400 * MS)),
            3 if self.may_be_wild(to) => Fate::Corrupt,
            4 if self.may_be_wild(to) => Fate::Queued(magnitude(&mut self.rng, US, 20 * MS)),
            _ => Fate::Late(magnitude(&mut self.rng, US, 300 * MS)),
        }
    }

    /// Two samples in a second may be wild, which are two of eight: more of them cannot be told
    /// from a longer cable.
    fn may_be_wild(&mut self, to: usize) -> bool {
        let [older, newer] = self.wild[to];
        let may = older.is_none_or(|at| self.now - at > 1_000 * MS);
        if may {
            self.wild[to] = [newer, Some(self.now)];
        }
        may || self.plan.liar == Liar::Forger
    }

    fn on(&mut self, event: Event) {
        match event {
            Event::Grandmaster(n) => self.grandmaster(n),
            Event::Turn(of) => self.turn(of),
            Event::Datagram(to, bytes, at) => self.receive(to, &bytes, at),
            Event::Sent(of, event, at) => self.sent(of, event, at),
            Event::Edge(to, latency) => {
                let system = &mut self.systems[to];
                let count = system.edge.map_or(0, |(count, _)| count);
                let at = system.time.clock.local(self.now + latency);
                system.edge = Some((count.wrapping_add(1), at));
            }
            Event::Transfer(to, transfer) => {
                let system = &mut self.systems[to];
                let now = system.time.clock.local(self.now);
                if system.is_alive && !system.drives {
                    system.slave.on_transfer(now, transfer);
                    system.follow_pulses(now);
                }
            }
            Event::OnBus(of, at) => {
                self.on_bus_ns = self.error_of(of);
                let system = &mut self.systems[of];
                if let Some(conversion) = system.time.base.conversion() {
                    let is_to_gateway = is_to_gateway(conversion.status_at(at));
                    system.can.on_sent(at, conversion.at(at), is_to_gateway);
                }
            }
            Event::Frame(from, frame, at) => self.hear(from, &frame, at),
            Event::Read(place) => self.read(place),
            Event::Incident(incident) => self.suffer(incident),
            Event::Restart(of) => {
                let clock = self.systems[of].time.clock;
                let edge = self.systems[of].edge;
                self.systems[of] = System::new(of, clock, self.now);
                self.systems[of].edge = edge;
                self.after(0, Event::Turn(of));
                self.after(0, Event::Read(Place::System(of)));
            }
        }
    }

    fn grandmaster(&mut self, n: usize) {
        let gm = &mut self.gms[n];
        if !gm.is_alive {
            return;
        }
        let (now, mut out) = (gm.clock.local(self.now), Out::default());
        let next = gm.master.poll(now, global(gm.set_by), &mut out);
        let wait = next.since(now).as_ns().clamp(US, 125 * MS);
        self.send(n, out);
        self.after(wait, Event::Grandmaster(n));
    }

    /// Sends what a station of the Ethernet has to say to all others.
    fn send(&mut self, from: usize, out: Out) {
        for (bytes, event) in out.0 {
            if let Some(event) = event {
                let at = self.station_clock(from).local(self.now);
                match self.fate(from) {
                    Fate::Lost => {}
                    Fate::Late(span) => self.after(span, Event::Sent(from, event, at)),
                    _ => self.after(0, Event::Sent(from, event, at)),
                }
            }
            for to in 0..4 {
                let exists = to >= 2 || to < self.gms.len();
                if exists && to != from {
                    self.transmit(from, to, bytes.clone());
                }
            }
        }
    }

    fn transmit(&mut self, from: usize, to: usize, mut bytes: Vec<u8>) {
        let (shortest, jitter) = self.plan.wire;
        let back = if from >= 2 && !self.is_quiet() {
            self.plan.slower_back
        } else {
            0
        };
        let mut wire = shortest + self.draw(jitter + 1) + back;
        let spell = |spell| match spell {
            Spell::FollowUpsLate(span) if bytes[0] & 0xF == 8 => Some(span),
            _ => None,
        };
        let spell = self.plan.late(self.now, spell);
        let mut late = self.draw(2 * MS) + spell;
        let mut again = None;
        match self.fate(to) {
            Fate::Good if spell == 0 => {
                // A link keeps the order.
                let handed = self.handed[to].max(self.now + wire + late);
                late = handed - self.now - wire;
                self.handed[to] = handed;
            }
            Fate::Good => {}
            Fate::Lost => return,
            Fate::Twice(span) => again = Some(span),
            Fate::Late(span) => late += span,
            Fate::Queued(span) => wire += span,
            // The checksum of the Ethernet finds it.
            Fate::Corrupt if self.plan.liar != Liar::Forger => return,
            Fate::Corrupt => {
                for _ in 0..=self.draw(2) {
                    let bit = self.draw(8 * bytes.len() as u64) as usize;
                    bytes[bit / 8] ^= 1 << (bit % 8);
                }
            }
        }
        let clock = *self.station_clock(to);
        let mut deliver = |wire: u64| {
            let at = clock.local(self.now + wire);
            let event = Event::Datagram(to, bytes.clone(), at);
            self.after(wire + late, event);
        };
        deliver(wire);
        if let Some(span) = again {
            deliver(wire + span);
        }
    }

    fn station_clock(&self, station: usize) -> &Clock {
        match station {
            0 | 1 => &self.gms[station].clock,
            _ => &self.systems[station - 2].time.clock,
        }
    }

    fn receive(&mut self, to: usize, bytes: &[u8], at: Instant) {
        let mut out = Out::default();
        if to < 2 {
            let gm = &mut self.gms[to];
            if gm.is_alive {
                gm.master.on_message(at, bytes, global(gm.set_by), &mut out);
            }
        } else {
            let system = &mut self.systems[to - 2];
            if !system.is_alive {
                return;
            }
            let now = system.time.clock.local(self.now);
            if let Some(sample) = system.gptp.on_message(at, bytes, &mut out) {
                system.on_grandmaster(now, sample);
            }
        }
        self.send(to, out);
    }

    fn sent(&mut self, of: usize, event: EventId, at: Instant) {
        let mut out = Out::default();
        if of < 2 {
            let gm = &mut self.gms[of];
            gm.master.on_sent(event, at, global(gm.set_by), &mut out);
        } else {
            self.systems[of - 2].gptp.on_sent(event, at, &mut out);
        }
        self.send(of, out);
    }

    fn turn(&mut self, of: usize) {
        let (drives, has_grandmaster) = (self.driving == of, self.plan.has_grandmaster);
        let mut out = Out::default();
        let system = &mut self.systems[of];
        if !system.is_alive {
            return;
        }
        let now = system.time.clock.local(self.now);
        system.gptp.poll(now, &mut out);
        if system.begin_turn(now, drives, has_grandmaster) {
            self.begin(of);
        }
        self.send(2 + of, out);
        let system = &mut self.systems[of];
        if !drives {
            system.follow_pulses(now);
        } else if let Some(conversion) = system.time.base.conversion() {
            self.tell(of, now, &conversion);
        }
        // Now and then the task is starved.
        let late = match self.is_quiet() || self.draw(100) > 0 {
            true => self.draw(self.plan.lateness),
            false => self.draw(200 * MS),
        };
        let system = &self.systems[of];
        let due = match drives && system.time.base.conversion().is_some() {
            true => system.master.due().min(system.can.due()),
            false => Instant::NEVER,
        };
        let wait = due.since(now).as_ns().clamp(US, TURN_NS);
        self.after(wait + late, Event::Turn(of));
    }

    /// A system's clock has become the time of the chain. It is not that of a grandmaster.
    fn begin(&mut self, of: usize) {
        // Two systems that both begin a time have no truth.
        let is_only = core::mem::replace(&mut self.has_begun, true);
        self.origin = (!is_only && self.gms.is_empty()).then(|| (of, self.systems[of].time.clock));
        self.excuse.begin(self.now);
    }

    fn tell(&mut self, of: usize, now: Instant, conversion: &Conversion<Arbitrary>) {
        let system = &mut self.systems[of];
        if now >= system.master.due() {
            let lasts = self.rng.random_range(0..2 * US);
            let after = now + Duration::from_ns(lasts);
            let transfer = system.master.raised(now, after, conversion.at(now));
            let transfer = transfer.map(|transfer| PulseTransfer {
                master_error: conversion.error_at(now),
                is_to_gateway: is_to_gateway(conversion.status_at(now)),
                ..transfer
            });
            let raised = self.rng.random_range(0..=lasts);
            self.pulse(of, raised, transfer);
        }
        let system = &mut self.systems[of];
        if now >= system.can.due()
            && let Some(frame) = system.can.poll(now, conversion.at(now))
        {
            self.frame(of, frame);
        }
    }

    fn pulse(&mut self, of: usize, raised: u64, transfer: Option<PulseTransfer<Arbitrary>>) {
        let (to, (line, latency)) = (1 - of, self.plan.line);
        let latency = self.draw(latency + 1);
        let moves = self.plan.late(self.now, |spell| match spell {
            Spell::EdgesMove(span) => Some(span),
            _ => None,
        });
        match self.fate(2 + to) {
            _ if moves > 0 => {
                let moved = self.draw(2 * moves);
                if moved < moves {
                    self.after(raised + moved, Event::Edge(to, 0));
                }
            }
            Fate::Lost | Fate::Corrupt => {}
            Fate::Twice(span) | Fate::Late(span) => {
                self.after(raised + line, Event::Edge(to, latency));
                // A stray edge.
                self.after(raised + line + span, Event::Edge(to, 0));
            }
            Fate::Good | Fate::Queued(_) => self.after(raised + line, Event::Edge(to, latency)),
        }
        let Some(mut transfer) = transfer else { return };
        let late = self.plan.late(self.now, |spell| match spell {
            Spell::TransfersLate(span) => Some(span),
            _ => None,
        });
        let way = 100 * US + self.draw(MS) + late;
        let (mut late, mut again) = (0, None);
        match self.fate(2 + to) {
            Fate::Good => {}
            Fate::Lost => return,
            Fate::Twice(span) => again = Some(span),
            Fate::Late(span) | Fate::Queued(span) => late = span,
            // The checksum of the link finds it.
            Fate::Corrupt if self.plan.liar != Liar::Forger => return,
            Fate::Corrupt => {
                let mut words = transfer.to_words();
                let bit = self.draw(32 * words.len() as u64) as usize;
                words[bit / 32] ^= 1 << (bit % 32);
                let Some(corrupt) = PulseTransfer::from_words(&words) else {
                    return;
                };
                transfer = corrupt;
            }
        }
        self.after(way + late, Event::Transfer(to, transfer));
        if let Some(span) = again {
            self.after(way + span, Event::Transfer(to, transfer));
        }
    }

    /// A frame of time goes on the bus. Its sender hears when it was there.
    fn frame(&mut self, of: usize, mut frame: CanTimeFrame) {
        let spell = |spell| match spell {
            Spell::CanFollowUpsLate(span) if frame[0] & 0x08 != 0 => Some(span),
            _ => None,
        };
        let waits = self.plan.late(self.now, spell);
        let on_bus = 50 * US + self.draw(self.plan.lateness) + waits;
        // The stamps of two controllers differ by a bit at most.
        let [sent, heard] = [0, 0].map(|_: u64| self.draw(US));
        let at = self.systems[of].time.clock.local(self.now + on_bus + sent);
        let told = on_bus + self.draw(8 * MS);
        self.after(told, Event::OnBus(of, at));
        let (mut late, mut stamped_late, mut again) = (US, 0, None);
        match self.fate(4) {
            Fate::Good => {}
            Fate::Lost => return,
            Fate::Twice(span) => again = Some(span),
            Fate::Late(span) => late += span,
            // The sensor hears it when it is repeated on the bus.
            Fate::Queued(span) => stamped_late = span,
            Fate::Corrupt => {
                for _ in 0..=self.draw(3) {
                    let bit = self.draw(64) as usize;
                    frame[bit / 8] ^= 1 << (bit % 8);
                }
            }
        }
        let mut arrive = |after: u64| {
            let at = self.sensor.time.clock.local(self.now + after + heard);
            self.after(after + heard + late, Event::Frame(of, frame, at));
        };
        arrive(on_bus + stamped_late);
        if let Some(span) = again {
            arrive(on_bus + span);
        }
    }

    fn hear(&mut self, from: usize, frame: &CanTimeFrame, at: Instant) {
        let master_error_ns = self.error_of(from).max(self.on_bus_ns);
        self.sensor
            .hear(self.now, (from, at), frame, master_error_ns);
    }

    /// Returns the error that a system states now, ns.
    fn error_of(&self, system: usize) -> u64 {
        let reading = self.systems[system].time.reading(self.now);
        reading.map_or(0, |it| it.error.as_ns())
    }

    fn suffer(&mut self, incident: Incident) {
        match incident {
            Incident::Jump(place, by) => self.set(place, by, None),
            Incident::Rate(place, ppb) => self.set(place, 0, Some(ppb)),
            Incident::Takeover(back_ms) => {
                let old = self.driving;
                if !self.systems[1 - old].is_alive {
                    return;
                }
                self.driving = 1 - old;
                if let Some(ms) = back_ms {
                    self.systems[old].is_alive = false;
                    self.after(ms * MS, Event::Restart(old));
                }
            }
            Incident::SensorRestarts => {
                self.sensor = Sensor::new(self.sensor.time.clock);
            }
            Incident::GrandmasterDies => self.gms[0].is_alive = false,
            Incident::Forgery(by) => self.forge(by),
        }
    }

    fn set(&mut self, place: Place, mut by: i64, ppb: Option<i64>) {
        let now = self.now;
        let clock = match place {
            Place::Grandmaster => match self.gms.first_mut() {
                Some(gm) => {
                    gm.set_by += by;
                    by = 0;
                    &mut gm.clock
                }
                None => return,
            },
            Place::System(of) => &mut self.systems[of].time.clock,
            Place::Sensor => &mut self.sensor.time.clock,
        };
        let ppb = ppb.unwrap_or(clock.ppb);
        clock.set(now, by, ppb);
        if by == 0 {
            if let Some((of, origin)) = &mut self.origin
                && place == Place::System(*of)
            {
                origin.set(now, 0, ppb);
            }
            return;
        }
        match place {
            Place::Grandmaster => {}
            Place::System(of) => {
                self.systems[of].time.watched.jumps();
                // The clock that was the time has jumped: there is no truth any more.
                self.origin = None;
            }
            Place::Sensor => self.sensor.time.watched.jumps(),
        }
        self.excuse.begin(self.now);
    }

    /// Sends a Sync with its Follow_Up in the grandmaster's name, a transfer with an edge, and
    /// frames of time, with a time that is wrong by `by`.
    fn forge(&mut self, by: i64) {
        let (clock, set_by) = (self.gms[0].clock, self.gms[0].set_by + by);
        let mut forger = Grandmaster::new(1, clock).master;
        let global = global(set_by);
        let (now, mut out) = (clock.local(self.now), Out::default());
        // Numbers that are ahead of those of the grandmaster.
        for _ in 0..self.now / (125 * MS) + 2 {
            out.0.clear();
            forger.poll(now, global, &mut out);
            forger.poll(now + Duration::from_ms(2_000), global, &mut out);
        }
        for event in out.0.clone().iter().filter_map(|(_, event)| *event) {
            forger.on_sent(event, now, global, &mut out);
        }
        for (bytes, _) in out.0 {
            for to in 2..4 {
                self.transmit(0, to, bytes.clone());
            }
        }
        let mut pulses = PulseMaster::new(Instant::ORIGIN);
        let transfer = pulses.raised(Instant::ORIGIN, Instant::ORIGIN, global(now).unwrap());
        self.pulse(self.driving, 0, transfer);
        let mut can = CanTimeMaster::new(SystemId::ALL[self.driving], true, now);
        for _ in 0..self.draw(16) {
            let _counts = can.poll::<Arbitrary>(can.due(), global(now).unwrap());
        }
        let time = global(now).unwrap();
        if let Some(sync) = can.poll(can.due(), time) {
            self.frame(self.driving, sync);
            can.on_sent(can.due(), time, false);
            if let Some(follow_up) = can.poll(can.due(), time) {
                self.frame(self.driving, follow_up);
            }
        }
    }

    /// Returns the right time; of a chain without a grandmaster that of its origin.
    fn truth(&self) -> Option<Time> {
        match self.gms.first() {
            Some(gm) => Some(gm.time(self.now)),
            None => self.origin.map(|(_, it)| Time::from_ns(it.at(self.now))),
        }
    }

    fn follower(&mut self, place: Place) -> Option<&mut Follower> {
        match place {
            Place::Grandmaster => None,
            Place::System(of) => Some(&mut self.systems[of])
                .filter(|it| it.is_alive)
                .map(|it| &mut it.time),
            Place::Sensor => Some(&mut self.sensor.time),
        }
    }

    /// A reader reads.
    fn read(&mut self, place: Place) {
        let (now, reader) = (self.now, usize::from(self.draw(16) == 0));
        let truth = self.truth().filter(|_| self.plan.liar <= Liar::Jumps);
        let is_faultless = self.plan.faulty_permille == 0;
        let (is_sensor, further) = match place {
            Place::Sensor => (true, self.sensor.master_error_ns),
            _ => (false, 0),
        };
        let mut excuse = self.excuse;
        let Some(node) = self.follower(place) else {
            return;
        };
        let local = node.clock.local(now);
        let mut found = node.violation;
        if let Some(conversion) = node.base.conversion() {
            let later = |time: Time| truth.map(|truth| (time.after(truth), further));
            let fresh = conversion.reading(local);
            if let Some(later) = later(fresh.time).filter(|_| is_faultless) {
                found = found.or(node.watched.judge_untold(now, &fresh, later));
            }
            let reading = node.readers[reader].read(&conversion, local);
            let (at, of) = ((now, &mut excuse), (local, is_sensor));
            let truth = later(reading.time);
            found = found.or(node.watched.judge(at, reader, of, &reading, truth));
        }
        self.excuse = excuse;
        self.violation = found
            .or_else(|| self.judge_recovery(place))
            .map(|found| (now, place, found));
        let wait = self.draw(40 * MS) + 1;
        self.after(wait, Event::Read(place));
    }

    /// Long after all faults, a place follows a grandmaster that lives.
    fn judge_recovery(&mut self, place: Place) -> Option<Violation> {
        if self.now < self.plan.ends + RECOVERS_NS {
            return None;
        }
        let is_own = self.gms.is_empty() && place == Place::System(self.driving);
        let living = self.gms.iter().filter(|gm| gm.is_alive);
        let times: Vec<Time> = living.map(|gm| gm.time(self.now)).collect();
        let near = |time: Time| {
            let mut apart = times.iter().map(|other| time.after(*other).unsigned_abs());
            times.is_empty() || apart.any(|ns| ns <= RECOVERED_NS)
        };
        let now = self.now;
        let reading = self.follower(place)?.reading(now);
        let is_good =
            reading.is_some_and(|it| (is_own || it.status.is_synchronised()) && near(it.time));
        (!is_good).then_some(Violation::DoesNotRecover)
    }
}
