/* Macros of the kernel as functions for the Rust side, and checks of sizes. */
#include "FreeRTOS.h"
#include "task.h"
#include "queue.h"
#include "timers.h"

#define WORDS( bytes )    ( ( ( bytes ) + sizeof( void * ) - 1 ) / sizeof( void * ) )
_Static_assert( WORDS( sizeof( StaticTask_t ) ) <= TANDEM_TASK_WORDS, "TASK_WORDS in build.rs" );
_Static_assert( WORDS( sizeof( StaticQueue_t ) ) <= TANDEM_QUEUE_WORDS, "QUEUE_WORDS in build.rs" );
_Static_assert( WORDS( sizeof( StaticTimer_t ) ) <= TANDEM_TIMER_WORDS, "TIMER_WORDS in build.rs" );
/* The Rust side declares these types by their width. */
_Static_assert( sizeof( BaseType_t ) == sizeof( void * ), "BaseType_t is isize" );
_Static_assert( sizeof( UBaseType_t ) == sizeof( void * ), "UBaseType_t is usize" );
_Static_assert( sizeof( TickType_t ) == 4, "TickType_t is u32" );
_Static_assert( sizeof( StackType_t ) == sizeof( void * ), "StackType_t is usize" );
_Static_assert( sizeof( configSTACK_DEPTH_TYPE ) == sizeof( void * ), "stack depth is usize" );

#if defined( __riscv )
volatile UBaseType_t tandem_held = 0;
volatile UBaseType_t tandem_yield_due = 0;

/* The kernel's port: above zero until the first task runs, so that interrupts stay masked. */
extern size_t xCriticalNesting;

/* As at power-on. */
void tandem_port_reset( void )
{
    xCriticalNesting = ( size_t ) 0xaaaaaaaa;
    tandem_held = 0;
    tandem_yield_due = 0;
}

void tandem_enter_critical( void )
{
    taskENTER_CRITICAL();
    tandem_held++;
}

void tandem_exit_critical( void )
{
    UBaseType_t due = 0;
    tandem_held--;
    if( tandem_held == 0 ) {
        due = tandem_yield_due;
        tandem_yield_due = 0;
    }
    taskEXIT_CRITICAL();
    if( due != 0 ) {
        taskYIELD();
    }
}
#else
void tandem_enter_critical( void )
{
    taskENTER_CRITICAL();
}

void tandem_exit_critical( void )
{
    taskEXIT_CRITICAL();
}
#endif

void tandem_yield( void )
{
    taskYIELD();
}

void tandem_yield_from_interrupt( BaseType_t woken )
{
    portYIELD_FROM_ISR( woken );
}

/* Same fields as `ffi::TaskInfo`. */
struct TandemTaskInfo {
    UBaseType_t number;
    UBaseType_t priority;
    UBaseType_t base_priority;
    UBaseType_t unused_stack_words;
    uint64_t run_time;
};

void tandem_task_info( TaskHandle_t task, struct TandemTaskInfo * info )
{
    TaskStatus_t status;
    vTaskGetInfo( task, &status, pdFALSE, eReady );
    info->number = status.xTaskNumber;
    info->priority = status.uxCurrentPriority;
    info->base_priority = status.uxBasePriority;
    info->unused_stack_words = uxTaskGetStackHighWaterMark( task );
    info->run_time = status.ulRunTimeCounter;
}

#if defined( __riscv )
extern void tandem_riscv_interrupt( uint32_t cause );
extern void tandem_riscv_exception( uint32_t cause );

/* Strong definitions in place of the port's weak ones. */
void freertos_risc_v_application_interrupt_handler( uint32_t cause )
{
    tandem_riscv_interrupt( cause );
}

void freertos_risc_v_application_exception_handler( uint32_t cause )
{
    tandem_riscv_exception( cause );
}
#endif
