//! loom model of the plain queue: no block is accessed by two cores at a time.
#![cfg(loom)]
#![allow(clippy::unwrap_used, reason = "test code")]

mod common;

use common::{model, zeroed};
use loom::thread;
use tandem_shm::fifo::Full;
use tandem_shm::incarnation::Incarnation;
use tandem_shm::map::Map;
use tandem_shm::plain::PlainMap;
use tandem_shm::region::{Plain, Region};
use tandem_shm::sync::{AtomicU32, spin};

const BLOCKS: Region<Plain<6, 2>> = Region::first("blocks");

fn map(words: &[AtomicU32]) -> PlainMap<'_> {
    let map = Map::attach(words, BLOCKS.end()).unwrap();
    // SAFETY: only the ends of the model access the region; a predecessor does nothing more.
    unsafe { PlainMap::new(map) }
}

/// loom checks each plain access against those of the other thread: a block is written after the
/// consumer has released it, and read after the producer has sent it. `successors`: each end is
/// replaced after two blocks.
fn blocks_change_hands(preemptions: usize, successors: bool) {
    model(preemptions, move || {
        let words = zeroed(BLOCKS.end().total_words());
        let formatted = Map::format(&words, BLOCKS.end()).unwrap();
        let start = |core, generation| {
            let incarnation = Incarnation::new(core, generation).unwrap();
            formatted.incarnations().announce(incarnation).unwrap();
            incarnation
        };
        let [to, from] = [0, 1].map(|core| start(core, 1));
        let producer = {
            let words = words.clone();
            thread::spawn(move || {
                let map = map(&words);
                let mut producer = BLOCKS.producer(&map, to).unwrap();
                for k in 0..4 {
                    if successors && k == 2 {
                        let next = Incarnation::new(0, 2).unwrap();
                        map.incarnations().announce(next).unwrap();
                        producer = BLOCKS.producer(&map, next).unwrap();
                    }
                    let mut loan = loop {
                        match producer.loan() {
                            Ok(loan) => break loan,
                            Err(Full) => spin(1),
                        }
                    };
                    loan.bytes_mut();
                    loan.send();
                }
            })
        };
        let map = map(&words);
        let mut consumer = BLOCKS.consumer(&map, from).unwrap();
        for k in 0..4 {
            if successors && k == 2 {
                let next = Incarnation::new(1, 2).unwrap();
                map.incarnations().announce(next).unwrap();
                consumer = BLOCKS.consumer(&map, next).unwrap();
            }
            let item = loop {
                match consumer.item() {
                    Some(item) => break item,
                    None => spin(1),
                }
            };
            item.bytes();
            item.release();
        }
        producer.join().unwrap();
        assert!(consumer.item().is_none());
    });
}

#[test]
fn a_block_is_accessed_by_its_holder_alone() {
    blocks_change_hands(3, false);
}

#[test]
fn a_block_is_accessed_by_its_holder_alone_when_both_ends_are_replaced() {
    blocks_change_hands(2, true);
}
