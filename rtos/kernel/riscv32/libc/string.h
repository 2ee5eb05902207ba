/* The functions of string.h that the kernel uses; Rust's compiler_builtins has them. */
#ifndef TANDEM_STRING_H
#define TANDEM_STRING_H
#include <stddef.h>
void * memcpy( void * to, const void * from, size_t bytes );
void * memset( void * to, int value, size_t bytes );
int memcmp( const void * left, const void * right, size_t bytes );
size_t strlen( const char * text );
#endif
