/* A program without a C library: a process entry, the two functions that compilers ask of every environment, and a controller
 * in static memory. The image is linked in. Its exit status is that of the first call that failed, 0 for none. */
#include <lads.h>

#include "../../examples/targets/memory.h"

extern const unsigned char image_start[], image_end[];

static lads_policy policy;
static _Alignas(LADS_WORKSPACE_ALIGN) unsigned char workspace[WORKSPACE_BYTES];

static lads_status run(void) {
    lads_controller *controller;
    lads_status status = lads_policy_open(image_start, (size_t)(image_end - image_start), &policy);
    if (status != LADS_STATUS_OK) {
        return status;
    }
    status = lads_controller_init(&policy, workspace, sizeof workspace, NULL, &controller, NULL);
    return status == LADS_STATUS_OK ? lads_self_test(controller, NULL) : status;
}

static _Noreturn void leave(long status) {
    for (;;) {
        __asm__ volatile("syscall" : : "a"(60L), "D"(status) : "rcx", "r11", "memory");
    }
}

__attribute__((used)) static void start(void) { leave(run()); }

__asm__(".globl _start\n_start: andq $-16, %rsp\n call start\n");
