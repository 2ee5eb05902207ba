/* FreeRTOS with its own POSIX port, in a separate program: our port defines the same symbols.
 *
 * freertos-posix switch|tick|interrupt SAMPLES
 *
 * Writes SAMPLES times of 64 bits to standard output, in ticks of the processor's counter that
 * clock.rs reads (nanoseconds of CLOCK_MONOTONIC where there is none):
 *   switch     the time of each yield, from its call in one task to its end in the other
 *   tick       how late the task woke: time since its last wake-up minus a period, in nanoseconds
 *   interrupt  from the tick's hook in the interrupt to the task that the tick woke
 */
#define _GNU_SOURCE
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "FreeRTOS.h"
#include "task.h"

static uint64_t * samples;
static size_t wanted;
static size_t taken;
static volatile uint64_t stamp;

static uint64_t now_ns( void )
{
    struct timespec now;
    clock_gettime( CLOCK_MONOTONIC, &now );
    return ( uint64_t ) now.tv_sec * 1000000000u + ( uint64_t ) now.tv_nsec;
}

static inline uint64_t ticks( void )
{
#if defined( __x86_64__ )
    __builtin_ia32_lfence();
    return __builtin_ia32_rdtsc();
#else
    return now_ns();
#endif
}

/* Keeps a sample. When there are enough, writes them to a file in memory (one write is enough for
 * it) and exits without stopping the port, because stopping is not measured. */
static void take( uint64_t sample )
{
    if( taken == wanted ) {
        const size_t size = wanted * sizeof( *samples );
        _exit( write( 1, samples, size ) != ( ssize_t ) size );
    }
    samples[ taken++ ] = sample;
}

static void yielder( void * unused )
{
    ( void ) unused;
    for( ; ; ) {
        uint64_t began = stamp;
        if( began != 0 ) {
            take( ticks() - began );
        }
        stamp = ticks();
        taskYIELD();
    }
}

static void periodic( void * unused )
{
    TickType_t wake = xTaskGetTickCount();
    uint64_t last = 0;
    ( void ) unused;
    for( ; ; ) {
        vTaskDelayUntil( &wake, 1 );
        uint64_t woke = now_ns();
        if( last != 0 ) {
            uint64_t due = last + 1000000u;
            take( woke > due ? woke - due : 0 );
        }
        last = woke;
    }
}

static void interrupted( void * unused )
{
    TickType_t wake = xTaskGetTickCount();
    ( void ) unused;
    for( ; ; ) {
        vTaskDelayUntil( &wake, 1 );
        take( ticks() - stamp );
    }
}

void vApplicationTickHook( void )
{
    extern volatile int stamp_ticks;
    if( stamp_ticks ) {
        stamp = ticks();
    }
}

volatile int stamp_ticks;

/* Sleeps until the tick's signal, as our idle task does. */
void vApplicationIdleHook( void )
{
    pause();
}

int main( int count, char ** words )
{
    TaskFunction_t measured;
    if( count != 3 ) {
        return 2;
    }
    wanted = strtoul( words[ 2 ], NULL, 10 );
    samples = calloc( wanted + 1, sizeof( *samples ) );
    if( samples == NULL ) {
        return 1;
    }
    if( strcmp( words[ 1 ], "switch" ) == 0 ) {
        measured = yielder;
        xTaskCreate( yielder, "other", configMINIMAL_STACK_SIZE, NULL, 2, NULL );
    } else if( strcmp( words[ 1 ], "tick" ) == 0 ) {
        measured = periodic;
    } else if( strcmp( words[ 1 ], "interrupt" ) == 0 ) {
        measured = interrupted;
        stamp_ticks = 1;
    } else {
        return 2;
    }
    xTaskCreate( measured, "measured", configMINIMAL_STACK_SIZE, NULL, 2, NULL );
    vTaskStartScheduler();
    return 1;
}
