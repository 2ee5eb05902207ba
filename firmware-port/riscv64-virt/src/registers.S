# What start.S needs from this board: registers of 64 bits, and the doorbell as cause 11 (external).

    .equ REGISTER_BYTES, 8
    .equ DOORBELL_CAUSE, 11
    .equ MISELECT, 0x350
    .equ MIREG, 0x351
    .equ EIDELIVERY, 0x70    # numbers of registers behind MISELECT
    .equ EITHRESHOLD, 0x72
    .equ EIE0, 0xC0

    .macro STORE register, index
    sd \register, 8 * \index(sp)
    .endm

    .macro LOAD register, index
    ld \register, 8 * \index(sp)
    .endm

    .macro SET_INDIRECT number, value
    li t0, \number
    csrw MISELECT, t0
    li t0, \value
    csrw MIREG, t0
    .endm

    # Enables identity 1 in the interrupt file of this hart. A message that came before stays
    # pending.
    .macro PREPARE_DOORBELL
    SET_INDIRECT EITHRESHOLD, 0      # no limit
    SET_INDIRECT EIE0, 1 << 1
    SET_INDIRECT EIDELIVERY, 1
    .endm

    # A word wakes the others: the bell of a hart that does not exist is an access fault.
    .macro MEMORY_IS_READY
    la t0, memory_is_ready
    li t1, 1
    sw t1, 0(t0)
    .endm

    # Under icount each sleep yields the turn to hart 0.
    .macro AWAIT_MEMORY
    la t0, memory_is_ready
3:  csrsi mie, SSI
    wfi
    csrci mie, SSI
    lw t1, 0(t0)
    beqz t1, 3b
    .endm

    # Not in .bss, which hart 0 clears.
    .section .data
    .align 2
memory_is_ready:
    .word 0

