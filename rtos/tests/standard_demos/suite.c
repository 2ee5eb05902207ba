/* What a board gives one suite of FreeRTOS's standard demo tasks. The driver defines its calls. */
#include <stdlib.h>
#include "FreeRTOS.h"
#include "task.h"
#include HEADER
#include "IntQueueTimer.h"

#ifndef TICK
    #define TICK
#endif
#ifndef FIRST
    #define FIRST
    #define SECOND
#endif

/* Raises an interrupt of the core: runner.rs. */
extern void suite_raise( uint8_t number );

void suite_start( void )
{
    START;
}

BaseType_t suite_is_running( void )
{
    return CHECK;
}

void vApplicationTickHook( void )
{
    TICK;
}

/* The handlers of interrupts 1 and 2. The second one is more urgent. */
void suite_first( void )
{
    FIRST;
}

void suite_second( void )
{
    SECOND;
}

/* The tick raises these interrupts. */
void vInitialiseTimerForIntQueueTest( void )
{
}

/* The crate makes the C library's allocator one that tasks can share. */
void * pvPortMalloc( size_t bytes )
{
    return malloc( bytes );
}

void vPortFree( void * place )
{
    free( place );
}
