/* Functions of the Rust side that the kernel calls. */
#ifndef TANDEM_HOOKS_H
#define TANDEM_HOOKS_H

#ifndef __ASSEMBLER__
#include <stdint.h>

/* A failed assertion of the kernel; does not return. */
extern void tandem_assert( const char * file, int line ) __attribute__( ( noreturn ) );
/* A fine, monotonic counter; its unit is the port's. */
extern uint64_t tandem_run_time( void );
/* Null without a sink. */
extern void * volatile tandem_trace_sink;
/* An event of a task. Called with interrupts masked. */
extern void tandem_trace( uint32_t kind, uint32_t task );
/* The kernel no longer needs this task's memory. */
extern void tandem_task_gone( void * task );
#define portCLEAN_UP_TCB( pxTCB )    tandem_task_gone( pxTCB )
#endif

#endif
