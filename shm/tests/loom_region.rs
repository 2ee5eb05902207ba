//! loom models of typed regions: one living core at a time can claim a unique end.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::thread;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::{Layout, Map};
use tandem_shm::region::{EndError, Mailbox, Region};
use tandem_shm::sync::AtomicU32;

const NEWS: Region<Mailbox> = Region::first("news");
const LAYOUT: Layout = NEWS.end();

/// Announces an incarnation of this core, which claims the sending end. Returns whether it got it.
fn claim(words: &[AtomicU32], core: usize, generation: u32) -> bool {
    let map = Map::attach(words, LAYOUT).unwrap();
    let incarnation = Incarnation::new(core, generation).unwrap();
    map.incarnations().announce(incarnation).unwrap();
    match NEWS.sender(&map, incarnation) {
        Ok(_) => true,
        Err(EndError::Claimed(holder)) => {
            assert_ne!(holder.core(), core, "another core has it");
            false
        }
        Err(error) => panic!("{error:?}"),
    }
}

/// Two new incarnations claim one end at the same time: exactly one gets it.
#[test]
fn two_cores_that_claim_at_once_get_one_end() {
    model(4, || {
        let words = zeroed(LAYOUT.total_words());
        Map::format(&words, LAYOUT).unwrap();
        let other = {
            let words = words.clone();
            thread::spawn(move || claim(&words, 1, 1))
        };
        let here = claim(&words, 0, 1);
        assert_ne!(here, other.join().unwrap());
    });
}

/// The holder is dead; two successors claim its end at the same time: exactly one gets it.
#[test]
fn two_successors_of_a_dead_holder_get_one_end() {
    model(3, || {
        let words = zeroed(LAYOUT.total_words());
        let map = Map::format(&words, LAYOUT).unwrap();
        assert!(claim(&words, 2, 1));
        map.incarnations()
            .mark_dead(Incarnation::new(2, 1).unwrap());
        let other = {
            let words = words.clone();
            thread::spawn(move || claim(&words, 1, 1))
        };
        let here = claim(&words, 0, 1);
        assert_ne!(here, other.join().unwrap());
    });
}
