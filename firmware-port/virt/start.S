# Start-up and trap entry. All harts start here at once; hart 0 prepares the memory, and the others
# wait for it. The board defines REGISTER_BYTES, DOORBELL_CAUSE, STORE, LOAD, PREPARE_DOORBELL, and
# how the others learn of the memory: MEMORY_IS_READY, AWAIT_MEMORY (s0 = hart).

    .equ HARTS, 8
    .equ STACK_SHIFT, 18     # 256 KiB for each hart, as in link.x
    .equ MIE_BIT, 8          # mstatus.MIE
    .equ TIMER_CAUSE, 7
    .equ SSI, 2              # mideleg, mip, mie: supervisor software interrupt

    .section .init, "ax"
    .globl _start
_start:
    .option push
    .option norvc            # four bytes each: an image in a slot finds the second one
    j begin
    j begin_again
    j tandem_rom_verify      # of the boot ROM: see boot_rom.rs
    .option pop
begin:
    csrw mie, zero
    csrci mstatus, MIE_BIT
    csrr s0, mhartid
    li t0, HARTS
    bgeu s0, t0, park
    la t0, trap_vector
    ori t0, t0, 1            # vectored
    csrw mtvec, t0
    # An interrupt that is always pending: delegated so that machine mode never takes it,
    # enabled only in `yield_turn`.
    csrsi mideleg, SSI
    csrsi mip, SSI
    PREPARE_DOORBELL
    addi t0, s0, 1
    slli t0, t0, STACK_SHIFT
    la sp, __stacks
    add sp, sp, t0
    bnez s0, wait_for_memory

    la t0, __bss_start
    la t1, __bss_end
1:  bgeu t0, t1, 2f
    sw zero, 0(t0)
    addi t0, t0, 4
    j 1b
2:  la t0, __carrier_start
    la t1, __carrier_end
6:  bgeu t0, t1, 7f
    sw zero, 0(t0)
    addi t0, t0, 4
    j 6b
7:  fence rw, rw
    MEMORY_IS_READY
    j run

wait_for_memory:
    AWAIT_MEMORY
    fence rw, rw
run:
    mv a0, s0
    call tandem_hart_main
park:
    csrw mie, zero
5:  wfi
    j 5b

# A new incarnation of this hart: a0 = hart. The stack is discarded.
    .globl tandem_restart_hart
tandem_restart_hart:
    la t0, __begin_again     # of the first image, whichever this one is
    jr t0
    .globl begin_again
begin_again:
    csrci mstatus, MIE_BIT
    csrw mie, zero
    mv s0, a0
    # An operating system may have set its own.
    la t0, trap_vector
    ori t0, t0, 1
    csrw mtvec, t0
    addi t0, s0, 1
    slli t0, t0, STACK_SHIFT
    la sp, __stacks
    add sp, sp, t0
    j run

# An image without that service verifies nothing.
    .globl tandem_no_verify
tandem_no_verify:
    li a0, 0
    ret

    .section .text.trap, "ax"
    .align 6
trap_vector:
    .option push
    .option norvc            # four bytes an entry
    .set cause, 0
    .rept 12
    .if cause == DOORBELL_CAUSE
    j on_doorbell_interrupt
    .elseif cause == TIMER_CAUSE
    j on_timer_interrupt
    .else
    j on_exception
    .endif
    .set cause, cause + 1
    .endr
    .option pop

    .macro SAVE
    addi sp, sp, -16 * REGISTER_BYTES
    STORE ra, 0
    STORE t0, 1
    STORE t1, 2
    STORE t2, 3
    STORE a0, 4
    STORE a1, 5
    STORE a2, 6
    STORE a3, 7
    STORE a4, 8
    STORE a5, 9
    STORE a6, 10
    STORE a7, 11
    STORE t3, 12
    STORE t4, 13
    STORE t5, 14
    STORE t6, 15
    .endm

    .macro RESTORE
    LOAD ra, 0
    LOAD t0, 1
    LOAD t1, 2
    LOAD t2, 3
    LOAD a0, 4
    LOAD a1, 5
    LOAD a2, 6
    LOAD a3, 7
    LOAD a4, 8
    LOAD a5, 9
    LOAD a6, 10
    LOAD a7, 11
    LOAD t3, 12
    LOAD t4, 13
    LOAD t5, 14
    LOAD t6, 15
    addi sp, sp, 16 * REGISTER_BYTES
    .endm

on_doorbell_interrupt:
    SAVE
    call tandem_on_doorbell
    RESTORE
    mret

on_timer_interrupt:
    SAVE
    call tandem_on_timer
    RESTORE
    mret

on_exception:
    csrr a0, mcause
    csrr a1, mepc
    csrr a2, mtval
    call tandem_on_exception
6:  wfi
    j 6b
