/*
 * Tandem for firmware in C: the LMU (map, incarnations, lock, mailbox, pool, channels) and the redundancy.
 *
 * Generated from capi/src by `cargo xtask c-header`; do not edit. C99, and C++ by extern "C".
 *
 * Objects are opaque, of known size, and live where the firmware places them: statically, zero at
 * first, and never moved or copied. Nothing is allocated. Each function says its context ("task",
 * or "any": also a handler), whether it blocks, and which statuses it returns besides
 * TANDEM_STATUS_OK. Every function may return TANDEM_STATUS_BAD_POINTER,
 * TANDEM_STATUS_NOT_ATTACHED and, where it is given numbers, TANDEM_STATUS_OUT_OF_RANGE; those that
 * attach something also TANDEM_STATUS_TOO_SMALL. Where nothing else is said, a function may be
 * called from any context.
 *
 * The caller's contract:
 *  1. A pointer is null or points to memory of its type that stays where it is.
 *  2. The LMU stays mapped as long as any object attached to it is used.
 *  3. One object is used by one context of one core at a time.
 *  4. The firmware defines `void tandem_on_panic(void)`, which does not return: it resets the core.
 *
 * Every function relies on it.
 */

#ifndef TANDEM_H
#define TANDEM_H

#include <stddef.h>
#include <stdint.h>

/* A word of the LMU: read and written whole, and seen by other cores. */
typedef volatile uint32_t tandem_word_t;

/* Called inside the library where it found a mistake of its own. Defined by the firmware. */
#ifdef __cplusplus
extern "C" {
#endif
extern void tandem_on_panic(void);
#ifdef __cplusplus
}
#endif

/* Whether a call did what its name says. */
#define TANDEM_DONE(status) ((status) < 16)

/* Words for a region, as constants. `slots` is a power of two, 2 to 65536. */
#define TANDEM_LINES(words) (((words) + 15u) / 16u * 16u)
#define TANDEM_FIFO_SLOT(words)                                 \
    ((words) <= 2u ? 2u : (words) <= 4u ? 4u : (words) <= 8u ? 8u : TANDEM_LINES(words))
#define TANDEM_FIFO_WORDS(slots, slot_words) (16u + (slots) * TANDEM_FIFO_SLOT(1u + (slot_words)))
#define TANDEM_NEWEST_WORDS(slots, slot_words)                  \
    ((slots) * (1u + (slot_words)) < 16u                        \
         ? 1u + (slots) * (1u + (slot_words))                   \
         : 16u + (slots) * TANDEM_LINES(1u + (slot_words)))
#define TANDEM_BROADCAST_WORDS(slots, slot_words)               \
    (((slots) * (1u + (slot_words)) < 16u ? 1u : 16u) + (slots) * (1u + (slot_words)))
#define TANDEM_POOL_WORDS(blocks) (16u + TANDEM_LINES(blocks) + (blocks) * 16u)

// Words of a lock.
#define TANDEM_LOCK_WORDS 16

// Words of a mailbox.
#define TANDEM_MAILBOX_WORDS 64

// Tasks are numbered from 1 to this; 0 is none.
#define TANDEM_MAX_TASK 15

// Cores that share an LMU; they are numbered from 0.
#define TANDEM_CORES 3

// The most regions of a layout.
#define TANDEM_MAX_REGIONS 32

// The longest name of a region, in bytes.
#define TANDEM_MAX_NAME 31

// Words of a block of a pool, the unit in which it lends.
#define TANDEM_BLOCK_WORDS 16

// The most blocks of a pool.
#define TANDEM_MAX_BLOCKS 511

// The power was switched on.
#define TANDEM_CAUSE_POWER_ON 0

// The software asked for the reset.
#define TANDEM_CAUSE_SOFTWARE 1

// A watchdog was not serviced as it must be.
#define TANDEM_CAUSE_WATCHDOG 2

// A core trapped or died.
#define TANDEM_CAUSE_TRAP 3

// Role: not yet in one.
#define TANDEM_ROLE_STARTING 0

// Role: drives the vehicle.
#define TANDEM_ROLE_MASTER 1

// Role: computes silently.
#define TANDEM_ROLE_STANDBY 2

// Role: has failed and stays silent.
#define TANDEM_ROLE_SUSPENDED 3

// Mode: no driving function.
#define TANDEM_MODE_NONE 0

// Mode: automated driving with both systems healthy.
#define TANDEM_MODE_L3 1

// Mode: lane and distance keeping by the system that is left.
#define TANDEM_MODE_DEGRADED_L2 2

// Mode: bringing the vehicle to a stop.
#define TANDEM_MODE_SAFE_STOP 3

// No edge.
#define TANDEM_EDGE_NONE 0

// A rising edge.
#define TANDEM_EDGE_RISING 1

// A falling edge.
#define TANDEM_EDGE_FALLING 2

// No reset.
#define TANDEM_RESET_NONE 0

// An orderly restart.
#define TANDEM_RESET_SOFTWARE 1

// A core of this system does not answer.
#define TANDEM_RESET_CORE_DEAD 2

// Hold the system in reset for good.
#define TANDEM_RESET_SUSPEND 3

// Room for the events of one call.
#define TANDEM_MAX_EVENTS 8

// Words of a report on the link.
#define TANDEM_REPORT_WORDS 4

// System A.
#define TANDEM_SYSTEM_A 0

// System B.
#define TANDEM_SYSTEM_B 1

// Bytes of a record in the flash.
#define TANDEM_RECORD_BYTES 32

// No fault.
#define TANDEM_FAILURE_NONE 0

// Too many abnormal resets in a row.
#define TANDEM_FAILURE_ABNORMAL_RESETS 1

// Nothing is received on a CAN bus that is alive.
#define TANDEM_FAILURE_CAN_OPEN_CIRCUIT 2

// The output driver's diagnosis register reports a fault.
#define TANDEM_FAILURE_IO_MODULE 3

// Core 1 does not answer.
#define TANDEM_FAILURE_PERCEPTION_CORE 4

// Core 2 does not answer.
#define TANDEM_FAILURE_PLANNING_CORE 5

// Control cycles are late again and again.
#define TANDEM_FAILURE_DEADLINE 6

// No mastership term is left.
#define TANDEM_FAILURE_TERMS_EXHAUSTED 7

// Its command is not the one that its own inputs demand, or not the one that reaches the vehicle.
#define TANDEM_FAILURE_WRONG_COMMAND 8

// Its clock has drifted away from the vehicle's and the other system's.
#define TANDEM_FAILURE_CLOCK 9

// Its CAN controller was bus-off.
#define TANDEM_FAILURE_CAN_BUS_OFF 10

// A state was found in the flash.
#define TANDEM_LOADED_STATE 0

// The flash was never written.
#define TANDEM_LOADED_BLANK 1

// There is something in the flash, but no valid record.
#define TANDEM_LOADED_LOST 2

// Nothing is to be started.
#define TANDEM_FLASH_NOTHING 0

// Erase sector `sector`.
#define TANDEM_FLASH_ERASE 1

// Program `data` at `offset`.
#define TANDEM_FLASH_PROGRAM 2

// The flash is ready; its last operation is durable.
#define TANDEM_FLASH_IDLE 0

// An operation is under way.
#define TANDEM_FLASH_BUSY 1

// The last operation failed.
#define TANDEM_FLASH_FAILED 2

// The result of a call. Below 16 the call succeeded; from 16 on it changed nothing.
//
// 16 ..= 31 are expected: try again, or do something else. 32 ..= 47 are caused by another core.
// 48 and above are mistakes of the caller.
enum tandem_status_t
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Done.
  TANDEM_STATUS_OK = 0,
  // The lock is taken, from an owner that died with it: what it guards may be half-changed.
  TANDEM_STATUS_RECOVERED = 1,
  // Signalled, and the receiver may be asleep: ring its doorbell.
  TANDEM_STATUS_RING_NEEDED = 2,
  // Every slot or block is in use.
  TANDEM_STATUS_FULL = 16,
  // There is nothing to receive or to read.
  TANDEM_STATUS_EMPTY = 17,
  // Another core uses it, or the call that runs this handler does.
  TANDEM_STATUS_BUSY = 18,
  // The lock was not free in any of the permitted polls.
  TANDEM_STATUS_TIMED_OUT = 19,
  // The LMU is not formatted yet.
  TANDEM_STATUS_NOT_READY = 20,
  // The other end was faster: what was read is void, or values are lost.
  TANDEM_STATUS_OVERRUN = 21,
  // There is something to handle: do not sleep.
  TANDEM_STATUS_DO_NOT_SLEEP = 22,
  // The words are not an LMU of this library.
  TANDEM_STATUS_WRONG_MAGIC = 32,
  // The LMU was formatted by another version of this library.
  TANDEM_STATUS_WRONG_VERSION = 33,
  // The LMU was formatted by an image with another layout.
  TANDEM_STATUS_WRONG_LAYOUT = 34,
  // A later incarnation of this core is announced, or this one was marked dead: it must stop.
  TANDEM_STATUS_OUTDATED = 35,
  // The words were given back, or reclaimed from a dead owner, since.
  TANDEM_STATUS_STALE = 36,
  // The words belong to another core, or to an earlier incarnation of this one.
  TANDEM_STATUS_NOT_OWNER = 37,
  // The handle or the datagram is not valid: forged or overwritten.
  TANDEM_STATUS_INVALID = 38,
  // The other core is not alive.
  TANDEM_STATUS_RECEIVER_DEAD = 39,
  // A pointer is null or not aligned.
  TANDEM_STATUS_BAD_POINTER = 48,
  // A number is out of its range.
  TANDEM_STATUS_OUT_OF_RANGE = 49,
  // The object was not attached.
  TANDEM_STATUS_NOT_ATTACHED = 50,
  // The memory is smaller than the layout, or the region than what is to live in it.
  TANDEM_STATUS_TOO_SMALL = 51,
  // The memory does not begin at a boundary of 64 bytes.
  TANDEM_STATUS_MISALIGNED = 52,
  // Nothing is lent, held or under way that this call could end.
  TANDEM_STATUS_NOTHING_TO_END = 53,
  // The task id has a handler already.
  TANDEM_STATUS_TAKEN = 54,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum tandem_status_t tandem_status_t;
#else
typedef int32_t tandem_status_t;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// The sending end of a FIFO. There is one at a time. Static, zero at first.
typedef struct tandem_fifo_producer_t {
  // Private.
  size_t opaque[11];
} tandem_fifo_producer_t;

// An LMU that this core is attached to. Static, zero at first; `tandem_map_format` or
// `tandem_map_attach` makes it one.
typedef struct tandem_map_t {
  // Private.
  size_t opaque[8];
} tandem_map_t;

// The words of a slot or of an allocation in the LMU, to be accessed in place. Each word is read
// and written whole.
typedef struct tandem_words_t {
  // The first word.
  tandem_word_t *first;
  // How many words.
  size_t count;
} tandem_words_t;

// The receiving end of a FIFO. There is one at a time. Static, zero at first.
typedef struct tandem_fifo_consumer_t {
  // Private.
  size_t opaque[11];
} tandem_fifo_consumer_t;

// The writing end of a newest-value channel. There is one at a time. Static, zero at first.
typedef struct tandem_newest_writer_t {
  // Private.
  size_t opaque[11];
} tandem_newest_writer_t;

// A reading end of a newest-value channel; any number of them. Static, zero at first.
typedef struct tandem_newest_reader_t {
  // Private.
  size_t opaque[20];
} tandem_newest_reader_t;

// The sending end of a broadcast ring. There is one at a time. Static, zero at first.
typedef struct tandem_broadcast_sender_t {
  // Private.
  size_t opaque[11];
} tandem_broadcast_sender_t;

// A receiving end of a broadcast ring, with its own cursor; any number of them. Static, zero at
// first.
typedef struct tandem_broadcast_receiver_t {
  // Private.
  size_t opaque[11];
} tandem_broadcast_receiver_t;

// Periods and limits of the redundancy; both systems must use the same. Times in microseconds.
// Begin with `tandem_config_rt`, change what must be, and let `tandem_config_check` say whether
// the values still fit together. What each means, and why it has its value, stands in
// `docs/redundancy.md`.
typedef struct tandem_config_t {
  // Time between two heartbeats on each line.
  uint32_t heartbeat_period_us;
  // How many heartbeats in a row must be missing before a line counts as silent.
  uint32_t heartbeat_misses;
  // How much later than due a heartbeat may arrive on top of that.
  uint32_t heartbeat_jitter_us;
  // Longest time between two polls.
  uint32_t poll_interval_us;
  // After how long a silence of both lines the master gives up its standby.
  uint32_t standby_limit_us;
  // Period of the control frames.
  uint32_t control_period_us;
  // How much later than due a control frame may arrive.
  uint32_t control_margin_us;
  // How many periods without a control frame make a master mute.
  uint32_t mute_periods;
  // Time between two handshake edges.
  uint32_t handshake_period_us;
  // How long a system waits at power-on for the other's handshake.
  uint32_t start_limit_us;
  // How much longer B waits than A wherever both might act at once.
  uint32_t stagger_us;
  // How much longer B waits before its sync edge.
  uint32_t sync_stagger_us;
  // How long a standby that has received a handshake waits for the sync edge.
  uint32_t promote_limit_us;
  // How long heartbeats must have been back before the other system counts as recovered.
  uint32_t recover_after_us;
  // Not 0: dual operation resumes at run time when the other system has recovered.
  uint32_t reintegrate;
  // How many abnormal resets in a row are tolerated, 1 ..= 255.
  uint32_t abnormal_limit;
  // Operation without a reset for this long ends a row of abnormal resets.
  uint32_t healthy_after_us;
  // Nothing received on CAN for this long, while the other system reports a live bus, is an open
  // circuit.
  uint32_t can_open_limit_us;
  // Time between two reports over the link.
  uint32_t report_period_us;
  // How long a report of the other system holds.
  uint32_t report_limit_us;
  // Without a status frame of the standby on CAN for this long, a master has no backup.
  uint32_t status_limit_us;
  // For this long after a takeover, a new standby takes over only if the vehicle's report
  // demands it.
  uint32_t hold_down_us;
} tandem_config_t;

// One end of a lock: one for each task that takes it. Static, zero at first.
typedef struct tandem_lock_t {
  // Private.
  size_t opaque[13];
} tandem_lock_t;

// Waits about as long as `spins` spins (1 ..= 64) between two polls of a lock: yields or sleeps.
typedef void (*tandem_relax_t)(void *context, uint32_t spins);

// The sending end of a mailbox. There is one at a time; tasks and handlers of the sending core
// that share it take turns, for example with interrupts disabled. Static, zero at first.
typedef struct tandem_mailbox_sender_t {
  // Private.
  size_t opaque[20];
} tandem_mailbox_sender_t;

// The receiving end of a mailbox with the handlers of its tasks. Static, zero at first.
typedef struct tandem_mailbox_receiver_t {
  // Private.
  size_t opaque[56];
} tandem_mailbox_receiver_t;

// What a task does when it is signalled: `count` signals (at least 1) at once, `value` the newest
// that was sent to it (0 if there never was one). Runs inside `tandem_mailbox_poll`.
typedef void (*tandem_task_t)(void *context, uint32_t task, uint32_t count, uint32_t value);

// A layout of an LMU. Static, zero at first; `tandem_layout_init` makes it one.
typedef struct tandem_layout_t {
  // Private.
  size_t opaque[98];
} tandem_layout_t;

// One region of a layout. Names and sizes, in order, are the same in every image of a system,
// whether in C or in Rust.
typedef struct tandem_region_t {
  // The name: UTF-8, at most `TANDEM_MAX_NAME` bytes.
  const char *name;
  // How many words of 4 bytes are asked for: `TANDEM_LOCK_WORDS`, `TANDEM_FIFO_WORDS(…)`, …
  size_t words;
} tandem_region_t;

// A pool as one incarnation of one core sees it. Static, zero at first.
typedef struct tandem_pool_t {
  // Private.
  size_t opaque[22];
} tandem_pool_t;

// Names words that were lent. Plain data: it may be sent to another core as two words. Every use
// checks it, for it may be stale or forged.
typedef struct tandem_handle_t {
  // Its content.
  uint32_t words[2];
} tandem_handle_t;

// The redundancy of one system. Static, zero at first.
typedef struct tandem_redundancy_t {
  // Private.
  uint64_t opaque[104];
} tandem_redundancy_t;

// What a system knows about itself and the other beyond its own incarnation.
typedef struct tandem_state_t {
  // Not 0: it was master last, or was initialised as master.
  uint32_t is_master;
  // Not 0: this system has failed and stays suspended.
  uint32_t sys_failure;
  // What failed in this system: a `TANDEM_FAILURE_…`.
  uint32_t failure_mode;
  // Not 0: the other system counts as failed.
  uint32_t cpsys_failure;
  // Abnormal resets so far.
  uint32_t abn_resets;
  // Starts so far.
  uint32_t total_resets;
  // Abnormal resets since the last time that this system ran well for long enough, 0 ..= 255.
  uint32_t abn_in_a_row;
  // Incarnations that found their own command wrong, since the last time that this system ran
  // well for long enough, 0 ..= 255.
  uint32_t wrong_in_a_row;
  // The highest mastership term seen or used.
  uint32_t term;
} tandem_state_t;

// The record found in the flash.
typedef struct tandem_loaded_t {
  // A `TANDEM_LOADED_…`.
  uint32_t kind;
  // The state, if `kind` is `TANDEM_LOADED_STATE`.
  struct tandem_state_t state;
} tandem_loaded_t;

// The lines and the CAN receiver at one moment. Counts run on and wrap around; where they begin
// does not matter.
typedef struct tandem_snapshot_t {
  // Rising edges on the start line.
  uint32_t handshakes;
  // Falling edges on the start line.
  uint32_t syncs;
  // Edges of either type on heartbeat line 1 and 2.
  uint32_t beats[2];
  // Not 0: the other system's power level is high.
  uint32_t peer_powered;
  // Valid frames received on CAN from third parties: from neither of the two systems.
  uint32_t can_frames;
} tandem_snapshot_t;

// What the core must do now. Flags are 0 or 1.
typedef struct tandem_actions_t {
  // Send a rising edge on the start line.
  uint32_t handshake;
  // Send a falling edge on the start line, after the handshake if both.
  uint32_t sync;
  // A `TANDEM_EDGE_…` to send on both heartbeat lines.
  uint32_t beat;
  // The output has just opened, or a frame was refused until this poll: send a control frame now
  // (ask `tandem_redundancy_may_transmit`), do not wait for the next cycle.
  uint32_t transmit_now;
  // The output just closed: discard control frames that wait in the transmit buffer.
  uint32_t output_closed;
  // Dual operation begins now in both systems: align the control cycle to it.
  uint32_t synchronised;
  // Write `state` to the flash: hand it to `tandem_store_request`.
  uint32_t persist;
  // The state, if `persist`.
  struct tandem_state_t state;
  // A `TANDEM_RESET_…` to request from the supply as soon as the store is settled.
  uint32_t reset;
  // How many of `events` there are.
  uint32_t event_count;
  // For the trace: kind and two details each.
  uint32_t events[TANDEM_MAX_EVENTS][3];
  // Poll again no later than this, in nanoseconds on the clock of the calls.
  uint64_t deadline_ns;
} tandem_actions_t;

// The content of a control frame that passed its end-to-end protection.
typedef struct tandem_control_frame_t {
  // `TANDEM_SYSTEM_A` or `TANDEM_SYSTEM_B`: the sender.
  uint32_t system;
  // Its mastership term.
  uint32_t term;
  // Its `TANDEM_ROLE_…`.
  uint32_t role;
  // The `TANDEM_MODE_…` that produced the command.
  uint32_t mode;
} tandem_control_frame_t;

// A system's report about itself: over the link every control cycle, and in its status frame.
typedef struct tandem_report_t {
  // Its `TANDEM_ROLE_…`.
  uint32_t role;
  // The `TANDEM_MODE_…` that it runs.
  uint32_t mode;
  // The highest term that it knows.
  uint32_t term;
  // Not 0: it receives frames on CAN.
  uint32_t can_alive;
} tandem_report_t;

// Writes states to two sectors of the flash, one operation at a time, without waiting. Static,
// zero at first.
typedef struct tandem_store_t {
  // Private.
  uint64_t opaque[16];
} tandem_store_t;

// Copies `count` bytes from `offset` of the flash to `into`; returns 0 on success.
typedef int32_t (*tandem_flash_read_t)(void *context, uint32_t offset, uint8_t *into, uint32_t count);

// The next operation on the flash.
typedef struct tandem_flash_op_t {
  // `TANDEM_FLASH_NOTHING`, `TANDEM_FLASH_ERASE` or `TANDEM_FLASH_PROGRAM`.
  uint32_t kind;
  // The number of the sector in the flash.
  uint32_t sector;
  // Bytes from the begin of the flash.
  uint32_t offset;
  // One record.
  uint8_t data[TANDEM_RECORD_BYTES];
} tandem_flash_op_t;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Words of a FIFO of `slots` slots (a power of two, 2 ..= 65536) of `slot_words` words each
// (1 ..= 65536), 2^24 words in all at most; 0 if there can be no such FIFO. `TANDEM_FIFO_WORDS` is
// the same as a constant.
size_t tandem_fifo_words(size_t slots, size_t slot_words);

// Attaches to the FIFO in region `region`, behind what earlier incarnations have sent. Both ends
// must be given the same shape. Task; does not block.
tandem_status_t tandem_fifo_producer_attach(struct tandem_fifo_producer_t *producer,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// Lends the next slot, to be filled in place; its words hold an old value. Nothing is sent before
// `tandem_fifo_send`; until then another loan lends the same slot. Does not block.
//
// `TANDEM_STATUS_FULL`
tandem_status_t tandem_fifo_loan(struct tandem_fifo_producer_t *producer,
                                 struct tandem_words_t *words);

// Sends the value in the slot that was lent. Does not block. Ring the receiver's doorbell, or
// signal it through a mailbox, if it may be asleep.
//
// `TANDEM_STATUS_NOTHING_TO_END` if none was lent.
tandem_status_t tandem_fifo_send(struct tandem_fifo_producer_t *producer);

// Attaches to the FIFO in region `region`, at the oldest value that earlier incarnations have not
// released. Task; does not block.
tandem_status_t tandem_fifo_consumer_attach(struct tandem_fifo_consumer_t *consumer,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// The next value, to be read in place; it stays the next one until `tandem_fifo_release`.
// Does not block.
//
// `TANDEM_STATUS_EMPTY`
tandem_status_t tandem_fifo_receive(struct tandem_fifo_consumer_t *consumer,
                                    struct tandem_words_t *words);

// Frees the slot of the value that was received, for the producer. Does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if none was received.
tandem_status_t tandem_fifo_release(struct tandem_fifo_consumer_t *consumer);

// Words of a channel of `slots` slots (4 are a good number) of `slot_words` words each; ranges as
// `tandem_fifo_words`. `TANDEM_NEWEST_WORDS` is the same as a constant.
size_t tandem_newest_words(size_t slots, size_t slot_words);

// Attaches to the channel in region `region`, after the values of earlier incarnations. All ends
// must be given the same shape. Task; does not block.
tandem_status_t tandem_newest_writer_attach(struct tandem_newest_writer_t *writer,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// Lends the slot of the next value, to be filled in place; its words hold an old value. Nothing is
// published before `tandem_newest_publish`. Does not block.
tandem_status_t tandem_newest_loan(struct tandem_newest_writer_t *writer,
                                   struct tandem_words_t *words);

// Publishes the value in the slot that was lent. Does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if none was lent.
tandem_status_t tandem_newest_publish(struct tandem_newest_writer_t *writer);

// Attaches to the channel in region `region`. Task; does not block.
tandem_status_t tandem_newest_reader_attach(struct tandem_newest_reader_t *reader,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// The newest value, to be read in place. What is read counts only if `tandem_newest_finish`
// returns `TANDEM_STATUS_OK`. Does not block.
//
// `TANDEM_STATUS_EMPTY` if nothing was ever published, `TANDEM_STATUS_OVERRUN` if the writer was
// faster: try again.
tandem_status_t tandem_newest_view(struct tandem_newest_reader_t *reader,
                                   struct tandem_words_t *words);

// Whether all that was read through the last view was one value; its number, counted over all
// incarnations of the writer and wrapping around, goes to `number` (may be NULL). Does not block.
//
// `TANDEM_STATUS_OVERRUN`: discard what was read. `TANDEM_STATUS_NOTHING_TO_END` without a view.
tandem_status_t tandem_newest_finish(struct tandem_newest_reader_t *reader, uint32_t *number);

// Copies the newest value to `into`, as many words as both have, and its number to `number` (may
// be NULL). Tries up to four times; does not block.
//
// `TANDEM_STATUS_EMPTY`, `TANDEM_STATUS_OVERRUN`: the content of `into` is void.
//
// # Safety
// As all functions, for `count` initialised words at `into`.
tandem_status_t tandem_newest_read(struct tandem_newest_reader_t *reader,
                                   uint32_t *into,
                                   size_t count,
                                   uint32_t *number);

// Words of a ring of `slots` slots of `slot_words` words each; ranges as `tandem_fifo_words`.
// `TANDEM_BROADCAST_WORDS` is the same as a constant.
size_t tandem_broadcast_words(size_t slots, size_t slot_words);

// Attaches to the ring in region `region`, after the values of earlier incarnations. All ends must
// be given the same shape. Task; does not block.
tandem_status_t tandem_broadcast_sender_attach(struct tandem_broadcast_sender_t *sender,
                                               const struct tandem_map_t *map,
                                               size_t region,
                                               size_t slots,
                                               size_t slot_words);

// Lends the slot of the next value, to be filled in place; its words hold an old value. Nothing is
// sent before `tandem_broadcast_send`. Does not block.
tandem_status_t tandem_broadcast_loan(struct tandem_broadcast_sender_t *sender,
                                      struct tandem_words_t *words);

// Sends the value in the slot that was lent. Does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if none was lent.
tandem_status_t tandem_broadcast_send(struct tandem_broadcast_sender_t *sender);

// Attaches to the ring in region `region`, to receive what is sent from now on, or with `oldest`
// not 0 the oldest value that is still there first. Task; does not block.
tandem_status_t tandem_broadcast_receiver_attach(struct tandem_broadcast_receiver_t *receiver,
                                                 const struct tandem_map_t *map,
                                                 size_t region,
                                                 size_t slots,
                                                 size_t slot_words,
                                                 uint32_t oldest);

// The next value, to be read in place; what is read counts, and the cursor moves on, only with
// `tandem_broadcast_finish`. Does not block.
//
// `TANDEM_STATUS_EMPTY`; `TANDEM_STATUS_OVERRUN` if values were overwritten before they were
// received: how many goes to `lost` (may be NULL), and the next call continues behind them.
tandem_status_t tandem_broadcast_receive(struct tandem_broadcast_receiver_t *receiver,
                                         struct tandem_words_t *words,
                                         uint32_t *lost);

// Ends the reading: whether all that was read was one value. Its number goes to `number` (may be
// NULL). Does not block.
//
// `TANDEM_STATUS_OVERRUN` as `tandem_broadcast_receive`: discard what was read.
// `TANDEM_STATUS_NOTHING_TO_END` if nothing was received.
tandem_status_t tandem_broadcast_finish(struct tandem_broadcast_receiver_t *receiver,
                                        uint32_t *number,
                                        uint32_t *lost);

// The profile for chips: nothing stalls, and the link reports as often as the heartbeat lines.
//
// # Safety
// 1 of the caller's contract.
tandem_status_t tandem_config_chip(struct tandem_config_t *config);

// The profile for firmware: systems whose timers are late by far less than a millisecond.
tandem_status_t tandem_config_rt(struct tandem_config_t *config);

// Whether the values fit together; else `TANDEM_STATUS_OUT_OF_RANGE`.
tandem_status_t tandem_config_check(const struct tandem_config_t *config);

// Attaches to the lock in region `region`, as incarnation `generation` of core `core`, which was
// announced. A lock that an earlier incarnation held is not released by this: its next owner
// recovers it. Task; does not block.
tandem_status_t tandem_lock_attach(struct tandem_lock_t *lock,
                                   const struct tandem_map_t *map,
                                   size_t region,
                                   uint32_t core,
                                   uint32_t generation);

// Takes the lock, after at most `looks` polls of it (at least 1). `relax` waits between two polls;
// NULL spins. Task; blocks no longer than the polls take.
//
// `TANDEM_STATUS_OK`: taken from an owner that had released it. `TANDEM_STATUS_RECOVERED`: taken
// from one that died with it, repair what it guards. `TANDEM_STATUS_TIMED_OUT`: not taken.
// `TANDEM_STATUS_BUSY`: this end holds it already.
tandem_status_t tandem_lock_acquire(struct tandem_lock_t *lock,
                                    uint32_t looks,
                                    tandem_relax_t relax,
                                    void *context);

// Takes the lock if it is free and no waiting core comes before this one. Any context; does not
// block.
//
// As `tandem_lock_acquire`; `TANDEM_STATUS_BUSY` if another core holds it.
tandem_status_t tandem_lock_try_acquire(struct tandem_lock_t *lock);

// Gives the lock back. Any context; does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if this end does not hold it.
tandem_status_t tandem_lock_release(struct tandem_lock_t *lock);

// Attaches to the mailbox in region `region` as the sending core. Ring the receiver's doorbell
// once afterwards: an earlier incarnation may have died before it did. Task; does not block.
tandem_status_t tandem_mailbox_sender_attach(struct tandem_mailbox_sender_t *sender,
                                             const struct tandem_map_t *map,
                                             size_t region);

// Signals task `task` (1 ..= 15) of the receiving core. What was written to the LMU before is
// visible to its handler; no signal is lost. Task or handler, one at a time: a task that shares
// the sender with a handler keeps the handler away during the call. Does not block.
//
// `TANDEM_STATUS_RING_NEEDED`: signalled; ring the receiver's doorbell now.
tandem_status_t tandem_mailbox_signal(struct tandem_mailbox_sender_t *sender, uint32_t task);

// Signals a task and passes it a value; of several values it gets the newest. Otherwise as
// `tandem_mailbox_signal`.
tandem_status_t tandem_mailbox_signal_with(struct tandem_mailbox_sender_t *sender,
                                           uint32_t task,
                                           uint32_t value);

// How many signals to a task are not handled yet; 0 if an argument is not valid. Any context;
// does not block.
uint32_t tandem_mailbox_open(struct tandem_mailbox_sender_t *sender, uint32_t task);

// Attaches to the mailbox in region `region` as the receiving core, without handlers. Signals that
// an earlier incarnation of this core left open are handled by the first poll. Task; does not
// block.
tandem_status_t tandem_mailbox_receiver_attach(struct tandem_mailbox_receiver_t *receiver,
                                               const struct tandem_map_t *map,
                                               size_t region);

// Gives task `task` (1 ..= 15) a handler, which is called with `context`. Task; does not block.
//
// `TANDEM_STATUS_TAKEN` if it has one, `TANDEM_STATUS_BAD_POINTER` without a handler.
//
// # Safety
// 1 and 3 of the caller's contract; `run` may be called with `context` as long as the receiver is
// polled.
tandem_status_t tandem_mailbox_add_task(struct tandem_mailbox_receiver_t *receiver,
                                        uint32_t task,
                                        tandem_task_t run,
                                        void *context);

// Runs the handlers of the tasks that were signalled, the lowest id first, and writes how many
// signals there were to `signals` (may be NULL). Polls once and is bounded; a
// signal that arrives during the call is left to the next one. Task or handler, always the same;
// does not block.
//
// `TANDEM_STATUS_EMPTY` if there was none.
tandem_status_t tandem_mailbox_poll(struct tandem_mailbox_receiver_t *receiver, uint32_t *signals);

// How many signals named a task without a handler; they count as handled. Task; does not block.
uint32_t tandem_mailbox_unknown(struct tandem_mailbox_receiver_t *receiver);

// Announces that this core is going to sleep: from now on signals need the doorbell. Disable
// interrupts, call this, sleep on `TANDEM_STATUS_OK`, enable them, call `tandem_mailbox_awake`.
// Does not block.
//
// `TANDEM_STATUS_DO_NOT_SLEEP` if signals are open: poll instead.
tandem_status_t tandem_mailbox_prepare_sleep(struct tandem_mailbox_receiver_t *receiver);

// Announces that this core is awake: signals need no doorbell. Does not block.
tandem_status_t tandem_mailbox_awake(struct tandem_mailbox_receiver_t *receiver);

// Makes a layout of `count` regions (1 ..= `TANDEM_MAX_REGIONS`). `layout` must stay where it is
// as long as a map uses it. Task; does not block.
//
// `TANDEM_STATUS_OUT_OF_RANGE` if there are too many regions, a name is too long or no UTF-8, or a
// size is 0 or above 2^24 words.
tandem_status_t tandem_layout_init(struct tandem_layout_t *into,
                                   const struct tandem_region_t *regions,
                                   size_t count);

// Formats an LMU of `bytes` bytes at `base` (a boundary of 64): zeroes it and writes the layout.
// For the boot core or the supply, at power-on, before any other core uses it; a core that is
// reset alone attaches instead. Task; takes as long as writing the LMU.
//
// `TANDEM_STATUS_TOO_SMALL`, `TANDEM_STATUS_MISALIGNED`
//
// # Safety
// 1, 2 and 3 of the caller's contract; `layout` stays where it is.
tandem_status_t tandem_map_format(struct tandem_map_t *map,
                                  const struct tandem_layout_t *layout,
                                  void *base,
                                  size_t bytes);

// Attaches to an LMU that was formatted with the same layout. Task; does not block.
//
// `TANDEM_STATUS_NOT_READY` (try again), `TANDEM_STATUS_WRONG_MAGIC`, `_WRONG_VERSION`,
// `_WRONG_LAYOUT`, `_TOO_SMALL`, `_MISALIGNED`
//
// # Safety
// 1, 2 and 3 of the caller's contract; `layout` stays where it is.
tandem_status_t tandem_map_attach(struct tandem_map_t *map,
                                  const struct tandem_layout_t *layout,
                                  void *base,
                                  size_t bytes);

// The words of region `index` of the layout, rounded up to whole cache lines: for data that this
// library does not know. Any context; does not block.
//
// `TANDEM_STATUS_OUT_OF_RANGE` if there is no such region.
tandem_status_t tandem_map_region(const struct tandem_map_t *map,
                                  size_t index,
                                  struct tandem_words_t *words);

// Announces incarnation number `generation` (1 ..= 2^30 - 1) of core `core` at its start. What an
// earlier incarnation of this core owned is free to be taken over from here on. Task; does not
// block.
//
// `TANDEM_STATUS_OUTDATED` if this incarnation is not the latest, or was marked dead: it must
// stop.
tandem_status_t tandem_incarnation_announce(const struct tandem_map_t *map,
                                            uint32_t core,
                                            uint32_t generation);

// Marks an incarnation as dead: it was seen to end and will not run again. For the supervisor of
// the cores. Any context; does not block.
//
// `TANDEM_STATUS_OUTDATED` if it is not the announced incarnation: there is nothing to mark.
tandem_status_t tandem_incarnation_mark_dead(const struct tandem_map_t *map,
                                             uint32_t core,
                                             uint32_t generation);

// The generation of the living incarnation of a core; 0 if it has not begun, is dead, or an
// argument is not valid. Any context; does not block.
uint32_t tandem_incarnation_current(const struct tandem_map_t *map, uint32_t core);

// Words of a pool of `blocks` blocks (1 ..= `TANDEM_MAX_BLOCKS`); 0 if there can be no such pool.
// `TANDEM_POOL_WORDS` is the same as a constant.
size_t tandem_pool_words(size_t blocks);

// Attaches to the pool of `blocks` blocks in region `region`, as incarnation `generation` of core
// `core`, which was announced. The first attachment of an incarnation frees what earlier
// incarnations of its core own. Task; does not block.
tandem_status_t tandem_pool_attach(struct tandem_pool_t *pool,
                                   const struct tandem_map_t *map,
                                   size_t region,
                                   size_t blocks,
                                   uint32_t core,
                                   uint32_t generation);

// Borrows `count` words; they hold what an earlier owner left. Any context; does not block.
//
// `TANDEM_STATUS_FULL` if no free run of blocks is long enough (or `count` is 0),
// `TANDEM_STATUS_BUSY` if other cores took what this one had found free: try again later.
tandem_status_t tandem_pool_get(struct tandem_pool_t *pool,
                                size_t count,
                                struct tandem_handle_t *handle);

// The words that a handle names, if this incarnation owns them; it owns them until they are given
// back or handed over. Any context; does not block.
//
// `TANDEM_STATUS_STALE`, `TANDEM_STATUS_NOT_OWNER`, `TANDEM_STATUS_INVALID`
tandem_status_t tandem_pool_open(struct tandem_pool_t *pool,
                                 struct tandem_handle_t handle,
                                 struct tandem_words_t *words);

// Gives words back. Any context; does not block.
//
// `TANDEM_STATUS_STALE` (also if they were given back before), `TANDEM_STATUS_NOT_OWNER`,
// `TANDEM_STATUS_INVALID`
tandem_status_t tandem_pool_give_back(struct tandem_pool_t *pool, struct tandem_handle_t handle);

// Makes core `to` the owner. What this core wrote is visible to it when it opens the same handle;
// sending the handle there is the caller's business. Any context; does not block.
//
// As `tandem_pool_give_back`, and `TANDEM_STATUS_RECEIVER_DEAD`: then nothing has changed.
tandem_status_t tandem_pool_hand_over(struct tandem_pool_t *pool,
                                      struct tandem_handle_t handle,
                                      uint32_t to);

// Frees what incarnations that are not alive own, and returns how many words that were.
// `tandem_pool_get` does the same where it needs the words. Any context; bounded.
size_t tandem_pool_reclaim_dead(struct tandem_pool_t *pool);

// How many words are free, in whole blocks, at some moment during the call. Any context; bounded.
size_t tandem_pool_free_words(struct tandem_pool_t *pool);

// Makes the machine of `system` after the checks at power-on. `cause` is a `TANDEM_CAUSE_…`,
// `loaded` what the store found in the flash, `now_ns` the time of the start. Task; does not
// block.
//
// `TANDEM_STATUS_OUT_OF_RANGE` if a number has no meaning, or the configuration does not fit
// together.
tandem_status_t tandem_redundancy_init(struct tandem_redundancy_t *machine,
                                       const struct tandem_config_t *config,
                                       uint32_t system,
                                       uint32_t cause,
                                       const struct tandem_loaded_t *loaded,
                                       uint64_t now_ns);

// Polls the lines; call it each period, and at once when an edge or the power level interrupts.
// Hand over everything from the CAN receiver *before* this. Times must not go back. Any context;
// does not block. The actions are to be carried out.
tandem_status_t tandem_redundancy_poll(struct tandem_redundancy_t *machine,
                                       uint64_t now_ns,
                                       const struct tandem_snapshot_t *snapshot,
                                       struct tandem_actions_t *actions);

// A control frame was received on CAN. Any context; does not block.
tandem_status_t tandem_redundancy_control_frame(struct tandem_redundancy_t *machine,
                                                uint64_t now_ns,
                                                const struct tandem_control_frame_t *frame,
                                                struct tandem_actions_t *actions);

// A status frame of the other system was received on CAN. Any context; does not block.
tandem_status_t tandem_redundancy_status_frame(struct tandem_redundancy_t *machine,
                                               uint64_t now_ns,
                                               const struct tandem_report_t *report,
                                               struct tandem_actions_t *actions);

// A datagram of the other system arrived over the link: `words` of `count` words. Any context;
// does not block.
//
// `TANDEM_STATUS_INVALID` if it is no report.
//
// # Safety
// 1 and 3 of the caller's contract, for `count` words.
tandem_status_t tandem_redundancy_link_report(struct tandem_redundancy_t *machine,
                                              uint64_t now_ns,
                                              const uint32_t *words,
                                              size_t count,
                                              struct tandem_actions_t *actions);

// A control frame was received on CAN whose CRC is right, but whose counter is wrong: frames were
// lost, or its sender has restarted. Only its term counts; do not use its command. Any context;
// does not block.
tandem_status_t tandem_redundancy_stale_frame(struct tandem_redundancy_t *machine,
                                              uint64_t now_ns,
                                              const struct tandem_control_frame_t *frame,
                                              struct tandem_actions_t *actions);

// The vehicle reported which term it obeys: that of the last control frame that it accepted,
// `age_ns` ago; 0 if it has accepted none. It sent the report `on_the_way_ns` ago, at `sent_ms` of
// its own clock, of which the last eight bits count; below 0 if the report has no time. Any
// context; does not block.
tandem_status_t tandem_redundancy_vehicle_term(struct tandem_redundancy_t *machine,
                                               uint64_t now_ns,
                                               uint32_t term,
                                               uint64_t age_ns,
                                               int32_t sent_ms,
                                               uint64_t on_the_way_ns,
                                               struct tandem_actions_t *actions);

// This system found a fault in itself: a `TANDEM_FAILURE_…`. Repeat it while the fault lasts. Any
// context; does not block.
tandem_status_t tandem_redundancy_own_fault(struct tandem_redundancy_t *machine,
                                            uint64_t now_ns,
                                            uint32_t failure,
                                            struct tandem_actions_t *actions);

// 1 if a control frame may be sent now, else 0. Ask right before sending, for every frame, and
// send at once. Any context; does not block.
uint32_t tandem_redundancy_may_transmit(struct tandem_redundancy_t *machine, uint64_t now_ns);

// The `TANDEM_ROLE_…` for the frames; `TANDEM_ROLE_STARTING` if there is no machine. Any context.
uint32_t tandem_redundancy_role(struct tandem_redundancy_t *machine);

// The `TANDEM_MODE_…` to run; a standby computes what the master drives. Any context.
uint32_t tandem_redundancy_mode(struct tandem_redundancy_t *machine);

// The term for control frames; meaningful while the system drives. Any context.
uint32_t tandem_redundancy_term(struct tandem_redundancy_t *machine);

// What to report to the other system now: the datagram for the link goes to `words`
// (`TANDEM_REPORT_WORDS` of them), its content for the status frame to `report`; either may be
// null. Any context; does not block.
//
// # Safety
// 1 and 3 of the caller's contract; `words` has room.
tandem_status_t tandem_redundancy_report(struct tandem_redundancy_t *machine,
                                         uint64_t now_ns,
                                         uint32_t *words,
                                         struct tandem_report_t *report);

// The state that a new system is initialised with: A (0) is master, B (1) is standby.
tandem_status_t tandem_state_factory(struct tandem_state_t *state, uint32_t system);

// Reads both sectors, from number `first_sector` on, of `sector_bytes` bytes each (a multiple of
// `TANDEM_RECORD_BYTES`). At the start of a system; takes as long as reading them.
//
// # Safety
// 1 and 3 of the caller's contract; `read` may be called with `context`.
tandem_status_t tandem_store_load(struct tandem_store_t *store,
                                  uint32_t sector_bytes,
                                  uint32_t first_sector,
                                  tandem_flash_read_t read,
                                  void *context,
                                  struct tandem_loaded_t *loaded);

// Requests that a state be written: the one in the actions of the redundancy. Does not block.
tandem_status_t tandem_store_request(struct tandem_store_t *store,
                                     const struct tandem_state_t *state);

// The operation to start now, given what the flash does (a `TANDEM_FLASH_IDLE`, `_BUSY` or
// `_FAILED`). Start it before the next call, or call `tandem_store_refused`. Does not block.
tandem_status_t tandem_store_poll(struct tandem_store_t *store,
                                  uint32_t flash,
                                  struct tandem_flash_op_t *op);

// The operation of the last poll was not started; the next poll returns it again. Does not block.
tandem_status_t tandem_store_refused(struct tandem_store_t *store);

// 1 if all that was requested is durable, or never will be; else 0. Does not block.
uint32_t tandem_store_is_settled(struct tandem_store_t *store);

// Defined by the firmware: records what it can and resets the core. Must not return.
extern void tandem_on_panic(void);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* TANDEM_H */
