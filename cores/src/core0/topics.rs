//! Topics over DDS: frames of the bus go up to the SoC, its commands come down. D-2, D-3
//!
//! The least urgent task of core 0: nothing that drives waits for it. Both systems publish what
//! they hear and read what the SoC commands; only the frames of the master act on the vehicle.

use super::{Core0Task, Executor, TaskBody};
use crate::driving::parking::SocSample;
use crate::trace::{Begin, Event};
use heapless::Deque;
use tandem_board::{
    Board, CanId, Channel, Duration, Instant, Network, NoNetwork, Received, Recipient,
};
use tandem_bus::e2e::Checker;
use tandem_bus::{FRAMES, FrameInfo};
use tandem_topics::endpoints::{INPUTS, OUTPUTS, SocTopic, controller_prefix};
use tandem_topics::{
    CanFrame, Controller, GuidPrefix, LateralControl, LongitudinalControl, Outlet, ParkingBrake,
    PowerControl, TopicType as _,
};

/// Capacity for frames that have not been published: what the bus carries in 5 ms.
const FRAMES_HEARD: usize = 32;
/// Datagrams that one job reads at most.
const DATAGRAMS: u8 = 16;
/// How often the port is read while no frame arrives.
const POLLS_EVERY: Duration = Duration::from_ms(5);
/// An SoC that has sent no valid command for this long makes room for another one.
const SOC_SILENT: Duration = Duration::from_ms(500);
/// What the other system says of its SoC holds for this long: ten control cycles.
const THEIRS_HOLDS: Duration = Duration::from_ms(100);
/// A frame is silent after this many of its periods.
const SILENT_PERIODS: u64 = 5;
/// How often losses and silence of frames are looked for.
const SUPERVISES_EVERY: Duration = Duration::from_ms(100);
/// Length of the longest datagram of a port, bytes.
const LONGEST: usize = <NoNetwork as Network>::MAX_BYTES;

/// The frames that core 0 has heard and not published.
#[derive(Default)]
pub(super) struct Heard {
    /// There is a network to publish them on.
    is_open: bool,
    frames: Deque<Received, FRAMES_HEARD>,
}

impl Heard {
    /// Keeps a frame. One that finds no room is lost: the SoC misses its number.
    pub(super) fn push(&mut self, received: &Received) {
        if self.is_open {
            let _lost = self.frames.push_back(*received);
        }
    }

    pub(super) fn is_waiting(&self) -> bool {
        !self.frames.is_empty()
    }
}

/// Returns a code that tells SoCs apart; never 0.
pub(super) fn soc_code(soc: GuidPrefix) -> u16 {
    let add = |sum: u16, byte: &u8| sum.wrapping_mul(31).wrapping_add((*byte).into());
    soc.0.iter().fold(0, add).max(1)
}

/// The SoCs that both systems follow, as codes. Two SoCs may command, and two systems may have
/// heard them in another order: a standby follows the one of the master. D-3
#[derive(Default)]
pub(super) struct FollowedSoc {
    pub(super) own: u16,
    theirs: Option<(Instant, u16)>,
}

impl FollowedSoc {
    pub(super) const fn on_peer(&mut self, now: Instant, code: u16) {
        self.theirs = Some((now, code));
    }

    pub(super) fn theirs(&self, now: Instant) -> u16 {
        let newest = self.theirs.filter(|(at, _)| now.since(*at) <= THEIRS_HOLDS);
        newest.map_or(0, |(_, code)| code)
    }
}

/// The Ethernet port, as the participant sends.
struct Port<'b, B>(&'b B);

impl<B: Board> Outlet for Port<'_, B> {
    fn send(&mut self, to: Recipient, message: &[u8]) {
        // What finds no room is lost, as on the wire.
        let _lost = self.0.network().try_send(Channel::Topics, to, message);
    }
}

/// The SoC that commands. Another one is heard when this one is silent.
#[derive(Clone, Copy)]
struct Commander {
    soc: GuidPrefix,
    heard: Instant,
    /// For each topic, in the order of [`SocTopic`].
    checkers: [Checker; SocTopic::ALL.len()],
}

impl Commander {
    const fn new(soc: GuidPrefix, heard: Instant) -> Self {
        let checkers = [
            PowerControl::checker(),
            LateralControl::checker(),
            LongitudinalControl::checker(),
            ParkingBrake::checker(),
        ];
        Self {
            soc,
            heard,
            checkers,
        }
    }

    /// Decodes a command and checks it end to end. Returns `None` for one that must not act.
    /// `of_master`: the code of the SoC that the master follows; 0 if there is none.
    fn judge(
        commander: &mut Option<Self>,
        of_master: u16,
        (topic, at, soc): (SocTopic, Instant, GuidPrefix),
        payload: &[u8],
    ) -> Option<SocSample> {
        let is_of_master = of_master == soc_code(soc);
        if of_master != 0 && !is_of_master {
            return None;
        }
        let known = commander.take_if(|it| it.soc == soc);
        let is_free = |it: &Self| is_of_master || at.since(it.heard) > SOC_SILENT;
        if known.is_none() && !commander.as_ref().is_none_or(is_free) {
            return None;
        }
        let mut next = known.unwrap_or_else(|| Self::new(soc, at));
        let sample = next.decode(topic, payload);
        if sample.is_some() {
            next.heard = at;
        }
        // A new one has to send a valid command first.
        if sample.is_some() || known.is_some() {
            *commander = Some(next);
        }
        sample
    }

    fn decode(&mut self, topic: SocTopic, payload: &[u8]) -> Option<SocSample> {
        macro_rules! checked {
            ($type:ident, $sample:ident) => {{
                let command = $type::decode(payload).ok();
                let checker = &mut self.checkers[topic as usize];
                let command = command.filter(|it| it.check(checker).is_accepted());
                command.map(SocSample::$sample)
            }};
        }
        match topic {
            SocTopic::Power => checked!(PowerControl, Power),
            SocTopic::Lateral => checked!(LateralControl, Lateral),
            SocTopic::Longitudinal => checked!(LongitudinalControl, Longitudinal),
            SocTopic::ParkingBrake => checked!(ParkingBrake, Brake),
        }
    }
}

/// What is known of the frames of the bus, in the order of [`FRAMES`].
struct Supervision {
    /// When each was heard; `None` before the first one, and while its silence is told.
    heard: [Option<Instant>; FRAMES.len()],
    /// How many of each were lost when that was told.
    lost: [u32; FRAMES.len()],
    polled: Instant,
}

impl Supervision {
    /// Tells which frames are silent, and of which some were lost since that was told.
    fn poll<'b, B: Board>(&mut self, now: Instant, executor: &impl Executor<'b, B>) {
        if now.since(self.polled) < SUPERVISES_EVERY {
            return;
        }
        self.polled = now;
        executor.shared(|shared| {
            for (index, frame) in FRAMES.iter().enumerate() {
                let id = frame.id.into();
                let all = shared.can.receiver.lost_of(index);
                let lost = all.wrapping_sub(core::mem::replace(&mut self.lost[index], all));
                if lost > 0 {
                    shared.trace(Event::FrameGaps { id, lost });
                }
                let limit = Duration::from_ms(u64::from(frame.cycle_ms) * SILENT_PERIODS);
                let silent = self.heard[index].map(|at| now.since(at));
                if let Some(silent) = silent.filter(|it| *it > limit && is_cyclic(frame)) {
                    self.heard[index] = None;
                    let age_ms = (silent.as_us() / 1_000) as u32;
                    shared.trace(Event::FrameSilent { id, age_ms });
                }
            }
        });
    }
}

/// Returns whether the bus carries a frame of this id in each of its periods. A sensor that sees
/// nothing sends no object.
fn is_cyclic(frame: &FrameInfo) -> bool {
    frame.cycle_ms > 0 && !frame.name.ends_with("Object")
}

fn index_of(received: &Received) -> Option<usize> {
    let CanId::Standard(id) = received.frame.id() else {
        return None;
    };
    FRAMES.iter().position(|frame| frame.id == id)
}

/// Returns a frame as a sample. `period_ms`: 0 if it is unknown.
fn sample_of(received: &Received, period_ms: u32) -> CanFrame {
    let bytes = received.frame.data();
    let mut data = [0; 64];
    data[..bytes.len()].copy_from_slice(bytes);
    CanFrame {
        id: match received.frame.id() {
            CanId::Standard(id) => id.into(),
            CanId::Extended(id) => id | 1 << 31,
        },
        period_ms: period_ms as u16,
        length: bytes.len() as u8,
        data,
    }
}

/// Publishes the frames, and reads the SoC's commands.
pub struct TopicsTask<'b, B> {
    board: &'b B,
    participant: Option<Controller>,
    commander: Option<Commander>,
    supervision: Supervision,
}

impl<'b, B: Board> TopicsTask<'b, B> {
    pub(super) fn new(board: &'b B) -> Self {
        Self {
            board,
            participant: None,
            commander: None,
            supervision: Supervision {
                heard: [None; FRAMES.len()],
                lost: [0; FRAMES.len()],
                polled: board.now(),
            },
        }
    }

    /// Reads what has arrived, and passes the commands on.
    fn read(&mut self, executor: &impl Executor<'b, B>) {
        let Some(participant) = &mut self.participant else {
            return;
        };
        let of_master = executor.shared(|shared| shared.soc_of_master());
        let mut bytes = [0; LONGEST];
        for _ in 0..DATAGRAMS {
            let network = self.board.network();
            let Some(datagram) = network.try_receive(Channel::Topics, &mut bytes) else {
                return;
            };
            let bytes = bytes.get(..datagram.len).unwrap_or_default();
            participant.hear(self.board.now(), bytes, &mut Port(self.board));
            for topic in SocTopic::ALL {
                while let Some(sample) = participant.take(topic as usize) {
                    let of = (topic, datagram.at, sample.writer.prefix);
                    let commander = &mut self.commander;
                    let command = Commander::judge(commander, of_master, of, sample.payload());
                    if let Some(command) = command {
                        executor.drive(|drive| drive.on_soc(datagram.at, command));
                    }
                }
            }
        }
    }

    /// Tells the other system which SoC this one follows.
    fn tell_followed(&self, executor: &impl Executor<'b, B>) {
        if let Some(commander) = &self.commander {
            let own = soc_code(commander.soc);
            executor.shared(|shared| shared.followed.own = own);
        }
    }

    /// Publishes the frames that were heard.
    fn publish(&mut self, executor: &impl Executor<'b, B>) {
        let Some(participant) = &mut self.participant else {
            return;
        };
        for _ in 0..FRAMES_HEARD {
            let Some(received) = executor.shared(|shared| shared.heard.frames.pop_front()) else {
                return;
            };
            let known = index_of(&received);
            if let Some(index) = known {
                self.supervision.heard[index] = Some(received.at);
            }
            let period_ms = known.map_or(0, |index| FRAMES[index].cycle_ms);
            if let Ok(payload) = sample_of(&received, period_ms).encode() {
                // It ends after 2^32 frames, seven weeks at 1 kHz. The SoC then hears the other
                // system.
                let _ended = participant.write(0, &payload, &mut Port(self.board));
            }
        }
    }

    /// Opens the participant if there is a network. Returns whether there is one.
    fn open(&mut self, executor: &impl Executor<'b, B>) -> bool {
        if self.participant.is_some() {
            return true;
        }
        let Some(at) = self.board.network().address(Channel::Topics) else {
            return false;
        };
        let identity = self.board.identity();
        // The name is new: the flash counts the starts. A clock that begins at each start shows the
        // same time, but it tells those starts apart that the flash has not kept.
        let starts = executor.shared(|shared| shared.redundancy.starts_before());
        let [a, b, c, ..] = (self.board.now().as_ns() >> 10).to_le_bytes();
        let [low, high, ..] = starts.to_le_bytes();
        let start = [a, b, c, low, high];
        let prefix = controller_prefix(identity.system.index() as u8, start);
        self.participant = Some(Controller::new(prefix, at, &OUTPUTS, &INPUTS));
        executor.shared(|shared| shared.heard.is_open = true);
        true
    }
}

impl<'b, B: Board> TaskBody<'b, B> for TopicsTask<'b, B> {
    const ID: Core0Task = Core0Task::Topics;

    fn poll(&mut self, executor: &impl Executor<'b, B>) -> Instant {
        if !self.open(executor) {
            return Instant::NEVER;
        }
        executor.begins(Self::ID, Begin::Goes);
        self.read(executor);
        self.tell_followed(executor);
        self.publish(executor);
        let now = self.board.now();
        self.supervision.poll(now, executor);
        let due = match &mut self.participant {
            Some(participant) => participant.poll(now, &mut Port(self.board)),
            None => Instant::NEVER,
        };
        executor.ends(Self::ID);
        due.min(now + POLLS_EVERY)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOC: GuidPrefix = GuidPrefix([1; 12]);
    const OTHER: GuidPrefix = GuidPrefix([2; 12]);

    /// A valid command with this counter.
    fn command(counter: u8) -> [u8; ParkingBrake::PAYLOAD_LEN] {
        let mut sample = ParkingBrake::default();
        sample.protect(counter).expect("in range");
        sample.encode().expect("in range")
    }

    /// The commander, and the code of the master's one.
    struct Judge(Option<Commander>, u16);

    impl Judge {
        /// Returns whether a command acts.
        fn hears(&mut self, ms: u64, soc: GuidPrefix, payload: &[u8]) -> bool {
            let at = Instant::ORIGIN + Duration::from_ms(ms);
            let of = (SocTopic::ParkingBrake, at, soc);
            Commander::judge(&mut self.0, self.1, of, payload).is_some()
        }
    }

    /// D-3: another SoC commands when the first one has sent no valid command for 500 ms. Commands
    /// with a wrong CRC, or that were sent before, do not keep the place.
    #[test]
    fn only_valid_commands_keep_the_place_of_the_commander() {
        let mut damaged = command(7);
        damaged[4] ^= 1;
        let mut judge = Judge(None, 0);
        assert!(!judge.hears(0, OTHER, &damaged));
        assert!(judge.hears(10, SOC, &command(0)));
        assert!(!judge.hears(20, OTHER, &command(0)));
        assert!(judge.hears(100, SOC, &command(1)));
        for ms in [200, 400, 600] {
            assert!(!judge.hears(ms, SOC, &command(1)), "a repetition");
            assert!(!judge.hears(ms, SOC, &damaged));
            assert!(!judge.hears(ms, OTHER, &command(ms as u8)));
        }
        assert!(!judge.hears(601, OTHER, &damaged));
        assert!(judge.hears(602, SOC, &command(2)), "it only paused");
        assert!(!judge.hears(1_110, OTHER, &damaged));
        assert!(judge.hears(1_111, SOC, &command(3)));
        assert!(judge.hears(1_700, OTHER, &command(0)));
        assert!(!judge.hears(1_701, SOC, &command(4)));
    }

    /// D-3: counters wrap around; the command behind a gap that is too long does not act.
    #[test]
    fn the_counter_of_commands_wraps_around() {
        let mut judge = Judge(None, 0);
        for count in 250..=260_u64 {
            assert!(judge.hears(count * 100, SOC, &command(count as u8)));
        }
        assert!(!judge.hears(26_100, SOC, &command(40)));
        assert!(judge.hears(26_200, SOC, &command(41)));
    }
    /// D-3: a standby follows the SoC of the master at once, and no other one.
    #[test]
    fn a_standby_follows_the_soc_of_the_master() {
        let mut judge = Judge(None, 0);
        assert!(judge.hears(0, OTHER, &command(0)));
        judge.1 = soc_code(SOC);
        assert!(!judge.hears(20, OTHER, &command(1)));
        assert!(judge.hears(30, SOC, &command(0)));
        assert!(!judge.hears(5_000, OTHER, &command(2)));
        // The master is gone: this system keeps its SoC.
        judge.1 = 0;
        assert!(judge.hears(5_010, SOC, &command(1)));
        assert!(!judge.hears(5_020, OTHER, &command(3)));
    }
}
