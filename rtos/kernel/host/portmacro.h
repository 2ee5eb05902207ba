/* The host port's types and macros; the port itself is src/port/host. */
#ifndef PORTMACRO_H
#define PORTMACRO_H

#include <stdint.h>

typedef uintptr_t StackType_t;
typedef long BaseType_t;
typedef unsigned long UBaseType_t;
typedef uint32_t TickType_t;

#define portSTACK_TYPE             uintptr_t
#define portBASE_TYPE              long
#define portPOINTER_SIZE_TYPE      uintptr_t
#define portMAX_DELAY              ( ( TickType_t ) 0xffffffffUL )
#define portTICK_TYPE_IS_ATOMIC    1
#define portSTACK_GROWTH           ( -1 )
#define portBYTE_ALIGNMENT         16
#define portTICK_PERIOD_MS         ( ( TickType_t ) 1000 / configTICK_RATE_HZ )
#define portNOP()
#define portMEMORY_BARRIER()       __asm volatile ( "" ::: "memory" )

/* Accessed by the core's thread only: by tasks, and by the signal handlers that interrupt them.
 * Same fields as `Shared` in src/port/host/state.rs. */
struct TandemPort {
    volatile uint32_t masked;
    volatile uint32_t attention;
};
extern struct TandemPort tandem_port;

extern void tandem_port_attend( void );
extern void tandem_port_yield( void );
extern void tandem_port_yield_from_interrupt( void );

static inline void tandem_mask( void )
{
    tandem_port.masked++;
    portMEMORY_BARRIER();
}

static inline void tandem_unmask( void )
{
    portMEMORY_BARRIER();
    tandem_port.masked--;
    portMEMORY_BARRIER();
    if( ( tandem_port.masked == 0 ) && ( tandem_port.attention != 0 ) ) {
        tandem_port_attend();
    }
}

#define portENTER_CRITICAL()                      tandem_mask()
#define portEXIT_CRITICAL()                       tandem_unmask()
#define portSET_INTERRUPT_MASK_FROM_ISR()         ( tandem_mask(), ( UBaseType_t ) 0 )
#define portCLEAR_INTERRUPT_MASK_FROM_ISR( x )    ( ( void ) ( x ), tandem_unmask() )
/* Only the start and the end of the scheduler use these; the port masks there itself. */
#define portDISABLE_INTERRUPTS()
#define portENABLE_INTERRUPTS()

#define portYIELD()                               tandem_port_yield()
#define portEND_SWITCHING_ISR( x )                do { if( x ) tandem_port_yield_from_interrupt(); } while( 0 )
#define portYIELD_FROM_ISR( x )                   portEND_SWITCHING_ISR( x )

#define portRECORD_READY_PRIORITY( p, set )       ( set ) |= ( 1UL << ( p ) )
#define portRESET_READY_PRIORITY( p, set )        ( set ) &= ~( 1UL << ( p ) )
#define portGET_HIGHEST_PRIORITY( top, set )      ( top ) = ( 63UL - ( UBaseType_t ) __builtin_clzl( set ) )

#define portTASK_FUNCTION_PROTO( vFunction, pvParameters )    void vFunction( void * pvParameters )
#define portTASK_FUNCTION( vFunction, pvParameters )          void vFunction( void * pvParameters )

#endif
