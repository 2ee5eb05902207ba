# What start.S needs from this board: registers of 32 bits, the doorbell as cause 3 (software).

    .equ REGISTER_BYTES, 4
    .equ DOORBELL_CAUSE, 3

    .macro STORE register, index
    sw \register, 4 * \index(sp)
    .endm

    .macro LOAD register, index
    lw \register, 4 * \index(sp)
    .endm

    # The CLINT needs no preparation.
    .macro PREPARE_DOORBELL
    .endm

    # The doorbells wake the others. A store to the register of a hart that does not exist is ignored.
    .equ CLINT_MSIP, 0x02000000
    .equ MSI, 8              # mie.MSIE, mip.MSIP

    .macro MEMORY_IS_READY
    li t0, CLINT_MSIP
    li t1, 1
    li t2, 1
    li t3, HARTS
3:  slli t4, t1, 2
    add t4, t4, t0
    sw t2, 0(t4)
    addi t1, t1, 1
    bltu t1, t3, 3b
    .endm

    .macro AWAIT_MEMORY
    csrsi mie, MSI
4:  wfi
    csrr t0, mip
    andi t0, t0, MSI
    beqz t0, 4b
    slli t0, s0, 2
    li t1, CLINT_MSIP
    add t0, t0, t1
    sw zero, 0(t0)
    .endm

