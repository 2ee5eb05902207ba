//! The sync master over clients that are late, dead, lying or restarted (E-3).
#![allow(clippy::unwrap_used, reason = "a test")]

use tandem_board::{Duration, Instant};
use tandem_exec::master::{Config, Event, Lie, MasterCore};
use tandem_exec::message::{Activation, ClientId, SyncRequest, SyncResponse};

const fn ms(ms: u64) -> Duration {
    Duration::from_ms(ms)
}

const CONFIG: Config = Config {
    clients: 3,
    quorum: 2,
    candidates: 3,
    period: ms(10),
    lead: ms(1),
    wait: ms(8),
    patience: ms(100),
    takeover: ms(2),
};

fn id(number: usize) -> ClientId {
    ClientId::new(number).unwrap()
}

/// A master with a time of its own, and what it told.
struct Bench {
    master: MasterCore,
    now: Instant,
    told: Vec<Event>,
    generations: [u32; 3],
}

impl Bench {
    fn new() -> Self {
        let now = Instant::ORIGIN + ms(1_000);
        let master = MasterCore::new(CONFIG, id(0)).unwrap();
        Self {
            master,
            now,
            told: vec![],
            generations: [1; 3],
        }
    }

    /// The request of an honest client that has executed the last decision.
    fn honest(&self, client: usize) -> SyncRequest {
        let last = self.master.last();
        SyncRequest {
            client: id(client),
            generation: self.generations[client],
            cycle: last.map_or(0, |last| last.cycle),
            activation: last.map_or(Instant::ORIGIN, |last| last.activation),
            code: last.map(|last| last.code),
            is_lost: false,
            is_done: false,
            output: 7,
        }
    }

    fn send(&mut self, request: SyncRequest) {
        let told = &mut self.told;
        self.master
            .on_request(self.now, request.client, &request, &mut |event| {
                told.push(event)
            });
    }

    /// Lets the time go on until there is a proposal, decides it, and goes to its activation.
    fn decide(&mut self) -> SyncResponse {
        let give_up = self.now + ms(1_000);
        while self.now < give_up {
            if let Some(response) = self.master.poll(self.now).propose {
                let told = &mut self.told;
                self.master
                    .on_decided(&response, &mut |event| told.push(event));
                self.now = self.now.max(response.activation);
                return response;
            }
            self.now += ms(1);
        }
        panic!("no proposal: {:?}", self.told);
    }

    /// A cycle in which these clients do what they should.
    fn cycle(&mut self, clients: &[usize]) -> SyncResponse {
        clients
            .iter()
            .for_each(|client| self.send(self.honest(*client)));
        self.decide()
    }

    /// Goes to the fourth activation, the first `Run`.
    fn running() -> Self {
        let mut bench = Self::new();
        for _ in 0..4 {
            bench.cycle(&[0, 1, 2]);
        }
        assert_eq!(bench.told, []);
        bench
    }
}

/// SWS_EM_01322: with all requests the answer is immediate, on a grid, and the codes are in order.
#[test]
fn all_clients_are_answered_at_once() {
    let mut bench = Bench::new();
    let begin = bench.now;
    for (number, code) in (0..).zip(&Activation::ALL[..4]) {
        let response = bench.cycle(&[2, 0, 1]);
        assert_eq!((response.cycle, response.code), (number + 1, *code));
        assert_eq!(response.activation, begin + ms(1 + 10 * number));
        assert_eq!((response.members.len(), response.skipped), (3, 0));
        assert_eq!(response.agreed, if number == 0 { 0 } else { 7 });
    }
}

/// M of N: two of three are enough, but only after the wait; the third is told as silent, and is
/// no member after three activations.
#[test]
fn two_of_three_are_enough_after_the_wait() {
    let mut bench = Bench::running();
    for number in 1..=4 {
        let begin = bench.now;
        for client in [0, 1] {
            bench.send(bench.honest(client));
        }
        if number == 1 {
            let next = bench.master.poll(begin + ms(7));
            assert_eq!((next.propose, next.wake), (None, begin + ms(8)));
        }
        let response = bench.decide();
        assert_eq!(response.activation, begin + ms(10), "in time");
        assert_eq!(response.members.contains(id(2)), number < 3);
    }
    assert_eq!(bench.told, [Event::Silent(id(2)), Event::Left(id(2))]);
}

/// One of three is not enough: after the patience the answer is the safe state, for good.
#[test]
fn one_of_three_is_the_safe_state() {
    let mut bench = Bench::running();
    let begin = bench.now;
    let response = bench.cycle(&[1]);
    assert!(response.is_safe_state && response.code == Activation::Terminate);
    assert_eq!(response.activation, begin + ms(101));
    assert!(bench.told.contains(&Event::SafeState));
    assert_eq!(bench.master.poll(bench.now + ms(1_000)).propose, None);
}

/// E-3: lockstep. The output of cycle 4 that deviates excludes its client before cycle 5; it stays
/// out, and a restart brings it back after 8 equal activations. Then two differ: safe state.
#[test]
fn a_deviating_client_is_out_until_it_restarts() {
    let mut bench = Bench::running();
    bench.send(SyncRequest {
        output: 8,
        ..bench.honest(1)
    });
    let response = bench.cycle(&[0, 2]);
    assert_eq!(bench.told, [Event::Deviates(id(1), 4)]);
    assert!(response.excluded.contains(id(1)) && !response.members.contains(id(1)));
    for _ in 0..20 {
        assert_eq!(bench.cycle(&[0, 1, 2]).members.len(), 2);
    }
    bench.generations[1] = 2;
    let first = SyncRequest {
        cycle: 0,
        code: None,
        activation: Instant::ORIGIN,
        ..bench.honest(1)
    };
    bench.send(first);
    bench.cycle(&[0, 2]);
    let joined = (1..20).find(|_| bench.cycle(&[0, 1, 2]).members.len() == 3);
    assert_eq!(joined, Some(8));
    assert_eq!(
        bench.told[1..],
        [Event::Restarted(id(1)), Event::Joined(id(1))]
    );
    bench.send(SyncRequest {
        output: 1,
        ..bench.honest(0)
    });
    bench.send(SyncRequest {
        output: 2,
        ..bench.honest(1)
    });
    assert!(bench.cycle(&[2]).is_safe_state, "three different outputs");
}

/// Each lie is told by its name and not counted; the two others are answered in time.
#[test]
fn lies_are_told_and_not_counted() {
    type Lying = fn(SyncRequest) -> SyncRequest;
    let lies: [(Lie, Lying); 5] = [
        (Lie::Cycle, |honest| SyncRequest {
            cycle: honest.cycle + 1,
            ..honest
        }),
        (Lie::Cycle, |honest| SyncRequest {
            cycle: u64::MAX,
            ..honest
        }),
        (Lie::Time, |honest| SyncRequest {
            activation: honest.activation + ms(1),
            ..honest
        }),
        (Lie::Code, |honest| SyncRequest {
            code: Some(Activation::Init),
            ..honest
        }),
        (Lie::Generation, |honest| SyncRequest {
            generation: 0,
            ..honest
        }),
    ];
    for (lie, make) in lies {
        let mut bench = Bench::running();
        bench.send(make(bench.honest(2)));
        assert_eq!(bench.told, [Event::Disagrees(id(2), lie)]);
        let (begin, response) = (bench.now, bench.cycle(&[0, 1]));
        assert_eq!(response.activation, begin + ms(10), "{lie:?}");
        assert!(!response.is_safe_state);
    }
    let mut bench = Bench::running();
    let stolen = bench.honest(1);
    bench
        .master
        .on_request(bench.now, id(2), &stolen, &mut |event| {
            bench.told.push(event)
        });
    assert_eq!(bench.told, [Event::Disagrees(id(2), Lie::Identity)]);
    let (first, twice) = (
        bench.honest(2),
        SyncRequest {
            output: 9,
            ..bench.honest(2)
        },
    );
    for request in [first, first, twice] {
        bench.send(request);
    }
    assert_eq!(bench.told[1..], [Event::Disagrees(id(2), Lie::Twice)]);
    assert_eq!(
        bench.cycle(&[0, 1]).members.len(),
        3,
        "the first one counts"
    );
}

/// A late request is told with its cycles; the sender is still a member at its next one in time.
#[test]
fn a_late_client_is_told_and_continues() {
    let mut bench = Bench::running();
    let late = bench.honest(2);
    bench.cycle(&[0, 1]);
    bench.send(late);
    assert_eq!(bench.told, [Event::Silent(id(2)), Event::Late(id(2), 1)]);
    assert_eq!(bench.cycle(&[0, 1, 2]).members.len(), 3);
    assert_eq!(bench.told.len(), 2);
}

/// If all are late, points of the grid are left out, and this is told.
#[test]
fn an_overrun_of_all_is_told() {
    let mut bench = Bench::running();
    let begin = bench.now;
    bench.now += ms(25);
    let response = bench.cycle(&[0, 1, 2]);
    assert_eq!((response.activation, response.skipped), (begin + ms(30), 2));
    assert_eq!(bench.told, [Event::Overrun(2)]);
}

/// One member that alone reports a lost service holds the others for 8 activations only.
#[test]
fn a_loss_that_one_alone_reports_is_believed_for_a_while() {
    let mut bench = Bench::running();
    let mut codes = vec![];
    for _ in 0..12 {
        bench.send(SyncRequest {
            is_lost: true,
            ..bench.honest(1)
        });
        codes.push(bench.cycle(&[0, 2]).code);
    }
    assert!(
        codes[..8]
            .iter()
            .all(|code| *code == Activation::ServiceDiscovery),
        "{codes:?}"
    );
    assert_eq!(
        codes[8..],
        [
            Activation::Init,
            Activation::Run,
            Activation::Run,
            Activation::Run
        ]
    );
    assert_eq!(bench.told, [Event::LostAlone(id(1))]);
}

/// The next id follows a master that decides nothing, and the one after it waits twice as long.
/// It continues with the members, the grid and the cycle of the last decision.
#[test]
fn the_next_candidate_follows_a_dead_master() {
    let mut bench = Bench::running();
    let last = *bench.master.last().unwrap();
    let requests = [0, 1, 2].map(|client| bench.honest(client));
    for (number, wait) in [(1, 2), (2, 4)] {
        let mut next = MasterCore::new(CONFIG, id(number)).unwrap();
        next.on_decided(&last, &mut |_| {});
        for request in &requests {
            next.on_request(bench.now, request.client, request, &mut |_| {});
        }
        let poll = next.poll(bench.now);
        assert_eq!((poll.propose, poll.wake), (None, bench.now + ms(wait)));
        let response = next.poll(bench.now + ms(wait)).propose.unwrap();
        assert_eq!(
            (response.cycle, response.activation),
            (5, last.activation + ms(10))
        );
        assert_eq!(
            (response.master, response.members),
            (id(number), last.members)
        );
        let told = &mut bench.told;
        bench
            .master
            .clone()
            .on_decided(&response, &mut |event| told.push(event));
        assert_eq!(bench.told.pop(), Some(Event::Master(id(number))));
    }
}

/// The turn is counted from the master of the last decision, not from the first id.
#[test]
fn the_turn_goes_on_from_the_last_master() {
    let bench = Bench::running();
    let last = SyncResponse {
        master: id(1),
        ..*bench.master.last().unwrap()
    };
    for (number, wait) in [(1, 0), (2, 2), (0, 4)] {
        let mut next = MasterCore::new(CONFIG, id(number)).unwrap();
        next.on_decided(&last, &mut |_| {});
        for client in 0..3 {
            let request = bench.honest(client);
            next.on_request(bench.now, id(client), &request, &mut |_| {});
        }
        let poll = next.poll(bench.now);
        assert_eq!(poll.propose.is_some(), wait == 0, "candidate {number}");
        assert!(wait == 0 || poll.wake == bench.now + ms(wait));
    }
}

/// Enough members that are done end all; one alone does not.
#[test]
fn enough_that_are_done_end_all() {
    let mut bench = Bench::running();
    bench.send(SyncRequest {
        is_done: true,
        ..bench.honest(1)
    });
    assert_eq!(bench.cycle(&[0, 2]).code, Activation::Run);
    for client in [0, 1] {
        bench.send(SyncRequest {
            is_done: true,
            ..bench.honest(client)
        });
    }
    let response = bench.cycle(&[2]);
    assert_eq!(
        (response.code, response.is_safe_state),
        (Activation::Terminate, false)
    );
}

#[test]
fn numbers_that_contradict_each_other_are_refused() {
    let wrong = [
        Config {
            clients: 9,
            ..CONFIG
        },
        Config {
            quorum: 0,
            ..CONFIG
        },
        Config {
            quorum: 4,
            ..CONFIG
        },
        Config {
            candidates: 0,
            ..CONFIG
        },
        Config {
            lead: ms(10),
            ..CONFIG
        },
    ];
    assert!(
        wrong
            .into_iter()
            .all(|config| MasterCore::new(config, id(0)).is_none())
    );
    assert!(MasterCore::new(CONFIG, id(3)).is_none());
}
