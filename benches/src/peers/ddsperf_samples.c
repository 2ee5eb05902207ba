/* Loaded into ddsperf, which prints no 99.9th percentile. Once a second it sorts the latencies of
 * that second, in ns: they are written to the file descriptor TANDEM_SAMPLES, in the order in which
 * they were measured. Nothing of this is timed. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <unistd.h>

typedef int (*comparison)(const void *, const void *);

void qsort(void *elements, size_t count, size_t size, comparison compare)
{
    static void (*sort)(void *, size_t, size_t, comparison);
    const char *descriptor = getenv("TANDEM_SAMPLES");
    /* Nothing else that it sorts has so many elements. */
    if (descriptor && size == 8 && count >= 100) {
        const char *bytes = elements;
        size_t left = count * size;
        while (left > 0) {
            ssize_t written = write(atoi(descriptor), bytes, left);
            if (written <= 0)
                break;
            bytes += written;
            left -= written;
        }
    }
    if (!sort)
        sort = (void (*)(void *, size_t, size_t, comparison))dlsym(RTLD_NEXT, "qsort");
    sort(elements, count, size, compare);
}
