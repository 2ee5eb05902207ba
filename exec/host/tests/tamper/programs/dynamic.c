/* Prints which build of itself and of its libraries runs, and its environment. Ends with its input. */
#include <stdio.h>
#include <string.h>

const char *first(void);
extern char **environ;

int main(int argc, char **argv)
{
    int variables = 0;
    while (environ[variables])
        variables++;
    printf("%s-dynamic %s %d %d %s, %s\n", TOKEN, first(), argc, variables, argv[0], strerror(1));
    fflush(stdout);
    while (getchar() != EOF)
        ;
    return 0;
}
