//! What a system that drives tells one that has just joined, over the link. T-CHIP-5
//!
//! The one that joins *asks* in each control cycle; the other sends a *transfer*, two *chunks* in a
//! control cycle. A lost chunk costs its transfer, and the next one begins with the next scene.
//!
//! | word | ask | chunk |
//! |---|---|---|
//! | 0 | CRC-16, counter, [`VERSION`] | CRC-16, counter, [`VERSION`] |
//! | 1 | the asking incarnation | number of the transfer, index and count of its chunks |
//! | from 2 | | content |
//!
//! Content: the asking incarnation, the sender's term, age of the scene in µs, and the words of
//! [`Knowledge`] from the third on, without those of objects that are not there. What arrives is an
//! allegation: a transfer counts only if it is whole, in order, of now, and an answer to this
//! incarnation.

use crate::driving::knowledge::{KNOWLEDGE_MAX_AGE, Knowledge};
use crate::words::Payload;
use tandem_board::{Duration, Instant};
use tandem_bus::e2e::{Checker, protect};

/// Words of the longest datagram.
pub(super) const MAX_WORDS: usize = 32;
/// Chunks that are sent in a control cycle.
pub(super) const CHUNKS_PER_CYCLE: usize = 2;

/// Of asks and chunks. Another version's are not understood, and refused.
const VERSION: u8 = 1;
/// Data ids of the protection: above those of CAN, and beside the opinion's.
const ASK: u16 = 0x0802;
const CHUNK: u16 = 0x0803;

/// Words of a chunk before its content.
const HEAD: usize = 2;
const CHUNK_CONTENT: usize = MAX_WORDS - HEAD;
/// Incarnation, term, age.
const FRONT: usize = 3;
/// The words of the time, which is told as an age.
const TIME: usize = 2;
const CONTENT: usize = FRONT + Knowledge::WORDS - TIME;
const MAX_CHUNKS: usize = CONTENT.div_ceil(CHUNK_CONTENT);
const _: () = assert!(MAX_CHUNKS <= 15, "index and count have four bits each");

/// An ask holds for this long: it comes in each control cycle.
const ASK_HOLDS: Duration = Duration::from_ms(35);

/// Writes CRC, counter and version into word 0 of a datagram.
fn seal(id: u16, counter: &mut u8, words: &mut [u32]) {
    *counter = counter.wrapping_add(1);
    let mut bytes = [0; 4 * MAX_WORDS];
    words[0] = u32::from(VERSION) << 24;
    let bytes = to_bytes(words, &mut bytes);
    protect(id, *counter, bytes);
    words[0] = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
}

/// Whether the datagram has this id, is new, and is of this version.
fn is_sealed(checker: &mut Checker, words: &[u32]) -> bool {
    let mut bytes = [0; 4 * MAX_WORDS];
    let new = checker.check(to_bytes(words, &mut bytes)).is_accepted();
    new && words[0] >> 24 == u32::from(VERSION)
}

/// `words` has at most [`MAX_WORDS`].
fn to_bytes<'a>(words: &[u32], bytes: &'a mut [u8; 4 * MAX_WORDS]) -> &'a mut [u8] {
    for (bytes, word) in bytes.chunks_exact_mut(4).zip(words) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    &mut bytes[..4 * words.len()]
}

/// The end of the system that drives.
#[derive(Debug)]
pub(super) struct Giver {
    asks: Checker,
    asked: Option<(u32, Instant)>,
    counter: u8,
    transfer: u16,
    /// The scene that was sent last.
    told: Option<Instant>,
    content: [u32; CONTENT],
    len: usize,
    next: usize,
}

impl Giver {
    pub(super) const fn new() -> Self {
        Self {
            asks: Checker::new(ASK),
            asked: None,
            counter: 0,
            transfer: 0,
            told: None,
            content: [0; CONTENT],
            len: 0,
            next: 0,
        }
    }

    /// A datagram that may be an ask.
    pub(super) fn on_datagram(&mut self, now: Instant, words: &[u32]) {
        if let &[_, incarnation] = words
            && is_sealed(&mut self.asks, words)
        {
            self.asked = Some((incarnation, now));
        }
    }

    /// Whether a transfer could begin.
    pub(super) fn wants(&self, now: Instant) -> bool {
        let is_idle = self.next >= self.len;
        is_idle && self.asked.is_some_and(|(_, at)| now.since(at) <= ASK_HOLDS)
    }

    /// Begins a transfer, unless this scene was told.
    pub(super) fn begin(&mut self, now: Instant, term: u32, knowledge: &Knowledge) {
        let Some((incarnation, _)) = self.asked else {
            return;
        };
        if self.told.replace(knowledge.at) == Some(knowledge.at) {
            return;
        }
        let age = now.since(knowledge.at).as_us();
        let age = u32::try_from(age).unwrap_or(u32::MAX);
        self.content[..FRONT].copy_from_slice(&[incarnation, term, age]);
        let mut index = 0;
        knowledge.store(&mut |word| {
            if let Some(at) = (FRONT + index).checked_sub(TIME).filter(|_| index >= TIME) {
                self.content[at] = word;
            }
            index += 1;
        });
        let absent = knowledge.objects.capacity() - knowledge.objects.len();
        self.len = CONTENT - absent * crate::driving::knowledge::KnownObject::WORDS;
        self.next = 0;
        self.transfer = self.transfer.wrapping_add(1);
    }

    /// The next chunk of the transfer.
    pub(super) fn chunk(&mut self) -> Option<heapless::Vec<u32, MAX_WORDS>> {
        let content = self.content.get(self.next..self.len)?;
        let content = &content[..content.len().min(CHUNK_CONTENT)];
        if content.is_empty() {
            return None;
        }
        let (index, count) = (self.next / CHUNK_CONTENT, self.len.div_ceil(CHUNK_CONTENT));
        let place = (index | count << 4) as u32;
        let mut words = heapless::Vec::new();
        let _fits = words.extend_from_slice(&[0, u32::from(self.transfer) | place << 16]);
        let _fits = words.extend_from_slice(content);
        self.next += content.len();
        seal(CHUNK, &mut self.counter, &mut words);
        Some(words)
    }
}

/// The end of a system that joins.
#[derive(Debug)]
pub(super) struct Taker {
    incarnation: u32,
    counter: u8,
    chunks: Checker,
    /// The transfer that is under way, when it began, and the index and count of its next chunk.
    under_way: Option<(u16, Instant, usize, usize)>,
    content: [u32; CONTENT],
}

/// What was told, and the term of the system that told it.
pub(super) type Told = (u32, Knowledge);

impl Taker {
    /// `incarnation`: a number that the other incarnations of this system have not.
    pub(super) const fn new(incarnation: u32) -> Self {
        Self {
            incarnation,
            counter: 0,
            chunks: Checker::new(CHUNK),
            under_way: None,
            content: [0; CONTENT],
        }
    }

    /// The datagram that asks.
    pub(super) fn ask(&mut self) -> [u32; 2] {
        let mut words = [0, self.incarnation];
        seal(ASK, &mut self.counter, &mut words);
        words
    }

    /// A datagram that may be a chunk; what was told, if it was the last one.
    pub(super) fn on_datagram(&mut self, now: Instant, words: &[u32]) -> Option<Told> {
        let (&[_, place], content) = words.split_first_chunk::<HEAD>()?;
        if words.len() > MAX_WORDS || !is_sealed(&mut self.chunks, words) {
            return None;
        }
        let transfer = place as u16;
        let (index, count) = ((place >> 16 & 0xF) as usize, (place >> 20) as usize);
        let is_last = index + 1 == count;
        let began = match self.under_way.take() {
            _ if index == 0 && (1..=MAX_CHUNKS).contains(&count) => {
                self.content = [0; CONTENT];
                now
            }
            Some((of, began, next, total)) if (of, next, total) == (transfer, index, count) => {
                began
            }
            _ => return None,
        };
        let to = self.content.get_mut(index * CHUNK_CONTENT..)?;
        let is_full = content.len() == CHUNK_CONTENT;
        if content.len() > to.len() || !(is_full || is_last) {
            return None;
        }
        to[..content.len()].copy_from_slice(content);
        if !is_last {
            self.under_way = Some((transfer, began, index + 1, count));
            return None;
        }
        self.finish(now, began)
    }

    fn finish(&self, now: Instant, began: Instant) -> Option<Told> {
        let (&[incarnation, term, age_us], rest) = self.content.split_first_chunk::<FRONT>()?;
        let age = Duration::from_us(u64::from(age_us));
        let is_fresh = age + now.since(began) <= KNOWLEDGE_MAX_AGE;
        if incarnation != self.incarnation || !is_fresh {
            return None;
        }
        let at = Instant::from_ns(began.as_ns().checked_sub(age.as_ns())?);
        let mut words = at.to_words().into_iter().chain(rest.iter().copied());
        let knowledge = Knowledge::load(&mut || words.next().unwrap_or(0)).ok()?;
        Some((term, knowledge))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driving::types::{Ego, Lanes, MAX_OBJECTS, Object, RouteCode, Scene};
    use std::vec::Vec;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    /// A full road, at 1 s of the sender's clock.
    fn knowledge(objects: usize) -> Knowledge {
        let lanes = Lanes {
            c: [0.1, 0.01, 1e-4, 0.0],
            ..Lanes::alone(3.5, 100.0)
        };
        let ego = Ego {
            speed: 25.0,
            ..Ego::default()
        };
        let scene = Scene {
            at: at(1_000),
            measured: at(990),
            cycle: 9,
            missing: 0,
            ego,
            lanes: Some(lanes),
            set_speed: None,
            route: RouteCode::Free,
            near_gap: false,
            lane_offset: 0.0,
            objects: (0..objects).map(|_| Object::truck()).collect(),
        };
        Knowledge::of(&scene, None)
    }

    /// The chunks of a transfer that begins 40 ms after its scene, in term 5.
    fn chunks(taker: &mut Taker, giver: &mut Giver, told: &Knowledge) -> Vec<Vec<u32>> {
        giver.on_datagram(at(1_030), &taker.ask());
        assert!(giver.wants(at(1_040)));
        giver.begin(at(1_040), 5, told);
        core::iter::from_fn(|| giver.chunk().map(|chunk| chunk.to_vec())).collect()
    }

    /// Feeds chunks, the first at 9.000 s of the receiver's clock and then one each 5 ms.
    fn fed<'a>(taker: &mut Taker, chunks: impl IntoIterator<Item = &'a Vec<u32>>) -> Vec<Told> {
        let times = (0..).map(|index| at(9_000 + 5 * index));
        let told = times.zip(chunks);
        told.filter_map(|(now, chunk)| taker.on_datagram(now, chunk))
            .collect()
    }

    /// T-CHIP-5: what is told arrives, with the time of its scene on the receiver's clock, for any
    /// number of objects; and it is told once for a scene.
    #[test]
    fn a_transfer_arrives_whole() {
        for objects in [0, 1, 8, MAX_OBJECTS] {
            let (mut taker, mut giver) = (Taker::new(77), Giver::new());
            assert!(!giver.wants(at(1_000)), "not asked");
            let told = knowledge(objects);
            let sent = chunks(&mut taker, &mut giver, &told);
            assert!(sent.len() <= MAX_CHUNKS && sent.iter().all(|it| it.len() <= MAX_WORDS));
            let expected = Knowledge {
                at: at(8_960),
                ..told.clone()
            };
            assert_eq!(fed(&mut taker, &sent), [(5, expected)]);
            assert!(giver.wants(at(1_050)));
            giver.begin(at(1_050), 5, &told);
            assert_eq!(giver.chunk(), None, "this scene was told");
            assert!(!giver.wants(at(1_100)), "not asked any more");
        }
    }

    /// T-CHIP-5: a chunk that is lost or damaged costs its transfer and not the next one, a
    /// repeated one nothing; what is old or meant for another incarnation is refused.
    #[test]
    fn what_is_not_whole_and_of_now_is_refused() {
        let fresh = || (Taker::new(77), Giver::new(), knowledge(MAX_OBJECTS));
        let (mut taker, mut giver, told) = fresh();
        let sent = chunks(&mut taker, &mut giver, &told);
        for lost in 0..sent.len() {
            let (mut taker, mut giver, mut told) = fresh();
            let mut sent = chunks(&mut taker, &mut giver, &told);
            sent.remove(lost);
            assert_eq!(fed(&mut taker, &sent), [], "without chunk {lost}");
            told.at = at(1_035);
            let next = chunks(&mut taker, &mut giver, &told);
            assert_eq!(
                fed(&mut taker, &next).len(),
                1,
                "after chunk {lost} was lost"
            );
        }
        for bit in 0..32 * MAX_WORDS {
            let mut wrong = sent.clone();
            wrong[1][bit / 32] ^= 1 << (bit % 32);
            assert_eq!(fed(&mut Taker::new(77), &wrong), [], "bit {bit}");
        }
        let twice = || sent.iter().flat_map(|chunk| [chunk, chunk]);
        assert_eq!(fed(&mut Taker::new(77), twice()).len(), 1, "repeated");
        assert_eq!(fed(&mut Taker::new(78), &sent), [], "another incarnation");
        let mut slow = Taker::new(77);
        let late = sent
            .iter()
            .enumerate()
            .filter_map(|(index, chunk)| slow.on_datagram(at(9_000 + 50 * index as u64), chunk));
        assert_eq!(late.count(), 0, "too old");
        let other_version = |words: &Vec<u32>| {
            let mut words = words.clone();
            let mut bytes = [0; 4 * MAX_WORDS];
            words[0] = 2 << 24;
            let bytes = to_bytes(&words, &mut bytes);
            protect(CHUNK, 1, bytes);
            words[0] = u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
            words
        };
        let newer = sent.iter().map(other_version).collect::<Vec<_>>();
        assert_eq!(fed(&mut Taker::new(77), &newer), []);
    }

    /// T-CHIP-5: values that do not occur on a road are refused, whatever their protection says.
    #[test]
    fn what_no_road_has_is_refused() {
        let wrong: [fn(&mut Knowledge); 6] = [
            |it| it.ego.speed = f32::NAN,
            |it| it.ego.speed = 400.0,
            |it| it.line.iter_mut().for_each(|line| line.c[2] = 0.5),
            |it| {
                it.line
                    .iter_mut()
                    .for_each(|line| line.view_range = f32::INFINITY)
            },
            |it| it.objects[2].0[1] = 0x7FFF_7FFF,
            |it| it.objects[3].0[3] = 0,
        ];
        for (index, wrong) in wrong.iter().enumerate() {
            let (mut taker, mut giver) = (Taker::new(77), Giver::new());
            let mut told = knowledge(MAX_OBJECTS);
            wrong(&mut told);
            let sent = chunks(&mut taker, &mut giver, &told);
            assert_eq!(fed(&mut taker, &sent), [], "{index}");
        }
    }

    /// T-SHM-4: no datagram makes the receiver panic, whatever it holds.
    #[test]
    fn any_words_are_refused_or_taken() {
        let mut taker = Taker::new(1);
        for length in 0..40 {
            for fill in [0, u32::MAX, 0x0101_0101] {
                let words = std::vec![fill; length];
                assert_eq!(taker.on_datagram(at(9_000), &words), None);
            }
            for place in [0, 0x00FF_0000, 0x0010_0000, 0x00F0_0000, 0x0051_0000] {
                let mut words = std::vec![0; length.clamp(HEAD, MAX_WORDS)];
                words[1] = place;
                let mut counter = length as u8;
                seal(CHUNK, &mut counter, &mut words);
                assert_eq!(taker.on_datagram(at(9_000), &words), None);
            }
        }
    }
}
