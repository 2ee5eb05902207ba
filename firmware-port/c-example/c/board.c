/* QEMU's riscv32 virt machine: doorbell, clock, log, end. */
#include "board.h"
#include "tandem.h"

#define OWN_HART 2u
#define MSIP ((volatile uint32_t *)0x02000000u)
#define MTIME ((volatile uint32_t *)0x0200BFF8u)
#define UART ((volatile uint8_t *)0x10000000u)
#define TEST_DEVICE ((volatile uint32_t *)0x00100000u)
#define NS_PER_TICK 100u

extern void _start(void);
void on_trap(uint32_t cause, uint32_t at);

uint64_t now_ns(void)
{
    uint32_t high, low;
    do {
        high = MTIME[1];
        low = MTIME[0];
    } while (high != MTIME[1]);
    return ((uint64_t)high << 32 | low) * NS_PER_TICK;
}

void ring(uint32_t core)
{
    /* Memory first, then the device. */
    __asm__ volatile("fence rw, rw" ::: "memory");
    MSIP[core] = 1;
}

void clear_doorbell(void)
{
    MSIP[OWN_HART] = 0;
    __asm__ volatile("fence rw, rw" ::: "memory");
}

void sleep_until_rung(void)
{
    uint32_t pending;
    __asm__ volatile("csrsi mie, 8" ::: "memory");
    do {
        __asm__ volatile("wfi\n\tcsrr %0, mip" : "=r"(pending)::"memory");
    } while ((pending & 8u) == 0);
    __asm__ volatile("csrci mie, 8" ::: "memory");
}

void yield_turn(void)
{
    __asm__ volatile("csrsi mie, 2\n\twfi\n\tcsrci mie, 2" ::: "memory");
}

void reset_core(void)
{
    _start();
}

static void print(const char *text)
{
    for (; *text != 0; text++) {
        *UART = (uint8_t)*text;
    }
}

void fail(const char *file, int line, const char *what)
{
    char digits[8];
    int at = 7;
    digits[at] = 0;
    do {
        at -= 1;
        digits[at] = (char)('0' + line % 10);
        line /= 10;
    } while (line != 0 && at > 0);
    print("core 2: ");
    print(file);
    print(":");
    print(&digits[at]);
    print(": not so: ");
    print(what);
    print("\n");
    *TEST_DEVICE = 103u << 16 | 0x3333u;
    for (;;) {
        yield_turn();
    }
}

void on_trap(uint32_t cause, uint32_t at)
{
    (void)cause;
    (void)at;
    fail("trap", 0, "no exception");
}

/* The library found an internal error. */
void tandem_on_panic(void)
{
    fail("libtandem_capi.a", 0, "no panic");
}
