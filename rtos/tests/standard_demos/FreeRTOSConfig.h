/* The crate's configuration, and what FreeRTOS's standard demo tasks need beyond it. */
#include "../../kernel/FreeRTOSConfig.h"

#ifndef STANDARD_DEMOS_CONFIG_H
#define STANDARD_DEMOS_CONFIG_H

#undef configUSE_TICK_HOOK
#define configUSE_TICK_HOOK                      1
#undef configUSE_RECURSIVE_MUTEXES
#define configUSE_RECURSIVE_MUTEXES              1
#undef configUSE_EVENT_GROUPS
#define configUSE_EVENT_GROUPS                   1
#undef configUSE_STREAM_BUFFERS
#define configUSE_STREAM_BUFFERS                 1
#undef configTASK_NOTIFICATION_ARRAY_ENTRIES
#define configTASK_NOTIFICATION_ARRAY_ENTRIES    3
#undef configSUPPORT_DYNAMIC_ALLOCATION
#define configSUPPORT_DYNAMIC_ALLOCATION         1
#undef INCLUDE_xTimerPendFunctionCall
#define INCLUDE_xTimerPendFunctionCall           1
#define INCLUDE_xTaskAbortDelay                  1
#define INCLUDE_xTaskGetHandle                   1
#define portDOUBLE                               double

/* The demo of two cores is told when a message was sent. */
#ifdef SENT
    extern void SENT( void * buffer );
    #define sbSEND_COMPLETED( buffer )           SENT( buffer )
#endif

/* The Rust side makes two tasks, which do not end; the memory of the others is not its own. */
#undef portCLEAN_UP_TCB
#define portCLEAN_UP_TCB( pxTCB )                ( ( void ) ( pxTCB ) )

#endif
