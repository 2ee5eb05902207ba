# From reset to main, for hart 2.

    .section .init, "ax"
    .globl _start
_start:
    csrw mie, zero
    csrci mstatus, 8
    la t0, trap
    csrw mtvec, t0
    # A sleep that ends at once, see board.c: always pending, never taken.
    csrsi mideleg, 2
    csrsi mip, 2
    la sp, __stack
    la t0, __bss_start
    la t1, __bss_end
1:  bgeu t0, t1, 2f
    sw zero, 0(t0)
    addi t0, t0, 4
    j 1b
2:  call main
3:  wfi
    j 3b

    .align 2
trap:
    csrr a0, mcause
    csrr a1, mepc
    call on_trap
    j 3b
