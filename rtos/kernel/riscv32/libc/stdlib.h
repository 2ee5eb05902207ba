/* The kernel includes stdlib.h and uses nothing of it in our configuration. */
#ifndef TANDEM_STDLIB_H
#define TANDEM_STDLIB_H
#include <stddef.h>
#endif
