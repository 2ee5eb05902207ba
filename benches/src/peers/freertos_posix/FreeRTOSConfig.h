/* The peer's configuration. Options that affect the times are as in rtos/kernel/FreeRTOSConfig.h;
 * options that the measurement does not use are left out, so they have the kernel's defaults. */
#ifndef FREERTOS_CONFIG_H
#define FREERTOS_CONFIG_H

#define configUSE_PREEMPTION                       1
#define configTICK_RATE_HZ                         1000
#define configTICK_TYPE_WIDTH_IN_BITS              TICK_TYPE_WIDTH_64_BITS
#define configMAX_PRIORITIES                       32
#define configMINIMAL_STACK_SIZE                   8192
#define configUSE_IDLE_HOOK                        1
#define configUSE_TICK_HOOK                        1
#define configUSE_MUTEXES                          1
#define configUSE_EVENT_GROUPS                     0
#define configUSE_STREAM_BUFFERS                   0
#define configSUPPORT_STATIC_ALLOCATION            0
#define configSUPPORT_DYNAMIC_ALLOCATION           1

#define INCLUDE_vTaskDelay                         1
#define INCLUDE_xTaskDelayUntil                    1
#define INCLUDE_vTaskSuspend                       1
#define INCLUDE_xTaskGetSchedulerState             1

#endif
