//! What one process of a test does. It tells each event as a line on its standard output.

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration as Time;

use rustix::process::{Signal, set_parent_process_death_signal};
use tandem_board::{CanId, Duration};
use tandem_exec::client::{Activated, Standing};
use tandem_exec::lockstep::OutputDigest;
use tandem_exec::master::Config;
use tandem_exec::message::{Activation, ClientId, SyncRequest};
use tandem_exec_client::sync::{SyncClient, SyncMaster, SyncPlace};
use tandem_golden::{Functions, instant};
use tandem_peripherals::codec::{BusFrame, FRAME_WORDS};
use tandem_shm::Shape;
use tandem_shm::bare::newest_writer;
use tandem_shm::newest::Writer;

pub(crate) const ROLE: &str = "--role";
/// A process ends by itself after this time, whatever became of its test.
const WATCHDOG: Time = Time::from_secs(120);
const GIVE_UP: Duration = Duration::from_ms(60_000);

/// The configuration that a test gives to its masters, as text.
pub(crate) fn text(config: &Config) -> String {
    let spans = [
        config.period,
        config.lead,
        config.wait,
        config.patience,
        config.takeover,
    ];
    let spans = spans.map(|span| span.as_us().to_string()).join(",");
    format!(
        "{},{},{},{spans}",
        config.clients, config.quorum, config.candidates
    )
}

fn config(text: &str) -> Config {
    let numbers: Vec<u64> = text
        .split(',')
        .map(|number| number.parse().unwrap())
        .collect();
    let span = |at: usize| Duration::from_us(numbers[at]);
    Config {
        clients: numbers[0] as usize,
        quorum: numbers[1] as usize,
        candidates: numbers[2] as usize,
        period: span(3),
        lead: span(4),
        wait: span(5),
        patience: span(6),
        takeover: span(7),
    }
}

/// Plays `kind run place id …`.
pub(crate) fn play(args: &[String]) -> ExitCode {
    set_parent_process_death_signal(Some(Signal::KILL)).unwrap();
    std::thread::spawn(|| {
        std::thread::sleep(WATCHDOG);
        std::process::exit(3);
    });
    let [kind, run, place, id, rest @ ..] = args else {
        return ExitCode::FAILURE;
    };
    let place = SyncPlace::open(&run.parse().unwrap(), place).unwrap();
    let id = ClientId::new(id.parse().unwrap()).unwrap();
    match kind.as_str() {
        "master" => {
            let mut master = SyncMaster::attach(place, config(&rest[0]), id).unwrap();
            tell("ready");
            master.run(|event| tell(&format!("{event:?}")), || false);
        }
        "client" => count(place, id, &rest[0]),
        "driver" => drive(place, id, &rest[0], &rest[1]),
        "liar" => lie(place, id),
        _ => return ExitCode::FAILURE,
    }
    ExitCode::SUCCESS
}

fn tell(line: &str) {
    let mut out = std::io::stdout().lock();
    // The test may have ended: then this process ends too.
    if writeln!(out, "{line}").and_then(|()| out.flush()).is_err() {
        std::process::exit(2);
    }
}

/// `A cycle code time random standing missed overrun skipped agreed`
fn tell_activation(now: &Activated, client: &mut SyncClient) {
    let client = client.client();
    let (at, random) = (client.activation_time().as_ns(), client.random());
    tell(&format!(
        "A {} {:?} {at} {random} {:?} {} {} {} {}{}",
        now.cycle,
        now.code,
        now.standing,
        now.missed,
        now.overrun.as_ns(),
        now.skipped,
        now.agreed,
        if now.is_safe_state { " safe-state" } else { "" },
    ));
}

/// A client that computes from its inputs alone: cycle, time, random number. `script` has items
/// `flip@cycle`, `lost@cycle` and `done@cycle`.
fn count(place: SyncPlace, id: ClientId, script: &str) {
    let at = |what: &str| -> u64 {
        let found = script
            .split(',')
            .find_map(|item| item.strip_prefix(what)?.strip_prefix('@'));
        found.map_or(u64::MAX, |cycle| cycle.parse().unwrap())
    };
    let (flip, lost, done) = (at("flip"), at("lost"), at("done"));
    let mut client = SyncClient::attach(place, id).unwrap();
    tell("ready");
    let mut output = OutputDigest::NONE.digest();
    while let Ok(now) = client.wait_for_activation(output, GIVE_UP) {
        tell_activation(&now, &mut client);
        if now.code == Activation::Terminate {
            return;
        }
        let mut words = OutputDigest::NONE;
        words.add(client.client().random() as u32 ^ u32::from(now.cycle == flip));
        words.add(now.cycle as u32);
        output = words.digest();
        match now.code {
            Activation::ServiceDiscovery => client.client().set_lost(false),
            _ if now.cycle == lost => client.client().set_lost(true),
            _ if now.cycle >= done => client.client().set_done(),
            _ => {}
        }
    }
}

/// The driving functions over recorded frames: each activation for `Run` is one control cycle.
/// `flip` is `-`, or `output@n` or `frame@n`: one bit is wrong in the n-th control cycle.
fn drive(place: SyncPlace, id: ClientId, recording: &str, flip: &str) {
    let mut replay = Replay::new(&std::fs::read(recording).unwrap(), flip);
    let mut client = SyncClient::attach(place, id).unwrap();
    tell("ready");
    let mut output = OutputDigest::NONE.digest();
    while let Ok(now) = client.wait_for_activation(output, GIVE_UP) {
        tell_activation(&now, &mut client);
        match now.code {
            Activation::Terminate => break,
            Activation::Run if now.standing != Standing::Excluded => output = replay.step(),
            Activation::Run => break,
            _ => {}
        }
        if replay.is_over() {
            client.client().set_done();
        }
    }
    tell(&format!("digest {:?}", replay.functions.digest()));
}

/// The driving functions and the frames that they have not yet received.
pub(crate) struct Replay {
    pub(crate) functions: Functions,
    words: Vec<u32>,
    next: usize,
    ms: u64,
    flip_output: u64,
}

/// Length of a control cycle, ms.
const CYCLE_MS: u64 = 10;

impl Replay {
    pub(crate) fn new(bytes: &[u8], flip: &str) -> Self {
        let words = bytes
            .chunks_exact(4)
            .map(|word| u32::from_le_bytes(word.try_into().unwrap()));
        let mut words: Vec<u32> = words.collect();
        let at = |what| {
            flip.strip_prefix(what)
                .map(|number| number.parse::<u64>().unwrap())
        };
        if let Some(cycle) = at("frame@") {
            flip_frame(&mut words, instant(cycle * CYCLE_MS));
        }
        Self {
            functions: Functions::new(),
            words,
            next: 0,
            ms: 0,
            flip_output: at("output@").unwrap_or(u64::MAX),
        }
    }

    fn is_over(&self) -> bool {
        self.ms >= crate::driving::DRIVE_MS
    }

    /// Drives one control cycle, and returns the digest of all that was computed in it.
    pub(crate) fn step(&mut self) -> u64 {
        let mut output = OutputDigest::NONE;
        let cycle = self.ms / CYCLE_MS;
        while !self.is_over() && self.ms / CYCLE_MS == cycle {
            while let Some(BusFrame { received, .. }) = self.frame()
                && received.at <= instant(self.ms)
            {
                if let CanId::Standard(id) = received.frame.id() {
                    self.functions
                        .on_frame(received.at, id, received.frame.data());
                }
                self.next += 1;
            }
            if let Some(command) = self.functions.tick(self.ms) {
                let wrong = u32::from(cycle == self.flip_output) << 7;
                output.add(command.steering_angle.to_bits() ^ wrong);
                output.add(command.acceleration.to_bits());
            }
            self.ms += 1;
        }
        let all = self.functions.digest();
        for hash in [all.scenes, all.trajectories, all.commands, all.degraded] {
            output.add(hash.0);
        }
        output.digest()
    }

    fn frame(&self) -> Option<BusFrame> {
        let words = self.words.get(self.next * FRAME_WORDS..)?.first_chunk()?;
        BusFrame::decode(words)
    }
}

/// Flips one bit of the data of the first frame that is received from `at` on.
fn flip_frame(words: &mut [u32], at: tandem_board::Instant) {
    let is_later = |frame: &&mut [u32]| {
        let frame = BusFrame::decode((&**frame).try_into().unwrap());
        frame.is_some_and(|frame| frame.received.at >= at)
    };
    let frame = words.chunks_exact_mut(FRAME_WORDS).find(is_later).unwrap();
    frame[5] ^= 1 << 9;
}

/// A client that writes into its mailbox what it should not: garbage, another's name, cycles that
/// were never decided, old ones, and two answers for one cycle.
fn lie(place: SyncPlace, id: ClientId) {
    let mut client = SyncClient::attach(place, id).unwrap();
    let honest = client.client().request(0);
    let words = place.request_words(id);
    let mut mailbox: Writer<'_, [u32; 8]> = newest_writer(words, Shape::new(4, 8)).unwrap();
    tell("ready");
    let mut seed = tandem_exec::client::Random::new(1);
    for round in 0_u32.. {
        let other = ClientId::new((id.index() + 1) % 3).unwrap();
        let random = seed.draw();
        let code = Some(Activation::Run);
        let activation = tandem_board::Instant::from_ns(random);
        let ahead = SyncRequest {
            cycle: random,
            code,
            ..honest
        };
        // A greater generation makes liars of all that follow, so it comes late.
        let generation = if round < 200 {
            honest.generation
        } else {
            random as u32 | 1
        };
        let lies = [
            honest,
            SyncRequest {
                output: random,
                ..honest
            },
            SyncRequest {
                client: other,
                ..honest
            },
            SyncRequest {
                cycle: u64::MAX,
                activation,
                ..ahead
            },
            ahead,
            SyncRequest {
                generation,
                ..ahead
            },
        ];
        for request in lies {
            let mut words = vec![];
            tandem_shm::Payload::store(&request, &mut |word| words.push(word));
            mailbox.publish(&words.try_into().unwrap());
            std::thread::sleep(Time::from_micros(300));
        }
        mailbox.publish(&core::array::from_fn(|_| seed.draw() as u32));
        std::thread::sleep(Time::from_micros(300));
    }
}
