/*
 * Tandem for firmware in C: the LMU (map, incarnations, lock, mailbox, pool, channels) and the redundancy.
 *
 * Generated from capi/src by `cargo xtask c-header`; do not edit. C99, and C++ by extern "C".
 *
 * Objects are opaque and have a known size. The firmware provides their memory: static, initially
 * zero, and never moved or copied. Nothing is allocated. The comment of each function states its
 * context ("Tasks only", or "Any context": also handlers), whether it blocks, and the statuses that
 * it returns besides TANDEM_STATUS_OK. Every function may return TANDEM_STATUS_BAD_POINTER and
 * TANDEM_STATUS_NOT_ATTACHED; functions with numbers as arguments also TANDEM_STATUS_OUT_OF_RANGE;
 * functions that attach something also TANDEM_STATUS_TOO_SMALL. A function whose comment states no
 * context may be called from any context.
 *
 * The caller's contract:
 *  1. A pointer is null or points to memory of its type that does not move.
 *  2. The LMU stays mapped as long as any object attached to it is used.
 *  3. One object is used by one context of one core at a time.
 *  4. The firmware defines `void tandem_on_panic(void)`, which does not return: it resets the core.
 *
 * Every function relies on this contract.
 */

#ifndef TANDEM_H
#define TANDEM_H

#include <stddef.h>
#include <stdint.h>

/* A word of the LMU: read and written whole, and seen by other cores. */
typedef volatile uint32_t tandem_word_t;

/* The library calls this function when it finds an internal error. The firmware defines it. */
#ifdef __cplusplus
extern "C" {
#endif
extern void tandem_on_panic(void);
#ifdef __cplusplus
}
#endif

/* Whether a call succeeded. */
#define TANDEM_DONE(status) ((status) < 16)

/* Numbers of words of a region, as constants. `slots` is a power of two, 2 to 65536. */
#define TANDEM_LINES(words) (((words) + 15u) / 16u * 16u)
#define TANDEM_FIFO_SLOT(words)                                 \
    ((words) <= 2u ? 2u : (words) <= 4u ? 4u : (words) <= 8u ? 8u : TANDEM_LINES(words))
#define TANDEM_FIFO_WORDS(slots, slot_words)                    \
    TANDEM_LINES(16u + (slots) * TANDEM_FIFO_SLOT(1u + (slot_words)))
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

// The largest task id. Ids start at 1; 0 means none.
#define TANDEM_MAX_TASK 15

// Cores that share an LMU; they are numbered from 0.
#define TANDEM_CORES 3

// The largest number of regions of a layout.
#define TANDEM_MAX_REGIONS 32

// The maximum length of a region's name, in bytes.
#define TANDEM_MAX_NAME 31

// Words of a block, the unit of a loan.
#define TANDEM_BLOCK_WORDS 16

// The largest number of blocks of a pool.
#define TANDEM_MAX_BLOCKS 511

// The power was switched on.
#define TANDEM_CAUSE_POWER_ON 0

// The software requested the reset.
#define TANDEM_CAUSE_SOFTWARE 1

// A watchdog was not serviced correctly.
#define TANDEM_CAUSE_WATCHDOG 2

// A core trapped or died.
#define TANDEM_CAUSE_TRAP 3

// Role: none yet, the system is starting.
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

// Mode: lane and distance keeping by the remaining system.
#define TANDEM_MODE_DEGRADED_L2 2

// Mode: bringing the vehicle to a stop.
#define TANDEM_MODE_SAFE_STOP 3

// Ability: drives with all sensors.
#define TANDEM_ABILITY_ALL 0

// Ability: drives, but a sensor is missing.
#define TANDEM_ABILITY_LACKS 1

// Ability: can only stop the vehicle.
#define TANDEM_ABILITY_STOP_ONLY 2

// Ability: could only brake.
#define TANDEM_ABILITY_NONE 3

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

// Hold the system in reset permanently.
#define TANDEM_RESET_SUSPEND 3

// The largest number of events of one call.
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

// Control cycles are late repeatedly.
#define TANDEM_FAILURE_DEADLINE 6

// No mastership term is left.
#define TANDEM_FAILURE_TERMS_EXHAUSTED 7

// The system's command does not follow from its inputs, or does not reach the vehicle unchanged.
#define TANDEM_FAILURE_WRONG_COMMAND 8

// The system's clock differs too much from the vehicle's and the other system's.
#define TANDEM_FAILURE_CLOCK 9

// The system's CAN controller was bus-off.
#define TANDEM_FAILURE_CAN_BUS_OFF 10

// The system's scene or plan contradicts the sensors' frames.
#define TANDEM_FAILURE_WRONG_SCENE 11

// The flash holds a state.
#define TANDEM_LOADED_STATE 0

// The flash was never written.
#define TANDEM_LOADED_BLANK 1

// The flash was written, but holds no valid record.
#define TANDEM_LOADED_LOST 2

// There is no operation to start.
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

// The result of a call. Below 16: the call succeeded. From 16 on: the call changed nothing.
//
// 16 ..= 31 are expected: try again, or do something else. 32 ..= 47 are caused by another core.
// Values from 48 on are errors of the caller.
enum tandem_status_t
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // The call succeeded.
  TANDEM_STATUS_OK = 0,
  // The lock is taken, but its last owner died holding it: its data may be half-changed.
  TANDEM_STATUS_RECOVERED = 1,
  // The signal was sent, and the receiver may be asleep: ring its doorbell.
  TANDEM_STATUS_RING_NEEDED = 2,
  // Every slot or block is in use.
  TANDEM_STATUS_FULL = 16,
  // There is nothing to receive or to read.
  TANDEM_STATUS_EMPTY = 17,
  // Another core, or the call that runs this handler, is using the object.
  TANDEM_STATUS_BUSY = 18,
  // The lock could not be taken within the permitted number of polls.
  TANDEM_STATUS_TIMED_OUT = 19,
  // The LMU is not formatted yet.
  TANDEM_STATUS_NOT_READY = 20,
  // The other end overwrote values: the words that were read are not valid, or values were lost.
  TANDEM_STATUS_OVERRUN = 21,
  // Signals are not handled yet: do not sleep.
  TANDEM_STATUS_DO_NOT_SLEEP = 22,
  // The words are not an LMU of this library.
  TANDEM_STATUS_WRONG_MAGIC = 32,
  // Another version of this library formatted the LMU.
  TANDEM_STATUS_WRONG_VERSION = 33,
  // An image with another layout formatted the LMU.
  TANDEM_STATUS_WRONG_LAYOUT = 34,
  // A later incarnation of this core is announced, or this one was marked dead: it must stop.
  TANDEM_STATUS_OUTDATED = 35,
  // The words were already given back, or reclaimed from a dead owner.
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
  // The object is not attached.
  TANDEM_STATUS_NOT_ATTACHED = 50,
  // The memory is smaller than the layout, or the region is too small for the object.
  TANDEM_STATUS_TOO_SMALL = 51,
  // The memory is not aligned to 64 bytes.
  TANDEM_STATUS_MISALIGNED = 52,
  // There is no loan, lock or read for this call to end.
  TANDEM_STATUS_NOTHING_TO_END = 53,
  // The task id already has a handler.
  TANDEM_STATUS_TAKEN = 54,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum tandem_status_t tandem_status_t;
#else
typedef int32_t tandem_status_t;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// The sending end of a FIFO. Each FIFO has one. Must be static and initially zero.
typedef struct tandem_fifo_producer_t {
  // Private.
  size_t opaque[11];
} tandem_fifo_producer_t;

// An LMU that this core is attached to. Must be static and initially zero; `tandem_map_format` or
// `tandem_map_attach` initialises it.
typedef struct tandem_map_t {
  // Private.
  size_t opaque[8];
} tandem_map_t;

// The words of a slot or of an allocation in the LMU, which the caller accesses in place. Read and
// write each word as a whole.
typedef struct tandem_words_t {
  // The first word.
  tandem_word_t *first;
  // The number of words.
  size_t count;
} tandem_words_t;

// The receiving end of a FIFO. Each FIFO has one. Must be static and initially zero.
typedef struct tandem_fifo_consumer_t {
  // Private.
  size_t opaque[11];
} tandem_fifo_consumer_t;

// Writing end of a newest-value channel. Each channel has one. Must be static and initially zero.
typedef struct tandem_newest_writer_t {
  // Private.
  size_t opaque[11];
} tandem_newest_writer_t;

// Reading end of a newest-value channel, one of any number. Must be static and initially zero.
typedef struct tandem_newest_reader_t {
  // Private.
  size_t opaque[20];
} tandem_newest_reader_t;

// The sending end of a broadcast ring. Each ring has one. Must be static and initially zero.
typedef struct tandem_broadcast_sender_t {
  // Private.
  size_t opaque[11];
} tandem_broadcast_sender_t;

// A receiving end of a broadcast ring, with its own cursor; there may be any number. Must be
// static and initially zero.
typedef struct tandem_broadcast_receiver_t {
  // Private.
  size_t opaque[11];
} tandem_broadcast_receiver_t;

// Periods and limits of the redundancy; both systems must use the same values. Times are in
// microseconds. Start with `tandem_config_rt`, change the values that differ, and check with
// `tandem_config_check` that they still fit together. `docs/redundancy.md` explains each value and
// the reason for it.
typedef struct tandem_config_t {
  // Time between two heartbeats on each line.
  uint32_t heartbeat_period_us;
  // Number of consecutive missing heartbeats after which a line counts as silent.
  uint32_t heartbeat_misses;
  // Further delay of a heartbeat that is tolerated.
  uint32_t heartbeat_jitter_us;
  // Longest time between two polls.
  uint32_t poll_interval_us;
  // Silence of both lines after which the master counts its standby as failed.
  uint32_t standby_limit_us;
  // Period of the control frames.
  uint32_t control_period_us;
  // Delay of a control frame that is tolerated.
  uint32_t control_margin_us;
  // Number of control periods without a control frame or an echo after which a master is mute.
  uint32_t mute_periods;
  // Time between two handshake edges.
  uint32_t handshake_period_us;
  // Longest time that a system waits at power-on for the other system's handshake.
  uint32_t start_limit_us;
  // Additional time that B waits when both systems might act at the same time.
  uint32_t stagger_us;
  // Additional time that B waits before its sync edge.
  uint32_t sync_stagger_us;
  // Longest time that a standby that has received a handshake waits for the sync edge.
  uint32_t promote_limit_us;
  // Time with heartbeats after which the other system counts as recovered.
  uint32_t recover_after_us;
  // If not 0, dual operation resumes at run time when the other system has recovered.
  uint32_t reintegrate;
  // Number of consecutive abnormal resets that are tolerated, 1 ..= 255.
  uint32_t abnormal_limit;
  // Interval without a reset after which the count of consecutive abnormal resets falls by one.
  uint32_t healthy_after_us;
  // Time without a frame on CAN after which the circuit counts as open, if the other system
  // reports a live bus.
  uint32_t can_open_limit_us;
  // Time between two reports over the link.
  uint32_t report_period_us;
  // Time for which a report from the other system is valid.
  uint32_t report_limit_us;
  // Time without a status frame of the standby on CAN after which a master has no backup.
  uint32_t status_limit_us;
  // Time after a change of the driver during which a new standby takes over only if the
  // vehicle's report demands it.
  uint32_t hold_down_us;
} tandem_config_t;

// One end of a lock. Each task that takes the lock has its own. Must be static and initially zero.
typedef struct tandem_lock_t {
  // Private.
  size_t opaque[13];
} tandem_lock_t;

// Waits for about `spins` spins (1 ..= 64) between two polls of a lock. May yield or sleep.
typedef void (*tandem_relax_t)(void *context, uint32_t spins);

// The sending end of a mailbox; each has one. Tasks and handlers of the sending core that share it
// must exclude each other, for example with interrupts off. Must be static and initially zero.
typedef struct tandem_mailbox_sender_t {
  // Private.
  size_t opaque[20];
} tandem_mailbox_sender_t;

// Receiving end of a mailbox with the handlers of its tasks. Must be static and initially zero.
typedef struct tandem_mailbox_receiver_t {
  // Private.
  size_t opaque[56];
} tandem_mailbox_receiver_t;

// The function of a task. `tandem_mailbox_poll` calls it with the number of signals (`count`, at
// least 1) and the newest value that was sent to the task (`value`, 0 if none was sent).
typedef void (*tandem_task_t)(void *context, uint32_t task, uint32_t count, uint32_t value);

// A layout of an LMU. Must be static and initially zero; `tandem_layout_init` initialises it.
typedef struct tandem_layout_t {
  // Private.
  size_t opaque[98];
} tandem_layout_t;

// One region of a layout. Every image of a system, in C or in Rust, must have the same names and
// sizes in the same order.
typedef struct tandem_region_t {
  // The name: UTF-8, at most `TANDEM_MAX_NAME` bytes.
  const char *name;
  // Number of words of 4 bytes: `TANDEM_LOCK_WORDS`, `TANDEM_FIFO_WORDS(…)`, …
  size_t words;
} tandem_region_t;

// A pool as one incarnation of one core sees it. Must be static and initially zero.
typedef struct tandem_pool_t {
  // Private.
  size_t opaque[22];
} tandem_pool_t;

// Identifies words that were lent. It is plain data, which may be sent to another core as two
// words. The library checks it at each use, because it may be stale or forged.
typedef struct tandem_handle_t {
  // The handle as two words.
  uint32_t words[2];
} tandem_handle_t;

// The redundancy of one system. Must be static and initially zero.
typedef struct tandem_redundancy_t {
  // Private.
  uint64_t opaque[128];
} tandem_redundancy_t;

// The state of a system and its view of the other system, which are kept over resets.
typedef struct tandem_state_t {
  // Not 0: this system was the last master, or was initialised as master.
  uint32_t is_master;
  // Not 0: this system has failed and stays suspended.
  uint32_t sys_failure;
  // The fault of this system, a `TANDEM_FAILURE_…`.
  uint32_t failure_mode;
  // Not 0: the other system counts as failed.
  uint32_t cpsys_failure;
  // Total number of abnormal resets.
  uint32_t abn_resets;
  // Total number of starts.
  uint32_t total_resets;
  // Abnormal resets since this system last ran long enough without a fault, 0 ..= 255.
  uint32_t abn_in_a_row;
  // Incarnations that found their own command wrong since this system last ran long enough
  // without a fault, 0 ..= 255.
  uint32_t wrong_in_a_row;
  // The highest mastership term seen or used.
  uint32_t term;
} tandem_state_t;

// The record that was found in the flash.
typedef struct tandem_loaded_t {
  // A `TANDEM_LOADED_…`.
  uint32_t kind;
  // The state, if `kind` is `TANDEM_LOADED_STATE`.
  struct tandem_state_t state;
} tandem_loaded_t;

// The state of the lines and the CAN receiver at one time. Counts only increase, and wrap around;
// they may start at any value.
typedef struct tandem_snapshot_t {
  // Rising edges on the start line.
  uint32_t handshakes;
  // Falling edges on the start line.
  uint32_t syncs;
  // Edges of either type on heartbeat lines 1 and 2.
  uint32_t beats[2];
  // Not 0 if the other system's power level is high.
  uint32_t peer_powered;
  // Valid frames received on CAN that neither of the two systems sent.
  uint32_t can_frames;
} tandem_snapshot_t;

// The actions that the core must carry out now. Flags are 0 or 1.
typedef struct tandem_actions_t {
  // Send a rising edge on the start line.
  uint32_t handshake;
  // Send a falling edge on the start line; if `handshake` is set too, after that edge.
  uint32_t sync;
  // A `TANDEM_EDGE_…` to send on both heartbeat lines.
  uint32_t beat;
  // The output has just opened, or a frame was refused before this poll: if
  // `tandem_redundancy_may_transmit` returns 1, send a control frame now, not in the next cycle.
  uint32_t transmit_now;
  // The output has just closed: discard control frames in the transmit buffer.
  uint32_t output_closed;
  // Dual operation starts now in both systems: align the control cycle to this time.
  uint32_t synchronised;
  // Write `state` to the flash: pass it to `tandem_store_request`.
  uint32_t persist;
  // The state to write, if `persist` is 1.
  struct tandem_state_t state;
  // A `TANDEM_RESET_…` to request from the supply as soon as the store is settled.
  uint32_t reset;
  // Number of valid entries of `events`.
  uint32_t event_count;
  // Events for the trace: each is a kind and two details.
  uint32_t events[TANDEM_MAX_EVENTS][3];
  // Latest time of the next poll, in nanoseconds on the clock of `now_ns`.
  uint64_t deadline_ns;
} tandem_actions_t;

// The content of a control frame that passed its end-to-end protection.
typedef struct tandem_control_frame_t {
  // `TANDEM_SYSTEM_A` or `TANDEM_SYSTEM_B`: the sender.
  uint32_t system;
  // The sender's mastership term.
  uint32_t term;
  // The sender's `TANDEM_ROLE_…`.
  uint32_t role;
  // The `TANDEM_MODE_…` that produced the command.
  uint32_t mode;
} tandem_control_frame_t;

// A system's report about itself, sent over the link every control cycle and in its status frame.
typedef struct tandem_report_t {
  // The `TANDEM_ROLE_…` of the system.
  uint32_t role;
  // The `TANDEM_MODE_…` that it runs.
  uint32_t mode;
  // The highest term that it has seen or used.
  uint32_t term;
  // Not 0 if it receives frames on CAN.
  uint32_t can_alive;
  // The `TANDEM_ABILITY_…` of the system.
  uint32_t ability;
} tandem_report_t;

// The store, which writes states to two sectors of the flash, one operation at a time, without
// waiting. Must be static and initially zero.
typedef struct tandem_store_t {
  // Private.
  uint64_t opaque[16];
} tandem_store_t;

// A function that copies `count` bytes at `offset` of the flash to `into`; returns 0 on success.
typedef int32_t (*tandem_flash_read_t)(void *context, uint32_t offset, uint8_t *into, uint32_t count);

// The next operation on the flash.
typedef struct tandem_flash_op_t {
  // `TANDEM_FLASH_NOTHING`, `TANDEM_FLASH_ERASE` or `TANDEM_FLASH_PROGRAM`.
  uint32_t kind;
  // The number of the sector in the flash.
  uint32_t sector;
  // Offset from the start of the flash, in bytes.
  uint32_t offset;
  // The data of one record.
  uint8_t data[TANDEM_RECORD_BYTES];
} tandem_flash_op_t;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Returns the number of words of a FIFO with `slots` slots (a power of two, 2 ..= 65536) of
// `slot_words` words each (1 ..= 65536), at most 2^24 words in all; 0 if a number is out of range.
// `TANDEM_FIFO_WORDS` computes it as a constant.
size_t tandem_fifo_words(size_t slots, size_t slot_words);

// Attaches the sending end of the FIFO in region `region`. It continues after the values that
// earlier incarnations have sent. Both ends must get the same shape. Tasks only; does not block.
tandem_status_t tandem_fifo_producer_attach(struct tandem_fifo_producer_t *producer,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// Lends the next slot, which the caller fills in place; its words hold an old value. Only
// `tandem_fifo_send` sends it; until then, further calls lend the same slot. Does not block.
//
// `TANDEM_STATUS_FULL` if no slot is free.
tandem_status_t tandem_fifo_loan(struct tandem_fifo_producer_t *producer,
                                 struct tandem_words_t *words);

// Sends the value in the slot that was lent. Does not block. If the receiver may be asleep, ring
// its doorbell or signal it through a mailbox.
//
// `TANDEM_STATUS_NOTHING_TO_END` if no slot was lent.
tandem_status_t tandem_fifo_send(struct tandem_fifo_producer_t *producer);

// Attaches the receiving end of the FIFO in region `region`. It continues with the oldest value
// that earlier incarnations have not released. Tasks only; does not block.
tandem_status_t tandem_fifo_consumer_attach(struct tandem_fifo_consumer_t *consumer,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// Lends the next value, which the caller reads in place. Further calls lend the same value until
// `tandem_fifo_release`. Does not block.
//
// `TANDEM_STATUS_EMPTY`
tandem_status_t tandem_fifo_receive(struct tandem_fifo_consumer_t *consumer,
                                    struct tandem_words_t *words);

// Frees the slot of the received value, so that the producer can reuse it. Does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if no value was received.
tandem_status_t tandem_fifo_release(struct tandem_fifo_consumer_t *consumer);

// Returns the number of words of a channel with `slots` slots (4 if in doubt) of `slot_words`
// words each; ranges as in `tandem_fifo_words`. `TANDEM_NEWEST_WORDS` computes it as a constant.
size_t tandem_newest_words(size_t slots, size_t slot_words);

// Attaches the writing end of the channel in region `region`. It continues after the values of
// earlier incarnations. All ends must get the same shape. Tasks only; does not block.
tandem_status_t tandem_newest_writer_attach(struct tandem_newest_writer_t *writer,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// Lends the slot of the next value, which the caller fills in place; its words hold an old value.
// Only `tandem_newest_publish` publishes it. Does not block.
tandem_status_t tandem_newest_loan(struct tandem_newest_writer_t *writer,
                                   struct tandem_words_t *words);

// Publishes the value in the slot that was lent. Does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if no slot was lent.
tandem_status_t tandem_newest_publish(struct tandem_newest_writer_t *writer);

// Attaches a reading end of the channel in region `region`. Tasks only; does not block.
tandem_status_t tandem_newest_reader_attach(struct tandem_newest_reader_t *reader,
                                            const struct tandem_map_t *map,
                                            size_t region,
                                            size_t slots,
                                            size_t slot_words);

// Lends the newest value, which the caller reads in place. The read is valid only if
// `tandem_newest_finish` returns `TANDEM_STATUS_OK`. Does not block.
//
// `TANDEM_STATUS_EMPTY` if no value was published, `TANDEM_STATUS_OVERRUN` if the writer has
// overwritten it: try again.
tandem_status_t tandem_newest_view(struct tandem_newest_reader_t *reader,
                                   struct tandem_words_t *words);

// Checks that all words read through the last view belong to one value. Writes the value's number
// to `number` (may be NULL): it counts over all incarnations, and wraps. Does not block.
//
// `TANDEM_STATUS_OVERRUN`: discard the words. `TANDEM_STATUS_NOTHING_TO_END` if there is no view.
tandem_status_t tandem_newest_finish(struct tandem_newest_reader_t *reader, uint32_t *number);

// Copies the newest value to `into` (at most `count` words), and its number to `number` (may be
// NULL). Tries up to four times; does not block.
//
// `TANDEM_STATUS_EMPTY` and `TANDEM_STATUS_OVERRUN`: discard the content of `into`.
//
// # Safety
// The caller's contract, for `count` initialised words at `into`.
tandem_status_t tandem_newest_read(struct tandem_newest_reader_t *reader,
                                   uint32_t *into,
                                   size_t count,
                                   uint32_t *number);

// Returns the number of words of a ring with `slots` slots of `slot_words` words each; ranges as
// in `tandem_fifo_words`. `TANDEM_BROADCAST_WORDS` computes it as a constant.
size_t tandem_broadcast_words(size_t slots, size_t slot_words);

// Attaches the sending end of the ring in region `region`. It continues after the values of
// earlier incarnations. All ends must get the same shape. Tasks only; does not block.
tandem_status_t tandem_broadcast_sender_attach(struct tandem_broadcast_sender_t *sender,
                                               const struct tandem_map_t *map,
                                               size_t region,
                                               size_t slots,
                                               size_t slot_words);

// Lends the slot of the next value, which the caller fills in place; its words hold an old value.
// Only `tandem_broadcast_send` sends it. Does not block.
tandem_status_t tandem_broadcast_loan(struct tandem_broadcast_sender_t *sender,
                                      struct tandem_words_t *words);

// Sends the value in the slot that was lent. Does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if no slot was lent.
tandem_status_t tandem_broadcast_send(struct tandem_broadcast_sender_t *sender);

// Attaches a receiving end of the ring in region `region`, for values sent from now on. If
// `oldest` is not 0, starts with the oldest value still in the ring. Tasks only; does not block.
tandem_status_t tandem_broadcast_receiver_attach(struct tandem_broadcast_receiver_t *receiver,
                                                 const struct tandem_map_t *map,
                                                 size_t region,
                                                 size_t slots,
                                                 size_t slot_words,
                                                 uint32_t oldest);

// Lends the next value, which the caller reads in place. Only `tandem_broadcast_finish` confirms
// the read and advances the cursor. Does not block.
//
// `TANDEM_STATUS_EMPTY`; `TANDEM_STATUS_OVERRUN` if values were overwritten before they were
// received: writes how many to `lost` (may be NULL). The next call continues after them.
tandem_status_t tandem_broadcast_receive(struct tandem_broadcast_receiver_t *receiver,
                                         struct tandem_words_t *words,
                                         uint32_t *lost);

// Ends the read and checks that all words belong to one value. Writes its number to `number` (may
// be NULL). Does not block.
//
// `TANDEM_STATUS_OVERRUN` as in `tandem_broadcast_receive`: discard the words.
// `TANDEM_STATUS_NOTHING_TO_END` if no value was received.
tandem_status_t tandem_broadcast_finish(struct tandem_broadcast_receiver_t *receiver,
                                        uint32_t *number,
                                        uint32_t *lost);

// Writes the profile for chips, where no task stalls and reports are as frequent as heartbeats.
//
// # Safety
// Rule 1 of the caller's contract applies.
tandem_status_t tandem_config_chip(struct tandem_config_t *config);

// Writes the profile for firmware, for systems whose timers are late by far less than 1 ms.
tandem_status_t tandem_config_rt(struct tandem_config_t *config);

// Checks that the values fit together; otherwise returns `TANDEM_STATUS_OUT_OF_RANGE`.
tandem_status_t tandem_config_check(const struct tandem_config_t *config);

// Attaches to the lock in region `region`, as incarnation `generation` of core `core`, which must
// be announced. If an earlier incarnation held the lock, it stays held: the next owner recovers
// it. Tasks only; does not block.
tandem_status_t tandem_lock_attach(struct tandem_lock_t *lock,
                                   const struct tandem_map_t *map,
                                   size_t region,
                                   uint32_t core,
                                   uint32_t generation);

// Takes the lock. Polls it at most `looks` times (at least 1). `relax` waits between two polls; if
// it is NULL, spins. Tasks only; blocks no longer than the polls take.
//
// `TANDEM_STATUS_OK`: taken; the last owner had released it. `TANDEM_STATUS_RECOVERED`: taken, but
// the last owner died holding it; repair its data. `TANDEM_STATUS_TIMED_OUT`: not taken.
// `TANDEM_STATUS_BUSY`: this end already holds it.
tandem_status_t tandem_lock_acquire(struct tandem_lock_t *lock,
                                    uint32_t looks,
                                    tandem_relax_t relax,
                                    void *context);

// Takes the lock if it is free and no waiting core has its turn before this core. Any context;
// does not block.
//
// Returns the same as `tandem_lock_acquire`, and `TANDEM_STATUS_BUSY` if the lock was not taken.
tandem_status_t tandem_lock_try_acquire(struct tandem_lock_t *lock);

// Releases the lock. Any context; does not block.
//
// `TANDEM_STATUS_NOTHING_TO_END` if this end does not hold it.
tandem_status_t tandem_lock_release(struct tandem_lock_t *lock);

// Attaches to the mailbox in region `region` as the sending core. Then ring the receiver's
// doorbell once: an earlier incarnation may have died before it rang. Tasks only; does not block.
tandem_status_t tandem_mailbox_sender_attach(struct tandem_mailbox_sender_t *sender,
                                             const struct tandem_map_t *map,
                                             size_t region);

// Signals task `task` (1 ..= 15) of the receiving core. Its handler sees everything that was
// written to the LMU before; no signal is lost. Tasks and handlers, one at a time: a task that
// shares the sender with a handler must disable the handler during the call. Does not block.
//
// `TANDEM_STATUS_RING_NEEDED`: signalled; ring the receiver's doorbell now.
tandem_status_t tandem_mailbox_signal(struct tandem_mailbox_sender_t *sender, uint32_t task);

// Signals a task and passes it a value. If several values are sent before the task runs, it gets
// the newest. Otherwise like `tandem_mailbox_signal`.
tandem_status_t tandem_mailbox_signal_with(struct tandem_mailbox_sender_t *sender,
                                           uint32_t task,
                                           uint32_t value);

// Returns the number of signals to a task that were not handled yet; 0 if an argument is not
// valid. Any context; does not block.
uint32_t tandem_mailbox_open(struct tandem_mailbox_sender_t *sender, uint32_t task);

// Attaches to the mailbox in region `region` as the receiving core, without handlers. The first
// poll handles the signals that an earlier incarnation of this core did not handle. Tasks only;
// does not block.
tandem_status_t tandem_mailbox_receiver_attach(struct tandem_mailbox_receiver_t *receiver,
                                               const struct tandem_map_t *map,
                                               size_t region);

// Adds a handler, called with `context`, for task `task` (1 ..= 15). Tasks only; does not block.
//
// `TANDEM_STATUS_TAKEN` if the task already has one, `TANDEM_STATUS_BAD_POINTER` if `run` is NULL.
//
// # Safety
// Rules 1 and 3 of the caller's contract apply. `run` may be called with `context` as long as the
// receiver is polled.
tandem_status_t tandem_mailbox_add_task(struct tandem_mailbox_receiver_t *receiver,
                                        uint32_t task,
                                        tandem_task_t run,
                                        void *context);

// Runs the handlers of the tasks that were signalled, the lowest id first, and writes the number
// of signals to `signals` (may be NULL). Polls once and is bounded; a signal that arrives after
// its task was handled is left to the next call. One task or handler only; does not block.
//
// `TANDEM_STATUS_EMPTY` if there was no signal.
tandem_status_t tandem_mailbox_poll(struct tandem_mailbox_receiver_t *receiver, uint32_t *signals);

// Returns the number of signals to tasks without a handler. They count as handled. Tasks only;
// does not block.
uint32_t tandem_mailbox_unknown(struct tandem_mailbox_receiver_t *receiver);

// Announces that this core is going to sleep: from now on signals need the doorbell. Disable
// interrupts, call this, sleep if it returns `TANDEM_STATUS_OK`, enable interrupts, and call
// `tandem_mailbox_awake`. Does not block.
//
// `TANDEM_STATUS_DO_NOT_SLEEP` if signals are not handled yet: poll instead.
tandem_status_t tandem_mailbox_prepare_sleep(struct tandem_mailbox_receiver_t *receiver);

// Announces that this core is awake: from now on signals do not need the doorbell. Does not block.
tandem_status_t tandem_mailbox_awake(struct tandem_mailbox_receiver_t *receiver);

// Makes a layout of `count` regions (1 ..= `TANDEM_MAX_REGIONS`) and writes it to `into`, which
// must not move as long as a map uses it. Tasks only; does not block.
//
// `TANDEM_STATUS_OUT_OF_RANGE` if there are too many regions, a name is too long or not UTF-8, or
// a size is 0 or above 2^24 words.
tandem_status_t tandem_layout_init(struct tandem_layout_t *into,
                                   const struct tandem_region_t *regions,
                                   size_t count);

// Formats an LMU of `bytes` bytes at `base` (a multiple of 64): zeroes it and writes the layout.
// The boot core or the supply calls this at power-on, before any other core uses the LMU. If only
// the boot core is reset, it attaches instead. Tasks only; takes the time to write the whole LMU.
//
// `TANDEM_STATUS_TOO_SMALL`, `TANDEM_STATUS_MISALIGNED`
//
// # Safety
// Rules 1, 2 and 3 of the caller's contract apply; `layout` does not move.
tandem_status_t tandem_map_format(struct tandem_map_t *map,
                                  const struct tandem_layout_t *layout,
                                  void *base,
                                  size_t bytes);

// Attaches to an LMU that was formatted with the same layout. Tasks only; does not block.
//
// `TANDEM_STATUS_NOT_READY` (try again), `TANDEM_STATUS_WRONG_MAGIC`, `_WRONG_VERSION`,
// `_WRONG_LAYOUT`, `_TOO_SMALL`, `_MISALIGNED`
//
// # Safety
// Rules 1, 2 and 3 of the caller's contract apply; `layout` does not move.
tandem_status_t tandem_map_attach(struct tandem_map_t *map,
                                  const struct tandem_layout_t *layout,
                                  void *base,
                                  size_t bytes);

// Writes the words of region `index` of the layout, rounded up to whole cache lines, to `words`.
// Use it for the firmware's own data. Any context; does not block.
//
// `TANDEM_STATUS_OUT_OF_RANGE` if there is no such region.
tandem_status_t tandem_map_region(const struct tandem_map_t *map,
                                  size_t index,
                                  struct tandem_words_t *words);

// Announces incarnation number `generation` (1 ..= 2^30 - 1) of core `core`, when it starts. From
// then on other cores may take over objects that an earlier incarnation of this core owned. Tasks
// only; does not block.
//
// `TANDEM_STATUS_OUTDATED` if this incarnation is not the latest, or was marked dead: it must
// stop.
tandem_status_t tandem_incarnation_announce(const struct tandem_map_t *map,
                                            uint32_t core,
                                            uint32_t generation);

// Marks an incarnation as dead. The supervisor of the cores calls this after the incarnation has
// ended. Any context; does not block.
//
// `TANDEM_STATUS_OUTDATED` if it is not the announced incarnation, or is already marked.
tandem_status_t tandem_incarnation_mark_dead(const struct tandem_map_t *map,
                                             uint32_t core,
                                             uint32_t generation);

// Returns the generation of the living incarnation of a core; 0 if there is none, or an argument
// is not valid. Any context; does not block.
uint32_t tandem_incarnation_current(const struct tandem_map_t *map, uint32_t core);

// Returns the number of words of a pool with `blocks` blocks (1 ..= `TANDEM_MAX_BLOCKS`); 0 if it
// is out of range. `TANDEM_POOL_WORDS` computes it as a constant.
size_t tandem_pool_words(size_t blocks);

// Attaches to the pool of `blocks` blocks in region `region`, as incarnation `generation` of core
// `core`, which must be announced. When an incarnation first attaches, this frees the words that
// earlier incarnations of its core own. Tasks only; does not block.
tandem_status_t tandem_pool_attach(struct tandem_pool_t *pool,
                                   const struct tandem_map_t *map,
                                   size_t region,
                                   size_t blocks,
                                   uint32_t core,
                                   uint32_t generation);

// Borrows `count` words, which hold the values of an earlier owner. Any context; does not block.
//
// `TANDEM_STATUS_FULL` if no free run of blocks is long enough (or `count` is 0),
// `TANDEM_STATUS_BUSY` if other cores took the blocks that this core found free: try again later.
tandem_status_t tandem_pool_get(struct tandem_pool_t *pool,
                                size_t count,
                                struct tandem_handle_t *handle);

// Writes the words of a handle to `words`, if this incarnation owns them. It owns them until they
// are given back or handed over. Any context; does not block.
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

// Makes core `to` the owner. The caller then sends it the handle. When that core opens the handle,
// it sees everything that this core wrote. Any context; does not block.
//
// Statuses as for `tandem_pool_give_back`, and `TANDEM_STATUS_RECEIVER_DEAD`: nothing has changed.
tandem_status_t tandem_pool_hand_over(struct tandem_pool_t *pool,
                                      struct tandem_handle_t handle,
                                      uint32_t to);

// Frees all words owned by incarnations that are not alive, and returns how many.
// `tandem_pool_get` does the same when it needs the words. Any context; bounded.
size_t tandem_pool_reclaim_dead(struct tandem_pool_t *pool);

// Returns the number of free words, in whole blocks, counted in one pass. Any context; bounded.
size_t tandem_pool_free_words(struct tandem_pool_t *pool);

// Makes the machine of `system` after the checks at power-on. `cause` is a `TANDEM_CAUSE_…`,
// `loaded` is the record that the store found in the flash, `now_ns` is the time of the start.
// Tasks only; does not block.
//
// `TANDEM_STATUS_OUT_OF_RANGE` if a number is not defined, or the configuration does not fit
// together.
tandem_status_t tandem_redundancy_init(struct tandem_redundancy_t *machine,
                                       const struct tandem_config_t *config,
                                       uint32_t system,
                                       uint32_t cause,
                                       const struct tandem_loaded_t *loaded,
                                       uint64_t now_ns);

// Passes the state of the lines. Call it in each period, and immediately when an edge or the power
// level interrupts. Pass all frames from the CAN receiver *before* this call. `now_ns` must not
// decrease. Carry out the actions. Any context; does not block.
tandem_status_t tandem_redundancy_poll(struct tandem_redundancy_t *machine,
                                       uint64_t now_ns,
                                       const struct tandem_snapshot_t *snapshot,
                                       struct tandem_actions_t *actions);

// Passes a control frame that was received on CAN. Any context; does not block.
tandem_status_t tandem_redundancy_control_frame(struct tandem_redundancy_t *machine,
                                                uint64_t now_ns,
                                                const struct tandem_control_frame_t *frame,
                                                struct tandem_actions_t *actions);

// Passes a status frame of the other system that was received on CAN. Any context; does not block.
tandem_status_t tandem_redundancy_status_frame(struct tandem_redundancy_t *machine,
                                               uint64_t now_ns,
                                               const struct tandem_report_t *report,
                                               struct tandem_actions_t *actions);

// Passes a datagram that arrived from the other system over the link: `count` words at `words`.
// Any context; does not block.
//
// `TANDEM_STATUS_INVALID` if it is not a report.
//
// # Safety
// Rules 1 and 3 of the caller's contract apply, for `count` words.
tandem_status_t tandem_redundancy_link_report(struct tandem_redundancy_t *machine,
                                              uint64_t now_ns,
                                              const uint32_t *words,
                                              size_t count,
                                              struct tandem_actions_t *actions);

// Passes a control frame that was received on CAN with a correct CRC, but a wrong counter: frames
// were lost, or the sender has restarted. The machine uses only its term; do not use its command.
// Any context; does not block.
tandem_status_t tandem_redundancy_stale_frame(struct tandem_redundancy_t *machine,
                                              uint64_t now_ns,
                                              const struct tandem_control_frame_t *frame,
                                              struct tandem_actions_t *actions);

// Passes the vehicle's report about the term that it obeys. `term` is that of the control frame
// that it accepted last, `age_ns` ago; 0 if none. It sent the report `on_the_way_ns` ago, at
// `sent_ms` on its own clock (only the low eight bits count; below 0 if the report has no time).
// Any context; does not block.
tandem_status_t tandem_redundancy_vehicle_term(struct tandem_redundancy_t *machine,
                                               uint64_t now_ns,
                                               uint32_t term,
                                               uint64_t age_ns,
                                               int32_t sent_ms,
                                               uint64_t on_the_way_ns,
                                               struct tandem_actions_t *actions);

// Passes the term of the vehicle's report if its CRC is correct, but its counter is wrong: another
// node may send such reports, so a row of unexplained terms begins anew. Any context; does not
// block.
tandem_status_t tandem_redundancy_stale_echo(struct tandem_redundancy_t *machine,
                                             uint64_t now_ns,
                                             uint32_t term,
                                             struct tandem_actions_t *actions);

// Passes a fault that this system found in itself, a `TANDEM_FAILURE_…`. Call it repeatedly while
// the fault lasts. Any context; does not block.
tandem_status_t tandem_redundancy_own_fault(struct tandem_redundancy_t *machine,
                                            uint64_t now_ns,
                                            uint32_t failure,
                                            struct tandem_actions_t *actions);

// Passes how well this system can drive, a `TANDEM_ABILITY_…`. It holds until the next call;
// `TANDEM_ABILITY_ALL` before the first. Any context; does not block.
tandem_status_t tandem_redundancy_ability(struct tandem_redundancy_t *machine,
                                          uint64_t now_ns,
                                          uint32_t able,
                                          struct tandem_actions_t *actions);

// Returns 1 if a control frame may be sent now, otherwise 0. Call it immediately before sending
// each frame. Any context; does not block.
uint32_t tandem_redundancy_may_transmit(struct tandem_redundancy_t *machine, uint64_t now_ns);

// Returns the `TANDEM_ROLE_…` for frames; `TANDEM_ROLE_STARTING` without a machine. Any context.
uint32_t tandem_redundancy_role(struct tandem_redundancy_t *machine);

// Returns the `TANDEM_MODE_…` to run; a standby computes in the master's mode. Any context.
uint32_t tandem_redundancy_mode(struct tandem_redundancy_t *machine);

// Returns the term for control frames; valid while the system is master. Any context.
uint32_t tandem_redundancy_term(struct tandem_redundancy_t *machine);

// Writes the current report to the other system: the datagram for the link to `words`
// (`TANDEM_REPORT_WORDS` words), its content for the status frame to `report`. Both may be NULL.
// Any context; does not block.
//
// # Safety
// Rules 1 and 3 of the caller's contract apply; `words` has room for `TANDEM_REPORT_WORDS` words.
tandem_status_t tandem_redundancy_report(struct tandem_redundancy_t *machine,
                                         uint64_t now_ns,
                                         uint32_t *words,
                                         struct tandem_report_t *report);

// Writes the initial state of a new system: master for A (0), standby for B (1).
tandem_status_t tandem_state_factory(struct tandem_state_t *state, uint32_t system);

// Reads the record from two sectors, `first_sector` and the next one, of `sector_bytes` bytes each
// (a multiple of `TANDEM_RECORD_BYTES`). Call it when the system starts; it reads both sectors.
//
// # Safety
// Rules 1 and 3 of the caller's contract apply; `read` may be called with `context`.
tandem_status_t tandem_store_load(struct tandem_store_t *store,
                                  uint32_t sector_bytes,
                                  uint32_t first_sector,
                                  tandem_flash_read_t read,
                                  void *context,
                                  struct tandem_loaded_t *loaded);

// Requests that the store write the state from the actions of the redundancy. Does not block.
tandem_status_t tandem_store_request(struct tandem_store_t *store,
                                     const struct tandem_state_t *state);

// Writes to `op` the operation to start now. `flash` is a `TANDEM_FLASH_IDLE`, `_BUSY` or
// `_FAILED`. Start it before the next call, or call `tandem_store_refused`. Does not block.
tandem_status_t tandem_store_poll(struct tandem_store_t *store,
                                  uint32_t flash,
                                  struct tandem_flash_op_t *op);

// Reports that the last operation was not started; the next poll returns it again. Does not block.
tandem_status_t tandem_store_refused(struct tandem_store_t *store);

// Returns 1 if every requested state is durable or was given up, otherwise 0. Does not block.
uint32_t tandem_store_is_settled(struct tandem_store_t *store);

// The firmware defines it. It should record the panic and reset the core, and not return.
extern void tandem_on_panic(void);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* TANDEM_H */
