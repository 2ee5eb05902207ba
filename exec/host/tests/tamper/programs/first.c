/* A library that needs another one. */
#include <stdio.h>

const char *second(void);

const char *first(void)
{
    static char text[64];
    snprintf(text, sizeof text, "%s-first %s", TOKEN, second());
    return text;
}
