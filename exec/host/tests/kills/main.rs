//! Random kills of a platform: nothing is left behind, no activation is wrong, the outputs are the
//! same. Its processes are killed, its launcher, its guardian, redundant clients and their masters.
//!
//! `TANDEM_KILLS` is the number of kills (100), `TANDEM_KILLS_SEED` the seed, `TANDEM_KILLS_JSON` a
//! file for `{"kills", "violations"}`: `cargo xtask campaign launch`.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test")]
#![allow(clippy::print_stdout, reason = "a campaign shows its progress")]

mod check;
mod episode;
mod platform;

use std::process::ExitCode;
use std::time::Instant;

use libtest_mimic::{Arguments, Trial};

use episode::Dice;
use platform::Record;

fn main() -> ExitCode {
    if let Some(status) = platform::run_mode() {
        return status;
    }
    let trials = vec![
        Trial::test("random_kills_leave_nothing_behind", || {
            kills();
            Ok(())
        }),
        Trial::test("a_wrong_activation_is_found", || {
            a_wrong_activation_is_found();
            Ok(())
        }),
    ];
    let mut arguments = Arguments::from_args();
    arguments.test_threads = Some(1);
    libtest_mimic::run(&arguments, trials).exit_code()
}

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

/// E-3, E-5, E-6: whatever is killed, frozen or told to end, nothing of a platform is left behind,
/// no client is activated wrongly, and all compute the same.
fn kills() {
    let count = number("TANDEM_KILLS").unwrap_or(100);
    let seed = number("TANDEM_KILLS_SEED").unwrap_or_else(|| std::process::id().into());
    println!("{count} kills, seed {seed}");
    let begin = Instant::now();
    let mut dice = Dice::new(seed);
    let (mut kills, mut cycles, mut wrong) = (0, 0, vec![]);
    let (mut episodes, mut safe_states) = (0, 0);
    let mut victims = std::collections::BTreeMap::<String, u64>::new();
    while kills < count {
        // Short episodes if there are few kills: each end of a platform is tried at least once.
        let most = (count / episode::ENDS).min(count - kills).max(1);
        let outcome = episode::run(&mut dice, episodes, most);
        kills += outcome.kills;
        cycles += outcome.cycles;
        episodes += 1;
        safe_states += u64::from(outcome.is_safe_state);
        for victim in outcome.victims {
            let what = victim.split(" at ").next().unwrap_or_default().to_owned();
            *victims.entry(what).or_default() += 1;
        }
        for what in outcome.wrong {
            println!("VIOLATION after {kills} kills: {what}");
            wrong.push(what);
        }
        if !outcome.story.is_empty() {
            println!("{}", outcome.story);
        }
    }
    let seconds = begin.elapsed().as_secs_f64();
    println!(
        "{kills} kills in {seconds:.1} s, {episodes} platforms, {cycles} cycles in step, \
         {safe_states} safe states after two clients were lost, {} violations",
        wrong.len()
    );
    for (victim, times) in victims {
        println!("  {times:6} {victim}");
    }
    if let Some(path) = std::env::var_os("TANDEM_KILLS_JSON") {
        let text = format!("{{\"kills\": {kills}, \"violations\": {}}}\n", wrong.len());
        std::fs::write(path, text).unwrap();
    }
    assert!(wrong.is_empty(), "seed {seed}: {wrong:?}");
}

type Damage = fn(&mut Record);

/// E-3: the check itself finds each kind of wrong activation.
fn a_wrong_activation_is_found() {
    let good = check::example();
    assert_eq!(check::check(&good).0, Vec::<String>::new());
    assert!(check::check(&good).1 > 0);
    let rows: [(&str, Damage); 10] = [
        ("may not follow", |it| it.code = 3),
        ("excluded", |it| it.standing = 2),
        ("without a reason", |it| (it.safe_state, it.code) = (1, 5)),
        ("may not follow", |it| it.safe_state = 1),
        ("too early", |it| it.woken_ns = it.activation_ns - 1),
        ("already over", |it| it.cycle -= 1),
        ("another random number", |it| it.random ^= 1),
        ("a wrong output", |it| it.output ^= 1),
        ("two times", |it| it.activation_ns += 1),
        ("two answers", |it| it.agreed ^= 1),
    ];
    for (words, damage) in rows {
        let mut logs = good.clone();
        damage(logs[1].last_mut().unwrap());
        let (wrong, _) = check::check(&logs);
        assert!(
            wrong.iter().any(|it| it.contains(words)),
            "{words}: {wrong:?}"
        );
    }
}
