//! Transports with one fault each: the case that looks for it must fail.

use crate::lmu::Lmu;
use crate::outcome_of;
use crate::suite;
use crate::topic::{Checked, PlaceOf, Transport, ViewOf};
use libtest_mimic::Trial;
use std::cell::Cell;
use std::convert::Infallible;
use tandem_shm::topic::{Publish, Subscribe};
use tandem_shm::{WordsMut, WordsRef};
use tandem_topics::CanFrame;

/// What the transport does wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Fault {
    None,
    AltersAValue,
    SwapsTwo,
    HidesLoss,
    CountsTooMuch,
    KeepsTooFew,
    GivesOldOnes,
    InventsOne,
    SharesOneCursor,
    PublishesAtItsEnd,
    PublishesBeforeItIsWritten,
    Copies,
}

use Fault::*;

const ALL: [Fault; 12] = [
    None,
    AltersAValue,
    SwapsTwo,
    HidesLoss,
    CountsTooMuch,
    KeepsTooFew,
    GivesOldOnes,
    InventsOne,
    SharesOneCursor,
    PublishesAtItsEnd,
    PublishesBeforeItIsWritten,
    Copies,
];

type Inner = Lmu<false>;

/// The ring with a fault, the number of one in [`ALL`].
struct Faulty<const FAULT: usize> {
    ring: Inner,
    /// How many subscribers it has.
    subscribers: Cell<u32>,
}

struct FaultyPublisher(Fault, <Inner as Transport>::Publisher);

struct FaultySubscriber {
    fault: Fault,
    inner: <Inner as Transport>::Subscriber,
    /// Which subscriber it is, from 1.
    number: u32,
    held: Option<CanFrame>,
}

impl Publish<CanFrame> for FaultyPublisher {
    type Place<'a> = WordsMut<'static>;
    type Error = Infallible;

    fn publish_with(
        &mut self,
        fill: impl FnOnce(&mut WordsMut<'static>),
    ) -> Result<(), Infallible> {
        if self.0 == PublishesBeforeItIsWritten {
            self.publish(&Inner::value(99))?;
        }
        if self.0 == Copies {
            let memory = Inner::start();
            let mut own = memory.publisher(1);
            own.publish_with(fill)?;
            return self.publish(&memory.subscriber().take().unwrap_or_default());
        }
        self.1.publish_with(fill)
    }

    fn publish(&mut self, value: &CanFrame) -> Result<(), Infallible> {
        Publish::publish(&mut self.1, value)
    }
}

impl Drop for FaultyPublisher {
    fn drop(&mut self) {
        if self.0 == PublishesAtItsEnd {
            let _ = self.publish(&Inner::value(99));
        }
    }
}

impl Subscribe<CanFrame> for FaultySubscriber {
    type View<'a> = WordsRef<'static>;

    fn take_with<R>(&mut self, read: impl FnMut(&WordsRef<'static>) -> R) -> Option<R> {
        self.inner.take_with(read)
    }

    fn take(&mut self) -> Option<CanFrame> {
        let mut value = match self.fault {
            SwapsTwo if self.held.is_none() => {
                let first = self.inner.take();
                self.held = self.inner.take();
                self.held.take().inspect(|_| self.held = first).or(first)
            }
            SwapsTwo => self.held.take(),
            SharesOneCursor if self.number > 1 => Option::None,
            InventsOne => self.inner.take().or_else(|| {
                self.fault = None;
                Some(Inner::value(7))
            }),
            KeepsTooFew => std::iter::from_fn(|| self.inner.take()).last(),
            _ => self.inner.take(),
        }?;
        if self.fault == AltersAValue {
            value.data[63] ^= 1;
        }
        Some(value)
    }

    fn lost(&self) -> u32 {
        match self.fault {
            HidesLoss => 0,
            CountsTooMuch => self.inner.lost() + 1,
            _ => self.inner.lost(),
        }
    }
}

impl<const FAULT: usize> Transport for Faulty<FAULT> {
    type Value = CanFrame;
    type Publisher = FaultyPublisher;
    type Subscriber = FaultySubscriber;
    const DEPTH: u32 = Inner::DEPTH;
    const LATE: u32 = Inner::LATE;
    const SUBSCRIBERS: usize = Inner::SUBSCRIBERS;

    fn start() -> Self {
        Self {
            ring: Inner::start(),
            subscribers: Cell::new(0),
        }
    }

    fn value(number: u32) -> CanFrame {
        Inner::value(number)
    }

    fn publisher(&self, life: u32) -> FaultyPublisher {
        FaultyPublisher(ALL[FAULT], self.ring.publisher(life))
    }

    fn subscriber(&self) -> FaultySubscriber {
        self.subscribers.set(self.subscribers.get() + 1);
        FaultySubscriber {
            fault: ALL[FAULT],
            inner: match ALL[FAULT] {
                GivesOldOnes => self.ring.subscriber_from_oldest(),
                _ => self.ring.subscriber(),
            },
            number: self.subscribers.get(),
            held: Option::None,
        }
    }

    fn fill(place: &mut PlaceOf<'_, Inner>, value: CanFrame) -> *const u8 {
        Inner::fill(place, value)
    }

    fn read(view: &ViewOf<'_, Inner>) -> (CanFrame, *const u8) {
        Inner::read(view)
    }
}

impl<const FAULT: usize> Checked for Faulty<FAULT> {
    fn publish_garbage(publisher: &mut FaultyPublisher) {
        Inner::publish_garbage(&mut publisher.1);
    }
}

/// Checks that the case fails, or passes if there is no fault.
fn trial<const FAULT: usize>(case: fn(&Faulty<FAULT>), name: &str) -> Trial {
    let fault = ALL[FAULT];
    Trial::test(format!("faulty::{name}::{fault:?}"), move || {
        let outcome = outcome_of(case);
        assert_eq!(outcome.is_err(), fault != None);
        Ok(())
    })
}

pub(crate) fn trials() -> Vec<Trial> {
    const fn at(fault: Fault) -> usize {
        fault as usize
    }
    vec![
        trial::<{ at(None) }>(suite::equal, "equal"),
        trial::<{ at(None) }>(suite::killed, "killed"),
        trial::<{ at(AltersAValue) }>(suite::equal, "equal"),
        trial::<{ at(SwapsTwo) }>(suite::order, "order"),
        trial::<{ at(HidesLoss) }>(suite::newest, "newest"),
        trial::<{ at(None) }>(suite::garbage, "garbage"),
        trial::<{ at(HidesLoss) }>(suite::garbage, "garbage"),
        trial::<{ at(CountsTooMuch) }>(suite::newest, "newest"),
        trial::<{ at(KeepsTooFew) }>(suite::newest, "newest"),
        trial::<{ at(GivesOldOnes) }>(suite::late, "late"),
        trial::<{ at(InventsOne) }>(suite::silence, "silence"),
        trial::<{ at(SharesOneCursor) }>(suite::several, "several"),
        trial::<{ at(PublishesAtItsEnd) }>(suite::dropped, "dropped"),
        trial::<{ at(PublishesBeforeItIsWritten) }>(suite::killed, "killed"),
        trial::<{ at(Copies) }>(suite::in_place, "in_place"),
    ]
}
