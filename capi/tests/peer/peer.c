/* Core 1 in C: a process that shares the LMU with Rust. `peer FILE GENERATION` or `peer check`. */
#define _POSIX_C_SOURCE 200809L

#include "layout.h"

#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

enum { CORE = 1, LMU_BYTES = 32768, HANDED_TO = 0 };

static tandem_layout_t layout;
static tandem_map_t map;
static tandem_lock_t lock;
static tandem_mailbox_sender_t sender;
static tandem_mailbox_receiver_t receiver;
static tandem_fifo_consumer_t orders;
static tandem_fifo_producer_t answers;
static tandem_newest_writer_t newest;
static tandem_broadcast_sender_t ring;
static tandem_pool_t pool;
static tandem_redundancy_t machine;
static tandem_words_t guarded;
static int stopped;

/* The header requires this function. On a host it is never called: a panic ends the process. */
void tandem_on_panic(void)
{
    abort();
}

#define MUST(condition)                                                                  \
    do {                                                                                 \
        if (!(condition)) {                                                              \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition);      \
            exit(3);                                                                     \
        }                                                                                \
    } while (0)
#define OK(call) MUST((call) == TANDEM_STATUS_OK)

/* Yields the CPU to another process, because these cores share CPUs. */
static void relax(void *context, uint32_t spins)
{
    struct timespec span = {0, 20000};
    unsigned *relaxed = context;
    *relaxed += spins;
    nanosleep(&span, NULL);
}

static void count_under_the_lock(uint32_t rounds)
{
    unsigned relaxed = 0;
    uint32_t round;
    for (round = 0; round < rounds; round++) {
        uint32_t one;
        OK(tandem_lock_acquire(&lock, 1000000, relax, &relaxed));
        MUST(tandem_lock_try_acquire(&lock) == TANDEM_STATUS_BUSY);
        one = guarded.first[0];
        MUST(guarded.first[1] == one);
        guarded.first[0] = one + 1;
        guarded.first[1] = one + 1;
        OK(tandem_lock_release(&lock));
    }
    MUST(tandem_lock_release(&lock) == TANDEM_STATUS_NOTHING_TO_END);
}

static void publish(uint32_t values)
{
    uint32_t value;
    MUST(tandem_newest_publish(&newest) == TANDEM_STATUS_NOTHING_TO_END);
    for (value = 1; value <= values; value++) {
        tandem_words_t words;
        size_t at;
        OK(tandem_newest_loan(&newest, &words));
        MUST(words.count == NEWEST_WORDS);
        for (at = 0; at < words.count; at++) {
            words.first[at] = value;
        }
        OK(tandem_newest_publish(&newest));
    }
}

static void broadcast(uint32_t values)
{
    uint32_t value;
    for (value = 1; value <= values; value++) {
        tandem_words_t words;
        size_t at;
        OK(tandem_broadcast_loan(&ring, &words));
        MUST(words.count == RING_WORDS);
        for (at = 0; at < words.count; at++) {
            words.first[at] = value * 7 + (uint32_t)at;
        }
        OK(tandem_broadcast_send(&ring));
    }
}

/* Opens the words that were handed over, copies them reversed into words of its own, hands those
 * over in return, and gives the first ones back. */
static void pool_swap(const uint32_t *order, tandem_word_t *answer)
{
    tandem_handle_t theirs, ours;
    tandem_words_t from, to;
    size_t at;
    theirs.words[0] = order[1];
    theirs.words[1] = order[2];
    OK(tandem_pool_open(&pool, theirs, &from));
    OK(tandem_pool_get(&pool, from.count, &ours));
    OK(tandem_pool_open(&pool, ours, &to));
    MUST(to.count == from.count);
    for (at = 0; at < from.count; at++) {
        to.first[at] = from.first[from.count - 1 - at];
    }
    OK(tandem_pool_hand_over(&pool, ours, HANDED_TO));
    MUST(tandem_pool_open(&pool, ours, &to) == TANDEM_STATUS_NOT_OWNER);
    OK(tandem_pool_give_back(&pool, theirs));
    MUST(tandem_pool_give_back(&pool, theirs) == TANDEM_STATUS_STALE);
    answer[1] = ours.words[0];
    answer[2] = ours.words[1];
}

/* Order: kind of input, low and high word of the time, the input. */
static void redundancy(const uint32_t *order, tandem_word_t *answer)
{
    enum { INIT, POLL, CONTROL_FRAME };
    uint64_t now = (uint64_t)order[3] << 32 | order[2];
    tandem_actions_t actions;
    uint32_t event, word;
    memset(&actions, 0, sizeof actions);
    if (order[1] == INIT) {
        tandem_config_t config;
        tandem_loaded_t loaded;
        memset(&loaded, 0, sizeof loaded);
        loaded.kind = TANDEM_LOADED_BLANK;
        OK(tandem_config_rt(&config));
        OK(tandem_config_check(&config));
        config.heartbeat_misses = 0;
        MUST(tandem_config_check(&config) == TANDEM_STATUS_OUT_OF_RANGE);
        OK(tandem_config_rt(&config));
        OK(tandem_redundancy_init(&machine, &config, TANDEM_SYSTEM_B, TANDEM_CAUSE_POWER_ON, &loaded,
                                  now));
    } else if (order[1] == POLL) {
        tandem_snapshot_t seen;
        seen.handshakes = order[4];
        seen.syncs = order[5];
        seen.beats[0] = order[6];
        seen.beats[1] = order[7];
        seen.peer_powered = order[8];
        seen.can_frames = order[9];
        OK(tandem_redundancy_poll(&machine, now, &seen, &actions));
    } else {
        tandem_control_frame_t frame;
        frame.system = order[4];
        frame.term = order[5];
        frame.role = order[6];
        frame.mode = order[7];
        OK(tandem_redundancy_control_frame(&machine, now, &frame, &actions));
    }
    answer[1] = actions.handshake;
    answer[2] = actions.sync;
    answer[3] = actions.beat;
    answer[4] = actions.transmit_now;
    answer[5] = actions.output_closed;
    answer[6] = actions.synchronised;
    answer[7] = actions.persist;
    answer[8] = actions.persist ? actions.state.term : 0;
    answer[9] = actions.reset;
    answer[10] = (uint32_t)actions.deadline_ns;
    answer[11] = (uint32_t)(actions.deadline_ns >> 32);
    answer[12] = tandem_redundancy_role(&machine);
    answer[13] = tandem_redundancy_mode(&machine);
    answer[14] = tandem_redundancy_term(&machine);
    answer[15] = tandem_redundancy_may_transmit(&machine, now);
    answer[16] = actions.event_count;
    for (event = 0; event < actions.event_count; event++) {
        for (word = 0; word < 3; word++) {
            answer[17 + 3 * event + word] = actions.events[event][word];
        }
    }
}

static void carry_out(const uint32_t *order, tandem_word_t *answer)
{
    size_t at;
    unsigned relaxed = 0;
    answer[0] = order[0];
    switch ((enum order)order[0]) {
    case ECHO:
        for (at = 1; at < ORDER_WORDS - 1; at++) {
            answer[at] = order[at] * 3 + 1;
        }
        break;
    case COUNT:
        count_under_the_lock(order[1]);
        break;
    case PUBLISH:
        publish(order[1]);
        break;
    case BROADCAST:
        broadcast(order[1]);
        break;
    case POOL_SWAP:
        pool_swap(order, answer);
        break;
    case DIE_LOCKED:
        OK(tandem_lock_acquire(&lock, 1000000, relax, &relaxed));
        guarded.first[0] += 1;
        _exit(0);
    case RECOVER:
        answer[1] = (uint32_t)tandem_lock_acquire(&lock, 1000000, relax, &relaxed);
        guarded.first[1] = guarded.first[0];
        OK(tandem_lock_release(&lock));
        break;
    case REDUNDANCY:
        redundancy(order, answer);
        break;
    case STOP:
        stopped = 1;
        break;
    }
}

/* The handler of TASK_ORDERS: copies each order and writes its answer directly into a slot. Signals
   the answer with the order's number, because an order may arrive before its own signal. */
static void on_orders(void *context, uint32_t task, uint32_t count, uint32_t value)
{
    tandem_words_t from, to;
    uint32_t order[ORDER_WORDS];
    size_t at;
    unsigned *calls = context;
    *calls += 1;
    MUST(task == TASK_ORDERS && count >= 1 && value != 0);
    MUST(tandem_mailbox_poll(&receiver, NULL) == TANDEM_STATUS_BUSY);
    while (tandem_fifo_receive(&orders, &from) == TANDEM_STATUS_OK) {
        MUST(from.count == ORDER_WORDS);
        for (at = 0; at < ORDER_WORDS; at++) {
            order[at] = from.first[at];
        }
        while (tandem_fifo_loan(&answers, &to) == TANDEM_STATUS_FULL) {
            unsigned relaxed = 0;
            relax(&relaxed, 1);
        }
        for (at = 0; at < to.count; at++) {
            to.first[at] = 0;
        }
        carry_out(order, to.first);
        OK(tandem_fifo_release(&orders));
        OK(tandem_fifo_send(&answers));
        MUST(TANDEM_DONE(tandem_mailbox_signal_with(&sender, TASK_ANSWERS, order[ORDER_WORDS - 1])));
    }
}

static void attach(void *base, uint32_t generation)
{
    OK(tandem_layout_init(&layout, LAYOUT, REGIONS));
    MUST(tandem_map_attach(&map, &layout, (char *)base + 4, LMU_BYTES - 4) == TANDEM_STATUS_MISALIGNED);
    MUST(tandem_map_attach(&map, &layout, base, 64) == TANDEM_STATUS_TOO_SMALL);
    OK(tandem_map_attach(&map, &layout, base, LMU_BYTES));
    OK(tandem_incarnation_announce(&map, CORE, generation));
    MUST(tandem_incarnation_current(&map, CORE) == generation);
    OK(tandem_lock_attach(&lock, &map, LOCK, CORE, generation));
    OK(tandem_mailbox_sender_attach(&sender, &map, FROM_C));
    OK(tandem_mailbox_receiver_attach(&receiver, &map, TO_C));
    OK(tandem_fifo_consumer_attach(&orders, &map, ORDERS, SLOTS, ORDER_WORDS));
    OK(tandem_fifo_producer_attach(&answers, &map, ANSWERS, SLOTS, ANSWER_WORDS));
    OK(tandem_newest_writer_attach(&newest, &map, NEWEST, SLOTS, NEWEST_WORDS));
    OK(tandem_broadcast_sender_attach(&ring, &map, RING, SLOTS, RING_WORDS));
    OK(tandem_pool_attach(&pool, &map, POOL, BLOCKS, CORE, generation));
    OK(tandem_map_region(&map, GUARDED, &guarded));
    MUST(tandem_map_region(&map, REGIONS, &guarded) == TANDEM_STATUS_OUT_OF_RANGE);
}

/* Checks that the header's constants and the library's functions return the same region sizes. */
static int check(void)
{
    size_t slots, words;
    for (slots = 2; slots <= 64; slots *= 2) {
        for (words = 1; words <= 70; words++) {
            MUST(TANDEM_FIFO_WORDS(slots, words) == tandem_fifo_words(slots, words));
            MUST(TANDEM_NEWEST_WORDS(slots, words) == tandem_newest_words(slots, words));
            MUST(TANDEM_BROADCAST_WORDS(slots, words) == tandem_broadcast_words(slots, words));
        }
    }
    for (words = 1; words <= TANDEM_MAX_BLOCKS; words++) {
        MUST(TANDEM_POOL_WORDS(words) == tandem_pool_words(words));
    }
    MUST(tandem_pool_words(0) == 0 && tandem_pool_words(TANDEM_MAX_BLOCKS + 1) == 0);
    MUST(tandem_fifo_words(3, 1) == 0 && tandem_newest_words(1, 1) == 0);
    MUST(tandem_broadcast_words(2, 0) == 0);

    MUST(tandem_lock_release(&lock) == TANDEM_STATUS_NOT_ATTACHED);
    MUST(tandem_lock_release(NULL) == TANDEM_STATUS_BAD_POINTER);
    MUST(tandem_lock_release((tandem_lock_t *)((char *)&lock + 1)) == TANDEM_STATUS_BAD_POINTER);
    MUST(tandem_lock_attach(&lock, &map, 0, 0, 1) == TANDEM_STATUS_NOT_ATTACHED);
    MUST(tandem_mailbox_poll(&receiver, NULL) == TANDEM_STATUS_NOT_ATTACHED);
    /* An object of another type counts as not attached. */
    OK(tandem_layout_init(&layout, LAYOUT, REGIONS));
    MUST(tandem_mailbox_awake((tandem_mailbox_receiver_t *)(void *)&layout)
         == TANDEM_STATUS_NOT_ATTACHED);
    MUST(tandem_layout_init(&layout, LAYOUT, 0) == TANDEM_STATUS_OUT_OF_RANGE);
    MUST(tandem_layout_init(&layout, LAYOUT, TANDEM_MAX_REGIONS + 1) == TANDEM_STATUS_OUT_OF_RANGE);
    return 0;
}

int main(int argc, char **argv)
{
    unsigned calls = 0;
    int file;
    void *base;
    alarm(120); /* ends a test that hangs */
    if (argc == 2 && strcmp(argv[1], "check") == 0) {
        return check();
    }
    MUST(argc == 3);
    file = open(argv[1], O_RDWR);
    MUST(file >= 0);
    base = mmap(NULL, LMU_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    MUST(base != MAP_FAILED);
    attach(base, (uint32_t)atoi(argv[2]));
    OK(tandem_mailbox_add_task(&receiver, TASK_ORDERS, on_orders, &calls));
    MUST(tandem_mailbox_add_task(&receiver, TASK_ORDERS, on_orders, &calls) == TANDEM_STATUS_TAKEN);
    MUST(tandem_mailbox_add_task(&receiver, 16, on_orders, &calls) == TANDEM_STATUS_OUT_OF_RANGE);
    while (!stopped) {
        unsigned relaxed = 0;
        if (tandem_mailbox_poll(&receiver, NULL) == TANDEM_STATUS_EMPTY) {
            relax(&relaxed, 1);
        }
    }
    MUST(tandem_mailbox_unknown(&receiver) == 0);
    return 0;
}
