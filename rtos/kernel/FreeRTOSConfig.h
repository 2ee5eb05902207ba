/* The kernel's configuration: that of the thesis (T-RTOS-1), for every port. */
#ifndef FREERTOS_CONFIG_H
#define FREERTOS_CONFIG_H

#include "tandem_hooks.h"

/* Scheduling: pre-emptive by priority, round robin among equals, tick of 1 kHz. */
#define configUSE_PREEMPTION                       1
#define configUSE_TIME_SLICING                     1
#define configTICK_RATE_HZ                         1000
#define configTICK_TYPE_WIDTH_IN_BITS              TICK_TYPE_WIDTH_32_BITS
#define configMAX_PRIORITIES                       32
#define configUSE_PORT_OPTIMISED_TASK_SELECTION    1
#define configIDLE_SHOULD_YIELD                    1
#define configMAX_TASK_NAME_LEN                    24
#define configUSE_TICKLESS_IDLE                    0
#define configUSE_IDLE_HOOK                        1
#define configUSE_TICK_HOOK                        0

/* Functions that tasks use. */
#define configUSE_COUNTING_SEMAPHORES              1
#define configUSE_MUTEXES                          1
#define configUSE_RECURSIVE_MUTEXES                0
#define configUSE_QUEUE_SETS                       1
#define configUSE_TASK_NOTIFICATIONS               1
#define configTASK_NOTIFICATION_ARRAY_ENTRIES      1
#define configUSE_EVENT_GROUPS                     0
#ifndef configUSE_STREAM_BUFFERS
#define configUSE_STREAM_BUFFERS                   0
#endif
#define configUSE_CO_ROUTINES                      0
#define configENABLE_BACKWARD_COMPATIBILITY        0

/* The service task of the software timers is more urgent than every other task. */
#define configUSE_TIMERS                           1
#define configTIMER_TASK_PRIORITY                  ( configMAX_PRIORITIES - 1 )
#define configTIMER_QUEUE_LENGTH                   32
#define configTIMER_TASK_STACK_DEPTH               configMINIMAL_STACK_SIZE

/* The Rust side provides all memory. */
#define configSUPPORT_STATIC_ALLOCATION            1
#define configSUPPORT_DYNAMIC_ALLOCATION           0

/* Checks and statistics. */
#define configCHECK_FOR_STACK_OVERFLOW             2
#define configUSE_MALLOC_FAILED_HOOK               0
#define configUSE_TRACE_FACILITY                   1
#define configUSE_STATS_FORMATTING_FUNCTIONS       0
#define configGENERATE_RUN_TIME_STATS              1
#define configRUN_TIME_COUNTER_TYPE                uint64_t
#define portCONFIGURE_TIMER_FOR_RUN_TIME_STATS()
#define portGET_RUN_TIME_COUNTER_VALUE()           tandem_run_time()
#define configASSERT( x )                          \
    do {                                           \
        if( ( x ) == 0 ) {                         \
            tandem_assert( __FILE__, __LINE__ );   \
        }                                          \
    } while( 0 )

#define INCLUDE_vTaskDelay                         1
#define INCLUDE_xTaskDelayUntil                    1
#define INCLUDE_vTaskDelete                        1
#define INCLUDE_vTaskSuspend                       1
#define INCLUDE_vTaskPrioritySet                   1
#define INCLUDE_uxTaskPriorityGet                  1
#define INCLUDE_uxTaskGetStackHighWaterMark        1
#define INCLUDE_xTaskGetCurrentTaskHandle          1
#define INCLUDE_xTaskGetIdleTaskHandle             1
#define INCLUDE_xTaskGetSchedulerState             1
#define INCLUDE_xSemaphoreGetMutexHolder           1
#define INCLUDE_xTimerPendFunctionCall             0
#define INCLUDE_eTaskGetState                      1

/* Trace: one test of a pointer without a sink. The numbers are those in `sys/mod.rs`. */
#define tandemTRACE( kind, task )                                          \
    do {                                                                   \
        if( tandem_trace_sink != 0 ) {                                     \
            tandem_trace( ( kind ), ( uint32_t ) ( task )->uxTCBNumber );  \
        }                                                                  \
    } while( 0 )
#define traceTASK_SWITCHED_IN()                    tandemTRACE( 1, pxCurrentTCB )
#define traceTASK_SWITCHED_OUT()                   tandemTRACE( 2, pxCurrentTCB )
#define traceMOVED_TASK_TO_READY_STATE( pxTCB )    tandemTRACE( 3, pxTCB )

#if defined( __riscv )
    /* QEMU virt: CLINT at 0x0200_0000, mtime at 10 MHz. */
    #define configCPU_CLOCK_HZ            10000000
    #define configMTIME_BASE_ADDRESS      0x0200BFF8UL
    #define configMTIMECMP_BASE_ADDRESS   0x02004000UL
    #define configISR_STACK_SIZE_WORDS    1024
    #define configMINIMAL_STACK_SIZE      512
#else
    #define configCPU_CLOCK_HZ            1000000000
    /* 64 KiB: frames of signals hold the vector registers, and Rust's formatting needs much. */
    #define configMINIMAL_STACK_SIZE      8192
#endif

#endif
