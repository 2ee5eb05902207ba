/* The kernel includes stdlib.h, but uses nothing of it in this configuration. */
#ifndef TANDEM_STDLIB_H
#define TANDEM_STDLIB_H
#include <stddef.h>
#endif
