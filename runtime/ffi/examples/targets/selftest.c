/* Runs the self-test of the image that is linked in, then an episode of its own that is longer than a context of 50 steps, and
 * prints a hash of all bits of the actions of both: the same on every target. Hosted, or bare on Cortex-M with semihosting
 * (startup.c), where it also says how much stack was used and how many instructions a control step executed. */
#include <lads.h>

#ifndef WORKSPACE_BYTES
#define WORKSPACE_BYTES (64 * 1024)
#endif
enum { OBSERVATION_MOST = 64, ACTION_MOST = 16, STEPS = 70 };

extern const unsigned char IMAGE[IMAGE_BYTES];
void say(const char *text);
/* Of startup.c. */
void say_number(const char *what, uint32_t number, const char *unit);
void count_from_here(void);
uint32_t instructions_counted(void);

static lads_policy policy;
static _Alignas(LADS_WORKSPACE_ALIGN) unsigned char workspace[WORKSPACE_BYTES];

static void say_hash(const char *what, uint32_t hash) {
    char text[] = "00000000\n";
    for (int digit = 0; digit < 8; digit++) {
        text[7 - digit] = "0123456789abcdef"[hash >> 4 * digit & 15];
    }
    say(what);
    say(text);
}

int run(void) {
    lads_contract contract = {.struct_bytes = sizeof contract};
    lads_element element = {.struct_bytes = sizeof element};
    lads_self_test_t tested = {.struct_bytes = sizeof tested};
    lads_controller *controller;
    float observation[OBSERVATION_MOST], action[ACTION_MOST];
    lads_status status = lads_policy_open(IMAGE, IMAGE_BYTES, &policy);
    if (status == LADS_STATUS_OK) {
        status = lads_controller_init(&policy, workspace, sizeof workspace, NULL, &controller, NULL);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_self_test(controller, &tested);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_set_instruction(controller, 0);
    }
    if (status == LADS_STATUS_OK) {
        status = lads_policy_contract(&policy, &contract);
    }
    if (status != LADS_STATUS_OK || contract.observation_len > OBSERVATION_MOST || contract.action_len > ACTION_MOST) {
        say(lads_status_text(status));
        say("\n");
        return 1;
    }
    say_hash("self-test passed, actions ", tested.digest);
    uint32_t hash = 2166136261u, random = 1, most = 0, sum = 0;
    for (int step = 0; step < STEPS; step++) {
        for (size_t i = 0; i < contract.observation_len; i++) {
            lads_channel_element(&policy, contract.observation, i, &element);
            random = random * 1664525u + 1013904223u;
            const float share = (float)(random >> 16) / 65536.0f;
            const float width = element.max - element.min;
            const float part = width * share;
            observation[i] = element.min + part;
        }
        count_from_here();
        status = lads_step(controller, observation, contract.observation_len, NULL, action, contract.action_len, NULL);
        const uint32_t executed = instructions_counted();
        most = executed > most ? executed : most;
        sum += executed;
        if (status != LADS_STATUS_OK) {
            say(lads_status_text(status));
            say("\n");
            return 2;
        }
        for (size_t i = 0; i < contract.action_len; i++) {
            union { float value; uint32_t bits; } word = {.value = action[i]};
            for (int shift = 0; shift < 32; shift += 8) {
                hash = (hash ^ (word.bits >> shift & 255u)) * 16777619u;
            }
        }
    }
    say_hash("own episode, actions ", hash);
    if (most > 0) {
        say_number("step ", sum / STEPS, " instructions in the mean,");
        say_number(" ", most, " at most\n");
    }
    return 0;
}

#if __STDC_HOSTED__
#include <stdio.h>
void say(const char *text) { fputs(text, stdout); }
void say_number(const char *what, uint32_t number, const char *unit) { printf("%s%lu%s", what, (unsigned long)number, unit); }
void count_from_here(void) {}
uint32_t instructions_counted(void) { return 0; }
int main(void) { return run(); }
#endif
