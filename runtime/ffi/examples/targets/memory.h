/* The two functions that compilers ask of every environment, for a program without a C library; to be included in one of its files. */
#include <stddef.h>

void *memcpy(void *restrict to, const void *restrict from, size_t bytes) {
    unsigned char *t = to;
    const unsigned char *f = from;
    while (bytes-- > 0) {
        *t++ = *f++;
    }
    return to;
}

void *memset(void *to, int value, size_t bytes) {
    unsigned char *t = to;
    while (bytes-- > 0) {
        *t++ = (unsigned char)value;
    }
    return to;
}
