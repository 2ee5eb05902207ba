//! Calls the functions of the header from Rust, so that Miri can check them.
#![allow(clippy::unwrap_used)]

use core::ffi::c_void;
use core::mem::zeroed;
use core::ptr::{null, null_mut};
use core::sync::atomic::{AtomicU32, Ordering};
use tandem_capi::TandemStatus as S;
use tandem_capi::*;

const LMU_BYTES: usize = 8192;

#[repr(align(64))]
struct Lmu([AtomicU32; LMU_BYTES / 4]);

/// The objects that C would place statically. They never move while they are in use.
struct Objects {
    lmu: Lmu,
    layout: TandemLayout,
    map: TandemMap,
    lock: TandemLock,
    other_lock: TandemLock,
    sender: TandemMailboxSender,
    receiver: TandemMailboxReceiver,
    producer: TandemFifoProducer,
    consumer: TandemFifoConsumer,
    writer: TandemNewestWriter,
    reader: TandemNewestReader,
    ring: TandemBroadcastSender,
    listener: TandemBroadcastReceiver,
    pool: TandemPool,
}

const SLOTS: usize = 4;
const WORDS: usize = 3;
const BLOCKS: usize = 4;

/// Returns objects attached as core 0, on the heap, so that Miri finds each access outside them.
fn objects() -> *mut Objects {
    let regions = [
        (c"mailbox", TANDEM_MAILBOX_WORDS),
        (c"lock", TANDEM_LOCK_WORDS),
        (c"fifo", tandem_fifo_words(SLOTS, WORDS)),
        (c"newest", tandem_newest_words(SLOTS, WORDS)),
        (c"ring", tandem_broadcast_words(SLOTS, WORDS)),
        (c"pool", tandem_pool_words(BLOCKS)),
    ]
    .map(|(name, words)| TandemRegion {
        name: name.as_ptr(),
        words,
    });
    // SAFETY: zero is a valid value of integers and atomics; the box is leaked, so its fields, to
    // which the pointers point, do not move.
    unsafe {
        let o = Box::into_raw(Box::new(zeroed::<Objects>()));
        let map = &raw mut (*o).map;
        let base = (&raw mut (*o).lmu).cast::<c_void>();
        let layout = &raw mut (*o).layout;
        let ok = [
            tandem_layout_init(layout, regions.as_ptr(), regions.len()),
            tandem_map_format(map, layout, base, LMU_BYTES),
            tandem_map_attach(map, layout, base, LMU_BYTES),
            tandem_incarnation_announce(map, 0, 1),
            tandem_incarnation_announce(map, 1, 1),
            tandem_mailbox_sender_attach(&raw mut (*o).sender, map, 0),
            tandem_mailbox_receiver_attach(&raw mut (*o).receiver, map, 0),
            tandem_lock_attach(&raw mut (*o).lock, map, 1, 0, 1),
            tandem_lock_attach(&raw mut (*o).other_lock, map, 1, 1, 1),
            tandem_fifo_producer_attach(&raw mut (*o).producer, map, 2, SLOTS, WORDS),
            tandem_fifo_consumer_attach(&raw mut (*o).consumer, map, 2, SLOTS, WORDS),
            tandem_newest_writer_attach(&raw mut (*o).writer, map, 3, SLOTS, WORDS),
            tandem_newest_reader_attach(&raw mut (*o).reader, map, 3, SLOTS, WORDS),
            tandem_broadcast_sender_attach(&raw mut (*o).ring, map, 4, SLOTS, WORDS),
            tandem_broadcast_receiver_attach(&raw mut (*o).listener, map, 4, SLOTS, WORDS, 0),
            tandem_pool_attach(&raw mut (*o).pool, map, 5, BLOCKS, 0, 1),
        ];
        assert_eq!(ok, [S::Ok; 16]);
        o
    }
}

fn free(objects: *mut Objects) {
    // SAFETY: `objects` made the pointer, and no code uses it afterwards.
    drop(unsafe { Box::from_raw(objects) });
}

/// Writes to lent words through the pointer, as C does.
fn fill(words: TandemWords, value: u32) {
    for at in 0..words.count {
        // SAFETY: the library lent `count` words.
        unsafe { words.first.cast::<u32>().add(at).write_volatile(value) };
    }
}

fn seen(words: TandemWords) -> Vec<u32> {
    // SAFETY: as in `fill`.
    let read = |at| unsafe { words.first.cast::<u32>().add(at).read_volatile() };
    (0..words.count).map(read).collect()
}

const NO_WORDS: TandemWords = TandemWords {
    first: null_mut(),
    count: 0,
};

/// Handles a signal: calls functions on the receiver that runs this handler, and on other objects.
unsafe extern "C" fn on_task(context: *mut c_void, task: u32, count: u32, value: u32) {
    assert_eq!((task, count, value), (5, 2, 9));
    let o = context.cast::<Objects>();
    // SAFETY: the context is the pointer that the task was added with.
    unsafe {
        assert_eq!(
            tandem_mailbox_poll(&raw mut (*o).receiver, null_mut()),
            S::Busy
        );
        assert_eq!(tandem_mailbox_awake(&raw mut (*o).receiver), S::Busy);
        let map = &raw const (*o).map;
        assert_eq!(
            tandem_mailbox_receiver_attach(&raw mut (*o).receiver, map, 0),
            S::Busy
        );
        assert_eq!(tandem_mailbox_signal(&raw mut (*o).sender, 3), S::Ok);
        assert_eq!(tandem_lock_try_acquire(&raw mut (*o).lock), S::Ok);
    }
}

#[test]
fn a_handler_may_use_everything_but_the_receiver_that_runs_it() {
    let o = objects();
    // SAFETY: all pointers are to the fields of `o`.
    unsafe {
        let receiver = &raw mut (*o).receiver;
        assert_eq!(tandem_mailbox_poll(receiver, null_mut()), S::Empty);
        assert_eq!(
            tandem_mailbox_add_task(receiver, 5, Some(on_task), o.cast()),
            S::Ok
        );
        assert_eq!(
            tandem_mailbox_add_task(receiver, 5, Some(on_task), o.cast()),
            S::Taken
        );
        assert_eq!(
            tandem_mailbox_add_task(receiver, 7, None, o.cast()),
            S::BadPointer
        );
        let sender = &raw mut (*o).sender;
        assert_eq!(tandem_mailbox_signal_with(sender, 5, 8), S::Ok);
        assert_eq!(tandem_mailbox_signal_with(sender, 5, 9), S::Ok);
        assert_eq!(tandem_mailbox_open(sender, 5), 2);
        let mut signals = 0;
        assert_eq!(tandem_mailbox_poll(receiver, &raw mut signals), S::Ok);
        assert_eq!(signals, 2);
        // The handler signalled a task without a handler.
        assert_eq!(tandem_mailbox_poll(receiver, null_mut()), S::Ok);
        assert_eq!(tandem_mailbox_unknown(receiver), 1);
        assert_eq!(tandem_mailbox_prepare_sleep(receiver), S::Ok);
        assert_eq!(tandem_mailbox_signal(sender, 1), S::RingNeeded);
        assert_eq!(tandem_mailbox_awake(receiver), S::Ok);
        assert_eq!(tandem_mailbox_prepare_sleep(receiver), S::DoNotSleep);
        assert_eq!(tandem_mailbox_signal(sender, 16), S::OutOfRange);
        assert_eq!(
            tandem_lock_release(&raw mut (*o).lock),
            S::Ok,
            "taken by the handler"
        );
    }
    free(o);
}

/// Runs between two polls: releases the lock, so that the waiter gets it.
unsafe extern "C" fn give_way(context: *mut c_void, spins: u32) {
    assert!(spins >= 1);
    let o = context.cast::<Objects>();
    // SAFETY: the context is the pointer that was passed to the call.
    unsafe {
        assert_eq!(
            tandem_lock_release(&raw mut (*o).other_lock),
            S::Busy,
            "it is waiting"
        );
        let map = &raw const (*o).map;
        assert_eq!(
            tandem_lock_attach(&raw mut (*o).other_lock, map, 1, 1, 1),
            S::Busy
        );
        assert_eq!(tandem_lock_release(&raw mut (*o).lock), S::Ok);
    }
}

#[test]
fn a_lock_is_held_until_it_is_released_or_its_owner_is_dead() {
    let o = objects();
    // SAFETY: all pointers are to the fields of `o`.
    unsafe {
        let (lock, other) = (&raw mut (*o).lock, &raw mut (*o).other_lock);
        assert_eq!(tandem_lock_release(lock), S::NothingToEnd);
        assert_eq!(tandem_lock_acquire(lock, 1, None, null_mut()), S::Ok);
        assert_eq!(tandem_lock_acquire(lock, 1, None, null_mut()), S::Busy);
        assert_eq!(tandem_lock_try_acquire(other), S::Busy);
        assert_eq!(tandem_lock_acquire(other, 2, None, null_mut()), S::TimedOut);
        assert_eq!(
            tandem_lock_acquire(other, 9, Some(give_way), o.cast()),
            S::Ok
        );
        assert_eq!(
            tandem_incarnation_mark_dead(&raw const (*o).map, 1, 1),
            S::Ok
        );
        assert_eq!(
            tandem_incarnation_mark_dead(&raw const (*o).map, 1, 1),
            S::Outdated
        );
        assert_eq!(tandem_incarnation_current(&raw const (*o).map, 1), 0);
        assert_eq!(tandem_lock_acquire(lock, 1, None, null_mut()), S::Recovered);
        assert_eq!(tandem_lock_release(lock), S::Ok);
    }
    free(o);
}

#[test]
fn channels_lend_slots_and_refuse_what_was_not_lent() {
    let o = objects();
    let mut words = NO_WORDS;
    let w = &raw mut words;
    // SAFETY: all pointers are to the fields of `o` and to `words`.
    unsafe {
        let (producer, consumer) = (&raw mut (*o).producer, &raw mut (*o).consumer);
        assert_eq!(tandem_fifo_send(producer), S::NothingToEnd);
        assert_eq!(tandem_fifo_receive(consumer, w), S::Empty);
        for value in 0..SLOTS as u32 {
            assert_eq!(tandem_fifo_loan(producer, w), S::Ok);
            fill(*w, value);
            assert_eq!(tandem_fifo_send(producer), S::Ok);
        }
        assert_eq!(tandem_fifo_loan(producer, w), S::Full);
        for value in 0..SLOTS as u32 {
            assert_eq!(tandem_fifo_receive(consumer, w), S::Ok);
            assert_eq!(seen(*w), [value; WORDS]);
            assert_eq!(tandem_fifo_release(consumer), S::Ok);
        }
        assert_eq!(tandem_fifo_release(consumer), S::NothingToEnd);

        let (writer, reader) = (&raw mut (*o).writer, &raw mut (*o).reader);
        assert_eq!(tandem_newest_publish(writer), S::NothingToEnd);
        assert_eq!(tandem_newest_view(reader, w), S::Empty);
        assert_eq!(tandem_newest_finish(reader, null_mut()), S::NothingToEnd);
        for value in 1..=9 {
            assert_eq!(tandem_newest_loan(writer, w), S::Ok);
            fill(*w, value);
            assert_eq!(tandem_newest_publish(writer), S::Ok);
            assert_eq!(tandem_newest_view(reader, w), S::Ok);
            assert_eq!(seen(*w), [value; WORDS]);
            let mut number = 0;
            assert_eq!(tandem_newest_finish(reader, &raw mut number), S::Ok);
            assert_eq!(number, value - 1);
        }
        assert_eq!(tandem_newest_view(reader, w), S::Ok);
        for _ in 0..SLOTS {
            assert_eq!(tandem_newest_loan(writer, w), S::Ok);
            assert_eq!(tandem_newest_publish(writer), S::Ok);
        }
        assert_eq!(tandem_newest_finish(reader, null_mut()), S::Overrun);
        let mut copy = [0; 2];
        assert_eq!(
            tandem_newest_read(reader, copy.as_mut_ptr(), 2, null_mut()),
            S::Ok
        );

        let (ring, listener) = (&raw mut (*o).ring, &raw mut (*o).listener);
        assert_eq!(tandem_broadcast_send(ring), S::NothingToEnd);
        for value in 0..2 * SLOTS as u32 {
            assert_eq!(tandem_broadcast_loan(ring, w), S::Ok);
            fill(*w, value);
            assert_eq!(tandem_broadcast_send(ring), S::Ok);
        }
        let mut lost = 0;
        assert_eq!(
            tandem_broadcast_receive(listener, w, &raw mut lost),
            S::Overrun
        );
        for value in lost..2 * SLOTS as u32 {
            assert_eq!(tandem_broadcast_receive(listener, w, null_mut()), S::Ok);
            assert_eq!(seen(*w), [value; WORDS]);
            assert_eq!(
                tandem_broadcast_finish(listener, null_mut(), null_mut()),
                S::Ok
            );
        }
        assert_eq!(tandem_broadcast_receive(listener, w, null_mut()), S::Empty);
        assert_eq!(
            tandem_broadcast_finish(listener, null_mut(), null_mut()),
            S::NothingToEnd
        );
    }
    free(o);
}

#[test]
fn words_of_the_pool_are_named_by_handles_that_are_checked() {
    let o = objects();
    let (mut words, mut handle) = (NO_WORDS, TandemHandle { words: [0; 2] });
    let (w, h) = (&raw mut words, &raw mut handle);
    // SAFETY: all pointers are to the fields of `o`, `words` and `handle`.
    unsafe {
        let pool = &raw mut (*o).pool;
        assert_eq!(tandem_pool_get(pool, 0, h), S::Full);
        assert_eq!(tandem_pool_get(pool, 65, h), S::Full);
        assert_eq!(tandem_pool_get(pool, 17, null_mut()), S::BadPointer);
        assert_eq!(
            tandem_pool_free_words(pool),
            64,
            "a refused call borrows nothing"
        );
        assert_eq!(tandem_pool_get(pool, 17, h), S::Ok);
        assert_eq!(tandem_pool_open(pool, *h, w), S::Ok);
        assert_eq!((*w).count, 17);
        fill(*w, 3);
        assert_eq!(tandem_pool_free_words(pool), 32);
        assert_eq!(tandem_pool_hand_over(pool, *h, 3), S::OutOfRange);
        assert_eq!(tandem_pool_hand_over(pool, *h, 2), S::ReceiverDead);
        assert_eq!(tandem_pool_hand_over(pool, *h, 1), S::Ok);
        assert_eq!(tandem_pool_give_back(pool, *h), S::NotOwner);
        assert_eq!(
            tandem_incarnation_mark_dead(&raw const (*o).map, 1, 1),
            S::Ok
        );
        assert_eq!(tandem_pool_reclaim_dead(pool), 32);
        assert_eq!(tandem_pool_give_back(pool, *h), S::Stale);
        let forged = TandemHandle {
            words: [u32::MAX; 2],
        };
        assert_eq!(tandem_pool_open(pool, forged, w), S::Invalid);
    }
    free(o);
}

/// Every function refuses an object that was not attached, and an invalid pointer.
#[test]
fn what_is_not_attached_is_refused() {
    // SAFETY: zero is a value of integers; all pointers are null or to locals.
    unsafe {
        let mut lock = zeroed::<TandemLock>();
        let mut map = zeroed::<TandemMap>();
        let mut layout = zeroed::<TandemLayout>();
        let l = &raw mut lock;
        assert_eq!(tandem_lock_release(l), S::NotAttached);
        assert_eq!(tandem_lock_release(null_mut()), S::BadPointer);
        assert_eq!(tandem_lock_release(l.wrapping_byte_add(1)), S::BadPointer);
        assert_eq!(
            tandem_lock_attach(l, &raw const map, 0, 0, 1),
            S::NotAttached
        );
        assert_eq!(tandem_lock_attach(l, null(), 0, 0, 1), S::BadPointer);
        let region = TandemRegion {
            name: null(),
            words: 1,
        };
        let y = &raw mut layout;
        assert_eq!(tandem_layout_init(y, &raw const region, 1), S::BadPointer);
        let long = TandemRegion {
            name: c"a name that has no end, or nearly".as_ptr(),
            words: 1,
        };
        assert_eq!(tandem_layout_init(y, &raw const long, 1), S::OutOfRange);
        let good = TandemRegion {
            name: c"r".as_ptr(),
            words: 1,
        };
        assert_eq!(tandem_layout_init(y, &raw const good, 1), S::Ok);
        // A layout is not accepted as a map.
        let as_map = y.cast::<TandemMap>();
        assert_eq!(tandem_incarnation_announce(as_map, 0, 1), S::NotAttached);
        let m = &raw mut map;
        assert_eq!(tandem_map_format(m, y, null_mut(), 64), S::BadPointer);
        let mut lmu = zeroed::<Lmu>();
        let base = (&raw mut lmu).cast::<c_void>();
        assert_eq!(tandem_map_attach(m, y, base, LMU_BYTES), S::NotReady);
        assert_eq!(
            tandem_map_format(m, y, base.wrapping_byte_add(4), 4096),
            S::Misaligned
        );
        assert_eq!(tandem_map_format(m, y, base, 64), S::TooSmall);
        assert_eq!(tandem_map_format(m, y, base, LMU_BYTES), S::Ok);
        assert_eq!(tandem_incarnation_announce(m, 3, 1), S::OutOfRange);
        assert_eq!(tandem_incarnation_announce(m, 0, 0), S::OutOfRange);
        assert_eq!(tandem_incarnation_announce(m, 0, 5), S::Ok);
        assert_eq!(tandem_incarnation_announce(m, 0, 4), S::Outdated);
        assert_eq!(tandem_incarnation_current(m, 0), 5);
        assert_eq!(tandem_incarnation_current(m, 3), 0);
        lmu.0[1].store(99, Ordering::Relaxed);
        assert_eq!(tandem_map_attach(m, y, base, LMU_BYTES), S::WrongVersion);
    }
}

/// A flash of two sectors in RAM.
struct Flash([u8; 256]);

unsafe extern "C" fn read(context: *mut c_void, offset: u32, into: *mut u8, count: u32) -> i32 {
    // SAFETY: the context is the pointer passed to the call; `into` has room for `count` bytes.
    unsafe {
        let flash = &*context.cast::<Flash>();
        let (first, count) = (offset as usize, count as usize);
        let Some(bytes) = flash.0.get(first..first + count) else {
            return 1;
        };
        core::ptr::copy_nonoverlapping(bytes.as_ptr(), into, count);
    }
    0
}

/// The next incarnation loads the state that the machine requested to store.
#[test]
fn the_state_goes_through_the_flash_of_c() {
    let mut flash = Flash([0xFF; 256]);
    // SAFETY: zero is a value of integers; all pointers are to locals.
    unsafe {
        let mut store = zeroed::<TandemStore>();
        let mut loaded = zeroed::<TandemLoaded>();
        let mut machine = zeroed::<TandemRedundancy>();
        let mut config = zeroed::<TandemConfig>();
        let mut actions = zeroed::<TandemActions>();
        let mut op = zeroed::<TandemFlashOp>();
        let (s, l, m) = (&raw mut store, &raw mut loaded, &raw mut machine);
        let (c, a) = (&raw mut config, &raw mut actions);
        let context = (&raw mut flash).cast::<c_void>();
        assert_eq!(
            tandem_store_load(s, 100, 0, Some(read), context, l),
            S::OutOfRange
        );
        assert_eq!(
            tandem_store_load(s, 128, 0, None, context, l),
            S::BadPointer
        );
        assert_eq!(tandem_store_load(s, 128, 0, Some(read), context, l), S::Ok);
        assert_eq!((*l).kind, TANDEM_LOADED_BLANK);
        assert_eq!(tandem_config_rt(c), S::Ok);
        assert_eq!(tandem_redundancy_init(m, c, 2, 0, l, 0), S::OutOfRange);
        assert_eq!(
            tandem_redundancy_init(m, c, TANDEM_SYSTEM_A, 4, l, 0),
            S::OutOfRange
        );
        assert_eq!(
            tandem_redundancy_init(m, c, TANDEM_SYSTEM_A, 0, l, 0),
            S::Ok
        );
        let seen = zeroed::<TandemSnapshot>();
        assert_eq!(
            tandem_redundancy_poll(m, 1_000_000, &raw const seen, a),
            S::Ok
        );
        assert_eq!(((*a).persist, (*a).state.total_resets), (1, 1));
        assert_eq!(
            tandem_redundancy_own_fault(m, 2_000_000, 256, a),
            S::OutOfRange
        );
        let words = [0; 4];
        let link = tandem_redundancy_link_report(m, 2_000_000, words.as_ptr(), 4, a);
        assert_eq!(link, S::Invalid);
        assert_eq!(tandem_store_request(s, &raw const (*a).state), S::Ok);
        assert_eq!(tandem_store_is_settled(s), 0);
        assert_eq!(tandem_store_poll(s, 3, &raw mut op), S::OutOfRange);
        assert_eq!(tandem_store_poll(s, TANDEM_FLASH_IDLE, &raw mut op), S::Ok);
        assert_eq!((op.kind, op.offset), (TANDEM_FLASH_PROGRAM, 0));
        flash.0[..32].copy_from_slice(&op.data);
        assert_eq!(tandem_store_poll(s, TANDEM_FLASH_IDLE, &raw mut op), S::Ok);
        assert_eq!(
            (op.kind, tandem_store_is_settled(s)),
            (TANDEM_FLASH_NOTHING, 1)
        );

        let context = (&raw mut flash).cast::<c_void>();
        assert_eq!(tandem_store_load(s, 128, 0, Some(read), context, l), S::Ok);
        assert_eq!((*l).kind, TANDEM_LOADED_STATE);
        assert_eq!((*l).state.total_resets, 1);
    }
}

/// A started machine learns a far term from two reports of the vehicle, but not if a report with a
/// wrong counter and an explained term came between them.
#[test]
fn a_report_with_a_wrong_counter_begins_the_row_anew() {
    for (stale_term, learned) in [(None, 5_001), (Some(5_001), 5_001), (Some(2), 0)] {
        // SAFETY: zero is a value of integers; all pointers are to locals.
        unsafe {
            let mut machine = zeroed::<TandemRedundancy>();
            let mut config = zeroed::<TandemConfig>();
            let mut actions = zeroed::<TandemActions>();
            let loaded = zeroed::<TandemLoaded>();
            let (m, c, a) = (&raw mut machine, &raw mut config, &raw mut actions);
            assert_eq!(tandem_config_rt(c), S::Ok);
            let system = TANDEM_SYSTEM_A;
            let made = tandem_redundancy_init(m, c, system, 0, &raw const loaded, 0);
            assert_eq!(made, S::Ok);
            let echo = || tandem_redundancy_vehicle_term(m, 1_000_000, 5_001, 0, -1, 0, a);
            assert_eq!(echo(), S::Ok);
            if let Some(term) = stale_term {
                let passed = tandem_redundancy_stale_echo(m, 1_000_000, term, a);
                assert_eq!(passed, S::Ok);
            }
            assert_eq!(echo(), S::Ok);
            let term = if (*a).persist == 1 {
                (*a).state.term
            } else {
                0
            };
            assert_eq!(term, learned, "{stale_term:?}");
        }
    }
}
