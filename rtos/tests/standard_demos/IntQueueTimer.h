/* The two interrupts that a board gives FreeRTOS's demo of queues in nested interrupts. */
extern void vInitialiseTimerForIntQueueTest( void );
extern BaseType_t xFirstTimerHandler( void );
extern BaseType_t xSecondTimerHandler( void );
