/* The layout of the test's LMU: the same as in main.rs. */
#ifndef PEER_LAYOUT_H
#define PEER_LAYOUT_H

#include "tandem.h"

enum region { TO_C, FROM_C, LOCK, GUARDED, ORDERS, ANSWERS, NEWEST, RING, POOL, REGIONS };

enum { SLOTS = 4, ORDER_WORDS = 13, ANSWER_WORDS = 48, NEWEST_WORDS = 8, RING_WORDS = 5, BLOCKS = 8 };

static const tandem_region_t LAYOUT[REGIONS] = {
    {"to c", TANDEM_MAILBOX_WORDS},
    {"from c", TANDEM_MAILBOX_WORDS},
    {"lock", TANDEM_LOCK_WORDS},
    {"guarded", 2},
    {"orders", TANDEM_FIFO_WORDS(SLOTS, ORDER_WORDS)},
    {"answers", TANDEM_FIFO_WORDS(SLOTS, ANSWER_WORDS)},
    {"newest", TANDEM_NEWEST_WORDS(SLOTS, NEWEST_WORDS)},
    {"ring", TANDEM_BROADCAST_WORDS(SLOTS, RING_WORDS)},
    {"pool", TANDEM_POOL_WORDS(BLOCKS)},
};

/* Tasks and orders. */
enum { TASK_ORDERS = 1, TASK_ANSWERS = 2 };
enum order {
    ECHO = 1,    /* returns every word times 3 plus 1 */
    COUNT,       /* words[1] rounds under the lock */
    PUBLISH,     /* words[1] values to the newest-value channel */
    BROADCAST,   /* words[1] values to the ring */
    POOL_SWAP,   /* words[1..3] is a handle; returns another one, of the same words reversed */
    DIE_LOCKED,  /* takes the lock, changes half of what it guards, dies */
    RECOVER,     /* takes the lock; returns the status */
    REDUNDANCY,  /* one input to the machine of system B; returns the actions */
    STOP
};

#endif
