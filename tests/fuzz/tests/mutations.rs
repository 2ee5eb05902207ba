//! Runs each target on its corpus and on mutations of it. T-BOOT-3, T-BOOT-4
#![allow(clippy::unwrap_used)]

use tandem_fuzz::{Mutator, TARGETS, Target};

/// Number of mutated inputs for each target. A campaign tries more.
const MUTATIONS: u64 = 300;

#[test]
fn what_was_found_and_what_is_near_it_holds() {
    for target in &TARGETS {
        let Target { name, body, .. } = target;
        let corpus = target.corpus().unwrap();
        assert!(corpus.len() >= 3, "{name} has {} inputs", corpus.len());
        for (path, input) in &corpus {
            println!("{}", path.display());
            let accepted = body(input);
            let file = path.file_name().unwrap().to_string_lossy();
            assert!(accepted || !file.starts_with("seed-"), "refused");
        }
        let mutator = Mutator::new(target).unwrap();
        let mut taken = 0;
        for seed in 0..MUTATIONS {
            println!("{name}: mutation {seed}");
            taken += u64::from(body(&mutator.input(seed)));
        }
        assert!((1..MUTATIONS).contains(&taken), "{name}: {taken} accepted");
    }
}
