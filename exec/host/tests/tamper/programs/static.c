/* Prints which build runs. It is also what takes the place of a loader. */
#include <stdio.h>

int main(int argc, char **argv)
{
    printf("%s-static %d %s\n", TOKEN, argc, argv[0]);
    return 0;
}
