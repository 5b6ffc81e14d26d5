/*
 * files.h: what the example programs share: an image out of a file, in memory that the library takes.
 *
 * For programs with an operating system; define _POSIX_C_SOURCE first. On a microcontroller the image lies in flash instead:
 * `lads compile --emit-c`.
 */
#ifndef EXAMPLE_FILES_H
#define EXAMPLE_FILES_H

#include <lads.h>

#include <stdio.h>
#include <stdlib.h>

/* Memory that starts on a cache line. */
static inline void *lines(size_t bytes) {
    void *memory = NULL;
    return posix_memalign(&memory, LADS_WORKSPACE_ALIGN, bytes) == 0 ? memory : NULL;
}

static inline unsigned char *read_file(const char *path, size_t *bytes) {
    FILE *file = fopen(path, "rb");
    unsigned char *content = NULL;
    long end = -1;
    if (file != NULL && fseek(file, 0, SEEK_END) == 0 && (end = ftell(file)) > 0) {
        *bytes = (size_t)end;
        content = lines(*bytes);
        rewind(file);
        if (content != NULL && fread(content, 1, *bytes, file) != *bytes) {
            free(content);
            content = NULL;
        }
    }
    if (file != NULL) {
        fclose(file);
    }
    return content;
}

#endif
