# Start-up and trap entry. All harts start here at once; hart 0 prepares the memory, and the others
# sleep until its software interrupt.

    .equ CLINT_MSIP, 0x02000000
    .equ HARTS, 8
    .equ STACK_SHIFT, 18     # 256 KiB for each hart, as in link.x
    .equ MIE_BIT, 8          # mstatus.MIE
    .equ MSI, 8              # mie.MSIE, mip.MSIP
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
    # Wake the others. A store to the register of a hart that does not exist is ignored.
    li t0, CLINT_MSIP
    li t1, 1
    li t2, 1
    li t3, HARTS
3:  slli t4, t1, 2
    add t4, t4, t0
    sw t2, 0(t4)
    addi t1, t1, 1
    bltu t1, t3, 3b
    j run

wait_for_memory:
    csrsi mie, MSI
4:  wfi
    csrr t0, mip
    andi t0, t0, MSI
    beqz t0, 4b
    slli t0, s0, 2
    li t1, CLINT_MSIP
    add t0, t0, t1
    sw zero, 0(t0)
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

# Leaves this image: a0 = hart, a1 = entry. Clears the stack and the registers, and
# fetches the slot's instructions anew after its programming. T-BOOT-7
    .globl tandem_jump
tandem_jump:
    csrci mstatus, MIE_BIT
    csrw mie, zero
    li t1, 1
    slli t1, t1, STACK_SHIFT
    slli t0, a0, STACK_SHIFT
    la t2, __stacks
    add t2, t2, t0
    add t1, t2, t1
8:  bgeu t2, t1, 9f
    sw zero, 0(t2)
    addi t2, t2, 4
    j 8b
9:  fence rw, rw
    .word 0x0000100f         # fence.i
    li ra, 0
    li sp, 0
    li s0, 0
    li s1, 0
    li t0, 0
    li t1, 0
    li t2, 0
    jr a1

# Entry of an image in a slot, for each of its cores; core 0 is first and prepares the memory.
    .section .slot, "ax"
    .globl tandem_slot_start
tandem_slot_start:
    csrw mie, zero
    csrci mstatus, MIE_BIT
    csrr s0, mhartid
    la t0, trap_vector
    ori t0, t0, 1            # vectored
    csrw mtvec, t0
    addi t0, s0, 1
    slli t0, t0, STACK_SHIFT
    la sp, __stacks
    add sp, sp, t0
    beqz s0, 5f              # core 0 of system A
    li t0, 3
    bne s0, t0, 4f           # core 0 of system B
5:  la t0, __data_load
    la t1, __data_start
    la t2, __data_end
1:  bgeu t1, t2, 2f
    lw t3, 0(t0)
    sw t3, 0(t1)
    addi t0, t0, 4
    addi t1, t1, 4
    j 1b
2:  la t0, __bss_start
    la t1, __bss_end
3:  bgeu t0, t1, 4f
    sw zero, 0(t0)
    addi t0, t0, 4
    j 3b
4:  fence rw, rw
    j run

    .section .text.trap, "ax"
    .align 6
trap_vector:
    .option push
    .option norvc            # four bytes an entry
    j on_exception           # 0
    j on_exception
    j on_exception
    j on_software_interrupt  # 3: a doorbell
    j on_exception
    j on_exception
    j on_exception
    j on_timer_interrupt     # 7
    j on_exception
    j on_exception
    j on_exception
    j on_exception           # 11: external, not used
    .option pop

    .macro SAVE
    addi sp, sp, -64
    sw ra, 0(sp)
    sw t0, 4(sp)
    sw t1, 8(sp)
    sw t2, 12(sp)
    sw a0, 16(sp)
    sw a1, 20(sp)
    sw a2, 24(sp)
    sw a3, 28(sp)
    sw a4, 32(sp)
    sw a5, 36(sp)
    sw a6, 40(sp)
    sw a7, 44(sp)
    sw t3, 48(sp)
    sw t4, 52(sp)
    sw t5, 56(sp)
    sw t6, 60(sp)
    .endm

    .macro RESTORE
    lw ra, 0(sp)
    lw t0, 4(sp)
    lw t1, 8(sp)
    lw t2, 12(sp)
    lw a0, 16(sp)
    lw a1, 20(sp)
    lw a2, 24(sp)
    lw a3, 28(sp)
    lw a4, 32(sp)
    lw a5, 36(sp)
    lw a6, 40(sp)
    lw a7, 44(sp)
    lw t3, 48(sp)
    lw t4, 52(sp)
    lw t5, 56(sp)
    lw t6, 60(sp)
    addi sp, sp, 64
    .endm

on_software_interrupt:
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
