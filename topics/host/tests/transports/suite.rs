//! The cases: what each transport of topics promises.

use crate::topic::{Checked, Topic, Transport};
use std::fs;
use std::sync::atomic::Ordering::{Acquire, Release};
use std::time::Duration;
use tandem_shm::topic::{Publish, Subscribe};
use tandem_two_cores::shared::SharedPage;
use tandem_two_cores::worker::Child;

/// A value that is published whole, and one that is written in place.
pub(crate) fn equal<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    topic.publish(1..2);
    topic.expect(0, 1..2);
    let publisher = topic.publisher.as_mut().unwrap();
    let fill = publisher.publish_with(|place| {
        R::fill(place, R::value(2));
    });
    fill.unwrap();
    topic.expect(0, 2..3);
    topic.publish(3..4);
    let seen = loop {
        R::turn_subscriber(&mut topic.subscribers[0], 1);
        if let Some((seen, _)) = topic.subscribers[0].take_with(|view| R::read(view)) {
            break seen;
        }
        assert!(!R::IS_INSTANT, "nothing arrived");
    };
    assert_eq!(seen, R::value(3));
    assert_eq!(topic.subscribers[0].lost(), 0);
}

pub(crate) fn order<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    for turn in 0..4 {
        let first = turn * R::DEPTH;
        topic.publish(first..first + R::DEPTH);
        topic.expect(0, first..first + R::DEPTH);
    }
    assert_eq!(topic.subscribers[0].lost(), 0);
}

/// A publisher never waits. What is kept is in order and ends with the newest; what was taken and
/// what was lost add up to what was published.
pub(crate) fn newest<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    topic.publish(0..1);
    topic.expect(0, 0..1);
    let end = 1 + 10 * R::DEPTH;
    topic.publish(1..end);
    topic.ignore(end - 1);
    let kept = topic.taken(0, R::DEPTH);
    let first = end - kept.len() as u32;
    assert_eq!(kept, (first..end).map(R::value).collect::<Vec<_>>());
    assert!(kept.len() as u32 >= R::DEPTH, "{}", kept.len());
    assert_eq!(topic.subscribers[0].lost(), first - 1);
    topic.publish(end..end + 1);
    topic.expect(0, end..end + 1);
    assert_eq!(topic.subscribers[0].lost(), first - 1);
}

pub(crate) fn late<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    let end = 3 * R::DEPTH;
    topic.publish(0..end);
    topic.join();
    topic.expect(1, end - R::LATE..end);
    topic.publish(end..end + 1);
    topic.expect(1, end..end + 1);
    assert_eq!(topic.subscribers[1].lost(), 0);
}

/// Neither before the first value, nor when the publisher has gone.
pub(crate) fn silence<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    topic.expect(0, 0..0);
    topic.publisher = None;
    topic.expect(0, 0..0);
    let seen = topic.subscribers[0].take_with(|view| R::read(view));
    assert_eq!(seen, None);
    assert_eq!(topic.subscribers[0].lost(), 0);
}

/// Each subscriber gets each value; the last one takes nothing until the end.
pub(crate) fn several<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, R::SUBSCRIBERS);
    let last = R::SUBSCRIBERS - 1;
    for turn in 0..10 {
        let first = turn * R::DEPTH;
        topic.publish(first..first + R::DEPTH);
        for subscriber in 0..last {
            topic.expect(subscriber, first..first + R::DEPTH);
        }
    }
    topic.ignore(10 * R::DEPTH);
    let kept = topic.taken(last, R::DEPTH);
    assert_eq!(kept.last(), Some(&R::value(10 * R::DEPTH - 1)));
    assert!(kept.len() as u32 >= R::DEPTH, "{}", kept.len());
}

/// What has arrived can be taken when the publisher has ended. The values of its successor follow.
pub(crate) fn dropped<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    topic.publish(0..R::DEPTH);
    topic.publisher = None;
    topic.expect(0, 0..R::DEPTH);
    topic.publisher = Some(rig.publisher(2));
    topic.meet(1);
    topic.publish(R::DEPTH..R::DEPTH + 2);
    topic.expect(0, R::DEPTH..R::DEPTH + 2);
    assert_eq!(topic.subscribers[0].lost(), 0);
}

/// Another process publishes, and is killed within the closure that writes the last value.
pub(crate) fn killed<R: Transport>(rig: &R) {
    let shared = SharedPage::new().unwrap();
    let [exists, ready, knows] = &shared.spare;
    let child = Child::start(0, || {
        let mut publisher = rig.publisher(1);
        exists.store(1, Release);
        let knows_both = |met: bool| met && knows.load(Acquire) == 1;
        while !knows_both(R::turn_publisher(&mut publisher, 1)) {}
        (0..R::DEPTH).for_each(|number| publisher.publish(&R::value(number)).unwrap());
        let _ = publisher.publish_with(|place| {
            R::fill(place, R::value(99));
            ready.store(1, Release);
            loop {
                std::thread::sleep(Duration::from_secs(1));
            }
        });
        true
    });
    let child = child.unwrap();
    while exists.load(Acquire) == 0 {
        std::thread::yield_now();
    }
    let mut topic = Topic {
        rig,
        publisher: None,
        subscribers: vec![rig.subscriber()],
    };
    topic.meet(1);
    knows.store(1, Release);
    while ready.load(Acquire) == 0 {
        R::turn_subscriber(&mut topic.subscribers[0], 1);
    }
    drop(child);
    topic.expect(0, 0..R::DEPTH);
    topic.publisher = Some(rig.publisher(2));
    // The dead one said nothing: its lease still runs.
    topic.meet(2);
    topic.publish(R::DEPTH..R::DEPTH + 2);
    topic.expect(0, R::DEPTH..R::DEPTH + 2);
    assert_eq!(topic.subscribers[0].lost(), 0);
}

/// The place in a shared file of an address: device, inode, offset.
fn in_file(address: *const u8) -> (String, String, u64) {
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    let address = address.addr() as u64;
    let hex = |text: &str| u64::from_str_radix(text, 16).unwrap();
    for line in maps.lines() {
        // proc(5): addresses, rights, offset, device, inode.
        let words: Vec<&str> = line.split_whitespace().collect();
        let (begin, end) = words[0].split_once('-').unwrap();
        if (hex(begin)..hex(end)).contains(&address) {
            assert!(words[1].ends_with('s'), "not in shared memory: {line}");
            let offset = hex(words[2]) + address - hex(begin);
            return (words[3].to_owned(), words[4].to_owned(), offset);
        }
    }
    panic!("{address:#x} is not mapped");
}

/// The closure that writes and the one that reads get the same bytes of the same file, although the
/// ends may map it at different addresses.
pub(crate) fn in_place<R: Transport>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    for number in 0..3 * R::DEPTH {
        let mut written = std::ptr::null();
        let publisher = topic.publisher.as_mut().unwrap();
        let fill = publisher.publish_with(|place| written = R::fill(place, R::value(number)));
        fill.unwrap();
        let read = topic.subscribers[0].take_with(|view| R::read(view));
        let (value, read) = read.unwrap();
        assert_eq!(value, R::value(number));
        assert_eq!(in_file(written), in_file(read));
    }
}

/// Bytes that are no value are not given, and do not stop the values behind them.
pub(crate) fn garbage<R: Checked>(rig: &R) {
    let mut topic = Topic::with_subscribers(rig, 1);
    topic.publish(0..1);
    R::publish_garbage(topic.publisher.as_mut().unwrap());
    topic.publish(1..2);
    topic.expect(0, 0..2);
    assert_eq!(topic.subscribers[0].lost(), 1);
}
