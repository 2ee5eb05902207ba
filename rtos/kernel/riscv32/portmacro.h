/* The kernel's own port, but a task that is held does not yield: `tandem_exit_critical` does. */
#ifndef TANDEM_PORTMACRO_H
#define TANDEM_PORTMACRO_H

#include_next "portmacro.h"

#ifndef __ASSEMBLER__
/* How often tasks are held by the interface's critical sections; above zero no task is switched
 * to, so this is the running task's. */
extern volatile UBaseType_t tandem_held;
/* A switch is due at the end of the outermost one. */
extern volatile UBaseType_t tandem_yield_due;

/* The kernel's own yield is an exception, which switches at once, even in a critical section. */
#undef portYIELD
#define portYIELD()                        \
    do {                                   \
        if( tandem_held != 0 ) {           \
            tandem_yield_due = 1;          \
        } else {                           \
            __asm volatile ( "ecall" );    \
        }                                  \
    } while( 0 )
#endif

#endif
