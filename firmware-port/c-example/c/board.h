/* The parts of QEMU's riscv32 virt machine that the core in C uses. */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

/* The LMU of system A; see virt/link.x. */
#define LMU ((void *)0x80800000u)
#define LMU_BYTES 32768u

/* Nanoseconds since the start. */
uint64_t now_ns(void);

/* Rings the doorbell of another core. */
void ring(uint32_t core);

/* Clears the ring of this core's doorbell. */
void clear_doorbell(void);

/* Sleeps until the doorbell has rung. Interrupts are never enabled on this core: the sleep ends when
 * one is pending, so none is missed between a poll and the sleep. */
void sleep_until_rung(void);

/* Yields the emulator's turn to the next hart: call it in every loop that spins. */
void yield_turn(void);

/* Starts the next incarnation of this core, as a reset does. */
void reset_core(void);

/* Writes a line and ends the emulator with a status that is not 0. */
void fail(const char *file, int line, const char *what);

#define MUST(condition)                             \
    do {                                            \
        if (!(condition)) {                         \
            fail(__FILE__, __LINE__, #condition);   \
        }                                           \
    } while (0)

#endif
