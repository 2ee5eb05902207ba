//! What must hold of the activations that clients have logged, whatever was killed.

use std::collections::BTreeMap;

use crate::platform::{Record, output_of};

const REGISTER: u64 = 1;
const DISCOVERY: u64 = 2;
const INIT: u64 = 3;
const RUN: u64 = 4;
const TERMINATE: u64 = 5;

/// Returns the violations of one episode, and the number of cycles that at least two clients ran.
pub(crate) fn check(logs: &[Vec<Record>]) -> (Vec<String>, usize) {
    let mut wrong = vec![];
    for log in logs {
        check_client(log, &mut wrong);
    }
    check_safe_state(logs, &mut wrong);
    let mut cycles: BTreeMap<u64, Vec<&Record>> = BTreeMap::new();
    for record in logs.iter().flatten() {
        cycles.entry(record.cycle).or_default().push(record);
    }
    let mut together = 0;
    let mut last_ns = 0;
    for (cycle, records) in &cycles {
        let first = records[0];
        for record in records {
            if record.activation_ns != first.activation_ns {
                wrong.push(format!(
                    "cycle {cycle} had two times: {first:?}, {record:?}"
                ));
            }
            if record.agreed != first.agreed {
                wrong.push(format!(
                    "cycle {cycle} had two answers: {first:?}, {record:?}"
                ));
            }
        }
        if first.activation_ns <= last_ns {
            wrong.push(format!(
                "cycle {cycle} was not after the cycle before it: {first:?}"
            ));
        }
        last_ns = first.activation_ns;
        let ran = records
            .iter()
            .filter(|it| it.code == RUN && it.standing == 1);
        together += usize::from(ran.count() >= 2);
    }
    check_agreed(&cycles, &mut wrong);
    (wrong, together)
}

/// What one client may do: wake in time, in the order of the table, and compute what is right.
fn check_client(log: &[Record], wrong: &mut Vec<String>) {
    let mut last: Option<&Record> = None;
    for record in log {
        let before = last.filter(|last| last.process == record.process);
        let may_follow = match before.map(|before| before.code) {
            None => &[REGISTER][..],
            Some(REGISTER) => &[DISCOVERY],
            Some(DISCOVERY) => &[INIT],
            Some(INIT | RUN) => &[RUN],
            Some(_) => &[],
        };
        // Whether the safe state is right is checked for all clients together.
        let may_follow = if record.safe_state == 1 {
            &[TERMINATE]
        } else {
            may_follow
        };
        let mut say = |what: &str| wrong.push(format!("{what}: {record:?} after {last:?}"));
        if !may_follow.contains(&record.code) {
            say("this activation may not follow");
        }
        if record.standing == 2 {
            say("a client that computes what is right was excluded");
        }
        if record.woken_ns < record.activation_ns {
            say("it was activated too early");
        }
        // Over restarts too: what is over does not come again.
        if last.is_some_and(|last| last.cycle >= record.cycle) {
            say("this cycle was already over");
        }
        if record.random != first_random(record.activation_ns, record.cycle) {
            say("another random number");
        }
        let right = output_of(record.cycle, record.activation_ns, record.random);
        if record.output != if record.code == RUN { right } else { 0 } {
            say("a wrong output");
        }
        last = Some(record);
    }
}

/// The safe state is right only if fewer than two members of the cycle before it still run: then no
/// two can agree.
fn check_safe_state(logs: &[Vec<Record>], wrong: &mut Vec<String>) {
    let safe = logs.iter().flatten().find(|record| record.safe_state == 1);
    let Some(safe) = safe else {
        return;
    };
    let went_on = |log: &&Vec<Record>| {
        let member = |record: &&Record| record.cycle + 1 == safe.cycle && record.standing == 1;
        let member = log.iter().find(member).map(|record| record.process);
        let last = log.iter().find(|record| record.cycle == safe.cycle);
        member.is_some() && member == last.map(|record| record.process)
    };
    if logs.iter().filter(went_on).count() >= 2 {
        wrong.push(format!("the safe state without a reason: {safe:?}"));
    }
    if logs
        .iter()
        .flatten()
        .any(|it| it.cycle >= safe.cycle && it.code != TERMINATE)
    {
        wrong.push(format!("an activation after the safe state: {safe:?}"));
    }
}

/// The answer to a cycle names the output of the cycle before, on which its members agreed.
fn check_agreed(cycles: &BTreeMap<u64, Vec<&Record>>, wrong: &mut Vec<String>) {
    for (cycle, records) in cycles {
        let before = cycles.get(&(cycle - 1)).into_iter().flatten();
        let ran = before.filter(|it| it.code == RUN && it.standing == 1);
        for one in ran {
            if one.output != records[0].agreed && records[0].safe_state == 0 {
                wrong.push(format!(
                    "agreed on another output: {one:?}, {:?}",
                    records[0]
                ));
            }
        }
    }
}

/// An implementation of its own: SplitMix64, seeded by the number of the cycle at the place of the
/// activation's time.
fn first_random(activation_ns: u64, cycle: u64) -> u64 {
    fn next(state: u64) -> u64 {
        let mut z = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    let place = activation_ns.wrapping_add(cycle.wrapping_mul(0x9E37_79B9_7F4A_7C15));
    next(next(place))
}

/// Logs of three clients without anything wrong.
pub(crate) fn example() -> Vec<Vec<Record>> {
    let log = |client: u64| {
        let record = |cycle: u64| {
            let activation_ns = cycle * 5_000_000;
            let code = cycle.min(RUN);
            let random = first_random(activation_ns, cycle);
            let before = first_random((cycle - 1) * 5_000_000, cycle - 1);
            Record {
                client,
                process: 100 + client,
                cycle,
                activation_ns,
                woken_ns: activation_ns + 20_000,
                code,
                standing: 1,
                safe_state: 0,
                random,
                output: if code == RUN {
                    output_of(cycle, activation_ns, random)
                } else {
                    0
                },
                agreed: match cycle {
                    0..=4 => 0,
                    _ => output_of(cycle - 1, (cycle - 1) * 5_000_000, before),
                },
            }
        };
        (1..=8).map(record).collect()
    };
    (0..3).map(log).collect()
}
