/* The program that each supervisor starts ten times: it reports that it is ready, by the protocol of
 * its supervisor, then tells the benchmark when that was, and waits until it is killed.
 *
 *   ready PROTOCOL INDEX WITNESS
 *
 * PROTOCOL is `notify` (systemd's, and Tandem's), `fd3` (s6's), or `none` (runit has no protocol).
 * WITNESS is the path of the benchmark's datagram socket. */
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

static int tell(const char *path, const char *text) {
    struct sockaddr_un to = {.sun_family = AF_UNIX};
    size_t length = path ? strlen(path) : 0;
    if (length == 0 || length >= sizeof to.sun_path) return 1;
    memcpy(to.sun_path, path, length);
    /* A name that begins with `@` is in the abstract namespace. */
    if (path[0] == '@') to.sun_path[0] = 0;
    int from = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    if (from < 0) return 1;
    socklen_t size = offsetof(struct sockaddr_un, sun_path) + length;
    int failed = sendto(from, text, strlen(text), 0, (struct sockaddr *)&to, size) < 0;
    close(from);
    return failed;
}

int main(int count, char **words) {
    if (count != 4) return 2;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    int failed = 0;
    if (!strcmp(words[1], "notify")) failed = tell(getenv("NOTIFY_SOCKET"), "READY=1\n");
    if (!strcmp(words[1], "fd3")) failed = write(3, "\n", 1) != 1 || close(3);
    char text[64];
    snprintf(text, sizeof text, "%s %lld", words[2], now.tv_sec * 1000000000LL + now.tv_nsec);
    if (failed || tell(words[3], text)) return 1;
    for (;;) pause();
}
