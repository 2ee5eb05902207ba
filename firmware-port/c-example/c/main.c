/* Core 2, in C: answers signals, processes data from core 1, shares a lock, and dies while it holds
 * it. Its second incarnation leads a system that is alone. src/main.rs has the same layout. */
#include "board.h"
#include "tandem.h"

enum { CORE = 2, CORE_0 = 0, CORE_1 = 1 };
enum region { FROM_0, TO_0, FROM_1, LOCK, GUARDED, WORK, RESULT, REGIONS };
enum { SLOTS = 4, WORK_WORDS = 16, RESULT_WORDS = 2 };
/* Tasks of this core, and one of core 0. */
enum { PING = 1, COUNT = 2, DIE = 3, LEAD = 4, WORK_THERE = 1, ANSWER = 1 };

static const tandem_region_t LAYOUT[REGIONS] = {
    {"mailbox 0 to 2", TANDEM_MAILBOX_WORDS},
    {"mailbox 2 to 0", TANDEM_MAILBOX_WORDS},
    {"mailbox 1 to 2", TANDEM_MAILBOX_WORDS},
    {"lock", TANDEM_LOCK_WORDS},
    {"guarded", 2},
    {"work 1 to 2", TANDEM_FIFO_WORDS(SLOTS, WORK_WORDS)},
    {"result of 2", TANDEM_NEWEST_WORDS(SLOTS, RESULT_WORDS)},
};

/* All objects of the library: static and initially zero. */
static tandem_layout_t layout;
static tandem_map_t map;
static tandem_mailbox_receiver_t from_0, from_1;
static tandem_mailbox_sender_t to_0;
static tandem_lock_t lock;
static tandem_fifo_consumer_t work;
static tandem_newest_writer_t result;
static tandem_redundancy_t machine;
static tandem_words_t guarded;

/* Which incarnation this is; survives a reset of the core. */
static uint32_t generation __attribute__((section(".kept")));

static void answer(uint32_t value)
{
    tandem_status_t status = tandem_mailbox_signal_with(&to_0, ANSWER, value);
    MUST(TANDEM_DONE(status));
    if (status == TANDEM_STATUS_RING_NEEDED) {
        ring(CORE_0);
    }
}

static void on_ping(void *context, uint32_t task, uint32_t count, uint32_t value)
{
    uint32_t *pings = context;
    MUST(task == PING);
    *pings += count;
    answer(value * 2 + 1);
}

/* Sums up the words of core 1 in their slot, and publishes sum and number: nothing is copied. */
static void on_work(void *context, uint32_t task, uint32_t count, uint32_t value)
{
    static uint32_t done;
    tandem_words_t in, out;
    (void)context;
    (void)task;
    (void)count;
    (void)value;
    while (tandem_fifo_receive(&work, &in) == TANDEM_STATUS_OK) {
        uint32_t sum = 0;
        size_t at;
        MUST(in.count == WORK_WORDS);
        for (at = 0; at < in.count; at++) {
            sum += in.first[at];
        }
        MUST(tandem_fifo_release(&work) == TANDEM_STATUS_OK);
        done += 1;
        MUST(tandem_newest_loan(&result, &out) == TANDEM_STATUS_OK);
        out.first[0] = sum;
        out.first[1] = done;
        MUST(tandem_newest_publish(&result) == TANDEM_STATUS_OK);
    }
}

static void relax(void *context, uint32_t spins)
{
    (void)context;
    (void)spins;
    yield_turn();
}

/* `value` acquisitions of the lock, which guards two words that are always equal. */
static void on_count(void *context, uint32_t task, uint32_t count, uint32_t value)
{
    uint32_t turn;
    (void)context;
    (void)task;
    (void)count;
    for (turn = 0; turn < value; turn++) {
        uint32_t seen;
        MUST(tandem_lock_acquire(&lock, 100000, relax, NULL) == TANDEM_STATUS_OK);
        seen = guarded.first[0];
        MUST(guarded.first[1] == seen);
        guarded.first[0] = seen + 1;
        yield_turn(); /* in the middle of the change, on purpose */
        guarded.first[1] = seen + 1;
        MUST(tandem_lock_release(&lock) == TANDEM_STATUS_OK);
    }
    answer(value);
}

/* Dies while it holds the lock, in the middle of a change: resets itself when core 0 rings. */
static void on_die(void *context, uint32_t task, uint32_t count, uint32_t value)
{
    (void)context;
    (void)task;
    (void)count;
    (void)value;
    if (generation > 1) {
        /* The first incarnation died in this handler, so the same signal arrives again. */
        return;
    }
    MUST(tandem_lock_acquire(&lock, 100000, relax, NULL) == TANDEM_STATUS_OK);
    guarded.first[0] += 1;
    answer(guarded.first[0]);
    clear_doorbell();
    sleep_until_rung();
    clear_doorbell();
    reset_core();
}

/* A system B without an A: leads when no system has answered for long enough. */
static void on_lead(void *context, uint32_t task, uint32_t count, uint32_t value)
{
    tandem_config_t config;
    tandem_loaded_t loaded = {TANDEM_LOADED_BLANK, {0}};
    tandem_snapshot_t seen = {0, 0, {0, 0}, 1, 0};
    tandem_actions_t actions;
    uint64_t now = now_ns();
    uint32_t steps = 0;
    (void)context;
    (void)task;
    (void)count;
    MUST(tandem_config_rt(&config) == TANDEM_STATUS_OK);
    MUST(tandem_redundancy_init(&machine, &config, TANDEM_SYSTEM_B, TANDEM_CAUSE_POWER_ON, &loaded, now)
         == TANDEM_STATUS_OK);
    /* The machine gets the time as an argument, so it may be a future one. */
    do {
        now += 1000000;
        steps += 1;
        MUST(steps <= value);
        MUST(tandem_redundancy_poll(&machine, now, &seen, &actions) == TANDEM_STATUS_OK);
    } while (!actions.transmit_now);
    MUST(tandem_redundancy_role(&machine) == TANDEM_ROLE_MASTER);
    MUST(tandem_redundancy_may_transmit(&machine, now) == 1);
    answer(steps);
}

static void attach(void)
{
    tandem_status_t status;
    MUST(tandem_layout_init(&layout, LAYOUT, REGIONS) == TANDEM_STATUS_OK);
    do {
        yield_turn();
        status = tandem_map_attach(&map, &layout, LMU, LMU_BYTES);
    } while (status == TANDEM_STATUS_NOT_READY);
    MUST(status == TANDEM_STATUS_OK);
    MUST(tandem_incarnation_announce(&map, CORE, generation) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_receiver_attach(&from_0, &map, FROM_0) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_receiver_attach(&from_1, &map, FROM_1) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_sender_attach(&to_0, &map, TO_0) == TANDEM_STATUS_OK);
    MUST(tandem_lock_attach(&lock, &map, LOCK, CORE, generation) == TANDEM_STATUS_OK);
    MUST(tandem_fifo_consumer_attach(&work, &map, WORK, SLOTS, WORK_WORDS) == TANDEM_STATUS_OK);
    MUST(tandem_newest_writer_attach(&result, &map, RESULT, SLOTS, RESULT_WORDS)
         == TANDEM_STATUS_OK);
    MUST(tandem_map_region(&map, GUARDED, &guarded) == TANDEM_STATUS_OK);
}

int main(void)
{
    uint32_t pings = 0;
    generation += 1;
    attach();
    MUST(tandem_mailbox_add_task(&from_0, PING, on_ping, &pings) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_add_task(&from_0, COUNT, on_count, NULL) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_add_task(&from_0, DIE, on_die, NULL) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_add_task(&from_0, LEAD, on_lead, NULL) == TANDEM_STATUS_OK);
    MUST(tandem_mailbox_add_task(&from_1, WORK_THERE, on_work, NULL) == TANDEM_STATUS_OK);
    for (;;) {
        int awake = tandem_mailbox_poll(&from_0, NULL) == TANDEM_STATUS_OK;
        awake |= tandem_mailbox_poll(&from_1, NULL) == TANDEM_STATUS_OK;
        if (!awake && tandem_mailbox_prepare_sleep(&from_0) == TANDEM_STATUS_OK) {
            if (tandem_mailbox_prepare_sleep(&from_1) == TANDEM_STATUS_OK) {
                sleep_until_rung();
                clear_doorbell();
                MUST(tandem_mailbox_awake(&from_1) == TANDEM_STATUS_OK);
            }
            MUST(tandem_mailbox_awake(&from_0) == TANDEM_STATUS_OK);
        }
    }
}
