/* Two cores that hand over values through a queue in shared memory; here both are this program.
 * On a chip each core has an image of its own, and the linker places `lmu` where all see it. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "tandem.h"

enum { SLOTS = 4, SLOT_WORDS = 2, SPEEDS = 0 };

static const tandem_region_t regions[] = {
    [SPEEDS] = {"speeds", TANDEM_FIFO_WORDS(SLOTS, SLOT_WORDS)},
};
static uint32_t lmu[1024] __attribute__((aligned(64)));

/* The library calls it if it panics: firmware records that, and resets the core. */
void tandem_on_panic(void)
{
    abort();
}

static void must(tandem_status_t status)
{
    if (status != TANDEM_STATUS_OK) {
        fprintf(stderr, "status %d\n", (int)status);
        exit(1);
    }
}

int main(void)
{
    static tandem_layout_t layout;
    static tandem_map_t boot_core, other_core;
    static tandem_fifo_producer_t producer;
    static tandem_fifo_consumer_t consumer;
    tandem_words_t words;
    uint32_t speed;

    must(tandem_layout_init(&layout, regions, 1));
    /* Core 0 formats the memory; core 1 attaches when it is ready. */
    must(tandem_map_format(&boot_core, &layout, lmu, sizeof lmu));
    must(tandem_incarnation_announce(&boot_core, 0, 1));
    must(tandem_fifo_producer_attach(&producer, &boot_core, SPEEDS, SLOTS, SLOT_WORDS));
    must(tandem_map_attach(&other_core, &layout, lmu, sizeof lmu));
    must(tandem_incarnation_announce(&other_core, 1, 1));
    must(tandem_fifo_consumer_attach(&consumer, &other_core, SPEEDS, SLOTS, SLOT_WORDS));

    for (speed = 1; speed <= 3; speed++) {
        must(tandem_fifo_loan(&producer, &words));
        words.first[0] = speed;
        words.first[1] = 1000 * speed;
        must(tandem_fifo_send(&producer));
    }
    while (tandem_fifo_receive(&consumer, &words) == TANDEM_STATUS_OK) {
        printf("core 1: %u m/s, %u mm/s\n", (unsigned)words.first[0], (unsigned)words.first[1]);
        must(tandem_fifo_release(&consumer));
    }
    return 0;
}
