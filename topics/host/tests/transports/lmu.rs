//! Topics in the LMU: a broadcast ring.

use crate::topic::{Checked, Transport};
use tandem_shm::broadcast::Writer;
use tandem_shm::map::Map;
use tandem_shm::region::{Broadcast, Region};
use tandem_shm::topic::{Publish, RingSubscriber};
use tandem_shm::{Payload, WordsMut, WordsRef};
use tandem_topics::CanFrame;
use tandem_two_cores::shared::{SharedPage, announce};

const SLOTS: u32 = 8;
const TOPIC: Region<Broadcast<CanFrame, { SLOTS as usize }>> = Region::first("topic");

/// A ring in memory that processes share. `FROM_OLDEST`: subscribers begin with the oldest value.
pub(crate) struct Lmu<const FROM_OLDEST: bool> {
    _memory: SharedPage,
    map: Map<'static>,
}

/// Returns the frame of a number.
pub(crate) fn frame(number: u32) -> CanFrame {
    CanFrame {
        id: number,
        period_ms: 10,
        length: 64,
        data: std::array::from_fn(|at| (number as usize + at) as u8),
    }
}

impl<const FROM_OLDEST: bool> Lmu<FROM_OLDEST> {
    /// Makes a subscriber that begins with the oldest value.
    pub(crate) fn subscriber_from_oldest(&self) -> RingSubscriber<'static, CanFrame> {
        RingSubscriber::new(TOPIC.receiver(&self.map).unwrap().from_oldest())
    }
}

impl<const FROM_OLDEST: bool> Transport for Lmu<FROM_OLDEST> {
    type Value = CanFrame;
    type Publisher = Writer<'static, CanFrame>;
    type Subscriber = RingSubscriber<'static, CanFrame>;
    const DEPTH: u32 = SLOTS / 2;
    const LATE: u32 = if FROM_OLDEST { SLOTS - 1 } else { 0 };
    const SUBSCRIBERS: usize = 3;

    fn start() -> Self {
        let (memory, map) = SharedPage::with_lmu(TOPIC.end()).unwrap();
        Self {
            _memory: memory,
            map,
        }
    }

    fn value(number: u32) -> CanFrame {
        frame(number)
    }

    fn publisher(&self, life: u32) -> Self::Publisher {
        TOPIC
            .writer(&self.map, announce(&self.map, 0, life))
            .unwrap()
    }

    fn subscriber(&self) -> Self::Subscriber {
        match FROM_OLDEST {
            true => self.subscriber_from_oldest(),
            false => RingSubscriber::new(TOPIC.receiver(&self.map).unwrap()),
        }
    }

    fn fill(place: &mut WordsMut<'static>, value: CanFrame) -> *const u8 {
        let mut at = 0..;
        value.store(&mut |word| place.set(at.next().unwrap(), word));
        place.as_slice().as_ptr().cast()
    }

    fn read(view: &WordsRef<'static>) -> (CanFrame, *const u8) {
        let mut words = view.iter();
        let value = CanFrame::load(&mut || words.next().unwrap()).unwrap();
        (value, view.as_slice().as_ptr().cast())
    }
}

impl Checked for Lmu<false> {
    fn publish_garbage(publisher: &mut Self::Publisher) {
        let words = CanFrame::WORDS;
        let fill = |place: &mut WordsMut<'_>| (0..words).for_each(|at| place.set(at, u32::MAX));
        publisher.publish_with(fill).unwrap();
    }
}
