/* Start-up of a Cortex-M with a floating-point unit, and its way to speak: semihosting, which qemu and debuggers understand. */
#include <stdint.h>

#include "memory.h"

extern uint32_t stack_top, data_start, data_end, data_load, bss_start, bss_end;
int run(void);
void say(const char *text);
void reset(void);

static int semihosting(int operation, const void *argument) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

void say(const char *text) { semihosting(0x04, text); }

static void leave(int status) {
    /* SYS_EXIT_EXTENDED with ADP_Stopped_ApplicationExit */
    const uint32_t reason[2] = {0x20026, (uint32_t)status};
    semihosting(0x20, reason);
    for (;;) {
    }
}

static void fault(void) { leave(99); }

/* The stack grows down from the end of the memory to the data: what is free is painted, and what is no longer paint was used. */
#define PAINT 0xa5a5a5a5u

static void __attribute__((noinline)) paint(void) {
    /* Up to well below this function's own frame. */
    const uintptr_t end = (uintptr_t)__builtin_frame_address(0) - 64;
    for (uintptr_t free = (uintptr_t)&bss_end; free < end; free += sizeof(uint32_t)) {
        *(volatile uint32_t *)free = PAINT;
    }
}

void say_number(const char *what, uint32_t number, const char *unit) {
    char text[] = "0000000000";
    int digit = sizeof text - 1;
    do {
        text[--digit] = (char)('0' + number % 10);
        number /= 10;
    } while (number > 0 && digit > 0);
    say(what);
    say(text + digit);
    say(unit);
}

static void say_stack(void) {
    const volatile uint32_t *untouched = &bss_end;
    while (untouched < &stack_top && *untouched == PAINT) {
        untouched++;
    }
    say_number("stack ", (uint32_t)((uintptr_t)&stack_top - (uintptr_t)untouched), " bytes\n");
}

/* The core's own timer, which counts down from its largest number. Under `qemu -icount shift=0` an instruction takes a nanosecond; the boards'
 * clock has 25 MHz, so that a tick is forty instructions. */
#define SYST_CSR (*(volatile uint32_t *)0xe000e010)
#define SYST_RVR (*(volatile uint32_t *)0xe000e014)
#define SYST_CVR (*(volatile uint32_t *)0xe000e018)
enum { TICKS_MOST = 0xffffff, INSTRUCTIONS_PER_TICK = 40 };

void count_from_here(void) {
    SYST_RVR = TICKS_MOST;
    SYST_CVR = 0;
    SYST_CSR = 5;
}

uint32_t instructions_counted(void) { return (TICKS_MOST - SYST_CVR) * INSTRUCTIONS_PER_TICK; }

void reset(void) {
    /* Full access to the floating-point unit. */
    *(volatile uint32_t *)0xe000ed88 |= 0xfu << 20;
    __asm__ volatile("dsb\n isb");
    uint32_t *from = &data_load;
    for (uint32_t *to = &data_start; to < &data_end; to++) {
        *to = *from++;
    }
    for (uint32_t *to = &bss_start; to < &bss_end; to++) {
        *to = 0;
    }
    paint();
    const int status = run();
    say_stack();
    leave(status);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &stack_top, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault, 0,
    0,          0,             0,             (void *)fault, (void *)fault, 0,             (void *)fault, (void *)fault};
