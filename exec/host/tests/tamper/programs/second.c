/* A library that another library needs. */
const char *second(void) { return TOKEN "-second"; }
