//! The knowledge that a driving system sends to one that has just joined, over the link. T-CHIP-5
//!
//! The joining system sends a *request* in each control cycle. The other one answers with a
//! *transfer*, two *chunks* in a control cycle. If a chunk is lost, its transfer fails; the next
//! one begins with the next scene.
//!
//! | word | request | chunk |
//! |---|---|---|
//! | 0 | CRC-16, counter, [`VERSION`] | CRC-16, counter, [`VERSION`] |
//! | 1 | the asking incarnation | number of the transfer, index and count of its chunks |
//! | from 2 | | content |
//!
//! The content is the asking incarnation, the sender's term, the age of the scene in µs, and the
//! words of [`Knowledge`] from the third on, without those of absent objects. The receiver accepts
//! a transfer only if it is complete, in order and recent, and answers this incarnation.

use super::datagram::{KNOWLEDGE_CHUNK, KNOWLEDGE_REQUEST, MAX_WORDS, is_sealed, seal};
use crate::driving::knowledge::{KNOWLEDGE_MAX_AGE, Knowledge};
use crate::words::Payload;
use tandem_board::{Duration, Instant, Link, SystemId};
use tandem_bus::e2e::Checker;
use tandem_redundancy::{Redundancy, Term};
use tandem_shm::newest::Writer;

/// Chunks that are sent in a control cycle.
const CHUNKS_PER_CYCLE: usize = 2;
/// A system asks until its redundancy has run this many control cycles: for 300 ms.
const ASKING_CYCLES: u32 = 30;

/// Version of requests and chunks. Other versions are refused.
const VERSION: u8 = 1;

/// Words of a chunk before its content.
const HEAD: usize = 2;
const CHUNK_CONTENT: usize = MAX_WORDS - HEAD;
/// Incarnation, term, age.
const FRONT: usize = 3;
/// Words of the time in the knowledge; an age is sent instead.
const TIME: usize = 2;
const CONTENT: usize = FRONT + Knowledge::WORDS - TIME;
const MAX_CHUNKS: usize = CONTENT.div_ceil(CHUNK_CONTENT);
const _: () = assert!(MAX_CHUNKS <= 15, "index and count have four bits each");

/// A request is valid for this long: another one follows in each control cycle.
const REQUEST_HOLDS: Duration = Duration::from_ms(35);

/// Both ends of the transfer. Only a system that drives sends, and only one that does not drive
/// receives.
pub(super) struct KnowledgeTransfer<'b> {
    sender: KnowledgeSender,
    receiver: KnowledgeReceiver,
    /// Control cycles with a running redundancy in which this system has asked.
    asked: u32,
    /// Where cores 1 and 2 find the received knowledge; `None` until the LMU is attached.
    pub(super) received: Option<Writer<'b, Knowledge>>,
}

impl KnowledgeTransfer<'_> {
    pub(super) fn new(started: Instant, generation: u32) -> Self {
        Self {
            sender: KnowledgeSender::new(),
            // After power-on the generation starts over, so the time is part of the number.
            receiver: KnowledgeReceiver::new((started.as_ns() / 1_000) as u32 ^ generation << 24),
            asked: 0,
            received: None,
        }
    }

    /// Takes a datagram that may be a request or a chunk. Refuses knowledge of an earlier term.
    pub(super) fn on_datagram(
        &mut self,
        now: Instant,
        words: &[u32],
        redundancy: Option<&Redundancy>,
        system: SystemId,
    ) {
        if redundancy.is_some_and(|it| it.phase().is_driving()) {
            self.sender.on_datagram(now, words);
            return;
        }
        let Some((term, knowledge)) = self.receiver.on_datagram(now, words) else {
            return;
        };
        let term = Term::from_bits(term);
        let is_earlier = redundancy.is_some_and(|it| term < it.highest_term());
        if term.system() != system
            && !is_earlier
            && let Some(cells) = &mut self.received
        {
            cells.publish(&knowledge);
        }
    }

    /// Returns whether this system can begin a transfer, if it drives.
    pub(super) fn wants_knowledge(&self, now: Instant) -> bool {
        self.sender.wants(now)
    }

    /// Called once in a control cycle: asks while this system is newly started, and answers if it
    /// drives. Takes a bounded time.
    pub(super) fn cycle(
        &mut self,
        now: Instant,
        redundancy: Option<&Redundancy>,
        knowledge: Option<&Knowledge>,
        link: &impl Link,
    ) {
        // A full link drops the datagram. Requests repeat; without a chunk, a transfer fails.
        let Some(redundancy) = redundancy.filter(|it| it.phase().is_driving()) else {
            // Count only cycles with a running redundancy: it starts after cores 1 and 2, which may
            // take long to start.
            if self.asked < ASKING_CYCLES {
                self.asked += u32::from(redundancy.is_some());
                let _full = link.try_send(&self.receiver.request());
            }
            return;
        };
        if let Some(knowledge) = knowledge {
            self.sender.begin(now, redundancy.term().bits(), knowledge);
        }
        for chunk in core::iter::from_fn(|| self.sender.chunk()).take(CHUNKS_PER_CYCLE) {
            let _full = link.try_send(&chunk);
        }
    }
}

/// The sending end of the transfer, in a driving system.
#[derive(Debug)]
struct KnowledgeSender {
    requests: Checker,
    /// The last request: its incarnation and when it arrived.
    requested: Option<(u32, Instant)>,
    counter: u8,
    transfer: u16,
    /// The scene that was sent last.
    sent: Option<Instant>,
    content: [u32; CONTENT],
    len: usize,
    next: usize,
}

impl KnowledgeSender {
    const fn new() -> Self {
        Self {
            requests: Checker::new(KNOWLEDGE_REQUEST),
            requested: None,
            counter: 0,
            transfer: 0,
            sent: None,
            content: [0; CONTENT],
            len: 0,
            next: 0,
        }
    }

    /// Takes a datagram that may be a request.
    fn on_datagram(&mut self, now: Instant, words: &[u32]) {
        if let &[_, incarnation] = words
            && is_sealed(&mut self.requests, VERSION, words)
        {
            self.requested = Some((incarnation, now));
        }
    }

    /// Returns whether a transfer is requested and none is under way.
    fn wants(&self, now: Instant) -> bool {
        let is_idle = self.next >= self.len;
        is_idle
            && self
                .requested
                .is_some_and(|(_, at)| now.since(at) <= REQUEST_HOLDS)
    }

    /// Begins a transfer, unless this scene was sent before.
    fn begin(&mut self, now: Instant, term: u32, knowledge: &Knowledge) {
        let Some((incarnation, _)) = self.requested else {
            return;
        };
        if self.sent.replace(knowledge.at) == Some(knowledge.at) {
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

    /// Returns the next chunk of the transfer.
    fn chunk(&mut self) -> Option<heapless::Vec<u32, MAX_WORDS>> {
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
        seal(KNOWLEDGE_CHUNK, VERSION, &mut self.counter, &mut words);
        Some(words)
    }
}

/// The receiving end of the transfer, in a joining system.
#[derive(Debug)]
struct KnowledgeReceiver {
    incarnation: u32,
    counter: u8,
    chunks: Checker,
    /// The transfer that is under way, when it began, and the index and count of its next chunk.
    under_way: Option<(u16, Instant, usize, usize)>,
    content: [u32; CONTENT],
}

/// The sender's term and its knowledge.
type Received = (u32, Knowledge);

impl KnowledgeReceiver {
    /// `incarnation`: a number that no other incarnation of this system has.
    const fn new(incarnation: u32) -> Self {
        Self {
            incarnation,
            counter: 0,
            chunks: Checker::new(KNOWLEDGE_CHUNK),
            under_way: None,
            content: [0; CONTENT],
        }
    }

    /// Returns the datagram that requests a transfer.
    fn request(&mut self) -> [u32; 2] {
        let mut words = [0, self.incarnation];
        seal(KNOWLEDGE_REQUEST, VERSION, &mut self.counter, &mut words);
        words
    }

    /// Takes a datagram that may be a chunk. Returns the knowledge if it was the last one.
    fn on_datagram(&mut self, now: Instant, words: &[u32]) -> Option<Received> {
        let (&[_, place], content) = words.split_first_chunk::<HEAD>()?;
        if words.len() > MAX_WORDS || !is_sealed(&mut self.chunks, VERSION, words) {
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

    fn finish(&self, now: Instant, began: Instant) -> Option<Received> {
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
    use crate::driving::types::{CameraLine, Ego, Lanes, MAX_OBJECTS, Object, RouteCode, Scene};
    use std::vec::Vec;

    fn at(ms: u64) -> Instant {
        Instant::from_ns(ms * 1_000_000)
    }

    /// Returns the knowledge of a road with this many objects, at 1 s of the sender's clock.
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
            moment: None,
            measured: at(990),
            cycle: 9,
            missing: 0,
            ego,
            lanes: Some(lanes),
            camera: CameraLine::default(),
            set_speed: None,
            route: RouteCode::Free,
            near_gap: false,
            lane_offset: 0.0,
            objects: (0..objects).map(|_| Object::truck()).collect(),
        };
        Knowledge::of(&scene, None)
    }

    /// Returns the chunks of a transfer that begins 40 ms after its scene, in term 5.
    fn chunks(
        receiver: &mut KnowledgeReceiver,
        sender: &mut KnowledgeSender,
        known: &Knowledge,
    ) -> Vec<Vec<u32>> {
        sender.on_datagram(at(1_030), &receiver.request());
        assert!(sender.wants(at(1_040)));
        sender.begin(at(1_040), 5, known);
        core::iter::from_fn(|| sender.chunk().map(|chunk| chunk.to_vec())).collect()
    }

    /// Feeds chunks, the first at 9.000 s of the receiver's clock and then one every 5 ms.
    fn fed<'a>(
        receiver: &mut KnowledgeReceiver,
        chunks: impl IntoIterator<Item = &'a Vec<u32>>,
    ) -> Vec<Received> {
        let times = (0..).map(|index| at(9_000 + 5 * index));
        let fed = times.zip(chunks);
        fed.filter_map(|(now, chunk)| receiver.on_datagram(now, chunk))
            .collect()
    }

    /// T-CHIP-5: a transfer arrives with the time of its scene on the receiver's clock, for any
    /// number of objects. Each scene is sent once.
    #[test]
    fn a_transfer_arrives_whole() {
        for objects in [0, 1, 8, MAX_OBJECTS] {
            let (mut receiver, mut sender) = (KnowledgeReceiver::new(77), KnowledgeSender::new());
            assert!(!sender.wants(at(1_000)), "not requested");
            let known = knowledge(objects);
            let sent = chunks(&mut receiver, &mut sender, &known);
            assert!(sent.len() <= MAX_CHUNKS && sent.iter().all(|it| it.len() <= MAX_WORDS));
            let expected = Knowledge {
                at: at(8_960),
                ..known.clone()
            };
            assert_eq!(fed(&mut receiver, &sent), [(5, expected)]);
            assert!(sender.wants(at(1_050)));
            sender.begin(at(1_050), 5, &known);
            assert_eq!(sender.chunk(), None, "this scene was sent");
            assert!(!sender.wants(at(1_100)), "the request has expired");
        }
    }

    /// T-CHIP-5: a lost or damaged chunk makes its own transfer fail but not the next one; a
    /// repeated chunk does no harm. Old transfers and those for another incarnation are refused.
    #[test]
    fn incomplete_and_old_transfers_are_refused() {
        let fresh = || {
            (
                KnowledgeReceiver::new(77),
                KnowledgeSender::new(),
                knowledge(MAX_OBJECTS),
            )
        };
        let (mut receiver, mut sender, known) = fresh();
        let sent = chunks(&mut receiver, &mut sender, &known);
        for lost in 0..sent.len() {
            let (mut receiver, mut sender, mut known) = fresh();
            let mut sent = chunks(&mut receiver, &mut sender, &known);
            sent.remove(lost);
            assert_eq!(fed(&mut receiver, &sent), [], "without chunk {lost}");
            known.at = at(1_035);
            let next = chunks(&mut receiver, &mut sender, &known);
            assert_eq!(
                fed(&mut receiver, &next).len(),
                1,
                "after chunk {lost} was lost"
            );
        }
        for bit in 0..32 * MAX_WORDS {
            let mut wrong = sent.clone();
            wrong[1][bit / 32] ^= 1 << (bit % 32);
            assert_eq!(
                fed(&mut KnowledgeReceiver::new(77), &wrong),
                [],
                "bit {bit}"
            );
        }
        let twice = || sent.iter().flat_map(|chunk| [chunk, chunk]);
        assert_eq!(
            fed(&mut KnowledgeReceiver::new(77), twice()).len(),
            1,
            "repeated"
        );
        assert_eq!(
            fed(&mut KnowledgeReceiver::new(78), &sent),
            [],
            "another incarnation"
        );
        let mut slow = KnowledgeReceiver::new(77);
        let late = sent
            .iter()
            .enumerate()
            .filter_map(|(index, chunk)| slow.on_datagram(at(9_000 + 50 * index as u64), chunk));
        assert_eq!(late.count(), 0, "too old");
        let other_version = |words: &Vec<u32>| {
            let mut words = words.clone();
            seal(KNOWLEDGE_CHUNK, VERSION + 1, &mut 0, &mut words);
            words
        };
        let newer = sent.iter().map(other_version).collect::<Vec<_>>();
        assert_eq!(fed(&mut KnowledgeReceiver::new(77), &newer), []);
    }

    /// T-CHIP-5: values that no road has are refused, even if the protection is valid.
    #[test]
    fn implausible_knowledge_is_refused() {
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
            let (mut receiver, mut sender) = (KnowledgeReceiver::new(77), KnowledgeSender::new());
            let mut known = knowledge(MAX_OBJECTS);
            wrong(&mut known);
            let sent = chunks(&mut receiver, &mut sender, &known);
            assert_eq!(fed(&mut receiver, &sent), [], "{index}");
        }
    }

    /// T-SHM-4: no content of a datagram makes the receiver panic.
    #[test]
    fn arbitrary_words_never_panic() {
        let mut receiver = KnowledgeReceiver::new(1);
        for length in 0..40 {
            for fill in [0, u32::MAX, 0x0101_0101] {
                let words = std::vec![fill; length];
                assert_eq!(receiver.on_datagram(at(9_000), &words), None);
            }
            for place in [0, 0x00FF_0000, 0x0010_0000, 0x00F0_0000, 0x0051_0000] {
                let mut words = std::vec![0; length.clamp(HEAD, MAX_WORDS)];
                words[1] = place;
                let mut counter = length as u8;
                seal(KNOWLEDGE_CHUNK, VERSION, &mut counter, &mut words);
                assert_eq!(receiver.on_datagram(at(9_000), &words), None);
            }
        }
    }
}
