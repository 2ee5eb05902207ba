# How core 0 and the others leave the bootloader for an image in a slot of the program flash.

    .section .init, "ax"
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
