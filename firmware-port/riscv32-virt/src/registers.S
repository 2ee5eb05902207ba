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

