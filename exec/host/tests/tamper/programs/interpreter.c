/* Prints the script that it is given. */
#include <stdio.h>

int main(int argc, char **argv)
{
    FILE *script = argc > 2 ? fopen(argv[2], "r") : NULL;
    int byte;
    if (!script)
        return 1;
    printf("%s-interpreter %s ", TOKEN, argv[1]);
    while ((byte = getc(script)) != EOF)
        putchar(byte);
    return 0;
}
