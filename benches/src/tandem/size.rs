//! Payloads of any size: every word is written into a newest-value channel and read where it lies.
//!
//! The LMU of a controller has 32 KiB. The channels here lie in memory of the harness, so that
//! larger payloads fit; the code is the same.

use super::lmu;
use crate::harness::{Batch, End, Plan, between_processes};
use crate::shared::Shared;
use std::hint::spin_loop;
use std::io;
use std::sync::atomic::Ordering;
use tandem_shm::mailbox::{Receiver, Ring, Sender, TaskId};
use tandem_shm::map::{Layout, Map};
use tandem_shm::newest::{Reader, Writer};
use tandem_shm::region::{Mailbox, Newest, Region};

/// The word at this place of a payload.
#[inline]
pub(crate) const fn word(stamp: u32, at: usize) -> u32 {
    stamp.wrapping_add(at as u32)
}

/// The stamp of a payload, after all its words were read.
///
/// # Panics
/// If a word is not what was written.
#[inline]
pub(crate) fn sum_from(words: impl ExactSizeIterator<Item = u32>) -> u32 {
    let count = words.len() as u32;
    let (mut sum, mut stamp) = (0u32, 0);
    for (at, word) in words.enumerate() {
        if at == 0 {
            stamp = word;
        }
        sum = sum.wrapping_add(word);
    }
    let places = (u64::from(count) * (u64::from(count) - 1) / 2) as u32;
    assert_eq!(
        sum,
        stamp.wrapping_mul(count).wrapping_add(places),
        "a payload arrived torn"
    );
    stamp
}

/// In a ping-pong one value is written while the other one may still be read.
const SLOTS: usize = 2;

struct InPlace<const WORDS: usize> {
    payload: Writer<'static, [u32; WORDS]>,
    signal: Sender<'static>,
    signals: Receiver<'static>,
    payloads: Reader<'static, [u32; WORDS]>,
}

impl<const WORDS: usize> InPlace<WORDS> {
    const MAILBOX: Region<Mailbox> = Region::first("mailbox 0 to 1");
    const BACK: Region<Mailbox> = Self::MAILBOX.then("mailbox 1 to 0");
    const CHANNEL: Region<Newest<[u32; WORDS], SLOTS>> = Self::BACK.then("0 to 1");
    const CHANNEL_BACK: Region<Newest<[u32; WORDS], SLOTS>> = Self::CHANNEL.then("1 to 0");
    const LAYOUT: Layout = Self::CHANNEL_BACK.end();

    fn attach(map: &Map<'static>, core: usize) -> Self {
        let own = lmu::announce(map, core, 1);
        let mut ways = [
            (Self::MAILBOX, Self::CHANNEL),
            (Self::BACK, Self::CHANNEL_BACK),
        ];
        ways.rotate_left(core);
        let [(to, out), (from, inward)] = ways;
        Self {
            payload: out.writer(map, own).expect("it is free"),
            signal: to.sender(map, own).expect("it is free"),
            signals: from.receiver(map, own).expect("it is free"),
            payloads: inward.reader(map).expect("it fits"),
        }
    }
}

impl<const WORDS: usize> End for InPlace<WORDS> {
    fn send(&mut self, stamp: u32) {
        let mut loan = self.payload.loan();
        for (at, place) in loan.words().as_slice().iter().enumerate() {
            place.store(word(stamp, at), Ordering::Relaxed);
        }
        loan.publish();
        // The receiver spins: no doorbell is needed.
        let _: Ring = self.signal.signal(TaskId::FIRST);
    }

    fn receive(&mut self) -> u32 {
        loop {
            self.payloads.prefetch();
            if self.signals.poll(|_| {}) > 0 {
                let view = self.payloads.view().expect("a signal follows its payload");
                let stamp = sum_from(view.words().iter());
                view.finish().expect("no second payload is under way");
                return stamp;
            }
            spin_loop();
        }
    }
}

/// One-way time of a payload of `WORDS` words between cores that spin, from before its first word
/// is written until its last word was read.
///
/// # Errors
/// As [`between_processes`].
pub fn in_place<const WORDS: usize>(plan: &Plan) -> io::Result<Batch> {
    let layout = InPlace::<WORDS>::LAYOUT;
    let (_payloads, map) = lmu::shared(layout)?;
    let end = |core| move |_: &Shared| InPlace::<WORDS>::attach(&map, core);
    Ok(between_processes(plan, lmu::bytes(layout), end(0), end(1))?
        .carrying(4 * WORDS as u64)
        .without_facts())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_payload_is_known_by_all_its_words() {
        let stamp = u32::MAX - 3;
        let words: Vec<u32> = (0..10).map(|at| word(stamp, at)).collect();
        assert_eq!(sum_from(words.iter().copied()), stamp);
        let torn = [words[0], words[1] + 1];
        assert!(std::panic::catch_unwind(|| sum_from(torn.into_iter())).is_err());
    }
}
